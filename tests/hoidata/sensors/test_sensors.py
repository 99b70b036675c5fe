"""Sensors against closed formulas, slow independent code, motion of the scene, the mirror, and odd places."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors import OURS, PAPER, Sensed, sense, sensor_size
from hoidata.sensors.mano_hand import mano_hand
from tests.builders.objects import box_model, hinged_box, model_of
from tests.builders.sensing import SENSORS, small_hand, turns
from tests.hoidata.sensors import slow

TIMES = len(OURS.times_s)
HERE = RigidTransform(np.tile(np.eye(3), (1, TIMES, 1, 1)), np.zeros((1, TIMES, 3)))
UP = np.array([0.0, 0.0, 1.0])


def scene(hand: TrackedHand, frames: int = 40, seed: int = 3) -> tuple[HandState, RigidTransform]:
    """Hands in many poses about an object at the origin, which moves a little until each later time."""
    random = np.random.default_rng(seed)
    state = hand.state(turns(frames * (hand.n_joints - 1), 0.3, seed).reshape(frames, -1, 3, 3))
    turn = turns(frames, 1.5, seed + 1)[:, None] @ turns(frames * TIMES, 0.2, seed + 2).reshape(frames, TIMES, 3, 3)
    middle = hand.wrist_from_canonical @ [0.11, 0.0, -0.05]
    place = random.normal(0, 0.025, (frames, 1, 3)) + random.normal(0, 0.01, (frames, TIMES, 3))
    return state, RigidTransform(turn, place - turn @ middle)


def with_sensors(points: np.ndarray, normals: np.ndarray) -> tuple[TrackedHand, HandState]:
    """A small hand whose skin points lie where they are told, in the object's frame."""
    hand = small_hand()
    state = hand.state(hand.rest_rotmats[None])
    return hand, state._replace(sensor_m=points[None], sensor_normal=normals[None])


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
    cells, turn = cells_in_object(hand, state, wrist, frame)
    distance = slow.distances(model.vertices_m, model.faces, cells)[0]
    rows = zip(cells, distance, strict=True)
    return np.array([slow.occupancy(model.vertices_m, model.faces, cell, turn, way) for cell, way in rows])


def cells_in_object(
    hand: TrackedHand, state: HandState, wrist: RigidTransform, frame: int
) -> tuple[np.ndarray, np.ndarray]:
    """Cell by cell, index 100 x + 10 y + z: middles (1000, 3), and the axes of their edges (3, 3)."""
    knuckle, canonical = state.joint_m[frame, hand.middle_knuckle], hand.wrist_from_canonical
    middle = knuckle + canonical @ [0.04, 0.0, -0.09]
    axes = state.joint_rotmats[frame, hand.middle_knuckle] @ canonical
    now, cells = wrist[frame, 0], np.empty((1000, 3))
    for index in range(1000):
        x, y, z = index // 100, index // 10 % 10, index % 10
        cells[index] = middle + axes @ (0.018 * (np.array([x, y, z]) - 4.5))
    return now @ cells, now.rotation @ axes


def assert_alike(one: Sensed, other: Sensed, atol: float = 1e-9) -> None:
    for name, first, second in zip(Sensed._fields, one, other, strict=True):
        np.testing.assert_allclose(first, second, rtol=0, atol=atol, err_msg=name)


