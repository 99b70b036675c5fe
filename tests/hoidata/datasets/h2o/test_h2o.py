"""H2O's adapter on handwritten text files, and the bitwise exact parser.

Also subject 4, whose action labels are withheld and whose segments are published.
"""

import shutil
import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Clip
from hoidata.datasets import Quarantined
from hoidata.datasets.h2o.adapter import H2OAdapter
from hoidata.datasets.h2o.files import Segment, parse_rows, parse_segments
from hoidata.errors import BadInput
from tests.builders.h2o import camera, object_in_camera, write_root, write_text


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_root(tmp_path)


@pytest.fixture
def clip(root, load_all):
    (clip,) = load_all(H2OAdapter(), root)
    return clip


def test_a_run_of_one_label_becomes_one_clip_with_its_words_and_source_frames(clip):
    assert (clip.clip_id, clip.subject) == ("h2o/subject2/k1/3/000003-000024", "subject2")
    assert (clip.verb, clip.object_words, clip.object.model.name) == ("take out", "chips", "chips")
    assert clip.source_frames.tolist() == list(range(3, 25))
    assert clip.gravity is None
    assert len(clip.hands["left"].betas) == 1  # equal in every frame


def test_source_frames_are_the_numbers_of_the_files_also_when_the_first_are_absent(root, clip, load_all):
    for path in sorted((root / "subject2/k1/3/cam4").glob("*/00000[01].txt")):
        path.unlink()
    (later,) = load_all(H2OAdapter(), root)
    assert later.clip_id == clip.clip_id
    assert later.source_frames.tolist() == list(range(3, 25))
    np.testing.assert_array_equal(later.hands["right"].wrist_m, clip.hands["right"].wrist_m)


def test_the_folder_names_of_the_readme_are_read_too(root, clip, load_all):
    folder = root / "subject2" / "k1" / "3" / "cam4"
    (folder / "hand_pose_mano").rename(folder / "hand_pose_MANO")
    (folder / "obj_pose_rt").rename(folder / "obj_pose_RT")
    (again,) = load_all(H2OAdapter(), root)
    np.testing.assert_array_equal(again.hands["right"].wrist_m, clip.hands["right"].wrist_m)


def test_twenty_frames_of_a_label_are_too_short_and_twenty_one_enough(root, load_all):
    labels = root / "subject2" / "k1" / "3" / "cam4" / "action_label"
    for frame in (3, 4):
        write_text(labels / f"{frame:06d}.txt", [0])
    (short,) = load_all(H2OAdapter(), root)
    assert isinstance(short, Quarantined)
    assert (short.source_key, short.got) == ("h2o/subject2/k1/3/000005-000024", "20 (frames 5 to 24)")
    write_text(labels / "000004.txt", [26])
    (clip,) = load_all(H2OAdapter(), root)
    assert clip.n_frames == 21


def test_a_margin_widens_the_clip_within_the_recording(root, load_all):
    (clip,) = load_all(H2OAdapter(margin_frames=5), root)
    assert clip.source_frames.tolist() == list(range(27))


def test_another_object_class_than_that_of_the_label_is_rejected_with_its_reason(root, load_all):
    write_text(root / "subject2/k1/3/cam4/obj_pose_rt/000010.txt", [5, *object_in_camera(10).ravel()])
    (item,) = load_all(H2OAdapter(), root)
    assert isinstance(item, Quarantined)
    assert "7 (chips)" in item.expected
    assert "[5, 7]" in item.got


def test_a_run_is_cut_to_the_frames_in_which_its_object_is_tracked(root, load_all):
    write_text(root / "subject2/k1/3/cam4/obj_pose_rt/000003.txt", [0, *np.zeros(16)])
    (clip,) = load_all(H2OAdapter(margin_frames=2), root)
    assert clip.clip_id.endswith("000004-000024")
    assert clip.source_frames[[0, -1]].tolist() == [4, 26]


