"""Animated frames of a clip with an untracked hand: the track's values in untracked frames are never used."""

import numpy as np
import pytest

from hoidata.clips.clip import HandTrack
from models.manipnet.animate import gap_of, interpolate_fingers, with_fingers
from models.manipnet.control import control_from_clip
from tests.builders.clips import build_clip, random_hand, with_hand

FRAMES = 40


def partly_tracked_hand(tracked: np.ndarray) -> HandTrack:
    """A hand that is untracked in the other frames, where its arrays are zero."""
    hand = random_hand(FRAMES, seed=1)
    for array in (hand.wrist_m, hand.global_orient, hand.hand_pose):
        array[~tracked] = 0
    hand.valid[:] = tracked
    return hand


def test_the_poses_around_a_gap_are_the_nearest_tracked_ones() -> None:
    tracked = np.ones(FRAMES, bool)
    tracked[8:12], tracked[20:23] = False, False
    track = partly_tracked_hand(tracked)
    gap = gap_of(track, slice(12, 20))
    whole = gap_of(track, slice(0, FRAMES))
    assert (gap.first, gap.stop) == (8, 23)
    expected = gap_of(random_hand(FRAMES, seed=1), slice(8, 23))
    np.testing.assert_array_equal([gap.before, gap.after], [expected.before, expected.after])
    assert (whole.first, whole.stop, whole.before, whole.after) == (0, FRAMES, None, None)
    assert gap_of(partly_tracked_hand(np.arange(FRAMES) >= 20), slice(5, 10)).before is None


def test_an_untracked_wrist_has_its_nearest_tracked_pose_and_a_tracked_wrist_is_unchanged() -> None:
    tracked = np.ones(FRAMES, bool)
    tracked[10:20] = False
    clip = with_hand(build_clip(FRAMES), "right", **vars(partly_tracked_hand(tracked)))
    track, frames = clip.hands["right"], slice(5, 25)
    filled = with_fingers(track, frames, np.tile(np.eye(3), (20, 15, 1, 1)), control_from_clip(clip).wrists["right"])
    nearest = np.array([9] * 5 + [20] * 5)
    np.testing.assert_allclose(filled.wrist_m[10:20], track.wrist_m[nearest], atol=1e-6)
    np.testing.assert_array_equal(filled.wrist_m[tracked], track.wrist_m[tracked])
    np.testing.assert_array_equal(filled.global_orient[tracked], track.global_orient[tracked])
    assert np.abs(filled.global_orient[10:20]).min() > 0
    assert filled.valid.all()


def test_a_gap_of_up_to_two_seconds_between_known_poses_is_short() -> None:
    track = random_hand(90)
    assert gap_of(track, slice(5, 65)).is_short
    assert not gap_of(track, slice(5, 66)).is_short
    assert not gap_of(track, slice(0, 30)).is_short
    assert len(interpolate_fingers(gap_of(track, slice(5, 65)))) == 60
    with pytest.raises(ValueError, match="both sides"):
        interpolate_fingers(gap_of(track, slice(0, 30)))
