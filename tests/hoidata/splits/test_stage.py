"""The stage split: its output, its errors, and training statistics without held-out clips."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hoidata.clips import SourceContact, SourceFile
from hoidata.errors import BadInput
from hoidata.splits.stage import motion_digest, split_store
from hoidata.store.info import generated_info
from hoidata.store.store import write_store

RULE = {"by": "subject", "train": ["s1"], "validation": ["s9"], "test": ["s10"]}


@pytest.fixture
def clips(make_clip):
    """Two clips of s1 and one each of s9, s10 and of s4, whom the rule does not name; raw files as GRAB has them."""
    names = ("s1/cup_lift_1", "s1/cup_lift_2", "s9/cup_lift_1", "s10/mug_lift_1", "s4/cup_lift_1")
    return [
        replace(
            make_clip(16, seed=seed, clip_id=f"grab/{name}", subject=name.split("/")[0]),
            sources=(SourceFile(f"grab/{name}.npz", 9, "ab" * 32), SourceFile("tools/box.ply", 9, "cd" * 32)),
        )
        for seed, name in enumerate(names)
    ]


def write(root: Path, clips, without_words=(), choice=RULE) -> Path:
    """A store, the two tables of the annotation that the stage reads, and its output."""
    write_store(root / "clips", clips, generated_info("grab"))
    ids = [clip.clip_id for clip in clips]
    (root / "annotation").mkdir()
    nearest = {"min_left_m": [None] * len(ids), "min_right_m": [0.004] * len(ids)}
    words = {"verb": [clip.verb for clip in clips], "hand_type": ["right"] * len(ids)}
    pd.DataFrame({"clip_id": ids, **nearest, **words}).to_parquet(root / "annotation" / "hand_type.parquet")
    words = [clip_id for clip_id in ids for _ in range(4) if clip_id not in without_words]
    pd.DataFrame({"clip_id": words}, dtype=str).to_parquet(root / "annotation" / "text.parquet")
    split_store(root / "clips", root / "annotation", root / "splits", choice)
    return root / "splits"


def parts(folder: Path, column: str = "split") -> dict[str, str | None]:
    table = pd.read_parquet(folder / "splits.parquet")
    return {
        clip_id: part if isinstance(part, str) else None
        for clip_id, part in table[["clip_id", column]].itertuples(index=False)
    }


def test_every_clip_has_a_row_and_one_that_no_part_covers_is_left_out_and_counted(clips, tmp_path):
    folder = write(tmp_path, clips)
    assert list(parts(folder).values()) == ["train", "train", "validation", "test", None]
    info = json.loads((folder / "info.json").read_text())
    assert info["chosen"]["clips"] == {"train": 2, "validation": 1, "test": 1, "left_out": 1}
    assert info["chosen"]["frames"] == {"train": 32, "validation": 16, "test": 16, "left_out": 16}
    assert info["chosen"]["rule"] == RULE


def test_contact_labels_of_the_source_are_not_read(clips, tmp_path):
    """They are ten times what a clip of GRAB moves: a store without their file is split all the same."""
    touched = SourceContact(np.arange(3, dtype=np.int32), np.zeros(3, np.int32), np.full(3, 22, np.uint8))
    clips = [replace(clip, source_contact=touched) for clip in clips]
    first = write(tmp_path, clips)
    (tmp_path / "clips" / "arrays" / "source_contact-00000.npz").unlink()
    split_store(tmp_path / "clips", tmp_path / "annotation", tmp_path / "again", RULE)
    for name in ("splits.parquet", "info.json", "statistics.json"):
        assert (tmp_path / "again" / name).read_bytes() == (first / name).read_bytes()


def test_all_named_splits_of_the_dataset_stand_beside_the_chosen_one(clips, tmp_path):
    folder = write(tmp_path, clips, choice="text2hoi")
    columns = list(pd.read_parquet(folder / "splits.parquet").columns)
    assert columns == ["clip_id", "official", "text2hoi", "unseen-object", "unseen-subject", "split"]
    assert parts(folder) == parts(folder, "text2hoi")
    rare = write(tmp_path / "rare", clips, choice="drawn-per-object")  # written only where it is chosen
    assert list(pd.read_parquet(rare / "splits.parquet").columns) == columns
    assert set(parts(rare).values()) == {"train", "validation", "test"}
    assert list(parts(folder, "unseen-subject").values()) == ["train", "train", "validation", "test", "train"]
    info = json.loads((folder / "info.json").read_text())
    assert info["chosen"]["name"] == "text2hoi"
    assert set(info["splits"]) == {*columns} - {"clip_id", "split"}
    assert info["splits"]["unseen-subject"]["leaks"]["object"] == {
        "promised": False, "in_two_parts": 1, "first": ["box"],
    }  # fmt: skip
    assert info["splits"]["unseen-subject"]["leaks"]["file"]["in_two_parts"] == 0
    assert info["splits"]["unseen-subject"]["keeps_its_promises"]


def test_clips_without_sentences_belong_to_no_part_and_shift_no_round(clips, tmp_path):
    """Five clips of one recording; without the second, the fourth of those left validates and nobody tests."""
    clips = [
        replace(clip, sequence="cyl", source_frames=np.arange(16, dtype=np.int32) + 100 * index)
        for index, clip in enumerate(clips)
    ]
    folder = write(tmp_path, clips, [clips[1].clip_id], {"by": "rounds"})
    assert list(parts(folder).values()) == ["train", None, "train", "train", "validation"]
    info = json.loads((folder / "info.json").read_text())
    assert info["without_sentences"] == 1
    assert info["chosen"]["clips"]["left_out"] == 0


def test_numbers_of_held_out_clips_change_no_statistic(clips, tmp_path):
    def shaken(clip):
        hands = {side: replace(track, wrist_m=track.wrist_m * 3 + 1) for side, track in clip.hands.items()}
        return replace(clip, hands=hands, object=replace(clip.object, rotvec=clip.object.rotvec * 0.5))

    usual = write(tmp_path / "usual", clips)
    changed = write(tmp_path / "changed", [*clips[:2], *map(shaken, clips[2:])])
    trained = write(tmp_path / "trained", [shaken(clips[0]), *clips[1:]])
    name = "statistics.json"
    assert (usual / name).read_bytes() == (changed / name).read_bytes()
    assert (usual / name).read_bytes() != (trained / name).read_bytes()


def test_statistics_are_those_of_the_training_clips(clips, tmp_path):
    statistics = json.loads((write(tmp_path, clips) / "statistics.json").read_text())
    assert (statistics["clips"], statistics["frames"]) == (2, 32)
    wrists = np.concatenate([clip.hands["right"].wrist_m for clip in clips[:2]]).astype(np.float64)
    right = statistics["quantities"]["right_wrist_m"]
    np.testing.assert_allclose(right["mean"], wrists.mean(axis=0), rtol=1e-7)
    np.testing.assert_allclose(
        right["quantile_values"], np.percentile(wrists, (1, 5, 25, 50, 75, 95, 99), axis=0).T, rtol=1e-7
    )
    assert statistics["quantities"]["right_closest_m"]["mean"] == [0.004]


def test_the_same_clips_give_the_same_bytes(clips, tmp_path):
    first, second = write(tmp_path / "a", clips, choice="text2hoi"), write(tmp_path / "b", clips, choice="text2hoi")
    names = sorted(path.name for path in first.iterdir())
    assert names == ["info.json", "splits.parquet", "statistics.json"]
    assert all((first / name).read_bytes() == (second / name).read_bytes() for name in names)


def test_a_held_out_copy_of_a_training_clip_under_another_name_is_refused(clips, tmp_path):
    copy = replace(clips[0], clip_id="grab/s10/renamed", subject="s10", sequence="s10/renamed", sources=())
    with pytest.raises(BadInput, match=r"no motion in two parts.*grab/s1/cup_lift_1 = grab/s10/renamed"):
        write(tmp_path, [*clips, copy])
    assert not (tmp_path / "splits").exists()


def test_a_chosen_split_that_breaks_its_promise_is_refused_but_another_only_recorded(clips, tmp_path):
    by_object = {"by": "subject", "train": ["s1"], "test": ["s10"], "promises": ["object"]}
    with pytest.raises(BadInput, match="no object in two parts, as it promises, got 1 in several: box"):
        write(tmp_path / "refused", clips, choice=by_object)
    shared = replace(clips[2], sources=clips[0].sources)
    with pytest.raises(BadInput, match=r"no file in two parts.*grab/s1/cup_lift_1\.npz"):
        write(tmp_path / "shared", [clips[0], shared])
    folder = write(tmp_path / "other", [clips[0], shared], choice={**RULE, "promises": ["subject"]})
    record = json.loads((folder / "info.json").read_text())["splits"]["text2hoi"]
    assert not record["keeps_its_promises"]


def test_an_annotation_of_other_clips_is_refused(clips, tmp_path):
    write(tmp_path, clips)
    write_store(tmp_path / "clips", clips[:3], generated_info("grab"))
    with pytest.raises(BadInput, match="run the stage 'annotate' again"):
        split_store(tmp_path / "clips", tmp_path / "annotation", tmp_path / "splits", RULE)


def test_an_unknown_split_is_refused_before_anything_is_written(clips, tmp_path):
    with pytest.raises(BadInput, match=r"composition, drawn-object, .*official, text2hoi, .*subject, got 'text2hio'"):
        write(tmp_path, clips, choice="text2hio")
    assert not (tmp_path / "splits").exists()


def test_a_store_without_annotated_clips_has_an_empty_split(clips, tmp_path):
    folder = write(tmp_path, clips[:1], [clips[0].clip_id])
    assert parts(folder) == {clips[0].clip_id: None}


def test_how_complete_a_dataset_is_is_told_where_its_makers_list_the_sequences(make_clip, tmp_path):
    names = ("s01/box_use_01", "s01/box_use_02", "s01/of_my_own")
    clips = [replace(make_clip(seed=seed, clip_id=f"arctic/{name}"), sequence=name) for seed, name in enumerate(names)]
    write_store(tmp_path / "clips", clips, generated_info("arctic"))
    (tmp_path / "annotation").mkdir()
    nearest = [0.1] * len(clips)
    table = pd.DataFrame({"clip_id": [clip.clip_id for clip in clips], "min_left_m": nearest, "min_right_m": nearest})
    table = table.assign(verb="lift", hand_type="right")
    for name in ("hand_type", "text"):
        table.to_parquet(tmp_path / "annotation" / f"{name}.parquet")
    split_store(tmp_path / "clips", tmp_path / "annotation", tmp_path / "splits", "bimart")
    published = json.loads((tmp_path / "splits" / "info.json").read_text())["published"]
    assert (published["sequences"], published["usable"], published["with_clips"]) == (339, 301, 2)


@pytest.mark.parametrize("moved", ["rotvec", "translation_m", "hinge_rad"])
def test_clips_that_differ_in_one_number_of_the_object_are_no_copies(make_clip, moved):
    clip = make_clip(16, articulated=True)
    values = getattr(clip.object, moved).copy()
    values[3] += np.float32(0.01)
    assert motion_digest(clip) == motion_digest(replace(clip, clip_id="test/copy"))
    assert motion_digest(clip) != motion_digest(replace(clip, object=replace(clip.object, **{moved: values})))


@pytest.mark.parametrize("moved", ["wrist_m", "global_orient", "hand_pose", "valid"])
@pytest.mark.parametrize("side", ["left", "right"])
def test_motion_is_told_apart_by_every_number_of_a_hand(make_clip, side, moved):
    clip = make_clip(16)
    track = clip.hands[side]
    values = getattr(track, moved).copy()
    values[3] = ~values[3] if moved == "valid" else values[3] + np.float32(0.01)
    other = replace(clip, hands={**clip.hands, side: replace(track, **{moved: values})})
    assert motion_digest(clip) != motion_digest(other)


@pytest.mark.parametrize(
    ("rule", "missing"),
    [
        ({"by": "subject", "train": ["s1"], "validation": ["s7"], "test": ["s10"]}, ["validation"]),
        ({"by": "subject", "train": "rest", "validation": ["s9"]}, ["test"]),
        ({"by": "subject", "train": ["s7"], "test": ["s10"]}, ["train", "validation"]),
    ],
)
def test_a_part_without_clips_is_named_with_what_follows_from_it(clips, tmp_path, rule, missing):
    info = json.loads((write(tmp_path, clips, choice=rule) / "info.json").read_text())
    assert list(info["missing"]) == sorted(missing)
    assert all(
        words.startswith(f"no {'training' if part == 'train' else part} clips: ")
        for part, words in info["missing"].items()
    )


def test_nothing_is_said_to_be_missing_where_every_part_has_clips(clips, tmp_path):
    assert "missing" not in json.loads((write(tmp_path, clips) / "info.json").read_text())