def test_three_frames_without_the_object_are_bridged_and_marked_and_four_are_named_as_missing_poses(root, load_all):
    for frame in (8, 9, 10, 15):
        write_text(root / f"subject2/k1/3/cam4/obj_pose_rt/{frame:06d}.txt", [0, *np.zeros(16)])
    (clip,) = load_all(H2OAdapter(), root)
    interpolated = [8, 9, 10, 15]
    assert clip.camera.images.tolist() == list(range(3, 25))
    assert (np.flatnonzero(~clip.recorded) + 3).tolist() == interpolated
    assert clip.source_frames.tolist() == [7 if at in (8, 9, 10) else 14 if at == 15 else at for at in range(3, 25)]
    for frame in interpolated:
        truth = camera(frame) @ object_in_camera(frame)
        assert np.abs(clip.object.translation_m[frame - 3] - truth[:3, 3]).max() < 1e-3
        rotation = Rotation.from_rotvec(clip.object.rotvec[frame - 3]) * Rotation.from_matrix(truth[:3, :3]).inv()
        assert np.rad2deg(rotation.magnitude()) < 0.2
    write_text(root / "subject2/k1/3/cam4/obj_pose_rt/000011.txt", [0, *np.zeros(16)])
    result = load_all(H2OAdapter(shortest_frames=4), root)
    assert [clip.source_frames[[0, -1]].tolist() for clip in result[:2]] == [[3, 7], [12, 24]]
    assert isinstance(result[2], Quarantined)
    assert "poses of chips without a gap of more than 3 frames" in result[2].expected
    assert result[2].got == "none in source frames 8 to 11"


def test_the_old_name_of_an_object_folder_is_known(root, load_all):
    (root / "object" / "chips" / "chips.obj").rename(root / "object" / "chips" / "pringles.obj")
    (root / "object" / "chips").rename(root / "object" / "pringles")
    (clip,) = load_all(H2OAdapter(), root)
    assert clip.object.model.name == "chips"


def test_the_camera_that_saw_each_frame_comes_with_the_clip(root, load_all):
    (clip,) = load_all(H2OAdapter(), root)
    assert clip.camera.name == "cam4"
    assert clip.camera.images.tolist() == clip.source_frames.tolist() == list(range(3, 25))
    assert clip.camera.intrinsics is None
    turns = Rotation.from_rotvec(clip.camera.rotvec).as_matrix()
    for at, frame in enumerate(range(3, 25)):
        np.testing.assert_allclose(turns[at], camera(frame)[:3, :3], atol=1e-6)
        np.testing.assert_allclose(clip.camera.position_m[at], camera(frame)[:3, 3], atol=1e-6)


def test_intrinsics_are_read_where_they_are(root, load_all):
    (root / "subject2/k1/3/cam4/cam_intrinsics.txt").write_text("636.6593 636.2520 635.2839 366.8740 1280 720\n")
    (clip,) = load_all(H2OAdapter(), root)
    assert clip.camera.intrinsics.tolist() == [636.6593, 636.2520, 635.2839, 366.8740, 1280.0, 720.0]
    assert "subject2/k1/3/cam4/cam_intrinsics.txt" in [source.path for source in clip.sources]


NAMES = [f"{number:06d}.txt" for number in range(20)]
# Number formats that are not JSON: a plus sign, no digit next to the point, leading zeros.
WRITTEN = (repr, "{:.25e}".format, "{:+.18f}".format, "{:.3f}".format, "{:G}".format, lambda value: f"{value:.0f}.")


def loadtxt(data: bytes) -> np.ndarray:
    return np.loadtxt(BytesIO(data), ndmin=1, dtype=np.float64)


def bits(values: np.ndarray) -> list[int]:
    return np.ascontiguousarray(values).view(np.uint64).tolist()


def result_or_error(function, *arguments):
    try:
        return function(*arguments)
    except BadInput as error:
        return error


