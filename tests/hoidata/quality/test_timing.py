"""The lag between hands and object: found where one was planted, and not claimed where nothing tells."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.quality.timing import LARGEST_LAG, ObjectMotion, time_offset

CUBE = np.array(np.meshgrid([-0.04, 0.04], [-0.04, 0.04], [-0.04, 0.04])).reshape(3, 8).T
GRIP = np.array([0.05, 0.0, 0.0]) + np.random.default_rng(1).normal(0, 0.01, (21, 3))
LATE = (-5, -3, -1, 0, 1, 3, 5)
LAGS = pytest.mark.parametrize(("late", "seed"), [(late, seed) for late in LATE for seed in range(3)])


@dataclass
class Scene:
    """joints: (frame, 21, 3) of a hand that holds a cube which is waved about and turned."""

    joints: np.ndarray
    thing: ObjectMotion


def carried(frames: int = 90, late: int = 0, seed: int = 0, turning: float = 0.5) -> Scene:
    """The hand's frames are those of ``late`` frames before."""
    rng = np.random.default_rng(seed)
    time = np.arange(-20, frames + 20)[:, None] / 30
    place = sum(rng.normal(0, 0.04, 3) * np.sin(rng.uniform(2, 9) * time + rng.uniform(0, 6, 3)) for _ in range(4))
    turn = Rotation.from_rotvec(turning * np.sin(3 * time) * rng.normal(0, 1, 3)).as_matrix()
    hand = GRIP @ turn.transpose(0, 2, 1) + place[:, None]
    turn, place = turn[20:-20], place[20:-20]
    cube = CUBE @ turn.transpose(0, 2, 1) + place[:, None]
    thing = ObjectMotion(cube, np.zeros(8, np.uint8), turn[None], place[None])
    return Scene(hand[20 - late : 20 - late + frames], thing)


def usable(frames: int = 90) -> np.ndarray:
    return np.ones(frames, dtype=bool)


@LAGS
def test_planted_lag_is_found_with_its_sign(late, seed):
    scene = carried(90, late, seed)
    found = time_offset([(scene.joints, usable())], scene.thing)
    assert abs(found.frames - late) <= 1
    assert found.confidence > 0.9


@LAGS
def test_planted_lag_is_found_to_the_frame_where_the_object_does_not_turn(late, seed):
    scene = carried(90, late, seed, turning=0.0)
    found = time_offset([(scene.joints, usable())], scene.thing)
    assert found.frames == late
    assert found.confidence == pytest.approx(1, abs=0.005)


def test_hand_fixed_to_an_object_that_turns_agrees_with_it_entirely():
    scene = carried(turning=1.5)
    found = time_offset([(scene.joints, usable())], scene.thing)
    assert found.frames == 0
    assert found.confidence == pytest.approx(1, abs=1e-9)


def test_confidence_is_the_normalised_correlation_of_velocities():
    scene = carried(60, turning=0.0)
    joints = scene.joints + np.random.default_rng(0).normal(0, 0.01, scene.joints.shape)
    found = time_offset([(joints, usable(60))], scene.thing)
    cube, u, v = scene.thing.points_m, [], []
    for frame in range(LARGEST_LAG + 1, 60 - LARGEST_LAG - 1):
        distance = np.linalg.norm(joints[frame][:, None] - cube[frame][None], axis=-1)
        joint, point = np.unravel_index(distance.argmin(), distance.shape)
        one, other = (15 * (x[frame + 1, i] - x[frame - 1, i]) for x, i in ((cube, point), (joints, joint)))
        if distance.min() <= 0.05 and np.linalg.norm(one) >= 0.05:
            u.append(one)
            v.append(other)
    assert found.samples == len(u)
    assert found.frames == 0
    expected = np.vdot(u, v) / np.sqrt(np.vdot(u, u) * np.vdot(v, v))
    assert found.confidence == pytest.approx(expected, rel=1e-9)


def test_hand_on_the_moving_part_is_compared_with_that_part():
    scene = carried(turning=1.5)
    points = np.concatenate([scene.thing.points_m, np.repeat(CUBE[None] + 0.5, 90, axis=0)], axis=1)
    rotmats = np.stack([np.eye(3)[None].repeat(90, axis=0), scene.thing.rotmats[0]])
    places = np.stack([np.full((90, 3), 0.5), scene.thing.positions_m[0]])
    part = np.repeat(np.array([1, 0], np.uint8), 8)
    found = time_offset([(scene.joints, usable())], ObjectMotion(points, part, rotmats, places))
    assert found.frames == 0
    assert found.confidence == pytest.approx(1, abs=1e-9)


def test_object_that_rests_tells_nothing():
    scene = carried()
    points, part, rotmats, places = scene.thing
    still = ObjectMotion(
        points[:1].repeat(90, axis=0), part, rotmats[:, :1].repeat(90, axis=1), places[:, :1].repeat(90, axis=1)
    )
    found = time_offset([(scene.joints, usable())], still)
    assert np.isnan(found.frames)
    assert np.isnan(found.confidence)


def test_hand_far_away_or_lost_tells_nothing():
    scene = carried()
    assert np.isnan(time_offset([(scene.joints + 0.5, usable())], scene.thing).frames)
    assert np.isnan(time_offset([(scene.joints, ~usable())], scene.thing).frames)
    assert np.isnan(time_offset([], scene.thing).frames)
    short = carried(1)
    assert np.isnan(time_offset([(short.joints, usable(1))], short.thing).frames)


def test_frames_around_a_lost_one_are_not_compared():
    scene, valid = carried(late=2), usable()
    scene.joints[40], valid[40] = 9.0, False
    found = time_offset([(scene.joints, valid)], scene.thing)
    assert abs(found.frames - 2) <= 1
    assert found.confidence > 0.9


def test_hand_that_moves_on_its_own_gives_no_confidence():
    scene, other = carried(seed=0), carried(seed=5)
    found = time_offset([(other.joints, usable())], scene.thing)
    assert found.samples >= 15
    assert found.confidence < 0.8