MESHES = {
    "box": box_model(),
    "sphere": model_of(trimesh.creation.icosphere(2, 0.04)),
    "torus": model_of(trimesh.creation.torus(0.05, 0.02, major_sections=24, minor_sections=12)),
    "cylinder": model_of(trimesh.creation.cylinder(0.03, 0.1, sections=32)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
def test_all_sensors_agree_with_slow_independent_code(name):
    hand, model = small_hand(), MESHES[name]
    state, wrist = scene(hand, 4)
    found = sense(hand, state, wrist, None, SurfaceIndex(model))
    assert found.flat().shape == (4, sensor_size(hand))
    assert_alike(found, sensed_slowly(hand, state, wrist, model))
    assert min(found.proximity_m.min(), found.distance_m.min()) < 0
    assert 0 < (found.ambient > 0).mean() < 0.7


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    away = np.abs(points) - half
    return np.linalg.norm(np.maximum(away, 0), axis=-1) + np.minimum(away.max(axis=-1), 0)


def test_a_box_is_sensed_as_its_closed_formulas_say():
    hand, half = small_hand(), np.array([0.05, 0.04, 0.03])
    state, wrist = scene(hand, 100)
    found = sense(hand, state, wrist, None, SurfaceIndex(box_model()))
    points = wrist @ state.point_m[:, None]
    np.testing.assert_allclose(found.distance_m, np.minimum(box_distance(points, half), 0.1), atol=1e-12)
    start, way = wrist @ state.sensor_m[:, None], wrist.turn(state.sensor_normal[:, None])
    outside = box_distance(start, half) > 0.001
    enters, leaves = ((sign * half - start) / way for sign in (-np.sign(way), np.sign(way)))
    met = enters.max(axis=-1)
    met = np.where((met <= leaves.min(axis=-1)) & (met >= 0), met, 0.1)
    np.testing.assert_allclose(found.proximity_m[outside], np.minimum(met, 0.1)[outside], atol=1e-12)
    for frame in range(0, 100, 10):
        cells, _ = cells_in_object(hand, state, wrist, frame)
        way = box_distance(cells, half)
        near, far = way <= 0.009, way > 0.009 * np.sqrt(3)
        np.testing.assert_allclose(found.ambient[frame, near], 1 - np.maximum(way[near], 0) / 0.018, atol=1e-12)
        assert (found.ambient[frame, far] == 0).all()


@pytest.mark.slow
def test_a_sphere_and_a_cylinder_are_sensed_to_a_micrometre_where_their_meshes_are_that_fine():
    radius, points = 0.01, np.random.default_rng(0).normal(0, 0.03, (2000, 3))
    fine = trimesh.creation.icosphere(6, radius)
    assert fine.edges_unique_length.max() ** 2 / (6 * radius) < 1e-6  # how far a triangle's middle lies below it
    found = SurfaceIndex(model_of(fine)).nearest(points[None], None)
    np.testing.assert_allclose(found.distance_m[0], np.linalg.norm(points, axis=1) - radius, atol=1e-6)
    cylinder = SurfaceIndex(model_of(trimesh.creation.cylinder(0.03, 0.1, sections=1024)))
    across, along = np.linalg.norm(points[:, :2], axis=1) - 0.03, np.abs(points[:, 2]) - 0.05
    exact = np.hypot(np.maximum(across, 0), np.maximum(along, 0)) + np.minimum(np.maximum(across, along), 0)
    np.testing.assert_allclose(cylinder.nearest(points[None], None).distance_m[0], exact, atol=1e-6)


@pytest.mark.parametrize("settings", [OURS, PAPER])
def test_moving_the_whole_scene_changes_nothing(settings):
    hand, surface = small_hand(), SurfaceIndex(MESHES["torus"])
    state, wrist = scene(hand)
    world_from_object = RigidTransform(turns(1, 2.0, 9), np.array([[1.0, -2.0, 0.5]]))
    world_from_wrist = RigidTransform(world_from_object.rotation, world_from_object.translation) @ wrist
    again = world_from_object.inverse() @ world_from_wrist
    assert_alike(
        sense(hand, state, wrist, None, surface, settings), sense(hand, state, again, None, surface, settings), 1e-12
    )


@pytest.mark.parametrize("settings", [OURS, PAPER])
@pytest.mark.parametrize("kind", ["small", "mano"])
def test_the_mirrored_scene_gives_the_other_hand_the_same_numbers(kind, settings):
    pair = load_embedded_hands()
    right, left = (small_hand(), small_hand().mirrored()) if kind == "small" else (
        mano_hand(pair, "right"), mano_hand(pair, "left"),
    )  # fmt: skip
    model, mirror = hinged_box(), np.diag([-1.0, 1.0, 1.0])
    random = np.random.default_rng(1)
    poses, hinge = turns(6 * (right.n_joints - 1), 0.3, 5).reshape(6, -1, 3, 3), random.uniform(0, 1, (6, TIMES))
    _, wrist = scene(right, 6)
    # In a mirror with normal x of the object's and of the wrist's frame.
    other = replace(
        model,
        vertices_m=model.vertices_m @ mirror,
        faces=model.faces[:, ::-1],
        hinge=replace(model.hinge, axis=model.hinge.axis * [1, -1, -1], origin_m=mirror @ model.hinge.origin_m),
    )
    seen = RigidTransform(mirror @ wrist.rotation @ mirror, wrist.translation @ mirror)
    one = sense(right, right.state(poses), wrist, hinge, SurfaceIndex(model), settings)
    two = sense(left, left.state(mirror @ poses @ mirror), seen, hinge, SurfaceIndex(other), settings)
    assert_alike(one, two)
    assert (one.ambient > 0).any()


def test_the_present_hand_is_carried_to_later_times_by_its_wrist_alone():
    hand, surface = small_hand(), SurfaceIndex(MESHES["torus"])
    state, wrist = scene(hand)
    found = sense(hand, state, wrist, None, surface)
    for time in range(1, TIMES):
        now = sense(hand, state, wrist[:, [time] * TIMES], None, surface)
        np.testing.assert_array_equal(found.proximity_m[:, time], now.proximity_m[:, 0])
        np.testing.assert_array_equal(found.distance_m[:, time], now.distance_m[:, 0])


def test_single_frames_without_a_grid_give_the_bits_of_a_batch():
    hand, model = small_hand(), MESHES["torus"]
    state, wrist = scene(hand)
    whole = sense(hand, state, wrist, None, SurfaceIndex(model, grid_from=0)).flat()
    surface = SurfaceIndex(model)
    rows = [sense(hand, state.taken(slice(f, f + 1)), wrist[f : f + 1], None, surface).flat() for f in range(40)]
    np.testing.assert_array_equal(np.concatenate(rows), whole)


def test_sensors_inside_on_the_surface_and_along_it_say_what_the_release_says():
    """The box's top is at z = 0.03."""
    told = [
        ((0, 0, 0.040), -UP, 0.010),  # above, looking down
        ((0, 0, 0.040), UP, 0.1),  # away
        ((0, 0, 0.025), -UP, -0.005),  # 5 mm inside, the skin faces inward: back out to the top it came through
        ((0, 0, 0.025), UP, -0.02),  # 5 mm inside, facing out: its ray starts in the box and enters nothing
        ((0, 0, 0.000), -UP, -0.02),  # deeper than 2 cm
        ((0, 0, 0.030), -UP, 0.0),  # on the surface
        ((0, 0, 0.030), np.array([1.0, 0, 0]), 0.0),  # on it, looking along: nothing is entered, and it is not inside
        ((0, 0, 0.0305), -UP, 0.0005),  # touching
    ]
    hand, state = with_sensors(np.array([place for place, _, _ in told]), np.array([way for _, way, _ in told]))
    assert len(told) == SENSORS
    found = sense(hand, state, HERE, None, SurfaceIndex(box_model()))
    np.testing.assert_allclose(found.proximity_m[0, 0], [value for _, _, value in told], atol=1e-12)


def test_the_paper_looks_back_out_of_the_object_and_bounds_depth_at_10_cm():
    told = [
        ((0, 0, 0.025), -UP, -0.005),
        ((0, 0, 0.025), UP, -0.055),
        ((0, 0, 0.000), -UP, -0.03),
        ((0, 0, 0.030), -UP, 0.0),
        ((0, 0, 0.040), -UP, 0.01),
        ((0, 0, 0.040), UP, 0.1),
        ((0, 0, 0.0305), -UP, 0.0005),
        ((0.045, 0, 0), np.array([1.0, 0, 0]), -0.095),
    ]
    hand, state = with_sensors(np.array([place for place, _, _ in told]), np.array([way for _, way, _ in told]))
    found = sense(hand, state, HERE, None, SurfaceIndex(box_model()), PAPER)
    np.testing.assert_allclose(found.proximity_m[0, 0], [value for _, _, value in told], atol=1e-12)
    big = SurfaceIndex(box_model((0.6, 0.6, 0.6)))
    assert sense(hand, state, HERE, None, big, PAPER).distance_m.min() == -0.1
    assert sense(hand, state, HERE, None, big).distance_m.min() < -0.1


def test_a_hinged_object_is_sensed_as_the_rigid_one_it_is_at_each_angle():
    hand, model, angles = small_hand(), hinged_box(), np.linspace(0, 1.2, TIMES)
    state, wrist = scene(hand, 5)
    still = wrist[:, [0] * TIMES]
    found = sense(hand, state, still, np.tile(angles, (5, 1)), SurfaceIndex(model))
    for time, angle in enumerate(angles):
        turned = model.hinge.turn(np.array([angle]))
        vertices = np.where(model.part[:, None] == 1, (turned @ model.vertices_m)[0], model.vertices_m)
        faces = model.faces_of(0), model.faces_of(1), model.faces
        parts = [SurfaceIndex(ObjectModel("part", vertices, own, model.part * 0)) for own in faces]
        base, lid, both = (sense(hand, state, still, None, part) for part in parts)
        nearer = np.minimum(base.distance_m, lid.distance_m)[:, 0]
        np.testing.assert_allclose(found.distance_m[:, time], nearer, atol=1e-12)
        np.testing.assert_allclose(found.proximity_m[:, time], both.proximity_m[:, 0], atol=1e-12)
        if time == 0:
            np.testing.assert_allclose(found.ambient, both.ambient, atol=1e-12)


def test_an_open_box_has_no_inside_and_is_met_from_both_sides_and_a_small_hole_is_closed():
    box = box_model()
    top = np.abs(box.vertices_m[box.faces][:, :, 2].mean(axis=1) - 0.03) < 1e-9
    opened = SurfaceIndex(replace(box, faces=box.faces[~top]))
    told = np.array([[0, 0, 0.0], [0, 0, 0.0], [0, 0, -0.04], [0, 0, -0.02]] * 2)
    hand, state = with_sensors(told, np.array([-UP, UP, UP, -UP] * 2))
    found = sense(hand, state, HERE, None, opened)
    np.testing.assert_allclose(found.proximity_m[0, 0, :4], [0.03, 0.1, 0.01, 0.01], atol=1e-12)
    assert (found.distance_m >= 0).all()
    ball = trimesh.creation.icosphere(3, 0.04)
    holed = SurfaceIndex(model_of(trimesh.Trimesh(ball.vertices, ball.faces[1:])))
    assert holed.solid_note == "object: 1 small hole closed"
    whole = sense(hand, state, HERE, None, SurfaceIndex(model_of(ball)))
    assert_alike(sense(hand, state, HERE, None, holed), whole)
    assert whole.distance_m.min() < 0
