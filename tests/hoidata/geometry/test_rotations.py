import numpy as np
import pytest
import torch
from scipy.linalg import expm

from hoidata.geometry.rotations import (
    canonical_rotvec,
    mirror_rotvec_x,
    rot6d_to_rotmat,
    rotmat_to_rot6d,
    rotmat_to_rotvec,
    rotvec_to_rotmat,
    skew,
)

ANGLES = (0.0, 1e-9, 1e-7, 9e-7, 1.1e-6, 1e-4, 0.1, 1.0, 3.0, np.pi - 1e-6, np.pi)


def rotvecs(angles=ANGLES, per_angle=8, seed=0):
    axes = np.random.default_rng(seed).normal(size=(len(angles), per_angle, 3))
    return (axes / np.linalg.norm(axes, axis=-1, keepdims=True) * np.array(angles)[:, None, None]).reshape(-1, 3)


def cross_matrix(vector):
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_rotvec_to_rotmat_is_the_matrix_exponential(kind):
    vectors = rotvecs()
    expected = np.stack([expm(cross_matrix(vector)) for vector in vectors])
    got = rotvec_to_rotmat(kind(vectors))
    assert type(got) is type(kind(vectors))
    np.testing.assert_allclose(np.asarray(got), expected, atol=1e-13)


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_rotvec_round_trips_through_matrices(kind):
    vectors = rotvecs([angle for angle in ANGLES if angle < 3.1])
    back = rotmat_to_rotvec(rotvec_to_rotmat(kind(vectors)))
    np.testing.assert_allclose(np.asarray(back), vectors, atol=1e-9)


def test_half_turns_round_trip_as_rotations():
    vectors = rotvecs([np.pi - 1e-6, np.pi, 4.0, 6.0])
    matrices = rotvec_to_rotmat(vectors)
    back = rotmat_to_rotvec(matrices)
    assert np.linalg.norm(back, axis=-1).max() <= np.pi + 1e-12
    np.testing.assert_allclose(rotvec_to_rotmat(back), matrices, atol=1e-9)


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_six_numbers_round_trip_and_are_the_first_two_columns_row_by_row(kind):
    matrices = kind(rotvec_to_rotmat(rotvecs()))
    six = rotmat_to_rot6d(matrices)
    first = np.asarray(matrices)[40]
    expected = [first[0, 0], first[0, 1], first[1, 0], first[1, 1], first[2, 0], first[2, 1]]
    np.testing.assert_array_equal(np.asarray(six)[40], expected)
    np.testing.assert_allclose(np.asarray(rot6d_to_rotmat(six)), np.asarray(matrices), atol=1e-12)


def test_any_six_numbers_become_a_proper_rotation():
    matrices = rot6d_to_rotmat(np.random.default_rng(1).normal(size=(5, 7, 6)))
    assert matrices.shape == (5, 7, 3, 3)
    np.testing.assert_allclose(
        matrices @ matrices.swapaxes(-1, -2), np.broadcast_to(np.eye(3), matrices.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(matrices), 1, atol=1e-12)


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_mirrored_rotvec_is_the_rotation_seen_in_the_mirror(kind):
    mirror = np.diag([-1.0, 1.0, 1.0])
    vectors = rotvecs([0.3, 2.0])
    mirrored = np.asarray(rotvec_to_rotmat(mirror_rotvec_x(kind(vectors))))
    np.testing.assert_allclose(mirrored, mirror @ rotvec_to_rotmat(vectors) @ mirror, atol=1e-14)


def test_gradient_is_right_at_and_around_zero():
    for angle in (0.0, 1e-7, 1e-3, 1.0):
        vector = torch.as_tensor(rotvecs([angle], 2), dtype=torch.float64).requires_grad_()
        assert torch.autograd.gradcheck(rotvec_to_rotmat, vector, eps=1e-6, atol=1e-7)
    zero = torch.zeros(1, 3, requires_grad=True)
    rotvec_to_rotmat(zero)[0, 1, 0].backward()
    torch.testing.assert_close(zero.grad, torch.tensor([[0.0, 0.0, 1.0]]))


def test_float32_stays_float32_and_accurate():
    vectors = rotvecs().astype(np.float32)
    expected = np.stack([expm(cross_matrix(vector.astype(np.float64))) for vector in vectors])
    for kind in (np.asarray, torch.as_tensor):
        got = np.asarray(rotvec_to_rotmat(kind(vectors)))
        assert got.dtype == np.float32
        np.testing.assert_allclose(got, expected, atol=5e-7)


def test_no_rotations_give_no_rotations():
    assert rotvec_to_rotmat(np.zeros((0, 16, 3))).shape == (0, 16, 3, 3)
    assert rotmat_to_rotvec(np.zeros((0, 3, 3))).shape == (0, 3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_canonical_axis_angles_are_the_same_rotations_of_at_most_pi_and_shorter_ones_stay_bit_for_bit(dtype):
    vectors = rotvecs((0.0, 0.5, 3.14159, 3.2, 4.0, 6.2, 6.4, 8.6, 12.0)).astype(dtype)
    result, exact = canonical_rotvec(vectors), 1e-6 if dtype == np.float32 else 1e-12
    for vector, canonical in zip(vectors.astype(np.float64), result.astype(np.float64), strict=True):
        np.testing.assert_allclose(expm(cross_matrix(canonical)), expm(cross_matrix(vector)), atol=10 * exact)
    assert np.linalg.norm(result, axis=1).max() <= np.pi + exact
    short = np.linalg.norm(vectors, axis=1) < 3.15
    assert result[short].tobytes() == vectors[short].tobytes()
    assert result.dtype == dtype


def test_rotation_about_z_takes_x_towards_y():
    quarter = rotvec_to_rotmat(np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(quarter @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


def test_skew_is_the_cross_product():
    generator = torch.Generator().manual_seed(0)
    first, second = torch.randn(2, 4, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close((skew(first) @ second[..., None])[..., 0], torch.linalg.cross(first, second))
