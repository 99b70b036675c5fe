"""Sensors against closed formulas, a reference implementation, rigid motion, mirroring and edge cases."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors import OURS, PAPER, SensorReadings, sense, sensor_size
from hoidata.sensors.mano_hand import mano_hand
from tests.builders.objects import box_model, hinged_box, model_of
from tests.builders.sensing import SENSORS, random_rotations, small_hand
from tests.hoidata.sensors import slow

TIMES = len(OURS.times_s)
HERE = RigidTransform(np.tile(np.eye(3), (1, TIMES, 1, 1)), np.zeros((1, TIMES, 3)))
UP = np.array([0.0, 0.0, 1.0])


def scene(hand: TrackedHand, frames: int = 40, seed: int = 3) -> tuple[HandState, RigidTransform]:
    """Random hand poses around an object at the origin; the wrist moves slightly until each future time."""
    random = np.random.default_rng(seed)
    state = hand.state(random_rotations(frames * (hand.n_joints - 1), 0.3, seed).reshape(frames, -1, 3, 3))
    rotation = random_rotations(frames, 1.5, seed + 1)[:, None] @ random_rotations(
        frames * TIMES, 0.2, seed + 2
    ).reshape(frames, TIMES, 3, 3)
    middle = hand.wrist_from_canonical @ [0.11, 0.0, -0.05]
    position = random.normal(0, 0.025, (frames, 1, 3)) + random.normal(0, 0.01, (frames, TIMES, 3))
    return state, RigidTransform(rotation, position - rotation @ middle)


def with_sensors(points_m: np.ndarray, normals: np.ndarray) -> tuple[TrackedHand, HandState]:
    """A small hand with its sensors at ``points_m`` in the object's frame."""
    hand = small_hand()
    state = hand.state(hand.rest_rotmats[None])
    return hand, state._replace(sensor_m=points_m[None], sensor_normal=normals[None])


def reference_readings(
    hand: TrackedHand, state: HandState, wrist: RigidTransform, model: ObjectModel
) -> SensorReadings:
    vertices, faces = model.vertices_m, model.faces
    points, sensors = wrist @ state.point_m[:, None], wrist @ state.sensor_m[:, None]
    normals = wrist.turn(state.sensor_normal[:, None])
    distance, gradient = slow.distances(vertices, faces, points.reshape(-1, 3))
    gradient = wrist[:, 0].inverse().turn(gradient.reshape(points.shape)[:, 0]) @ hand.wrist_from_canonical
    depth = slow.distances(vertices, faces, sensors.reshape(-1, 3))[0]
    queries = zip(sensors.reshape(-1, 3), normals.reshape(-1, 3), depth, strict=True)
    proximity = np.array([slow.proximity(vertices, faces, *row) for row in queries]).reshape(sensors.shape[:3])
    ambient = np.array([reference_ambient(hand, state, wrist, model, frame) for frame in range(len(points))])
    return SensorReadings(ambient, proximity, np.minimum(distance, 0.1).reshape(points.shape[:3]), gradient)


def reference_ambient(
    hand: TrackedHand, state: HandState, wrist: RigidTransform, model: ObjectModel, frame: int
) -> np.ndarray:
    cells, axes = cells_in_object(hand, state, wrist, frame)
    distance = slow.distances(model.vertices_m, model.faces, cells)[0]
    queries = zip(cells, distance, strict=True)
    return np.array([slow.occupancy(model.vertices_m, model.faces, cell, axes, far) for cell, far in queries])


def cells_in_object(
    hand: TrackedHand, state: HandState, wrist: RigidTransform, frame: int
) -> tuple[np.ndarray, np.ndarray]:
    """Cell centres (1000, 3), index 100 x + 10 y + z, and the axes of their edges (3, 3)."""
    knuckle, canonical = state.joint_m[frame, hand.middle_knuckle], hand.wrist_from_canonical
    middle = knuckle + canonical @ [0.04, 0.0, -0.09]
    axes = state.joint_rotmats[frame, hand.middle_knuckle] @ canonical
    now, cells = wrist[frame, 0], np.empty((1000, 3))
    for index in range(1000):
        x, y, z = index // 100, index // 10 % 10, index % 10
        cells[index] = middle + axes @ (0.018 * (np.array([x, y, z]) - 4.5))
    return now @ cells, now.rotation @ axes


