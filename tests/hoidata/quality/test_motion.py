"""Shaking, jumps, frozen stretches and gaps: formulas by hand, then faults planted into smooth motion."""

import numpy as np
import pytest

from hoidata.quality.motion import (
    accelerations_m_s2,
    equal_steps,
    gap_share,
    largest_jump,
    longest_frozen,
    steps_m,
)

RULE = {"notable_m": 0.03, "large_m": 0.3, "ratio": 4.0}


def usable(frames: int) -> np.ndarray:
    return np.ones(frames, dtype=bool)


def smooth(frames: int = 60, points: int = 5) -> np.ndarray:
    """(frame, point, 3): points that sway by 20 cm, at most about 1 m/s."""
    phase = np.linspace(0, 2 * np.pi, frames)[:, None, None]
    return 0.2 * np.sin(phase + np.arange(points)[None, :, None] + np.arange(3))


def test_free_fall_is_measured_as_9_81_m_s2():
    seconds = np.arange(20) / 30
    falling = np.zeros((20, 2, 3))
    falling[:, :, 2] = (-0.5 * 9.81 * seconds**2)[:, None]
    accelerations = accelerations_m_s2(falling, usable(20))
    assert np.isnan(accelerations[[0, -1]]).all()
    assert accelerations[1:-1] == pytest.approx(9.81, rel=1e-9)


def test_noise_of_one_millimetre_shakes_at_3_5_m_s2():
    noise = np.random.default_rng(0).normal(0, 0.001, (20_000, 1, 3))
    assert np.nanmean(accelerations_m_s2(noise, usable(20_000))) == pytest.approx(3.518, rel=0.01)


def test_constant_speed_does_not_accelerate_and_short_clips_have_no_acceleration():
    steady = np.arange(10)[:, None, None] * np.array([0.1, 0.2, 0.3])
    assert np.nanmax(accelerations_m_s2(steady, usable(10))) == pytest.approx(0, abs=1e-9)
    assert np.isnan(accelerations_m_s2(steady[:2], usable(2))).all()


def test_frames_that_mean_nothing_spoil_neither_accelerations_nor_steps():
    points, valid = smooth(), usable(60)
    clean_accelerations, clean_steps = accelerations_m_s2(points, valid), steps_m(points, valid)
    points[20], valid[20] = 7.0, False
    accelerations, steps = accelerations_m_s2(points, valid), steps_m(points, valid)
    assert np.isnan(accelerations[19:22]).all()
    usable_frames = [1, 18, 22, 58]
    assert accelerations[usable_frames].tolist() == clean_accelerations[usable_frames].tolist()
    assert steps[[19, 20]].tolist() == [0, 0]
    assert steps[[18, 21]].tolist() == clean_steps[[18, 21]].tolist()


def test_step_is_the_way_of_the_point_that_moves_most():
    points = np.zeros((3, 2, 3))
    points[1, 1] = 0.3, 0.4, 0.0
    assert steps_m(points, usable(3)) == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("frame", [0, 1, 30, 57, 58])
def test_planted_jump_is_found_with_its_size_and_frame(frame):
    points = smooth()
    points[frame + 1 :, :, 0] += 0.4
    jump = largest_jump(steps_m(points, usable(60)), **RULE)
    assert jump.frame == frame
    assert jump.size_m == pytest.approx(0.4, abs=0.05)


def test_glitch_of_one_frame_is_a_jump_and_smooth_motion_is_none():
    points = smooth()
    assert largest_jump(steps_m(points, usable(60)), **RULE) == (0.0, -1)
    points[30, 2] += 0.15
    assert largest_jump(steps_m(points, usable(60)), **RULE).size_m == pytest.approx(0.26, abs=0.05)


def test_frozen_stretch_is_counted_in_frames():
    numbers = np.random.default_rng(0).normal(size=(30, 51))
    assert longest_frozen(equal_steps(numbers, usable(30))) == 0
    numbers[10:17] = numbers[10]
    numbers[20:23] = numbers[20]
    assert longest_frozen(equal_steps(numbers, usable(30))) == 7


def test_equal_means_to_1e_7_in_every_number():
    numbers = np.zeros((3, 4))
    numbers[1, 2], numbers[2, 2] = 0.9e-7, 3e-7
    assert equal_steps(numbers, usable(3)).tolist() == [True, False]


def test_frames_that_mean_nothing_are_not_frozen():
    valid = usable(6)
    valid[2:] = False
    assert longest_frozen(equal_steps(np.zeros((6, 4)), valid)) == 2


@pytest.mark.parametrize(
    ("valid", "fraction"),
    [("1111", 0.0), ("0000", 0.0), ("0110", 0.0), ("1011", 0.25), ("0100010", 0.6)],
)
def test_gap_is_what_is_missing_between_the_first_and_the_last_sight_of_a_hand(valid, fraction):
    assert gap_share(np.array([flag == "1" for flag in valid])) == pytest.approx(fraction)
