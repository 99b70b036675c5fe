"""Time offset between hands and object: planted lags, and clips without enough information."""

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
    """A hand that grasps a moving and rotating cube."""

    joints: np.ndarray  # (frame, 21, 3)
    motion: ObjectMotion


def carried(frames: int = 90, late: int = 0, seed: int = 0, turning: float = 0.5) -> Scene:
    """The hand lags ``late`` frames behind the object."""
    rng = np.random.default_rng(seed)
    time = np.arange(-20, frames + 20)[:, None] / 30
    position_m = sum(rng.normal(0, 0.04, 3) * np.sin(rng.uniform(2, 9) * time + rng.uniform(0, 6, 3)) for _ in range(4))
    rotation = Rotation.from_rotvec(turning * np.sin(3 * time) * rng.normal(0, 1, 3)).as_matrix()
    hand = GRIP @ rotation.transpose(0, 2, 1) + position_m[:, None]
    rotation, position_m = rotation[20:-20], position_m[20:-20]
    cube = CUBE @ rotation.transpose(0, 2, 1) + position_m[:, None]
    motion = ObjectMotion(cube, np.zeros(8, np.uint8), rotation[None], position_m[None])
    return Scene(hand[20 - late : 20 - late + frames], motion)


def usable(frames: int = 90) -> np.ndarray:
    return np.ones(frames, dtype=bool)


@LAGS
def test_planted_lag_is_found_with_its_sign(late, seed):
    scene = carried(90, late, seed)
    offset = time_offset([(scene.joints, usable())], scene.motion)
    assert abs(offset.frames - late) <= 1
    assert offset.confidence > 0.9


@LAGS
def test_planted_lag_is_found_to_the_frame_where_the_object_does_not_turn(late, seed):
    scene = carried(90, late, seed, turning=0.0)
    offset = time_offset([(scene.joints, usable())], scene.motion)
    assert offset.frames == late
    assert offset.confidence == pytest.approx(1, abs=0.005)


def test_confidence_is_the_normalised_correlation_of_velocities():
    scene = carried(60, turning=0.0)
    joints = scene.joints + np.random.default_rng(0).normal(0, 0.01, scene.joints.shape)
    offset = time_offset([(joints, usable(60))], scene.motion)
    cube, u, v = scene.motion.points_m, [], []
    for frame in range(LARGEST_LAG + 1, 60 - LARGEST_LAG - 1):
        distance = np.linalg.norm(joints[frame][:, None] - cube[frame][None], axis=-1)
        joint, point = np.unravel_index(distance.argmin(), distance.shape)
        one, other = (15 * (x[frame + 1, i] - x[frame - 1, i]) for x, i in ((cube, point), (joints, joint)))
        if distance.min() <= 0.05 and np.linalg.norm(one) >= 0.05:
            u.append(one)
            v.append(other)
    assert offset.samples == len(u)
    assert offset.frames == 0
    expected = np.vdot(u, v) / np.sqrt(np.vdot(u, u) * np.vdot(v, v))
    assert offset.confidence == pytest.approx(expected, rel=1e-9)


def test_hand_on_the_moving_part_is_compared_with_that_part():
    scene = carried(turning=1.5)
    points = np.concatenate([scene.motion.points_m, np.repeat(CUBE[None] + 0.5, 90, axis=0)], axis=1)
    rotmats = np.stack([np.eye(3)[None].repeat(90, axis=0), scene.motion.rotmats[0]])
    positions_m = np.stack([np.full((90, 3), 0.5), scene.motion.positions_m[0]])
    part = np.repeat(np.array([1, 0], np.uint8), 8)
    offset = time_offset([(scene.joints, usable())], ObjectMotion(points, part, rotmats, positions_m))
    assert offset.frames == 0
    assert offset.confidence == pytest.approx(1, abs=1e-9)


def test_an_object_at_rest_gives_no_offset():
    scene = carried()
    points, part, rotmats, positions_m = scene.motion
    still = ObjectMotion(
        points[:1].repeat(90, axis=0), part, rotmats[:, :1].repeat(90, axis=1), positions_m[:, :1].repeat(90, axis=1)
    )
    offset = time_offset([(scene.joints, usable())], still)
    assert np.isnan(offset.frames)
    assert np.isnan(offset.confidence)


def test_a_hand_far_away_or_lost_gives_no_offset():
    scene = carried()
    assert np.isnan(time_offset([(scene.joints + 0.5, usable())], scene.motion).frames)
    assert np.isnan(time_offset([(scene.joints, ~usable())], scene.motion).frames)
    assert np.isnan(time_offset([], scene.motion).frames)
    short = carried(1)
    assert np.isnan(time_offset([(short.joints, usable(1))], short.motion).frames)


def test_frames_around_a_lost_one_are_not_compared():
    scene, valid = carried(late=2), usable()
    scene.joints[40], valid[40] = 9.0, False
    offset = time_offset([(scene.joints, valid)], scene.motion)
    assert abs(offset.frames - 2) <= 1
    assert offset.confidence > 0.9


def test_an_independent_hand_gives_no_confidence():
    scene, other = carried(seed=0), carried(seed=5)
    offset = time_offset([(other.joints, usable())], scene.motion)
    assert offset.samples >= 15
    assert offset.confidence < 0.8