def assert_equal_readings(one: SensorReadings, other: SensorReadings, atol: float = 1e-9) -> None:
    for name, first, second in zip(SensorReadings._fields, one, other, strict=True):
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
    readings = sense(hand, state, wrist, None, SurfaceIndex(model))
    assert readings.flat().shape == (4, sensor_size(hand))
    assert_equal_readings(readings, reference_readings(hand, state, wrist, model))
    assert min(readings.proximity_m.min(), readings.distance_m.min()) < 0
    assert 0 < (readings.ambient > 0).mean() < 0.7


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    away = np.abs(points) - half
    return np.linalg.norm(np.maximum(away, 0), axis=-1) + np.minimum(away.max(axis=-1), 0)


def test_readings_of_a_box_equal_closed_formulas():
    hand, half = small_hand(), np.array([0.05, 0.04, 0.03])
    state, wrist = scene(hand, 100)
    readings = sense(hand, state, wrist, None, SurfaceIndex(box_model()))
    points = wrist @ state.point_m[:, None]
    np.testing.assert_allclose(readings.distance_m, np.minimum(box_distance(points, half), 0.1), atol=1e-12)
    start, direction = wrist @ state.sensor_m[:, None], wrist.turn(state.sensor_normal[:, None])
    outside = box_distance(start, half) > 0.001
    enters, leaves = ((sign * half - start) / direction for sign in (-np.sign(direction), np.sign(direction)))
    hit = enters.max(axis=-1)
    hit = np.where((hit <= leaves.min(axis=-1)) & (hit >= 0), hit, 0.1)
    np.testing.assert_allclose(readings.proximity_m[outside], np.minimum(hit, 0.1)[outside], atol=1e-12)
    for frame in range(0, 100, 10):
        cells, _ = cells_in_object(hand, state, wrist, frame)
        distance_m = box_distance(cells, half)
        near, far = distance_m <= 0.009, distance_m > 0.009 * np.sqrt(3)
        np.testing.assert_allclose(
            readings.ambient[frame, near], 1 - np.maximum(distance_m[near], 0) / 0.018, atol=1e-12
        )
        assert (readings.ambient[frame, far] == 0).all()


@pytest.mark.slow
def test_distances_to_a_finely_meshed_sphere_and_cylinder_are_exact_to_a_micrometre():
    radius, points = 0.01, np.random.default_rng(0).normal(0, 0.03, (2000, 3))
    fine = trimesh.creation.icosphere(6, radius)
    # How far the centre of a triangle is below the sphere.
    assert fine.edges_unique_length.max() ** 2 / (6 * radius) < 1e-6
    nearest = SurfaceIndex(model_of(fine)).nearest(points[None], None)
    np.testing.assert_allclose(nearest.distance_m[0], np.linalg.norm(points, axis=1) - radius, atol=1e-6)
    cylinder = SurfaceIndex(model_of(trimesh.creation.cylinder(0.03, 0.1, sections=1024)))
    across, along = np.linalg.norm(points[:, :2], axis=1) - 0.03, np.abs(points[:, 2]) - 0.05
    exact = np.hypot(np.maximum(across, 0), np.maximum(along, 0)) + np.minimum(np.maximum(across, along), 0)
    np.testing.assert_allclose(cylinder.nearest(points[None], None).distance_m[0], exact, atol=1e-6)


@pytest.mark.parametrize("settings", [OURS, PAPER])
def test_readings_do_not_depend_on_the_world_frame(settings):
    hand, surface = small_hand(), SurfaceIndex(MESHES["torus"])
    state, wrist = scene(hand)
    world_from_object = RigidTransform(random_rotations(1, 2.0, 9), np.array([[1.0, -2.0, 0.5]]))
    world_from_wrist = RigidTransform(world_from_object.rotation, world_from_object.translation) @ wrist
    again = world_from_object.inverse() @ world_from_wrist
    assert_equal_readings(
        sense(hand, state, wrist, None, surface, settings), sense(hand, state, again, None, surface, settings), 1e-12
    )


