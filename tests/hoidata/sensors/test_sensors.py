"""Sensors against closed formulas, slow independent code, motion of the scene, the mirror, and odd places."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors import OURS, PAPER, Sensed, sense, sensor_size
from tests.builders.objects import box_model, hinged_box, model_of
from tests.builders.sensing import small_hand, turns
from tests.hoidata.sensors import slow

TIMES = len(OURS.times_s)


def scene(hand: TrackedHand, frames: int = 40, seed: int = 3) -> tuple[HandState, RigidTransform]:
    """Hands in many poses about an object at the origin, which moves a little until each later time."""
    random = np.random.default_rng(seed)
    state = hand.state(turns(frames * (hand.n_joints - 1), 0.3, seed).reshape(frames, -1, 3, 3))
    turn = turns(frames, 1.5, seed + 1)[:, None] @ turns(frames * TIMES, 0.2, seed + 2).reshape(frames, TIMES, 3, 3)
    middle = np.array([0.11, 0.0, -0.05])
    place = random.normal(0, 0.025, (frames, 1, 3)) + random.normal(0, 0.01, (frames, TIMES, 3))
    return state, RigidTransform(turn, place - turn @ middle)


def sensed_slowly(hand: TrackedHand, state: HandState, wrist: RigidTransform, model: ObjectModel) -> Sensed:
    vertices, faces = model.vertices_m, model.faces
    points, sensors = wrist @ state.point_m[:, None], wrist @ state.sensor_m[:, None]
    normals = wrist.turn(state.sensor_normal[:, None])
    distance, gradient = slow.distances(vertices, faces, points.reshape(-1, 3))
    gradient = wrist[:, 0].inverse().turn(gradient.reshape(points.shape)[:, 0]) @ hand.wrist_from_canonical
    depth = slow.distances(vertices, faces, sensors.reshape(-1, 3))[0]
    rows = zip(sensors.reshape(-1, 3), normals.reshape(-1, 3), depth, strict=True)
    proximity = np.array([slow.proximity(vertices, faces, *row) for row in rows]).reshape(sensors.shape[:3])
    ambient = np.array([ambient_slowly(hand, state, wrist, model, frame) for frame in range(len(points))])
    return Sensed(ambient, proximity, np.minimum(distance, 0.1).reshape(points.shape[:3]), gradient)


def ambient_slowly(
    hand: TrackedHand, state: HandState, wrist: RigidTransform, model: ObjectModel, frame: int
) -> np.ndarray:
    """Cell by cell, index 100 x + 10 y + z."""
    knuckle, canonical = state.joint_m[frame, hand.middle_knuckle], hand.wrist_from_canonical
    middle = knuckle + canonical @ [0.04, 0.0, -0.09]
    axes = state.joint_rotmats[frame, hand.middle_knuckle] @ canonical
    now, cells = wrist[frame, 0], np.empty((1000, 3))
    for index in range(1000):
        x, y, z = index // 100, index // 10 % 10, index % 10
        cells[index] = middle + axes @ (0.018 * (np.array([x, y, z]) - 4.5))
    cells, turn = now @ cells, now.rotation @ axes
    distance = slow.distances(model.vertices_m, model.faces, cells)[0]
    rows = zip(cells, distance, strict=True)
    return np.array([slow.occupancy(model.vertices_m, model.faces, cell, turn, way) for cell, way in rows])


def assert_alike(one: Sensed, other: Sensed, atol: float = 1e-9) -> None:
    for name, first, second in zip(Sensed._fields, one, other, strict=True):
        np.testing.assert_allclose(first, second, rtol=0, atol=atol, err_msg=name)


MESHES = {
    "box": box_model(),
    "sphere": model_of(trimesh.creation.icosphere(2, 0.04)),
    "torus": model_of(trimesh.creation.torus(0.05, 0.02, major_sections=24, minor_sections=12)),
    "cylinder": model_of(trimesh.creation.cylinder(0.03, 0.1, sections=32)),
}


@pytest.mark.parametrize("name", MESHES)
def test_all_sensors_agree_with_slow_independent_code(name):
    hand, model = small_hand(), MESHES[name]
    state, wrist = scene(hand, 20)
    found = sense(hand, state, wrist, None, SurfaceIndex(model))
    assert found.flat().shape == (20, sensor_size(hand))
    assert_alike(found, sensed_slowly(hand, state, wrist, model))
    assert (found.proximity_m < 0).any() and (found.distance_m < 0).any() and 0 < (found.ambient > 0).mean() < 0.7
