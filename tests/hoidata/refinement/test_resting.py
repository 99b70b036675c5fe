"""Objects that rest where they lay: on motions whose faults are put in by hand."""

from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips.clip import Clip, ObjectTrack
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.refinement.resting import rest_object
from tests.hoidata.refinement.test_holding import BOX, clip_of, pressed

PAIR = load_embedded_hands()
FRAMES = 40


def lifted(end_m: float, middle_m: float = 0.2, start: int = 8, stop: int = 30, away: float = 0.3) -> Clip:
    """A box at rest that goes up and aside, and comes down ``end_m`` above where it lay; a hand on it."""
    u = np.clip((np.arange(FRAMES) - start) / (stop - start), 0, 1)
    height = middle_m * np.sin(np.pi * u) ** 2 + end_m * u * u * (3 - 2 * u)
    place = np.stack((away * u * u * (3 - 2 * u), 0 * u, height), 1)
    turn, still = np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3), np.float32)
    hands = {
        side: pressed(side, place + np.array([0, y, 0.03]), 0.004, 0.0, turn)
        for side, y in (("left", -0.08), ("right", 0.08))
    }
    return clip_of("toy/s1/rest", ObjectTrack(BOX, still, place.astype(np.float32)), hands)


def height(clip: Clip) -> np.ndarray:
    return clip.object.translation_m[:, 2].astype(np.float64)


@pytest.mark.parametrize("end_m", [0.02, -0.02])
def test_what_comes_back_too_high_or_too_low_lies_where_it_lay(end_m):
    clip = lifted(end_m)
    made = rest_object(clip)
    assert np.abs(height(made)[[0, 5, -5, -1]]).max() < 2e-4
    assert np.abs(height(made) - height(clip)).max() == pytest.approx(0.02, abs=1e-3)
    step = np.diff(height(made) - height(clip))
    assert np.abs(step).max() < 0.003  # shared out over the way, not in one jump
    np.testing.assert_array_equal(made.object.translation_m[:, :2], clip.object.translation_m[:, :2])


def test_hands_go_with_the_object():
    clip = lifted(0.02)
    made = rest_object(clip)
    for side in clip.hands:
        apart = [track_joints(c.hands[side], PAIR[side]) - c.object.translation_m[:, None] for c in (clip, made)]
        np.testing.assert_allclose(apart[1], apart[0], atol=1e-6)


@pytest.mark.parametrize("clip", [lifted(0.0), lifted(0.1), lifted(-0.2)], ids=["same height", "shelf", "floor"])
def test_what_is_put_down_elsewhere_stays_there(clip):
    np.testing.assert_allclose(height(rest_object(clip)), height(clip), atol=1e-6)


@pytest.mark.parametrize("end_m", [0.1, -0.2])
@pytest.mark.parametrize("drift_m", [0.004, -0.004])
def test_what_drifts_before_it_is_put_elsewhere_does_not_jump(end_m, drift_m):
    clip = lifted(end_m)
    drift = drift_m * np.clip(np.arange(FRAMES) / 8, 0, 1)
    clip = moved(clip, drift)
    made = rest_object(clip)
    assert np.abs(height(made)[:8]).max() < 1e-6
    assert np.abs(np.diff(height(made) - height(clip))).max() < 0.001
    np.testing.assert_allclose(height(made)[20:], height(clip)[20:], atol=1e-6)


def test_what_is_lifted_slowly_is_lifted():
    clip = moved(lifted(0.0, 0.0, away=0.0), np.linspace(0, 0.036, FRAMES))
    made = rest_object(clip)
    assert height(made)[-1] == pytest.approx(0.036, abs=1e-6)
    assert np.abs(np.diff(height(made))).max() < 0.003


def moved(clip: Clip, up_m: np.ndarray) -> Clip:
    """A clip whose object is so much higher in each frame."""
    place = clip.object.translation_m + np.stack((0 * up_m, 0 * up_m, up_m), 1).astype(np.float32)
    return replace(clip, object=replace(clip.object, translation_m=place))


def test_nothing_passes_through_what_it_lay_on():
    clip = lifted(0.01, middle_m=-0.05)
    made = rest_object(clip)
    assert height(clip).min() < -0.03
    assert height(made).min() > -1e-6
    assert height(made).max() < 2e-3  # it slides: it was never above but by the 10 mm that are shared out
    assert np.abs(height(made)[:8]).max() < 1e-6
    assert np.abs(height(made)[-8:]).max() < 1e-6


@pytest.mark.parametrize("end_m", [0.0, 0.02, -0.02])
def test_what_is_held_in_the_air_and_put_down_in_between_is_put_down(end_m):
    clip = lifted(end_m, middle_m=-0.15)
    np.testing.assert_array_equal(height(rest_object(clip)), height(clip))


def test_without_gravity_or_a_rest_to_start_from_nothing_is_changed():
    clip = lifted(0.02)
    for other in (replace(clip, gravity=None), lifted(0.02, start=-6)):
        assert rest_object(other) is other


def test_a_rest_is_left_as_it_is_the_second_time():
    made = rest_object(lifted(0.02, middle_m=-0.05))
    np.testing.assert_allclose(height(rest_object(made)), height(made), atol=1e-3)