@settings(max_examples=200, deadline=None)
@given(
    rows=st.lists(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=4, max_size=4), max_size=5),
    write=st.sampled_from(WRITTEN),
    space=st.sampled_from([" ", "  ", "\t", " \t "]),
    end=st.sampled_from(["", "\n", "\r\n", " \n"]),
)
def test_numbers_are_those_of_numpy_to_the_last_bit(rows, write, space, end):
    contents = [(space.join(map(write, parsed)) + end).encode() for parsed in rows]
    values = parse_rows(contents, 4, "cam_pose", NAMES[: len(rows)])
    assert values.shape == (len(rows), 4)
    assert values.dtype == np.float64
    for parsed, data in zip(values, contents, strict=True):
        assert bits(parsed) == bits(loadtxt(data))


@pytest.mark.parametrize(
    "word",
    ["-0", "-0.0", "+1", "1.", ".5", "007", "1e-400", "9007199254740993", "18446744073709551617", "1E5", "-.5e1"],
)
def test_spellings_that_json_does_not_know_mean_what_numpy_reads(word):
    data = f"1.5 {word} 2 {word}\n".encode()
    assert bits(parse_rows([data, b"1 2 3 4"], 4, "f", NAMES[:2])[0]) == bits(loadtxt(data))


def test_only_the_first_line_of_a_file_counts():
    assert parse_rows([b"1 2\n3 4\n", b"5 6\nwords"], 2, "f", NAMES[:2]).tolist() == [[1, 2], [5, 6]]


@pytest.mark.parametrize(
    "line",
    [b"1 2 3", b"1", b"", b"1 true", b"1 null", b'1 "2"', b"1 [2]", b"1],[2", b"1,2", b"1 2,", b"1 0x10", b"1 1_0",
     b"1 nan", b"1 inf", b"1 -inf", b"1 1e999", b"1 2j", b"\xff 2", b"1 2\x00", "1 ٢".encode(), b"1 --2", b"1 2e"],
)  # fmt: skip
def test_any_other_content_names_its_file_and_no_other(line):
    with pytest.raises(BadInput) as caught:
        parse_rows([b"1 2", line, b"3 4"], 2, "subject1/h1/0/cam4/cam_pose", NAMES[:3])
    assert caught.value.where == "subject1/h1/0/cam4/cam_pose/000001.txt"


@settings(max_examples=300, deadline=None)
@given(st.lists(st.binary(max_size=30), min_size=1, max_size=3), st.integers(1, 3))
def test_any_bytes_give_finite_numbers_or_a_named_file(contents, columns):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values = result_or_error(parse_rows, contents, columns, "f", NAMES[: len(contents)])
    if isinstance(values, BadInput):
        assert values.where in [f"f/{name}" for name in NAMES]
    else:
        assert values.shape == (len(contents), columns)
        assert np.isfinite(values).all()


TRAIN = b"""id path action_label start_act end_act start_frame end_frame
1 subject1/h1/0 16 0 61 0 449
2 subject1/h1/0 27 62 138 0 449

3 subject3/k1/7 36 5 99 0 120
"""
TEST = b"id path start_act end_act start_frame end_frame\r\n1 subject4/o1/0 30 75 0 599\r\n"


def test_the_lists_give_their_segments_with_and_without_labels():
    assert parse_segments(TRAIN, "label_split/action_train.txt") == [
        Segment("subject1/h1/0", 16, 0, 61),
        Segment("subject1/h1/0", 27, 62, 138),
        Segment("subject3/k1/7", 36, 5, 99),
    ]
    assert parse_segments(TEST, "label_split/action_test.txt") == [Segment("subject4/o1/0", None, 30, 75)]


