"""ARCTIC: raw files as published, head camera, body and offsets, and described ranges that overlap in time."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from hoidata.conversion.convert import convert_dataset
from hoidata.datasets import Quarantined, RawTree
from hoidata.datasets.arctic.adapter import (
    ArcticAdapter,
    Description,
    parse_description,
    parse_descriptions,
    parse_misc,
    parse_parts,
)
from hoidata.errors import BadInput
from hoidata.splits.definitions import find_leaks
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store_check.check import check_store
from tests.builders import arctic as recording
from tests.builders.stores import write_annotated


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return recording.write_root(tmp_path)


def first(load_all, root: Path, **settings):
    return load_all(ArcticAdapter(**settings), root)[0]


def test_a_shift_of_three_numbers_per_frame_is_the_same_as_one_of_three_rows(root, load_all):
    head = recording.head()
    recording.write_extra(root, "egocam.dist", head)
    expected = first(load_all, root).camera.position_m
    recording.write_extra(root, "egocam.dist", head | {"T_k_cam_np": head["T_k_cam_np"][:, :, 0]})
    np.testing.assert_array_equal(first(load_all, root).camera.position_m, expected)


def test_a_subject_that_misc_json_lacks_has_images_numbered_like_frames(root, load_all):
    recording.write_extra(root, "egocam.dist", recording.head())
    (root / "meta" / "misc.json").write_text(json.dumps({"s01": {"ioi_offset": 5}}))
    assert first(load_all, root).camera.images[0] == 0


def test_the_body_is_included_on_request_only(root, load_all):
    recording.write_extra(root, "smplx", recording.body())
    assert first(load_all, root).body is None
    clip = load_all(ArcticAdapter(body=True), root)[1]
    stored = {name: value[14:44] for name, value in recording.body().items()}
    np.testing.assert_array_equal(clip.body.transl_m, stored["transl"])
    np.testing.assert_array_equal(clip.body.global_orient, stored["global_orient"])
    np.testing.assert_array_equal(clip.body.body_pose, stored["body_pose"])
    face = np.concatenate([stored["jaw_pose"], stored["leye_pose"], stored["reye_pose"]], axis=1)
    np.testing.assert_array_equal(clip.body.face_pose, face)
    assert clip.body.expression is None


def write_parts(root: Path, scale: float = 1.0, names: tuple[str, ...] = ("bottom", "top")) -> None:
    """Meshes of both parts with another topology than mesh.obj: a vertex more, in the middle of each."""
    quads = {"bottom": recording.BOTTOM_MM, "top": recording.TOP_MM}
    for name in names:
        corners = np.array([*quads[name], np.mean(quads[name], axis=0)]) * scale
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {a % 4 + 1} 5" for a in range(1, 5)]
        path = root / "meta" / "object_vtemplates" / "box" / f"{name}.obj"
        path.write_text("\n".join(lines) + "\n")


def test_the_release_s_separate_parts_are_used_where_both_are_there(root, load_all):
    whole = first(load_all, root).object.model
    write_parts(root, names=("top",))
    np.testing.assert_array_equal(first(load_all, root).object.model.vertices_m, whole.vertices_m)
    write_parts(root)
    model = first(load_all, root).object.model
    assert model.part.tolist() == [0] * 5 + [1] * 5
    assert (len(model.faces_of(0)), len(model.faces_of(1)), model.seam_triangles) == (4, 4, 0)
    np.testing.assert_allclose(model.vertices_m[:4], np.array(recording.BOTTOM_MM) / 1000)
    np.testing.assert_allclose(model.vertices_m[5:9], np.array(recording.TOP_MM) / 1000)


def test_separate_parts_in_another_unit_than_mesh_obj_are_refused_by_name(root, load_all):
    write_parts(root, scale=0.001)
    with pytest.raises(
        BadInput, match=r"box of meta/object_vtemplates/box/mesh.obj, within 5 mm, got .* 200 mm"
    ) as caught:
        load_all(ArcticAdapter(), root)
    assert caught.value.where.endswith("box/bottom.obj, meta/object_vtemplates/box/top.obj")


def test_whole_sequences_need_no_description_and_have_no_verb(root, load_all):
    shutil.rmtree(root / "description")
    clip = first(load_all, root, clips="whole")
    assert clip.clip_id == "arctic/s04/box_grab_01"
    assert (clip.verb, clip.labelled_hand, clip.object_words) == (None, None, "box")
    assert clip.source_frames.tolist() == list(range(70))
    assert len(load_all(ArcticAdapter(clips="whole"), root)) == 1


def test_whole_sequences_can_leave_out_their_ends(root, load_all):
    recording.write_extra(root, "egocam.dist", recording.head())
    clip = first(load_all, root, clips="whole", trimmed_frames=10)
    assert clip.source_frames.tolist() == clip.camera.images.tolist() == list(range(10, 60))
    with pytest.raises(BadInput) as caught:
        first(load_all, root, clips="whole", trimmed_frames=35)
    assert "more than 70 frames" in caught.value.expected


def test_espressomachine_has_no_description_and_is_used_as_a_whole(root, load_all):
    recording.write_sequence(root, "espressomachine_use_01")
    recording.write_template(root, "espressomachine")
    (root / "description/s04/espressomachine_use_01/description.txt").unlink()
    words = {clip.object_words for clip in load_all(ArcticAdapter(clips="whole"), root)}
    assert words == {"box", "espresso machine"}
    adapter = ArcticAdapter()
    key = adapter.sequences(root)[1]
    with pytest.raises(BadInput) as caught:
        adapter.load(RawTree(root), key, None)
    assert "espressomachine" in caught.value.remedy


def test_sequences_without_a_description_can_be_cut_into_segments_next_to_described_ones(root, load_all):
    described = load_all(ArcticAdapter(), root)
    recording.write_sequence(root, "espressomachine_use_01")
    recording.write_template(root, "espressomachine")
    (root / "description/s04/espressomachine_use_01/description.txt").unlink()
    both = load_all(ArcticAdapter(clips="described-else-segments"), root)
    words = [(clip.clip_id, clip.verb, clip.n_frames) for clip in both]
    whole = ("arctic/s04/espressomachine_use_01", None, 70)
    assert sorted(words, key=str) == sorted([*((c.clip_id, c.verb, c.n_frames) for c in described), whole], key=str)


@pytest.mark.parametrize("clips", ["described", "whole", "segments"])
def test_the_test_subject_whose_motion_is_withheld_is_named_as_such(root, hands, tmp_path_factory, clips):
    source, folder = root / "raw_seqs" / "s04", root / "raw_seqs" / "s03"
    folder.mkdir()
    np.save(folder / "box_grab_01.egocam.dist.npy", np.array(recording.head(), dtype=object))
    assert source.is_dir()
    out = tmp_path_factory.mktemp("store") / "clips"
    summary = convert_dataset(ArcticAdapter(clips=clips), root, hands, out, progress=False)
    (quarantined,) = summary.quarantined
    assert quarantined.source_key == "arctic/s03/box_grab_01"
    assert "withholds the motion of its test subject s03" in quarantined.got
    assert quarantined.remedy.startswith("nothing to do")
    assert summary.clips == {"described": 4, "whole": 1, "segments": 1}[clips]


def test_a_withheld_sequence_someone_does_have_converts_like_any_other(root, load_all):
    shutil.copytree(root / "raw_seqs" / "s04", root / "raw_seqs" / "s03")
    shutil.copytree(root / "description" / "s04", root / "description" / "s03")
    assert {clip.subject for clip in load_all(ArcticAdapter(), root)} == {"s03", "s04"}


@pytest.mark.parametrize("top", ["data", "arctic_data/data"])
def test_the_folders_may_lie_below_data(root, load_all, tmp_path_factory, top):
    download = tmp_path_factory.mktemp("download")
    shutil.copytree(root, download / top)
    assert [clip.clip_id for clip in load_all(ArcticAdapter(), download)] == [
        clip.clip_id for clip in load_all(ArcticAdapter(), root)
    ]
    (download / top / "raw_seqs/s04/box_grab_01.mano.npy").unlink()
    with pytest.raises(BadInput) as caught:
        load_all(ArcticAdapter(), download)
    assert caught.value.where == f"{top}/raw_seqs/s04/box_grab_01.mano.npy"


def test_files_are_paired_by_name_and_never_by_position(root, load_all):
    recording.write_sequence(root, "box_use_02")
    (root / "raw_seqs/s04/box_grab_01.mano.npy").unlink()
    (root / "raw_seqs/s04/box_use_02.object.npy").unlink()
    adapter = ArcticAdapter()
    assert [key.name for key in adapter.sequences(root)] == ["s04/box_grab_01", "s04/box_use_02"]
    for key, missing in zip(adapter.sequences(root), ("mano", "object"), strict=True):
        with pytest.raises(BadInput) as caught:
            adapter.load(RawTree(root), key, None)
        assert f"{key.name}.{missing}.npy" in caught.value.where


def test_descriptions_are_parsed_from_bytes_with_the_bad_lines_by_number():
    data = (
        b"\xef\xbb\xbf1-20 grab, left hand\r\n\r\n  \n30-25 lift, both hands\n31-60 take left hand\n5-9 , left hand\n"
    )
    described, problems = parse_descriptions(data, "here")
    assert described == [Description(1, 20, "grab", "left"), Description(31, 60, "take", "left")]
    assert [number for number, _ in problems] == [4, 6]
    assert [problem.where for _, problem in problems] == ["here:4", "here:6"]
    assert parse_descriptions(b"", "here") == ([], [])


def test_numbers_of_other_scripts_and_without_end_are_no_range():
    _, problems = parse_descriptions("१-२ open, left hand\n1-99999999999 open, left hand\n".encode(), "here")
    assert len(problems) == 2


def test_parts_say_which_vertices_belong_to_the_base():
    assert parse_parts(b"[1, 0, true, false]", "here", 4).tolist() == [True, False, True, False]
    for data in (b"[1, 0]", b"[1, 0, 1, null]", b"[1, 0, 1, [0]]", b"7", b"", b"[1, 0, 1, NaN]", b"\xff"):
        with pytest.raises(BadInput):
            parse_parts(data, "here", 4)


def test_misc_gives_the_image_offset_of_each_subject():
    assert parse_misc(b'{"s01": {"ioi_offset": 3, "gender": "male"}, "s02": {"ioi_offset": -1}}', "here") == {
        "s01": 3,
        "s02": -1,
    }
    for data in (b"", b"3", b'{"s01": 4}', b'{"s01": {"ioi_offset": true}}', b'{"s01": {"ioi_offset": 1e9}}', b"\xff"):
        with pytest.raises(BadInput):
            parse_misc(data, "here")


LINES = """1-40 grasp, left hand
21-60 open, right hand
21-60 lift, left hand
"""
HELD, OPENED, LIFTED = (f"arctic/s04/box_use_01/{name}" for name in ("0001-0040", "0021-0060-right", "0021-0060-left"))
NEAR_M = 0.4  # both hands are closer than this to the box in each range


@pytest.fixture
def annotated(tmp_path, load_clips):
    """The annotated store of a recording with those lines, by a rule for the hand."""
    recording.write_template(tmp_path / "raw", "box")
    recording.write_sequence(tmp_path / "raw", "box_use_01", LINES)
    clips = load_clips(ArcticAdapter(), tmp_path / "raw")

    def by_rule(hand: str) -> AnnotatedStore:
        rule = {"by": "subject", "train": "rest"}
        root = write_annotated(tmp_path / hand, clips, "arctic", rule, threshold_m=NEAR_M, points=64, hand=hand)
        assert not check_store(root / "clips")
        return load_annotated(root)

    return by_rule


def test_each_line_is_a_clip_with_the_range_hand_and_sentence_of_the_line(annotated):
    store = annotated("annotated-else-proximity")
    assert {key: store.sentences(key)[0] for key in store.ids()} == {
        HELD: "Grasp a box with the left hand.",
        OPENED: "Open a box with the right hand.",
        LIFTED: "Lift a box with the left hand.",
    }
    frames = {key: store.clip(key).source_frames for key in store.ids()}
    assert {key: (int(result[0]), int(result[-1])) for key, result in frames.items()} == {
        HELD: (0, 39),
        OPENED: (20, 59),
        LIFTED: (20, 59),
    }


def test_both_hands_of_such_a_clip_are_active_by_distance_and_the_annotated_hand_is_stored_too(annotated):
    store = annotated("proximity")
    assert set(store.hand_types["hand_type"]) == {"both"}
    assert store.hand_types["labelled_hand"].to_dict() == {HELD: "left", OPENED: "right", LIFTED: "left"}
    assert not store.hand_types["agreement"].any()
    assert store.sentences(OPENED)[0] == "Open a box with both hands."


def test_clips_that_share_frames_never_stand_in_two_parts_unnoticed(annotated):
    rows = annotated("proximity").store.sequences
    for parts in ({HELD: "train", OPENED: "test"}, {OPENED: "train", LIFTED: "test"}):
        assert find_leaks(rows, parts, ()).broken == ("frame",)


def test_one_hand_with_two_words_for_one_range_is_refused(annotated, tmp_path, load_clips):
    recording.write_sequence(tmp_path / "raw", "box_use_01", LINES + "21-60 place, left hand\n")
    with pytest.raises(BadInput, match="one line per range and hand"):
        load_clips(ArcticAdapter(), tmp_path / "raw")


@pytest.fixture
def clips(root, load_clips):
    return {clip.clip_id: clip for clip in load_clips(ArcticAdapter(), root)}


@pytest.fixture
def lift(clips):
    return clips["arctic/s04/box_grab_01/0015-0044-both"]


def test_words_and_hand_come_from_the_description(clips):
    words = {(clip.verb, clip.labelled_hand, clip.object_words) for clip in clips.values()}
    assert words == {
        ("grab", "left", "box"),
        ("lift", "both", "box"),
        ("close", "right", "box"),
        ("open", "right", "box"),
    }


def test_parts_may_be_json_booleans(root, load_all, lift):
    parts = root / "meta" / "object_vtemplates" / "box" / "parts.json"
    parts.write_text(json.dumps([True] * 4 + [False] * 4))
    again = load_all(ArcticAdapter(), root)[0]
    assert again.object.model.part.tolist() == lift.object.model.part.tolist()


@pytest.mark.parametrize(
    ("verb", "noun"), [("write", "notebook"), ("operate", "waffleiron"), ("push", "capsulemachine")]
)
def test_the_verb_object_pairs_that_text2hoi_excludes_give_no_clip(root, load_clips, verb, noun):
    lines = f"1-40 {verb}, right hand\n20-60 open, left hand\n"
    recording.write_sequence(root, f"{noun}_use_02", lines)
    recording.write_template(root, noun)
    assert [clip.verb for clip in load_clips(ArcticAdapter(), root) if noun in clip.clip_id] == ["open"]
    recording.write_sequence(root, "box_use_02", lines)
    assert [clip.verb for clip in load_clips(ArcticAdapter(), root) if "box_use" in clip.clip_id] == [verb, "open"]


def test_a_pair_text2hoi_leaves_out_is_listed_with_its_reason_and_kept_when_asked_for(root, load_all, load_clips):
    recording.write_sequence(root, "notebook_use_02", "1-40 write, right hand\n")
    recording.write_template(root, "notebook")
    (item,) = [item for item in load_all(ArcticAdapter(), root) if "notebook" in str(item)]
    assert (item.source_key, item.got) == ("arctic/s04/notebook_use_02/0001-0040", "write notebook")
    assert "all_pairs" in item.remedy
    verbs = [clip.verb for clip in load_clips(ArcticAdapter(all_pairs=True), root) if "notebook" in clip.clip_id]
    assert verbs == ["write"]


def test_a_range_of_19_frames_is_listed_with_its_reason(root, load_all):
    recording.write_sequence(root, "box_use_02", "1-19 open, left hand\n1-20 close, left hand\n")
    short, long = [item for item in load_all(ArcticAdapter(), root) if "box_use_02" in str(item)]
    assert (short.source_key, short.expected, short.got) == (
        "arctic/s04/box_use_02/0001-0019",
        "20 frames or more",
        "19",
    )
    assert long.n_frames == 20


def test_a_range_that_ends_one_frame_after_the_motion_is_rejected_and_not_shortened(root, load_all):
    recording.write_sequence(root, "box_use_02", "21-70 open, left hand\n31-71 close, left hand\n")
    whole, beyond = [item for item in load_all(ArcticAdapter(), root) if "box_use_02" in str(item)]
    assert whole.source_frames.tolist() == list(range(20, 70))
    assert (beyond.source_key, beyond.expected, beyond.got) == (
        "arctic/s04/box_use_02/0031-0071",
        "frames 1 to 70",
        "31-71",
    )


def test_trailing_digits_of_an_object_name_are_not_part_of_it(root, load_clips):
    recording.write_sequence(root, "box2_use_01", "1-40 open, left hand\n")
    (clip,) = [clip for clip in load_clips(ArcticAdapter(), root) if "box2" in clip.clip_id]
    assert (clip.object.model.name, clip.object_words) == ("box", "box")


@pytest.mark.parametrize(
    ("noun", "words"), [("capsulemachine", "capsule machine"), ("waffleiron", "waffle iron"), ("laptop", "laptop")]
)
def test_joined_object_names_become_words(root, load_clips, noun, words):
    recording.write_sequence(root, f"{noun}_use_01", "1-40 open, left hand\n")
    recording.write_template(root, noun)
    assert {clip.object_words for clip in load_clips(ArcticAdapter(), root) if noun in clip.clip_id} == {words}


def test_a_bad_line_is_listed_and_the_others_convert(root, load_all):
    recording.write_sequence(
        root, lines="1-30 lift, both hands\n31-60 open the box\n50-90 close, left hand\n40-20 grab, left hand\n"
    )
    results = load_all(ArcticAdapter(), root)
    left_out = [item for item in results if isinstance(item, Quarantined)]
    assert [item.where.rsplit(":", 1)[-1] for item in left_out[:2]] == ["2", "4"]
    assert "1 to 70" in left_out[2].expected
    assert len(results) - len(left_out) == 1


def test_a_description_line_has_four_words():
    assert parse_description("12-100 grab, right hand").stop == 100
    for line in ("12-100 grab, right", "12-100 grab, up hand", "a-b grab, left hand", "0-10 grab, left hand"):
        with pytest.raises(ValueError, match=r"words|range|hand"):
            parse_description(line)
