"""Objects at rest are snapped to their first height, on motions with known height errors."""

from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips.clip import Clip, ObjectTrack
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.refinement.resting import snap_to_rest
from tests.hoidata.refinement.test_holding import BOX, clip_of, pressed

PAIR = load_embedded_hands()
FRAMES = 40


def lifted(end_m: float, middle_m: float = 0.2, start: int = 8, stop: int = 30, away: float = 0.3) -> Clip:
    """A box at rest rises, moves sideways and comes down ``end_m`` above its first height, with hands on it."""
    u = np.clip((np.arange(FRAMES) - start) / (stop - start), 0, 1)
    height = middle_m * np.sin(np.pi * u) ** 2 + end_m * u * u * (3 - 2 * u)
    position_m = np.stack((away * u * u * (3 - 2 * u), 0 * u, height), 1)
    rotation, still = np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3), np.float32)
    hands = {
        side: pressed(side, position_m + np.array([0, y, 0.03]), 0.004, 0.0, rotation)
        for side, y in (("left", -0.08), ("right", 0.08))
    }
    return clip_of("toy/s1/rest", ObjectTrack(BOX, still, position_m.astype(np.float32)), hands)


def height(clip: Clip) -> np.ndarray:
    return clip.object.translation_m[:, 2].astype(np.float64)


@pytest.mark.parametrize("end_m", [0.02, -0.02])
def test_an_object_put_down_too_high_or_too_low_is_moved_to_its_first_height(end_m):
    clip = lifted(end_m)
    rested = snap_to_rest(clip)
    assert np.abs(height(rested)[[0, 5, -5, -1]]).max() < 2e-4
    assert np.abs(height(rested) - height(clip)).max() == pytest.approx(0.02, abs=1e-3)
    step = np.diff(height(rested) - height(clip))
    assert np.abs(step).max() < 0.003  # distributed over the motion
    np.testing.assert_array_equal(rested.object.translation_m[:, :2], clip.object.translation_m[:, :2])


def test_hands_move_with_the_object():
    clip = lifted(0.02)
    rested = snap_to_rest(clip)
    for side in clip.hands:
        relative_m = [track_joints(c.hands[side], PAIR[side]) - c.object.translation_m[:, None] for c in (clip, rested)]
        np.testing.assert_allclose(relative_m[1], relative_m[0], atol=1e-6)


@pytest.mark.parametrize("clip", [lifted(0.0), lifted(0.1), lifted(-0.2)], ids=["same height", "shelf", "floor"])
def test_an_object_put_down_on_another_surface_is_unchanged(clip):
    np.testing.assert_allclose(height(snap_to_rest(clip)), height(clip), atol=1e-6)


@pytest.mark.parametrize("end_m", [0.1, -0.2])
@pytest.mark.parametrize("drift_m", [0.004, -0.004])
def test_an_object_that_drifts_before_another_surface_does_not_jump(end_m, drift_m):
    clip = lifted(end_m)
    drift = drift_m * np.clip(np.arange(FRAMES) / 8, 0, 1)
    clip = moved(clip, drift)
    rested = snap_to_rest(clip)
    assert np.abs(height(rested)[:8]).max() < 1e-6
    assert np.abs(np.diff(height(rested) - height(clip))).max() < 0.001
    np.testing.assert_allclose(height(rested)[20:], height(clip)[20:], atol=1e-6)


def test_a_slow_lift_is_not_removed():
    clip = moved(lifted(0.0, 0.0, away=0.0), np.linspace(0, 0.036, FRAMES))
    rested = snap_to_rest(clip)
    assert height(rested)[-1] == pytest.approx(0.036, abs=1e-6)
    assert np.abs(np.diff(height(rested))).max() < 0.003


def moved(clip: Clip, up_m: np.ndarray) -> Clip:
    """The clip with its object raised by up_m (frame,)."""
    position_m = clip.object.translation_m + np.stack((0 * up_m, 0 * up_m, up_m), 1).astype(np.float32)
    return replace(clip, object=replace(clip.object, translation_m=position_m))


def test_an_object_does_not_pass_through_its_support():
    clip = lifted(0.01, middle_m=-0.05)
    rested = snap_to_rest(clip)
    assert height(clip).min() < -0.03
    assert height(rested).min() > -1e-6
    assert height(rested).max() < 2e-3  # it slides; only the 10 mm of the end are distributed
    assert np.abs(height(rested)[:8]).max() < 1e-6
    assert np.abs(height(rested)[-8:]).max() < 1e-6


@pytest.mark.parametrize("end_m", [0.0, 0.02, -0.02])
def test_an_object_in_the_air_at_both_ends_is_unchanged(end_m):
    clip = lifted(end_m, middle_m=-0.15)
    np.testing.assert_array_equal(height(snap_to_rest(clip)), height(clip))


def test_a_clip_without_gravity_or_without_rest_at_its_start_is_unchanged():
    clip = lifted(0.02)
    for other in (replace(clip, gravity=None), lifted(0.02, start=-6)):
        assert snap_to_rest(other) is other


def test_a_second_run_changes_nothing():
    rested = snap_to_rest(lifted(0.02, middle_m=-0.05))
    np.testing.assert_allclose(height(snap_to_rest(rested)), height(rested), atol=1e-3)
