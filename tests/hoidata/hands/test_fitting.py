"""Fitting a MANO-layout hand to keypoints: poses of the model are recovered; bad keypoints are refused."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from hoidata.hands import fitting, load_embedded_hands, track_joints
from hoidata.hands.fitting import fit_hands, fit_shape

N_FRAMES = 24
MIRROR = np.array([-1.0, 1.0, 1.0])
HANDS = load_embedded_hands()


def waving_hand(side: str, betas: np.ndarray, seed: int) -> SimpleNamespace:
    """A hand that opens and closes its fingers while it moves and rotates in the world."""
    random = np.random.default_rng(seed)
    time = np.linspace(0, 3, N_FRAMES)[:, None]
    pose = HANDS[side].mean_pose + 0.05 * np.sin(time + random.uniform(0, 6, (1, 45)))
    bend = 0.4 + 0.4 * np.sin(2 * time + random.uniform(0, 6, (1, 12)))
    pose[:, 2:36:3] += bend if side == "right" else -bend
    return SimpleNamespace(
        wrist_m=np.concatenate((np.sin(time), np.cos(time), 0.1 * time), axis=1),
        global_orient=np.concatenate((2 * np.sin(time), np.cos(time), time), axis=1),
        hand_pose=pose,
        betas=betas.reshape(1, 10),
        template_m=None,
    )


def keypoints_of(track: SimpleNamespace, side: str) -> np.ndarray:
    return track_joints(track, HANDS[side]).astype(np.float64)


@pytest.fixture(scope="module")
def betas() -> np.ndarray:
    return np.array([0.9, -0.6, 0.5, 0.3, -0.4, 0.2, 0.0, 0.1, -0.2, 0.3])


@pytest.fixture(scope="module")
def keypoints(betas: np.ndarray) -> dict[str, np.ndarray]:
    return {side: keypoints_of(waving_hand(side, betas, seed), side) for seed, side in enumerate(("left", "right"))}


@pytest.mark.slow
def test_poses_of_the_model_are_recovered_with_one_shape_for_both_sides(keypoints: dict) -> None:
    fits = fit_hands(keypoints, HANDS)
    np.testing.assert_array_equal(fits["left"].betas, fits["right"].betas)
    for side, fit in fits.items():
        assert fit.error_m.mean() < 0.0005
        assert fit.error_m.max() < 0.0015
        fitted = SimpleNamespace(**{**vars(fit), "template_m": None})
        error = np.linalg.norm(keypoints_of(fitted, side) - keypoints[side], axis=-1)
        np.testing.assert_allclose(error, fit.error_m, atol=1e-6)


def test_with_a_known_shape_position_and_orientation_are_recovered(keypoints: dict, betas: np.ndarray) -> None:
    fit = fit_hands(keypoints, HANDS, betas)["right"]
    truth = waving_hand("right", betas, 1)
    np.testing.assert_array_equal(fit.betas[0], betas)
    np.testing.assert_allclose(fit.wrist_m, truth.wrist_m, atol=0.001)
    error = Rotation.from_rotvec(fit.global_orient).inv() * Rotation.from_rotvec(truth.global_orient)
    assert np.rad2deg(error.magnitude().max()) < 2


def test_mirrored_keypoints_give_the_mirrored_hand(keypoints: dict, betas: np.ndarray) -> None:
    right = fit_hands({"right": keypoints["right"]}, HANDS, betas)["right"]
    left = fit_hands({"left": keypoints["right"] * MIRROR}, HANDS, betas)["left"]
    flip = np.tile([1.0, -1.0, -1.0], 15)
    np.testing.assert_allclose(left.wrist_m, right.wrist_m * MIRROR, atol=1e-6)
    np.testing.assert_allclose(left.hand_pose, right.hand_pose * flip, atol=1e-4)


def test_the_pose_does_not_depend_on_the_world_frame(keypoints: dict, betas: np.ndarray) -> None:
    rotation = Rotation.from_rotvec([0.3, -1.2, 2.0])
    still = fit_hands({"right": keypoints["right"]}, HANDS, betas)["right"]
    shift = np.array([1.0, 2.0, 3.0])
    points = rotation.apply(keypoints["right"].reshape(-1, 3)).reshape(-1, 21, 3) + shift
    moved = fit_hands({"right": points}, HANDS, betas)["right"]
    np.testing.assert_allclose(moved.hand_pose, still.hand_pose, atol=1e-5)
    np.testing.assert_allclose(moved.wrist_m, rotation.apply(still.wrist_m) + shift, atol=1e-6)


def test_unknown_keypoints_are_ignored(keypoints: dict, betas: np.ndarray) -> None:
    points = keypoints["right"].copy()
    points[:, [5, 13]] = np.nan
    points[3, 16:] = np.nan
    error = fit_hands({"right": points}, HANDS, betas)["right"].error_m
    assert np.array_equal(np.isnan(error), np.isnan(points).any(axis=-1))
    assert np.nanmean(error) < 0.001


def test_noise_does_not_twist_fingers_about_their_bones(keypoints: dict, betas: np.ndarray) -> None:
    noise = np.random.default_rng(3).normal(scale=0.004, size=keypoints["right"].shape)
    fit = fit_hands({"right": keypoints["right"] + noise}, HANDS, betas)["right"]
    rest = HANDS.right.rest_joints_m(np.zeros((1, 10)))[0]
    bone = (rest[2] - rest[1]) / np.linalg.norm(rest[2] - rest[1])
    assert np.abs(fit.hand_pose[:, :3] @ bone).max() < 0.35
    assert fit.error_m.mean() < 0.008


def test_equal_keypoints_give_equal_bytes(keypoints: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "SHAPE_FRAMES", 6)
    monkeypatch.setattr(fitting, "SHAPE_STEPS", 3)
    first, second = (fit_hands(keypoints, HANDS)["left"] for _ in range(2))
    assert first.hand_pose.tobytes() == second.hand_pose.tobytes()


@pytest.mark.slow
def test_many_frames_of_another_skeleton_give_a_moderate_shape(keypoints: dict) -> None:
    stretched = {side: points.copy() for side, points in keypoints.items()}
    for points in stretched.values():
        points[:, 1:13:3] += 0.3 * (points[:, :1] - points[:, 1:13:3])
    assert np.abs(fit_shape(stretched, HANDS)).max() < 4


def test_keypoints_of_larger_weight_fit_better(keypoints: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    shifted = keypoints["right"].copy()
    shifted[:, 16:] += [0.0, 0.01, 0.0]
    errors_m = []
    for weight in (1.0, 20.0):
        monkeypatch.setattr(fitting, "WEIGHTS", (1.0,) * 16 + (weight,) * 5)
        errors_m.append(fit_hands({"right": shifted}, HANDS, np.zeros(10))["right"].error_m[:, 16:].mean())
    assert errors_m[1] < errors_m[0]


def test_keypoints_of_another_layout_are_refused() -> None:
    with pytest.raises(BadInput, match="shape \\(5, 20, 3\\)"):
        fit_hands({"right": np.zeros((5, 20, 3))}, HANDS)


def test_a_frame_without_a_palm_is_refused_by_its_number(keypoints: dict) -> None:
    points = keypoints["left"].copy()
    points[7, [0, 1, 4, 7]] = np.nan
    with pytest.raises(BadInput, match="2 in frame 7"):
        fit_hands({"left": points}, HANDS)