BAD_LISTS = {
    "empty": (b"", "action_x.txt", "the header"),
    "another header": (b"id path start end\n", "action_x.txt", "the header"),
    "a column too few": (TRAIN.replace(b" 27 62", b" 62"), "action_x.txt:3", "7 words"),
    "a column too many": (TEST.replace(b" 30 ", b" 30 31 "), "action_x.txt:2", "6 words"),
    "no number": (TEST.replace(b" 30 ", b" x "), "action_x.txt:2", "a whole number as start_act"),
    "a negative number": (TEST.replace(b" 30 ", b" -3 "), "action_x.txt:2", "a whole number as start_act"),
    "a fraction": (TEST.replace(b" 75 ", b" 75.5 "), "action_x.txt:2", "a whole number as end_act"),
    "digits of another script": (TEST.replace(b" 75 ", " ٧٥ ".encode()), "action_x.txt:2", "a whole number"),
    "a number of a thousand digits": (TEST.replace(b" 75 ", b" " + b"7" * 1000 + b" "), "action_x.txt:2", "a whole"),
    "an unknown action": (TRAIN.replace(b" 27 ", b" 37 "), "action_x.txt:3", "an action label from 1 to 36"),
    "the end before the start": (TEST.replace(b" 30 75", b" 75 30"), "action_x.txt:2", "a first frame before the last"),
    "a path that climbs": (TEST.replace(b"subject4/o1/0", b"../../etc"), "action_x.txt:2", "a path like"),
    "not UTF-8": (TEST + b"\xff\xfe", "action_x.txt", "UTF-8"),
}


@pytest.mark.parametrize("name", BAD_LISTS)
def test_a_bad_list_is_named_with_its_line(name):
    data, location, expected = BAD_LISTS[name]
    with pytest.raises(BadInput) as caught:
        parse_segments(data, "action_x.txt")
    assert caught.value.where == location
    assert expected in caught.value.expected


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_after_a_header_give_segments_or_a_named_error(data):
    segments = result_or_error(parse_segments, TEST + data, "list")
    if isinstance(segments, BadInput):
        assert segments.where.startswith("list")
    else:
        assert all(0 <= segment.start <= segment.last for segment in segments)


CLASSES = [0] * 4 + [5] * 40 + [3] * 6 + [5] * 30 + [7] * 30  # milk, lotion for a moment, milk again, chips
HEADER = "id path start_act end_act start_frame end_frame"
SEQUENCE = "subject4/h1/0"


def write_sequence(root: Path, classes=CLASSES, label: int | None = None, sequence: str = SEQUENCE) -> None:
    folder = root / sequence / "cam4"
    hand = [0.0, *[0.0] * 51, *[0.0] * 10]
    rows = {"cam_pose": np.eye(4).ravel().tolist(), "hand_pose_mano": hand * 2}
    for frame, number in enumerate(classes):
        rows["obj_pose_rt"] = [float(number), *np.eye(4).ravel().tolist()]
        if label is not None:
            rows["action_label"] = [float(label)]
        for kind, numbers in rows.items():
            (folder / kind).mkdir(parents=True, exist_ok=True)
            (folder / kind / f"{frame:06d}.txt").write_text(" ".join(map(repr, numbers)))


def write_list(root: Path, *rows: str, header: str = HEADER, name: str = "action_test.txt") -> None:
    (root / "label_split").mkdir(exist_ok=True)
    (root / "label_split" / name).write_text("\n".join((header, *rows)) + "\n")


@pytest.fixture
def unlabelled(tmp_path: Path) -> Path:
    write_sequence(tmp_path)
    for name in ("milk", "chips", "lotion"):
        path = tmp_path / "object" / name / f"{name}.obj"
        path.parent.mkdir(parents=True)
        trimesh.creation.box((0.06, 0.06, 0.2)).export(path)
    return tmp_path


def facts(items: list) -> list:
    return [(i.clip_id.rsplit("/", 1)[1], i.verb, i.object_words) for i in items if isinstance(i, Clip)]


def test_segments_of_the_list_become_clips_without_a_verb(unlabelled, load_all):
    write_list(unlabelled, f"1 {SEQUENCE} 4 43 0 109", f"2 {SEQUENCE} 80 109 0 109", "3 subject4/h1/1 0 30 0 99")
    clips = load_all(H2OAdapter(), unlabelled)
    assert facts(clips) == [("000004-000043", None, "milk"), ("000080-000109", None, "chips")]
    assert clips[0].source_frames.tolist() == list(range(4, 44))  # the last frame of a row belongs to the segment
    assert clips[1].source_frames[-1] == 109
    assert "label_split/action_test.txt" in [source.path for source in clips[0].sources]


