"""Promises of the figures that tell whether a long motion shows where its windows meet."""

import numpy as np
import pytest

from hoidata.clips.clip import Clip
from hoidata.hands import load_embedded_hands
from models.bimart.borders import border_figures, borders_of, overlapping_borders_of
from tests.builders.clips import clip_of, flat_hand, still_object
from tests.builders.objects import box_model

FRAMES, BORDERS = 40, [20]
PAIR = load_embedded_hands()


def hand_along(height_m: np.ndarray) -> Clip:
    """A right hand over the origin of a box, at a height in every frame."""
    away = np.array([0.5, 0, 0])
    wrist = np.zeros((FRAMES, 3)) + height_m[:, None] * [0, 0, 1]
    hands = {"left": flat_hand(wrist + away, np.zeros(FRAMES, bool)), "right": flat_hand(wrist)}
    return clip_of("toy/s1/a", still_object(box_model((0.3, 0.3, 0.02)), FRAMES), hands)


def test_windows_that_overlap_have_borders_where_any_begins_or_ends() -> None:
    assert borders_of(300, 64) == [64, 128, 192, 256]
    assert overlapping_borders_of(300, 64) == [32, 64, 96, 128, 160, 192, 224, 236, 256, 288]
    assert overlapping_borders_of(50, 64) == []


def test_a_step_at_a_border_is_its_acceleration_over_that_elsewhere() -> None:
    falling = 0.001 * np.arange(FRAMES) ** 2 + 1.0  # 2 mm per frame squared throughout
    calm, _ = border_figures([hand_along(falling)], PAIR, BORDERS)
    jumping = falling + 0.01 * (np.arange(FRAMES) >= 20)
    shown, _ = border_figures([hand_along(jumping)], PAIR, BORDERS)
    assert calm == pytest.approx(1, abs=0.01)
    assert shown == pytest.approx((2 + 10) / 2, rel=0.01)


def test_contact_that_changes_at_borders_alone_is_counted_there() -> None:
    at, elsewhere = ([0.0 if start <= frame else 1.0 for frame in range(FRAMES)] for start in (20, 30))
    twice = np.where(np.arange(FRAMES) < 10, 0.0, at)  # changes at 10, too
    _, rate = border_figures([hand_along(np.asarray(twice))], PAIR, BORDERS)
    assert rate == pytest.approx(FRAMES - 1)  # one change at the only border; one in the 39 other frames
    _, none = border_figures([hand_along(np.asarray(elsewhere))], PAIR, BORDERS)
    assert none == 0
