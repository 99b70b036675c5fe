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


def test_nothing_passes_through_what_it_lay_on():
    clip = lifted(0.01, middle_m=-0.05)
    made = rest_object(clip)
    assert height(clip).min() < -0.03
    assert height(made).min() > -1e-6
    assert np.abs(np.diff(height(made), 2)).max() < 0.01


def test_without_gravity_or_a_rest_to_start_from_nothing_is_changed():
    clip = lifted(0.02)
    for other in (replace(clip, gravity=None), lifted(0.02, start=-6)):
        assert rest_object(other) is other


def test_a_rest_is_left_as_it_is_the_second_time():
    made = rest_object(lifted(0.02, middle_m=-0.05))
    np.testing.assert_allclose(height(rest_object(made)), height(made), atol=1e-3)
