"""The parts of the solvers against independent formulas."""

import numpy as np
import pytest
import torch

from hoidata.clips.clip import ObjectTrack
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import HandKinematics, load_embedded_hands
from hoidata.refinement import grasp_solver
from hoidata.refinement.banded import acceleration_equations, second_differences, solve_blocks
from hoidata.refinement.grasp_solver import CLEAR_M, GraspObjective
from hoidata.refinement.kernels import N_UNKNOWNS, add_squares
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.skin import HandPose, SkinnedHand
from tests.builders.clips import still_object
from tests.builders.objects import box_model, hinged_box, igl_signed_m

FRAMES = 3
IDS = np.array([0, 5, 100, 317, 445, 556, 673, 745, 760])


def any_pose(seed: int = 0, frames: int = FRAMES) -> HandPose:
    random = np.random.default_rng(seed)
    rotation = rotvec_to_rotmat(random.normal(size=(frames, 3)))
    return HandPose(random.normal(size=(frames, 3)), rotation, random.normal(0, 0.5, (frames, 15, 3)))


def kinematics_vertices(pose: HandPose, betas: np.ndarray, template_m: np.ndarray) -> np.ndarray:
    """The same hand by the project's torch kinematics."""
    layer = HandKinematics(load_embedded_hands().left, torch.float64)
    rotmats = np.concatenate((pose.orient[:, None], rotvec_to_rotmat(pose.fingers)), 1)
    arrays = (pose.wrist_m, rotmats, betas[None], template_m)
    return layer(*(torch.from_numpy(array) for array in arrays))[0].numpy()


@pytest.mark.slow
def test_vertices_and_derivatives_equal_those_of_the_hand_model():
    random, model = np.random.default_rng(1), load_embedded_hands().left
    betas, template = random.normal(size=10), model.template_m + random.normal(0, 0.001, (778, 3))
    skin, pose = SkinnedHand(model, betas, template, IDS), any_pose()
    chain = skin.chain(pose, slopes=True)
    assert skin.vertices_m(chain) == pytest.approx(kinematics_vertices(pose, betas, template)[:, IDS], abs=1e-12)
    derivative, step = skin.all_derivatives(chain).reshape(FRAMES, len(IDS), 3, N_UNKNOWNS), 1e-6
    for unknown in range(N_UNKNOWNS):
        direction = np.zeros((FRAMES, N_UNKNOWNS))
        direction[:, unknown] = step
        ahead, behind = (kinematics_vertices(pose.moved(sign * direction), betas, template)[:, IDS] for sign in (1, -1))
        assert derivative[..., unknown] == pytest.approx((ahead - behind) / (2 * step), abs=1e-8)


@pytest.mark.slow
def test_the_field_has_the_distances_of_both_posed_parts_and_their_gradient():
    model, random = hinged_box(), np.random.default_rng(2)
    rotvec, position_m = random.normal(size=(2, FRAMES, 3)).astype(np.float32)
    object_track = ObjectTrack(model, rotvec, position_m, np.array([0.0, -0.5, -1.2], np.float32))
    points_m = object_track.world_from_object @ random.uniform(-0.06, 0.06, (FRAMES, 200, 3))
    distance, slope = ObjectField(object_track).distances(points_m)
    for frame in range(FRAMES):
        vertices = object_track.take(slice(frame, frame + 1)).points_in_world(model.vertices_m, model.part)[0]
        by_part = [igl_signed_m(vertices, model.faces_of(part), points_m[frame]) for part in (0, 1)]
        exact = np.min(by_part, axis=0)
        near = exact < 0.01  # outside of the grid the distance is approximate
        assert near.sum() > 100
        assert distance[frame, near] == pytest.approx(exact[near], abs=0.0015)
    ahead, behind = (
        np.stack([ObjectField(object_track).distances(points_m + step * np.eye(3)[axis])[0] for axis in range(3)], -1)
        for step in (1e-6, -1e-6)
    )
    assert np.median(np.abs(slope - (ahead - behind) / 2e-6)) < 1e-6
    assert np.mean(np.abs(slope - (ahead - behind) / 2e-6).max(axis=-1) < 1e-3) > 0.98  # except at cell boundaries
    chosen, _ = ObjectField(object_track).distances(points_m[[2, 0]], np.array([2, 0]))
    assert np.array_equal(chosen, distance[[2, 0]])