@pytest.mark.parametrize("settings", [OURS, PAPER])
@pytest.mark.parametrize("kind", ["small", "mano"])
def test_the_mirrored_scene_gives_the_other_hand_equal_readings(kind, settings):
    pair = load_embedded_hands()
    right, left = (small_hand(), small_hand().mirrored()) if kind == "small" else (
        mano_hand(pair, "right"), mano_hand(pair, "left"),
    )  # fmt: skip
    model, mirror = hinged_box(), np.diag([-1.0, 1.0, 1.0])
    random = np.random.default_rng(1)
    poses, hinge = (
        random_rotations(6 * (right.n_joints - 1), 0.3, 5).reshape(6, -1, 3, 3),
        random.uniform(0, 1, (6, TIMES)),
    )
    _, wrist = scene(right, 6)
    # Mirrored with normal x, in the object's frame and in the wrist's frame.
    other = replace(
        model,
        vertices_m=model.vertices_m @ mirror,
        faces=model.faces[:, ::-1],
        hinge=replace(model.hinge, axis=model.hinge.axis * [1, -1, -1], origin_m=mirror @ model.hinge.origin_m),
    )
    mirrored_wrist = RigidTransform(mirror @ wrist.rotation @ mirror, wrist.translation @ mirror)
    one = sense(right, right.state(poses), wrist, hinge, SurfaceIndex(model), settings)
    two = sense(left, left.state(mirror @ poses @ mirror), mirrored_wrist, hinge, SurfaceIndex(other), settings)
    assert_equal_readings(one, two)
    assert (one.ambient > 0).any()


def test_future_readings_move_the_present_hand_with_the_wrist_alone():
    hand, surface = small_hand(), SurfaceIndex(MESHES["torus"])
    state, wrist = scene(hand)
    readings = sense(hand, state, wrist, None, surface)
    for time in range(1, TIMES):
        now = sense(hand, state, wrist[:, [time] * TIMES], None, surface)
        np.testing.assert_array_equal(readings.proximity_m[:, time], now.proximity_m[:, 0])
        np.testing.assert_array_equal(readings.distance_m[:, time], now.distance_m[:, 0])


def test_single_frames_without_a_grid_give_the_bits_of_a_batch():
    hand, model = small_hand(), MESHES["torus"]
    state, wrist = scene(hand)
    whole = sense(hand, state, wrist, None, SurfaceIndex(model, grid_after=0)).flat()
    surface = SurfaceIndex(model)
    frames = [sense(hand, state.taken(slice(f, f + 1)), wrist[f : f + 1], None, surface).flat() for f in range(40)]
    np.testing.assert_array_equal(np.concatenate(frames), whole)


def test_proximity_inside_on_and_along_the_surface_is_as_in_the_release():
    """The box's top is at z = 0.03."""
    cases = [
        ((0, 0, 0.040), -UP, 0.010),  # above, facing down
        ((0, 0, 0.040), UP, 0.1),  # facing away
        ((0, 0, 0.025), -UP, -0.005),  # 5 mm inside, facing inward: the distance back to the top
        ((0, 0, 0.025), UP, -0.02),  # 5 mm inside, facing out: the ray starts in the box and enters no surface
        ((0, 0, 0.000), -UP, -0.02),  # deeper than 2 cm
        ((0, 0, 0.030), -UP, 0.0),  # on the surface
        ((0, 0, 0.030), np.array([1.0, 0, 0]), 0.0),  # on it, facing along: the ray enters no surface
        ((0, 0, 0.0305), -UP, 0.0005),  # touching
    ]
    hand, state = with_sensors(
        np.array([position for position, _, _ in cases]), np.array([direction for _, direction, _ in cases])
    )
    assert len(cases) == SENSORS
    readings = sense(hand, state, HERE, None, SurfaceIndex(box_model()))
    np.testing.assert_allclose(readings.proximity_m[0, 0], [value for _, _, value in cases], atol=1e-12)


