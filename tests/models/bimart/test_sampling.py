"""BimArt's sampling: guidance equals its formulas, windows are joined, each sample depends on its seed only."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hoidata.batches.requests import ObjectPoints, Request
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rot6d, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.sensors.part_bps import BasisSettings
from hoidata.settings import build_config
from models.bimart.family import keypoints_in_world
from models.bimart.network import (
    ContactModel,
    DenoiserConfig,
    Layout,
    MotionModel,
    SceneWindow,
    build_windows,
)
from models.bimart.sampler import (
    OURS,
    PAPER,
    BimArt,
    BimArtSamplerConfig,
    ContactTarget,
    SamplingConfig,
    SamplingTask,
    combined,
    discrepancy,
    metre_step,
    paper_step,
    sampling_of,
)
from models.bimart.scene import FeatureConfig, RecordedClip, Scene
from models.bimart.training import middle_start, window_starts
from models.common.transformer import TransformerConfig
from tests.builders.objects import hinged_box

FEATURES = FeatureConfig(BasisSettings(3), keypoints=4, window_frames=8, state="local", max_distance_m=0.2)
TINY = DenoiserConfig(
    FEATURES,
    TransformerConfig(width=16, layers=1, heads=2, feed_forward=16, dropout=0.0),
    (8,),
    condition_on_hands=True,
    position_dropout=0.0,
)
FAST = replace(OURS, sampler=BimArtSamplerConfig("ddim", 2, 0.5))


def path_features(frames: int, seed: int = 0, shift_m: float = 0.0) -> np.ndarray:
    """(frame, 10) features of a smooth motion of a hinged object, model frame."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames)[:, None]
    rotation = rotvec_to_rotmat(time * rng.normal(size=3))
    rows = (time * rng.normal(size=3) * 0.1 + shift_m, rotmat_to_rot6d(rotation), time)
    return np.concatenate(rows, axis=1).astype(np.float32)


def scene(frames: int, seed: int = 0, basis: BasisSettings = FEATURES.basis, shift_m: float = 0.0) -> Scene:
    return Scene.of(BOX, path_features(frames, seed, shift_m), basis)


BOX = hinged_box()


def target_map(seed: int = 0) -> tuple[torch.Tensor, ContactTarget]:
    rng = torch.Generator().manual_seed(seed)
    keypoints = torch.randn(2, 3, 2, 5, 3, generator=rng)
    mask = torch.rand(2, 3, 14, generator=rng) < 0.8
    return keypoints, ContactTarget(torch.randn(2, 3, 7, 3, generator=rng), torch.rand(2, 3, 14, generator=rng), mask)


def test_the_contact_map_of_keypoints_is_the_distance_to_the_nearest_keypoint() -> None:
    keypoints, target = target_map()
    current = discrepancy(keypoints, target)
    distance_m = np.linalg.norm(
        keypoints.numpy()[:, :, :, None] - target.object_point_m.numpy()[:, :, None, :, None], axis=-1
    )
    error = distance_m.min(axis=-1) - target.contact_m.numpy().reshape(2, 3, 2, 7)
    np.testing.assert_allclose(current.error_m, error * target.mask.numpy().reshape(2, 3, 2, 7), atol=1e-6)
    np.testing.assert_array_equal(current.nearest, distance_m.argmin(axis=-1))


def test_the_papers_step_is_the_normalised_negative_gradient_of_the_mean_squared_error() -> None:
    keypoints, target = target_map()
    scale = torch.rand(2, 5, 3) + 0.5
    step = paper_step(keypoints, target, scale, window_frames=64)
    normalised = (keypoints / scale).double().requires_grad_()
    vectors_m = (normalised * scale)[:, :, :, None] - target.object_point_m[:, :, None, :, None]
    error = (vectors_m.norm(dim=-1).amin(-1) - target.contact_m.unflatten(-1, (2, 7))) * target.mask.unflatten(
        -1, (2, 7)
    )
    count = target.mask.unflatten(-1, (2, 7)).sum((1, 3), keepdim=True)
    (error.square() / count).sum().backward()
    for row in range(2):
        down = -normalised.grad[row] / normalised.grad[row].norm()
        torch.testing.assert_close(step[row], down.float(), rtol=1e-4, atol=1e-6)


def test_the_papers_step_has_length_1_in_each_window_of_a_longer_motion() -> None:
    keypoints, target = target_map()
    target = replace(target, mask=target.mask[:, :1].expand(-1, 3, -1))  # equal weights of both hands in all frames
    scale = torch.rand(2, 5, 3) + 0.5
    step = paper_step(keypoints, target, scale, window_frames=2)
    for frames in (slice(0, 2), slice(2, 3)):
        window = ContactTarget(*(tensor[:, frames] for tensor in vars(target).values()))
        alone = paper_step(keypoints[:, frames], window, scale, window_frames=2)
        torch.testing.assert_close(step[:, frames], alone)
        torch.testing.assert_close(alone.flatten(1).norm(dim=1), torch.ones(2))