@pytest.mark.parametrize("sizes_m", [(0.3, 0.2, 0.003), (1.4, 0.025, 0.025), (0.06, 0.06, 0.06), (2.0, 0.5, 0.02)])
def test_distances_of_any_proportions(sizes_m):
    """Above a face the distance is the height; inside the distance is negative."""
    field = ObjectField(still_object(box_model(sizes_m), 1))
    heights = np.array([-0.5 * sizes_m[2], 0.002, 0.006])
    points_m = np.stack(
        (0.31 * sizes_m[0] + 0 * heights, 0.1 * sizes_m[1] + 0 * heights, 0.5 * sizes_m[2] + heights), 1
    )
    distance = field.distances(points_m[None])[0][0]
    np.testing.assert_allclose(distance[1:], heights[1:], atol=0.001)
    assert distance[0] < 0


def test_the_banded_system_equals_the_dense_one():
    random, frames, values, n = np.random.default_rng(3), 6, 7, 4
    derivative = random.normal(size=(frames, values, n))
    weight = np.concatenate(([0, 0], random.uniform(1, 2, frames - 2)))
    weight[4] = 0  # a gap has no residual
    value = random.normal(size=(frames, values))
    stacked = np.zeros((frames, values, frames, n))
    for frame in range(2, frames):
        for back, factor in enumerate((1, -2, 1)):
            stacked[frame, :, frame - back] = factor * derivative[frame - back]
    dense = stacked.reshape(frames * values, frames * n)
    heavy = np.repeat(weight, values)
    matrix = dense.T @ (heavy[:, None] * dense) + np.eye(frames * n)
    difference = second_differences(value)
    vector = -dense.T @ (heavy * difference.ravel())
    blocks, actual = acceleration_equations(derivative, difference, weight)
    blocks[0] = blocks[0] + np.eye(n)
    assert actual.ravel() == pytest.approx(vector)
    assert solve_blocks(blocks, actual).ravel() == pytest.approx(np.linalg.solve(matrix, vector))


@pytest.mark.parametrize("part", [None, 0, 1])
def test_the_vector_of_the_grasp_objective_is_minus_half_the_gradient_of_its_cost(part, monkeypatch):
    """The vector is minus half the gradient of the cost; the hand is partly in both parts of a hinged box."""
    model, hand = hinged_box(), load_embedded_hands().right
    still = np.zeros((FRAMES, 3), np.float32)
    object_track = ObjectTrack(model, still, still, np.linspace(0, -0.6, FRAMES, dtype=np.float32))
    skin = SkinnedHand(hand, np.zeros(10), None)
    flat = HandPose(np.zeros((1, 3)), np.eye(3)[None], hand.mean_pose.reshape(1, 15, 3).astype(np.float64))
    centre = skin.vertices_m(skin.chain(flat))[0].mean(axis=0)
    hands = flat._replace(wrist_m=np.array([[0.013, -0.007, 0.021]]) - centre).taken(np.zeros(FRAMES, int))
    in_grasp = np.array([True, True, False])
    passed = None if part is None else np.array([False, True, False])
    monkeypatch.setattr(grasp_solver, "REACH_M", 0.01)
    field, frames = ObjectField(object_track), np.arange(FRAMES)
    objective = GraspObjective(skin, field, hands, frames, in_grasp, None, part or 0, passed)
    near = objective.start.passing_m < CLEAR_M
    assert near.any(axis=1).tolist() == [False, part is not None, False]
    vector, step = objective.equations(objective.start)[1], 1e-7
    directions = np.eye(N_UNKNOWNS)[:6] * step
    ahead, behind = (
        np.stack(
            [objective.costs(objective.evaluate(np.tile(sign * direction, (FRAMES, 1)))) for direction in directions], 1
        )
        for sign in (1, -1)
    )
    slope = (ahead - behind) / (2 * step)
    assert np.abs(vector[:, :6] + slope / 2).max() < 0.03 * np.abs(slope).max()


def test_scattered_squares_equal_matrix_products():
    random, pairs = np.random.default_rng(4), 20
    frame, slope = random.integers(0, 2, pairs), random.normal(size=(pairs, 3))
    derivative, weight = random.normal(size=(pairs, 3, N_UNKNOWNS)), random.uniform(size=pairs)
    residual = random.normal(size=pairs)
    matrix, vector = np.zeros((2, N_UNKNOWNS, N_UNKNOWNS)), np.zeros((2, N_UNKNOWNS))
    add_squares(frame, slope, derivative, weight, residual, matrix, vector)
    gradient = np.einsum("pa,pan->pn", slope, derivative)
    for index in range(2):
        in_frame = frame == index
        assert np.tril(matrix[index]) == pytest.approx(
            np.tril((gradient[in_frame].T * weight[in_frame]) @ gradient[in_frame])
        )
        assert vector[index] == pytest.approx(-gradient[in_frame].T @ (weight[in_frame] * residual[in_frame]))
