"""On which sides a body can stand: bodies whose stable sides are known from geometry."""

import numpy as np
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hoidata.objects.resting import footing


def downs(mesh: trimesh.Trimesh) -> np.ndarray:
    return footing(np.asarray(mesh.vertices), np.asarray(mesh.faces)).downs


def same_directions(actual: np.ndarray, expected: np.ndarray, tolerance_deg: float = 1e-4) -> bool:
    if len(actual) != len(expected):
        return False
    cosine = np.clip(actual @ np.asarray(expected, dtype=float).T, -1, 1)
    return bool((np.rad2deg(np.arccos(cosine)).min(axis=0) <= tolerance_deg).all())


AXES = np.concatenate((np.eye(3), -np.eye(3)))


def test_a_box_stands_on_each_of_its_six_sides():
    assert same_directions(downs(trimesh.creation.box((0.05, 0.08, 0.12))), AXES)


def test_a_can_stands_on_its_two_ends_and_rolls_on_its_side():
    assert same_directions(downs(trimesh.creation.cylinder(0.037, 0.13, sections=42)), AXES[[2, 5]])


def test_a_prism_of_six_sides_does_not_roll():
    assert len(downs(trimesh.creation.cylinder(0.05, 0.1, sections=6))) == 8


def test_a_ball_has_no_resting_pose():
    assert downs(trimesh.creation.icosphere(3, 0.05)).shape == (0, 3)


def test_a_pencil_does_not_stand_on_its_end():
    assert not (np.abs(downs(trimesh.creation.cylinder(0.004, 0.15, sections=6))[:, 2]) > 0.5).any()


def test_a_slanted_body_does_not_stand_on_a_foot_its_weight_is_not_above():
    """A box sheared so far that its middle leaves the base; 1.5 times the base's width over the height."""
    mesh = trimesh.creation.box((0.05, 0.05, 0.1))
    mesh.vertices[:, 0] += 1.5 * mesh.vertices[:, 2]
    assert not (np.abs(downs(mesh)[:, 2]) > 0.999).any()
    mesh.vertices[:, 0] -= 1.2 * mesh.vertices[:, 2]
    assert (np.abs(downs(mesh)[:, 2]) > 0.999).sum() == 2


def test_an_open_or_flat_mesh_raises_no_error():
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=float)
    assert footing(flat, np.array([[0, 1, 2], [1, 3, 2]])).downs.shape == (0, 3)
    box = trimesh.creation.box((0.05, 0.08, 0.12))
    assert same_directions(footing(np.asarray(box.vertices), np.asarray(box.faces)[2:]).downs, AXES)


def test_a_scanned_underside_that_is_not_flat_is_one_side():
    mesh = trimesh.creation.box((0.08, 0.06, 0.15)).subdivide().subdivide().subdivide()
    noisy = np.asarray(mesh.vertices) + np.random.default_rng(0).normal(size=mesh.vertices.shape) * 0.0005
    assert same_directions(footing(noisy, np.asarray(mesh.faces)).downs, AXES, tolerance_deg=2)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_the_sides_rotate_with_the_mesh(seed):
    rotation = Rotation.random(random_state=np.random.default_rng(seed)).as_matrix()
    mesh = trimesh.creation.box((0.05, 0.08, 0.12))
    turned = footing(np.asarray(mesh.vertices) @ rotation.T + 0.3, np.asarray(mesh.faces))
    assert same_directions(turned.downs, AXES @ rotation.T)
