"""H2O's subject 4: its action labels are withheld, its segments are not."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from hoidata.clips.clip import Clip
from hoidata.datasets import Quarantined
from hoidata.datasets.h2o.adapter import H2OAdapter
from hoidata.errors import BadInput

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
def root(tmp_path: Path) -> Path:
    write_sequence(tmp_path)
    for name in ("milk", "chips", "lotion"):
        path = tmp_path / "object" / name / f"{name}.obj"
        path.parent.mkdir(parents=True)
        trimesh.creation.box((0.06, 0.06, 0.2)).export(path)
    return tmp_path


def facts(items: list) -> list:
    return [(i.clip_id.rsplit("/", 1)[1], i.verb, i.object_words) for i in items if isinstance(i, Clip)]


def test_segments_of_the_list_become_clips_without_a_verb(root, load_all):
    write_list(root, f"1 {SEQUENCE} 4 43 0 109", f"2 {SEQUENCE} 80 109 0 109", "3 subject4/h1/1 0 30 0 99")
    clips = load_all(H2OAdapter(), root)
    assert facts(clips) == [("000004-000043", None, "milk"), ("000080-000109", None, "chips")]
    assert clips[0].source_frames.tolist() == list(range(4, 44))  # the last frame of a row belongs to the segment
    assert clips[1].source_frames[-1] == 109
    assert "label_split/action_test.txt" in [source.path for source in clips[0].sources]


def test_a_segment_is_cut_to_the_object_tracked_most_and_split_where_it_changes(root, load_all):
    write_list(root, f"1 {SEQUENCE} 0 84 0 109")
    assert facts(load_all(H2OAdapter(), root)) == [("000004-000043", None, "milk"), ("000050-000079", None, "milk")]


def test_a_segment_without_any_object_is_left_out_with_its_reason(root, load_all):
    shutil.rmtree(root / "subject4")
    write_sequence(root, [0] * 40 + [5] * 40)
    write_list(root, f"1 {SEQUENCE} 0 39 0 79", f"2 {SEQUENCE} 40 79 0 79", f"3 {SEQUENCE} 45 60 0 79")
    empty, kept, short = load_all(H2OAdapter(), root)
    assert isinstance(empty, Quarantined)
    assert (empty.expected, empty.got) == ("one object for 21 frames or more", "classes [0] (frames 0 to 39)")
    assert facts([kept]) == [("000040-000079", None, "milk")]
    assert (short.where, short.got) == ("label_split/action_test.txt", "16 (frames 45 to 60)")


def test_per_frame_labels_come_before_the_lists(root, load_all):
    write_sequence(root, label=18)
    write_list(root, f"1 {SEQUENCE} 80 109 0 109")
    assert facts(load_all(H2OAdapter(), root)) == [("000004-000043", "open", "milk"), ("000050-000079", "open", "milk")]


def test_labels_that_are_all_background_are_withheld_labels(root, load_all):
    write_sequence(root, label=0)
    assert load_all(H2OAdapter(), root) == []
    write_list(root, f"1 {SEQUENCE} 80 109 0 109")
    assert facts(load_all(H2OAdapter(), root)) == [("000080-000109", None, "chips")]


def test_a_list_with_labels_gives_the_verb_where_the_frames_have_none(root, load_all):
    header = "id path action_label start_act end_act start_frame end_frame"
    write_list(root, f"1 {SEQUENCE} 19 75 109 0 109", header=header, name="action_val.txt")
    assert facts(load_all(H2OAdapter(), root)) == [("000080-000109", "open", "chips")]


def test_a_sequence_with_neither_labels_nor_segments_says_what_to_do(root, load_all):
    with pytest.raises(BadInput, match=r"action_label.*subject4/h1/0 in a segment list.*neither.*label_split\.zip"):
        load_all(H2OAdapter(), root)
    write_list(root, "1 subject4/h1/1 0 30 0 99")
    with pytest.raises(BadInput, match="neither"):
        load_all(H2OAdapter(), root)


def test_a_segment_beyond_the_frames_there_are_is_refused(root, load_all):
    write_list(root, f"1 {SEQUENCE} 80 110 0 110")
    with pytest.raises(BadInput, match=r"action_test\.txt: expected frames 0 to 109.*segment 80 to 110"):
        load_all(H2OAdapter(), root)


def test_a_segment_listed_twice_gives_one_clip_and_one_reason(root, load_all):
    write_list(root, f"1 {SEQUENCE} 80 109 0 109", f"2 {SEQUENCE} 80 109 0 109")
    clip, twice = load_all(H2OAdapter(), root)
    assert facts([clip]) == [("000080-000109", None, "chips")]
    assert (twice.expected, twice.where) == ("each stretch once", "label_split/action_test.txt")


def test_a_margin_also_widens_a_segment(root, load_all):
    write_list(root, f"1 {SEQUENCE} 55 75 0 109")
    (clip,) = load_all(H2OAdapter(margin_frames=10), root)
    assert clip.source_frames[[0, -1]].tolist() == [50, 79]
