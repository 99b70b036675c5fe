"""Promises of animated frames of a clip in which the tracking lost a hand: what a track says there is never used."""

import numpy as np
import pytest

from hoidata.clips.clip import HandTrack
from models.manipnet.animate import clip_control, gap_of, straight_fingers, with_fingers
from tests.builders.clips import build_clip, random_hand, with_hand

FRAMES = 40


def lost(seen: np.ndarray) -> HandTrack:
    """A hand that was lost in the other frames, whose arrays are zero there."""
    hand = random_hand(FRAMES, seed=1)
    for array in (hand.wrist_m, hand.global_orient, hand.hand_pose):
        array[~seen] = 0
    hand.valid[:] = seen
    return hand


def test_the_poses_beside_frames_are_the_nearest_ones_that_were_seen() -> None:
    seen = np.ones(FRAMES, bool)
    seen[8:12], seen[20:23] = False, False
    track = lost(seen)
    gap = gap_of(track, slice(12, 20))
    whole = gap_of(track, slice(0, FRAMES))
    assert (gap.first, gap.stop) == (8, 23)
    assert gap.before is not None
    assert gap.after is not None
    known = gap_of(random_hand(FRAMES, seed=1), slice(8, 23))
    np.testing.assert_array_equal([gap.before, gap.after], [known.before, known.after])
    assert (whole.first, whole.stop, whole.before, whole.after) == (0, FRAMES, None, None)
    assert gap_of(lost(np.arange(FRAMES) >= 20), slice(5, 10)).before is None


def test_a_lost_wrist_is_where_it_was_seen_nearest_and_a_seen_one_stays_to_the_bit() -> None:
    seen = np.ones(FRAMES, bool)
    seen[10:20] = False
    clip = with_hand(build_clip(FRAMES), "right", **vars(lost(seen)))
    track, frames = clip.hands["right"], slice(5, 25)
    made = with_fingers(track, frames, np.tile(np.eye(3), (20, 15, 1, 1)), clip_control(clip).wrists["right"])
    nearest = np.array([9] * 5 + [20] * 5)
    np.testing.assert_allclose(made.wrist_m[10:20], track.wrist_m[nearest], atol=1e-6)
    np.testing.assert_array_equal(made.wrist_m[seen], track.wrist_m[seen])
    np.testing.assert_array_equal(made.global_orient[seen], track.global_orient[seen])
    assert np.abs(made.global_orient[10:20]).min() > 0
    assert made.valid.all()


def test_up_to_two_seconds_between_known_poses_is_a_short_gap() -> None:
    track = random_hand(90)
    assert gap_of(track, slice(5, 65)).is_short
    assert not gap_of(track, slice(5, 66)).is_short
    assert not gap_of(track, slice(0, 30)).is_short
    assert len(straight_fingers(gap_of(track, slice(5, 65)))) == 60
    with pytest.raises(ValueError, match="both sides"):
        straight_fingers(gap_of(track, slice(0, 30)))