def test_a_segment_is_cut_to_the_object_tracked_most_and_split_where_it_changes(unlabelled, load_all):
    write_list(unlabelled, f"1 {SEQUENCE} 0 84 0 109")
    assert facts(load_all(H2OAdapter(), unlabelled)) == [
        ("000004-000043", None, "milk"),
        ("000050-000079", None, "milk"),
    ]


def test_a_segment_without_any_object_is_rejected_with_its_reason(unlabelled, load_all):
    shutil.rmtree(unlabelled / "subject4")
    write_sequence(unlabelled, [0] * 40 + [5] * 40)
    write_list(unlabelled, f"1 {SEQUENCE} 0 39 0 79", f"2 {SEQUENCE} 40 79 0 79", f"3 {SEQUENCE} 45 60 0 79")
    empty, accepted, short = load_all(H2OAdapter(), unlabelled)
    assert isinstance(empty, Quarantined)
    assert (empty.expected, empty.got) == ("one object for 21 frames or more", "classes [0] (frames 0 to 39)")
    assert facts([accepted]) == [("000040-000079", None, "milk")]
    assert (short.where, short.got) == ("label_split/action_test.txt", "16 (frames 45 to 60)")


def test_per_frame_labels_come_before_the_lists(unlabelled, load_all):
    write_sequence(unlabelled, label=18)
    write_list(unlabelled, f"1 {SEQUENCE} 80 109 0 109")
    assert facts(load_all(H2OAdapter(), unlabelled)) == [
        ("000004-000043", "open", "milk"),
        ("000050-000079", "open", "milk"),
    ]


def test_labels_that_are_all_background_are_withheld_labels(unlabelled, load_all):
    write_sequence(unlabelled, label=0)
    assert load_all(H2OAdapter(), unlabelled) == []
    write_list(unlabelled, f"1 {SEQUENCE} 80 109 0 109")
    assert facts(load_all(H2OAdapter(), unlabelled)) == [("000080-000109", None, "chips")]


def test_a_list_with_labels_gives_the_verb_where_the_frames_have_none(unlabelled, load_all):
    header = "id path action_label start_act end_act start_frame end_frame"
    write_list(unlabelled, f"1 {SEQUENCE} 19 75 109 0 109", header=header, name="action_val.txt")
    assert facts(load_all(H2OAdapter(), unlabelled)) == [("000080-000109", "open", "chips")]


def test_a_sequence_with_neither_labels_nor_segments_says_what_to_do(unlabelled, load_all):
    with pytest.raises(BadInput, match=r"action_label.*subject4/h1/0 in a segment list.*neither.*label_split\.zip"):
        load_all(H2OAdapter(), unlabelled)
    write_list(unlabelled, "1 subject4/h1/1 0 30 0 99")
    with pytest.raises(BadInput, match="neither"):
        load_all(H2OAdapter(), unlabelled)


def test_a_segment_beyond_the_frames_there_are_is_refused(unlabelled, load_all):
    write_list(unlabelled, f"1 {SEQUENCE} 80 110 0 110")
    with pytest.raises(BadInput, match=r"action_test\.txt: expected frames 0 to 109.*segment 80 to 110"):
        load_all(H2OAdapter(), unlabelled)


def test_a_segment_listed_twice_gives_one_clip_and_one_reason(unlabelled, load_all):
    write_list(unlabelled, f"1 {SEQUENCE} 80 109 0 109", f"2 {SEQUENCE} 80 109 0 109")
    clip, twice = load_all(H2OAdapter(), unlabelled)
    assert facts([clip]) == [("000080-000109", None, "chips")]
    assert (twice.expected, twice.where) == ("each stretch once", "label_split/action_test.txt")


def test_a_margin_also_widens_a_segment(unlabelled, load_all):
    write_list(unlabelled, f"1 {SEQUENCE} 55 75 0 109")
    (clip,) = load_all(H2OAdapter(margin_frames=10), unlabelled)
    assert clip.source_frames[[0, -1]].tolist() == [50, 79]
