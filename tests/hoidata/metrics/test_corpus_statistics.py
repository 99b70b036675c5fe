"""Statistics of a corpus against motions whose numbers are known, and the comparison of two corpora."""

from dataclasses import replace

import numpy as np
import pytest

from hoidata.metrics.corpus_statistics import STATISTICS, clip_statistics, compare_corpora
from hoidata.store.annotated import load_annotated
from tests.builders.clips import build_clip, with_hand
from tests.builders.stores import write_annotated

SPLIT = {"by": "subject", "train": "rest", "validation": [], "test": ["s9"]}


def statistics(folder, clip) -> dict[str, list[float]]:
    """All values of one clip per statistic."""
    annotated = load_annotated(write_annotated(folder, [clip], "test", SPLIT, 0.02))
    values: dict[str, list[float]] = {}
    for name, value in clip_statistics(annotated, clip.clip_id):
        values.setdefault(name, []).append(value)
    return values


def test_a_rigid_grasp_has_no_finger_motion_no_slip_and_one_contact(tmp_path):
    values = statistics(tmp_path / "grasp", build_clip(n_frames=60, hand_type="right"))
    assert values["finger speed"] == pytest.approx([0], abs=1e-3)
    assert values["slip"] == pytest.approx([0], abs=1e-3)
    assert values["grasp duration"] == [2.0]
    assert values["regrasps"] == [0]
    assert values["frames with contact"] == [1]
    assert values["both hands"] == [0]
    assert "hinge speed" not in values


def test_one_bending_joint_of_fifteen_counts_a_fifteenth(tmp_path):
    clip = build_clip(n_frames=31, hand_type="right")
    pose = np.zeros((31, 45), np.float32)
    pose[:, 2] = np.deg2rad(np.arange(31))  # one degree per frame: 30 degrees per second
    values = statistics(tmp_path / "bend", with_hand(clip, "right", hand_pose=pose))
    assert values["finger speed"] == pytest.approx([30 / 15], rel=1e-3)


def test_a_hand_that_leaves_and_returns_regrasps_once(tmp_path):
    clip = build_clip(n_frames=90, hand_type="right")
    wrist_m = clip.hands["right"].wrist_m.copy()
    wrist_m[30:60] += 1.0
    values = statistics(tmp_path / "again", with_hand(clip, "right", wrist_m=wrist_m))
    assert values["grasp duration"] == [1.0, 1.0]
    assert values["regrasps"] == pytest.approx([10 / 3])
    assert values["frames with contact"] == pytest.approx([2 / 3])


def test_a_hinge_worked_by_two_hands_is_measured(tmp_path):
    clip = build_clip(n_frames=31, hand_type="both", articulated=True)
    values = statistics(tmp_path / "hinge", clip)
    step_deg = np.degrees(np.diff(np.asarray(clip.object.hinge_rad, float)))
    assert values["hinge speed"] == pytest.approx([30 * step_deg.mean()], rel=1e-3)
    assert values["both hands"] == [1]
    unknown = replace(clip, gravity=None, gravity_note="not stated")
    assert "object tilt" not in statistics(tmp_path / "unknown", unknown)


def test_equal_corpora_are_at_distance_0_and_disjoint_ones_at_1():
    values = {name: np.arange(1.0, 5.0) for name in STATISTICS}
    assert all(comparison.distance == 0 and comparison.ratio == 1 for comparison in compare_corpora(values, values))
    shifted = {name: array + 10 for name, array in values.items()}
    assert all(comparison.distance == 1 for comparison in compare_corpora(values, shifted))
    nothing = {name: np.zeros(0) for name in STATISTICS}
    assert all(
        np.isnan(comparison.distance) and np.isnan(comparison.ratio) for comparison in compare_corpora(values, nothing)
    )
