import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hoidata.geometry.transform import IDENTITY, RigidTransform

FRAMES = 5


@pytest.fixture(params=[np.asarray, torch.as_tensor])
def kind(request):
    return request.param


def poses(kind, seed: int, pivot: bool = False) -> tuple[RigidTransform, np.ndarray]:
    """Transforms of five frames, and the same as homogeneous matrices by another way."""
    rng = np.random.default_rng(seed)
    rotvec, offset, about = rng.normal(size=(3, FRAMES, 3))
    about = about * pivot
    matrix = np.tile(np.eye(4), (FRAMES, 1, 1))
    matrix[:, :3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    matrix[:, :3, 3] = offset - np.einsum("fij,fj->fi", matrix[:, :3, :3], about)
    plain = RigidTransform.from_rotvec(kind(rotvec), kind(offset))
    return (RigidTransform(plain.rotation, plain.offset, kind(about)) if pivot else plain), matrix


def moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.einsum("fij,fpj->fpi", matrix, np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1))[..., :3]


@pytest.mark.parametrize("pivot", [False, True])
def test_a_chain_of_transforms_and_its_inverse_equal_products_of_homogeneous_matrices(kind, pivot):
    (world_from_object, first), (object_from_part, second) = poses(kind, 1), poses(kind, 2, pivot)
    points = np.random.default_rng(3).normal(size=(FRAMES, 7, 3))
    world_from_part = world_from_object @ object_from_part
    for transform, matrix in (
        (world_from_part, first @ second),
        (object_from_part @ world_from_object, second @ first),
        (world_from_part.inverse(), np.linalg.inv(first @ second)),
        (object_from_part.inverse() @ world_from_object.inverse(), np.linalg.inv(first @ second)),
    ):
        result = transform @ kind(points)
        assert type(result) is type(kind(points))
        np.testing.assert_allclose(np.asarray(result), moved(matrix, points), atol=1e-12)
        np.testing.assert_allclose(np.asarray(transform.translation), matrix[:, :3, 3], atol=1e-12)
        np.testing.assert_allclose(np.asarray(transform.rotation), matrix[:, :3, :3], atol=1e-12)


def test_points_that_all_frames_share_and_rows_that_are_picked_keep_their_axes(kind):
    transform, matrix = poses(kind, 4)
    hinge = RigidTransform(transform.rotation, kind(np.ones(3)), kind(np.ones(3)))
    points = np.random.default_rng(5).normal(size=(7, 3))
    np.testing.assert_allclose(
        np.asarray(transform @ kind(points)), moved(matrix, np.tile(points, (FRAMES, 1, 1))), atol=1e-12
    )
    for whole in (transform, hinge):
        np.testing.assert_array_equal(
            np.asarray(whole[np.array([3, 1])] @ kind(points)), np.asarray(whole @ kind(points))[[3, 1]]
        )
    np.testing.assert_allclose(np.asarray(hinge @ kind(np.ones((1, 3)))), np.ones((FRAMES, 1, 3)), atol=1e-12)


def test_directions_are_rotated_and_not_translated(kind):
    transform, matrix = poses(kind, 6)
    vectors = np.random.default_rng(7).normal(size=(FRAMES, 2, 3))
    expected = np.einsum("fij,fpj->fpi", matrix[:, :3, :3], vectors)
    np.testing.assert_allclose(np.asarray(transform.turn(kind(vectors))), expected, atol=1e-12)


def test_the_identity_changes_nothing(kind):
    transform, _ = poses(kind, 8)
    points = kind(np.ones((FRAMES, 2, 3)))
    assert IDENTITY @ points is points
    assert IDENTITY @ transform is transform
    assert transform @ IDENTITY is transform
    assert IDENTITY.inverse() is IDENTITY
    assert IDENTITY.turn(points) is points
