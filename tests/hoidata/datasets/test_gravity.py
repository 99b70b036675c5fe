"""Estimation of gravity from objects at rest, on generated scenes in rotated worlds."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hoidata.datasets.gravity import GravityEstimate, TrackedObject, estimate_gravity
from hoidata.objects.resting import footing

BOX, CAN = trimesh.creation.box((0.06, 0.09, 0.16)), trimesh.creation.cylinder(0.04, 0.15, sections=40)
REST, MOVE = 12, 30
STILL_INTERVAL = REST + 4  # frames until the hand arrives
DOWN_BY = np.deg2rad(40)
# World from camera of a head bent down, facing +y. Columns: image right, image down, forward.
CAMERA = np.array(
    [[1, 0, 0], [0, -np.sin(DOWN_BY), np.cos(DOWN_BY)], [0, -np.cos(DOWN_BY), -np.sin(DOWN_BY)]], dtype=float
)


def episode(start, end, yaw: float, lift_m: float = 0.15, waves: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Poses (frame, 4, 4) of an object that is moved and rotated by ``yaw``, and positions (frame, 3) of a hand.

    The hand comes from 40 cm next to the object, grasps its side while it moves, and leaves.
    """
    fraction = np.clip((np.arange(2 * STILL_INTERVAL + MOVE) - STILL_INTERVAL) / MOVE, 0, 1)
    middle = np.array(start) + fraction[:, None] * np.subtract(end, start)
    middle[:, 2] += lift_m * np.sin(2 * np.pi * waves * fraction)
    poses = np.tile(np.eye(4), (len(fraction), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(fraction[:, None] * (0, 0, yaw)).as_matrix()
    poses[:, :3, 3] = middle
    away = np.zeros(len(fraction))
    away[:REST], away[-REST:] = 0.4, 0.4
    away[REST : REST + 4] = away[-REST - 4 : -REST][::-1] = np.linspace(0.4, 0, 4)
    return poses, middle + np.stack((0.05 + away, 0 * away, 0 * away), axis=1)


def scene(*, lift_m: float = 0.15, waves: float = 0.5, lean: Rotation | None = None, yaw: float = 1.0):
    """A box, then a can, each moved once on a table at height 0.7 m; gravity is -z. lean: constant tilt of the box."""
    box, hand_box = episode((0.0, 0.4, 0.78), (0.2, 0.5, 0.78), yaw, lift_m, waves)
    can, hand_can = episode((-0.2, 0.4, 0.775), (-0.1, 0.3, 0.775), yaw, lift_m, waves)
    if lean is not None:
        box[:, :3, :3] = lean.as_matrix() @ box[:, :3, :3]
    n = len(box)
    frames = np.arange(2 * n) < n
    objects = [
        TrackedObject(footing(np.asarray(BOX.vertices), np.asarray(BOX.faces)), frames, np.concatenate((box, can))),
        TrackedObject(footing(np.asarray(CAN.vertices), np.asarray(CAN.faces)), ~frames, np.concatenate((box, can))),
    ]
    hand = np.concatenate((hand_box, hand_can))
    joints = hand[:, None] + np.linspace(0, 0.09, 21)[:, None] * (1.0, 0.2, 0.3)
    return objects, joints, np.tile(CAMERA, (2 * n, 1, 1))


def rotated(objects, joints, camera, rotation: np.ndarray, shift: np.ndarray):
    moved = []
    for tracked_object in objects:
        poses = tracked_object.poses.copy()
        poses[:, :3, :3] = rotation @ poses[:, :3, :3]
        poses[:, :3, 3] = poses[:, :3, 3] @ rotation.T + shift
        moved.append(replace(tracked_object, poses=poses))
    return moved, joints @ rotation.T + shift, rotation @ camera


def error_deg(estimate: GravityEstimate, truth) -> float:
    assert estimate.direction is not None, estimate.note
    assert abs(np.linalg.norm(estimate.direction) - 1) < 1e-12
    return float(np.rad2deg(np.arccos(np.clip(estimate.direction @ truth, -1, 1))))


def test_gravity_points_to_the_side_on_which_objects_stand():
    estimate = estimate_gravity(*scene())
    assert error_deg(estimate, (0, 0, -1)) < 1e-3
    assert estimate.note.startswith("estimated from")
    assert "4 stretches that agree within 0.1 degrees" in estimate.note


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_gravity_rotates_with_the_world(seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    estimate = estimate_gravity(*rotated(*scene(), rotation, rng.normal(size=3)))
    assert error_deg(estimate, rotation @ (0, 0, -1)) < 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_tracking_noise_changes_gravity_by_less_than_a_degree(seed):
    objects, joints, camera = scene()
    rng = np.random.default_rng(seed)
    for tracked_object in objects:
        shaken = Rotation.from_rotvec(np.deg2rad(0.5) * rng.normal(size=(len(tracked_object.poses), 3))).as_matrix()
        tracked_object.poses[:, :3, :3] = shaken @ tracked_object.poses[:, :3, :3]
        tracked_object.poses[:, :3, 3] += 0.001 * rng.normal(size=(len(tracked_object.poses), 3))
    assert error_deg(estimate_gravity(objects, joints, camera), (0, 0, -1)) < 1


def unknown(estimate: GravityEstimate) -> str:
    assert estimate.direction is None
    assert estimate.note.startswith("unknown: ")
    return estimate.note


def test_a_leaning_object_makes_gravity_unknown():
    leaning = scene(lean=Rotation.from_rotvec((0.35, 0, 0)))
    assert "stretches agree" in unknown(estimate_gravity(*leaning))


def test_one_object_that_leans_twice_in_the_same_direction_is_no_evidence():
    objects, joints, camera = scene(lean=Rotation.from_rotvec((0.2, 0, 0)), yaw=0.0)
    assert "no two objects" in unknown(estimate_gravity(objects[:1], joints, camera))


def test_objects_that_are_never_lifted_leave_gravity_unknown():
    assert "lifted" in unknown(estimate_gravity(*scene(lift_m=0.0)))


def test_a_hand_that_never_leaves_makes_gravity_unknown():
    objects, joints, camera = scene()
    position_m = np.concatenate([tracked_object.poses[tracked_object.frames, :3, 3] for tracked_object in objects])
    assert "no object stands still" in unknown(
        estimate_gravity(objects, np.tile(position_m[:, None], (1, 21, 1)), camera)
    )
    assert "no object stands still" in unknown(estimate_gravity(objects, np.full_like(joints, np.nan), camera))


def test_a_camera_that_looks_up_from_below_does_not_reverse_gravity():
    objects, joints, camera = scene()
    for rotation in (Rotation.from_euler("y", np.pi), Rotation.from_euler("z", np.pi), Rotation.from_euler("x", np.pi)):
        estimate = estimate_gravity(objects, joints, camera @ rotation.as_matrix())
        assert estimate.direction is None or error_deg(estimate, (0, 0, -1)) < 1


def test_a_side_is_not_a_support_when_the_object_sinks_through_it():
    objects, joints, camera = scene(waves=1)
    lowest = np.concatenate([tracked_object.poses[tracked_object.frames, 2, 3] for tracked_object in objects]) < 0.75
    assert lowest.any()
    joints[lowest] = np.nan  # only the object's motion remains as evidence
    assert "no two objects" in unknown(estimate_gravity(objects, joints, camera))


def test_a_side_is_not_a_support_when_a_hand_reaches_below_it():
    objects, joints, camera = scene()
    assert "no two objects" in unknown(estimate_gravity(objects, joints - (0, 0, 0.1), camera))


def test_no_object_gives_no_gravity():
    _, joints, camera = scene()
    assert "no object" in unknown(estimate_gravity([], joints, camera))


def test_an_object_with_one_stable_side_determines_gravity():
    objects, joints, camera = scene()
    base_only = [replace(t, footing=replace(t.footing, downs=np.array([[0.0, 0.0, -1.0]]))) for t in objects]
    assert error_deg(estimate_gravity(base_only, joints, camera), (0, 0, -1)) < 1e-3
    top_only = [replace(t, footing=replace(t.footing, downs=np.array([[0.0, 0.0, 1.0]]))) for t in objects]
    assert estimate_gravity(top_only, joints, camera).direction is None


def test_one_leaning_object_does_not_outvote_the_others_by_resting_often():
    """Four usable intervals of a box that always leans in the same direction, one of a can."""
    objects, joints, camera = scene(lean=Rotation.from_rotvec((0.2, 0, 0)), yaw=0.0)
    n = len(joints) // 2
    order = np.concatenate((np.tile(np.arange(n), 4), np.arange(n, n + STILL_INTERVAL)))
    repeated = [
        replace(tracked_object, frames=tracked_object.frames[order], poses=tracked_object.poses[order])
        for tracked_object in objects
    ]
    repeated[0].frames[[n, 2 * n, 3 * n]] = False  # each repetition starts a new track of the box
    assert "4 of 5" in unknown(estimate_gravity(repeated, joints[order], camera[order]))