def test_a_step_in_metres_moves_keypoints_towards_the_target_and_keeps_those_that_match() -> None:
    points_m = torch.tensor([[0.0, 0, 0]]).expand(1, 1, 1, 3)
    keypoints = torch.tensor([[[0.05, 0, 0], [0.0, 0.3, 0]]]).expand(1, 1, 2, 2, 3)
    target = ContactTarget(points_m, torch.tensor([[[0.0, 0.05]]]), torch.ones(1, 1, 2, dtype=torch.bool))
    step = metre_step(keypoints, target)
    # One point of weight 1: the whole error over 1 + 0.5.
    assert float(step[0, 0, 0, 0, 0]) == pytest.approx(-0.05 / 1.5)
    assert not step[0, 0, 0, 1].any()
    torch.testing.assert_close(step[0, 0, 1], torch.zeros(2, 3), atol=1e-7, rtol=0)


@pytest.mark.parametrize("target_m", [0.0, 0.01, 0.04])
def test_a_point_with_a_large_target_distance_has_little_weight(target_m: float) -> None:
    """Weights decay by 1/e in 2 cm of the target distance."""
    keypoints = torch.tensor([[[0.05, 0, 0]]]).expand(1, 1, 2, 1, 3)
    target = ContactTarget(torch.zeros(1, 1, 1, 3), torch.full((1, 1, 2), target_m), torch.ones(1, 1, 2).bool())
    weight = np.exp(-target_m / 0.02)
    expected = -weight * (0.05 - target_m) / (weight + 0.5)
    assert metre_step(keypoints, target)[0, 0, :, 0, 0].numpy() == pytest.approx([expected, expected], rel=1e-4)


def test_a_hand_is_active_within_20_cm_of_the_object() -> None:
    distance_m = np.array([0.01, 0.19, 0.21, 0.5])
    to_object = np.zeros((2, 4, 3, 3))
    to_object[..., 2], to_object[:, :, 0, 2] = 1.0, distance_m
    request = request_of(np.array([False, True]))
    pose = RigidTransform(np.tile(np.eye(3), (4, 1, 1)), np.ones((4, 3)))
    hands = keypoints_in_world(request, pose, np.zeros((2, 4, 3, 3)), to_object)
    assert list(hands) == ["right"]
    assert hands["right"].is_active.tolist() == [True, True, False, False]
    np.testing.assert_array_equal(hands["right"].keypoints_m, np.ones((4, 3, 3)))


def request_of(active_hands: np.ndarray) -> Request:
    points = ObjectPoints(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1))
    return Request("m", BOX, points, np.zeros(512, np.float32), active_hands, 4)


def test_classifier_free_guidance_is_the_usual_formula_or_equation_7() -> None:
    conditional, unconditional = torch.tensor([2.0]), torch.tensor([3.0])
    assert float(combined(conditional, unconditional, 0.5, "usual")) == 1.5 * 2 - 0.5 * 3
    assert float(combined(conditional, unconditional, 0.5, "paper")) == 1.5 * 2 - 3


@pytest.mark.parametrize("frames", [5, 8, 9, 12, 30])
@pytest.mark.parametrize("overlapping", [True, False])
def test_windows_cover_a_motion_and_joined_windows_are_the_motion(frames: int, overlapping: bool) -> None:
    layout, motion = Layout(frames, min(8, frames), overlapping), torch.randn(3, frames, 2)
    torch.testing.assert_close(layout.joined(layout.cut(motion)), motion)
    covered = {start + step for start in layout.starts for step in range(layout.length)}
    assert covered >= set(range(frames))
    if overlapping:
        assert max(covered) < frames
        assert all(b - a <= 4 for a, b in zip(layout.starts, layout.starts[1:], strict=False))


def test_overlapping_windows_are_averaged_with_less_weight_towards_their_ends() -> None:
    layout = Layout(6, 4)
    assert layout.starts == [0, 2]
    joined = layout.joined(torch.stack((torch.zeros(4, 1), torch.ones(4, 1))))
    np.testing.assert_allclose(joined[0, :, 0], [0, 0, 1 / 3, 2 / 3, 1, 1], rtol=1e-6)