def test_rays_of_the_paper_are_cast_backward_and_depth_is_limited_to_10_cm():
    cases = [
        ((0, 0, 0.025), -UP, -0.005),
        ((0, 0, 0.025), UP, -0.055),
        ((0, 0, 0.000), -UP, -0.03),
        ((0, 0, 0.030), -UP, 0.0),
        ((0, 0, 0.040), -UP, 0.01),
        ((0, 0, 0.040), UP, 0.1),
        ((0, 0, 0.0305), -UP, 0.0005),
        ((0.045, 0, 0), np.array([1.0, 0, 0]), -0.095),
    ]
    hand, state = with_sensors(
        np.array([position for position, _, _ in cases]), np.array([direction for _, direction, _ in cases])
    )
    readings = sense(hand, state, HERE, None, SurfaceIndex(box_model()), PAPER)
    np.testing.assert_allclose(readings.proximity_m[0, 0], [value for _, _, value in cases], atol=1e-12)
    big = SurfaceIndex(box_model((0.6, 0.6, 0.6)))
    assert sense(hand, state, HERE, None, big, PAPER).distance_m.min() == -0.1
    assert sense(hand, state, HERE, None, big).distance_m.min() < -0.1


def test_readings_of_a_hinged_object_equal_those_of_the_rigid_object_at_each_angle():
    hand, model, angles = small_hand(), hinged_box(), np.linspace(0, 1.2, TIMES)
    state, wrist = scene(hand, 5)
    still = wrist[:, [0] * TIMES]
    readings = sense(hand, state, still, np.tile(angles, (5, 1)), SurfaceIndex(model))
    for time, angle in enumerate(angles):
        turned = model.hinge.turn(np.array([angle]))
        vertices = np.where(model.part[:, None] == 1, (turned @ model.vertices_m)[0], model.vertices_m)
        faces = model.faces_of(0), model.faces_of(1), model.faces
        parts = [SurfaceIndex(ObjectModel("part", vertices, part_faces, model.part * 0)) for part_faces in faces]
        base, lid, both = (sense(hand, state, still, None, part) for part in parts)
        distance_m = np.minimum(base.distance_m, lid.distance_m)[:, 0]
        np.testing.assert_allclose(readings.distance_m[:, time], distance_m, atol=1e-12)
        np.testing.assert_allclose(readings.proximity_m[:, time], both.proximity_m[:, 0], atol=1e-12)
        if time == 0:
            np.testing.assert_allclose(readings.ambient, both.ambient, atol=1e-12)


def test_an_open_box_has_no_inside_and_is_hit_from_both_sides_and_a_small_hole_is_closed():
    box = box_model()
    top = np.abs(box.vertices_m[box.faces][:, :, 2].mean(axis=1) - 0.03) < 1e-9
    opened = SurfaceIndex(replace(box, faces=box.faces[~top]))
    sensors = np.array([[0, 0, 0.0], [0, 0, 0.0], [0, 0, -0.04], [0, 0, -0.02]] * 2)
    hand, state = with_sensors(sensors, np.array([-UP, UP, UP, -UP] * 2))
    readings = sense(hand, state, HERE, None, opened)
    np.testing.assert_allclose(readings.proximity_m[0, 0, :4], [0.03, 0.1, 0.01, 0.01], atol=1e-12)
    assert (readings.distance_m >= 0).all()
    ball = trimesh.creation.icosphere(3, 0.04)
    holed = SurfaceIndex(model_of(trimesh.Trimesh(ball.vertices, ball.faces[1:])))
    assert holed.repair_note == "object: 1 small hole closed"
    whole = sense(hand, state, HERE, None, SurfaceIndex(model_of(ball)))
    assert_equal_readings(sense(hand, state, HERE, None, holed), whole)
    assert whole.distance_m.min() < 0