def test_the_state_is_the_objects_pose_relative_to_the_first_frame_or_its_local_velocities() -> None:
    near, far = scene(12), scene(12, shift_m=3.0)
    rotation, position = near.model_from_canonical.rotation, near.model_from_canonical.translation
    pose = near.state("pose", 4, 9)
    np.testing.assert_allclose(pose[:, :3], rotmat_to_rotvec(rotation[4:9]), atol=1e-12)
    np.testing.assert_allclose(pose[:, 3:], position[4:9] - position[4], atol=1e-12)
    local = near.state("local", 4, 9)
    np.testing.assert_allclose(local, near.state("local", 0, 12)[4:9])
    np.testing.assert_allclose(local, far.state("local", 4, 9), atol=1e-5)
    np.testing.assert_allclose(local[1, :3], rotation[5].T @ [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(local[1, 3:6], rotation[5].T @ (position[6] - position[4]) * 15, atol=1e-9)
    np.testing.assert_allclose(local[1, 6:], rotmat_to_rotvec(rotation[4].T @ rotation[6]) * 15, atol=1e-9)


def test_the_pose_state_is_relative_to_the_window_in_training_and_in_sampling() -> None:
    whole, config = scene(20), replace(TINY, features=replace(FEATURES, state="pose"))
    windows = [SceneWindow(whole, start, start + 8, np.ones(2, bool)) for start in Layout(20, 8).starts]
    batch = build_windows(windows, config)
    for row, window in enumerate(windows):
        torch.testing.assert_close(batch.state[row], build_windows([window], config).state[0])
        assert not batch.state[row, 0, 3:].any()


@pytest.mark.parametrize(
    ("change", "differs"),
    [
        ({"state": "pose"}, {"state"}),
        ({"basis": replace(FEATURES.basis, nearest="surface")}, {"basis_offset"}),
        ({"basis": replace(FEATURES.basis, seed=1)}, {"basis_offset"}),
        ({"keypoints": 5}, set()),
        ({"max_distance_m": 0.0}, set()),
        ({"contact_map_target": "keypoints"}, set()),
    ],
)  # fmt: skip
def test_a_feature_setting_changes_only_its_own_input(change: dict, differs: set[str]) -> None:
    features = replace(FEATURES, **change)
    kinds = [
        build_windows(
            [SceneWindow(scene(8, basis=config_features.basis), 0, 8, np.array([True, False]))],
            replace(TINY, features=config_features),
        )
        for config_features in (FEATURES, features)
    ]
    names = ("basis_offset", "state", "object_scale", "point_exists", "active_hands", "frame_mask")
    assert {
        name for name in names if not torch.equal(*(getattr(config_features, name) for config_features in kinds))
    } == differs


def recorded(features: np.ndarray, hand_m: np.ndarray | None = None) -> RecordedClip:
    """A clip of an object motion (frame, 10) and two hands at positions (frame, 3), by default resting 30 cm away."""
    object_scene = Scene.of(BOX, features, FEATURES.basis)
    hands_m = np.broadcast_to([0.3, 0, 0], (len(object_scene), 3)) if hand_m is None else hand_m
    canonical_m = (object_scene.model_from_canonical.inverse() @ hands_m[:, None])[:, 0]
    points = np.broadcast_to(canonical_m[None, :, None], (2, len(object_scene), 4, 3))
    zeros = np.zeros((2, len(object_scene), 6), np.float16)
    return RecordedClip(
        scene=object_scene,
        contact_m=zeros,
        keypoints_m=points,
        to_object_m=zeros,
        present=zeros[..., 0] == 0,
        active_hands=np.ones(2),
    )


DIRECTION = np.array([0.6, 0, 0.8], np.float32)


@pytest.mark.parametrize("jump", ["far", "5 cm", "hinge", "turn", "hands"])
def test_no_window_contains_a_jump_of_object_or_hands(jump: str) -> None:
    features, hand_m = path_features(30), None
    if jump in ("far", "5 cm"):
        features[17:, :3] += DIRECTION * (1.0 if jump == "far" else 0.05)
    elif jump == "hinge":
        features[17:, 9] += 0.3
    elif jump == "turn":
        turned = rotvec_to_rotmat(np.array([0, 0, 0.5])) @ rot6d_to_rotmat(features[17:, 3:9].astype(float))
        features[17:, 3:9] = rotmat_to_rot6d(turned)
    else:
        hand_m = 0.01 * np.arange(30)[:, None] * DIRECTION + 0.07 * (np.arange(30) >= 17)[:, None] * DIRECTION
    clip = recorded(features, hand_m)
    assert window_starts(clip, 8).tolist() == [*range(10), *range(17, 23)]
    assert middle_start(clip, 8) == [9]  # 11 is the middle
    assert middle_start(clip, 20) == []


def test_fast_motion_and_a_resting_hand_near_a_spinning_object_are_no_jumps() -> None:
    time = np.arange(30.0)[:, None]
    rotation = rotmat_to_rot6d(rotvec_to_rotmat(np.concatenate((0 * time, 0 * time, 0.35 * time), 1)))
    features = np.concatenate((0.06 * time, 0 * time, 0 * time, rotation, 0.1 * time), axis=1).astype(np.float32)
    assert window_starts(recorded(features), 8).tolist() == [*range(23)]
    assert middle_start(recorded(features), 8) == [11]


def test_a_hand_without_tracking_does_not_jump() -> None:
    hand_m = np.where((np.arange(30) < 17)[:, None], 0, 9) * DIRECTION
    clip = recorded(path_features(30), hand_m)
    present = np.tile(np.arange(30) >= 17, (2, 1))
    assert window_starts(replace(clip, present=present), 8).tolist() == [*range(23)]


@pytest.fixture(scope="module")
def model() -> BimArt:
    torch.manual_seed(0)
    contact, motion = ContactModel(TINY).eval(), MotionModel(TINY).eval()
    return BimArt(contact, motion, FAST, torch.device("cpu"))


def sampling_task(frames: int, seed: int, number: int = 0) -> SamplingTask:
    return SamplingTask(scene(frames, number), np.array([True, number == 0]), seed)


def test_a_sample_depends_on_its_seed_and_not_on_its_batch(model: BimArt) -> None:
    first, second = sampling_task(12, 1), sampling_task(12, 2, 1)
    for config in (FAST, replace(FAST, sampler=BimArtSamplerConfig("ddpm", 3, 0.5))):
        configured = replace(model, config=config)
        alone, repeated, other = (
            configured.sample_motions([task])[0] for task in (first, first, replace(first, seed=5))
        )
        in_batch = configured.sample_motions([second, first])[1]
        np.testing.assert_array_equal(alone.keypoints_m, repeated.keypoints_m)
        np.testing.assert_allclose(alone.keypoints_m, in_batch.keypoints_m, atol=1e-4)
        assert np.abs(alone.keypoints_m - other.keypoints_m).max() > 1e-2


def test_separate_windows_are_independent_and_overlapping_windows_are_not(model: BimArt) -> None:
    features = path_features(20)
    changed = features.copy()
    changed[9:, :3] *= -5
    changed[9:, 9] += 0.5
    tasks = [
        SamplingTask(Scene.of(BOX, object_features, FEATURES.basis), np.ones(2, bool), 1)
        for object_features in (features, changed)
    ]
    for overlapping in (True, False):
        configured = replace(model, config=replace(FAST, overlapping=overlapping))
        one, other = (configured.sample_motions([task])[0].keypoints_m for task in tasks)
        assert np.array_equal(one[:, :8], other[:, :8]) != overlapping
        assert not np.allclose(one[:, 8:], other[:, 8:], atol=1e-3)


def test_guidance_lowers_the_error_of_the_contact_map(model: BimArt) -> None:
    tasks, target_m = [sampling_task(8, 3)], torch.full((1, 8, 12), 0.05)
    errors = []
    for guide in ("off", "metres", "paper"):
        motion = replace(
            model, config=replace(FAST, contact_guidance=guide, contact_guidance_fraction=1.0)
        ).sample_motions(tasks, target_m)[0]
        distance_m = np.linalg.norm(
            motion.keypoints_m[:, :, None] - tasks[0].scene.object_point_m[None, :, :, None], axis=-1
        )
        errors.append(np.abs(distance_m.min(axis=-1) - 0.05).mean())
    assert errors[1] < 0.7 * errors[0]
    assert errors[2] < errors[0]


def test_sampler_settings_that_are_not_given_keep_their_defaults() -> None:
    assert SamplingConfig() == OURS
    config = build_config(SamplingConfig, {"sampler": {"steps": 20}}, "sample.bimart.sampling")
    assert config == replace(OURS, sampler=replace(OURS.sampler, steps=20))
    assert config.sampler.guidance == 0
    guided = build_config(SamplingConfig, {"sampler": {"guidance": 0.5}}, "sample.bimart.sampling")
    assert guided == replace(OURS, sampler=replace(OURS.sampler, guidance=0.5))


def test_a_preset_keeps_the_settings_that_are_not_changed() -> None:
    config = sampling_of(
        "paper", {"sampler": {"steps": 20}, "contact_guidance_fraction": 0.5}, "sample.bimart.sampling"
    )
    assert config == replace(PAPER, sampler=replace(PAPER.sampler, steps=20), contact_guidance_fraction=0.5)
    with pytest.raises(BadInput, match="guidence"):
        sampling_of("ours", {"guidence": 1}, "sample.bimart.sampling")
