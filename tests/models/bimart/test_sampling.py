"""Promises of BimArt's sampling: guidance by its formulas, windows put together, every motion from its own seed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rot6d, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.sensors.part_bps import BasisSettings
from hoidata.settings import build_config
from models.bimart.learning import middle_start, window_starts
from models.bimart.network import Asked, ContactModel, DenoiserConfig, Layout, MotionModel, layout_of, windows_of
from models.bimart.sampler import (
    OURS,
    PAPER,
    BimArt,
    Map,
    Path,
    SamplingConfig,
    WalkConfig,
    combined,
    discrepancy,
    metre_step,
    paper_step,
    sampling_of,
)
from models.bimart.scene import FeatureConfig, Recorded, Scene
from models.common.transformer import TransformerConfig
from tests.builders.objects import hinged_box

FEATURES = FeatureConfig(BasisSettings(3), keypoints=4, window=8, state="local", most_m=0.2)
TINY = DenoiserConfig(FEATURES, TransformerConfig(16, 1, 2, 16, 0.0), (8,), told=True, position_dropout=0.0)
FAST = replace(OURS, sampler=WalkConfig("ddim", 2, 0.5))


def path_features(frames: int, seed: int = 0, shift_m: float = 0.0) -> np.ndarray:
    """(frame, 10) a smooth motion of a hinged object in the model frame."""
    draws = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames)[:, None]
    turn = rotvec_to_rotmat(time * draws.normal(size=3))
    rows = (time * draws.normal(size=3) * 0.1 + shift_m, rotmat_to_rot6d(turn), time)
    return np.concatenate(rows, axis=1).astype(np.float32)


def scene(frames: int, seed: int = 0, basis: BasisSettings = FEATURES.basis, shift_m: float = 0.0) -> Scene:
    return Scene.of(BOX, path_features(frames, seed, shift_m), basis)


BOX = hinged_box()


def wanted_map(seed: int = 0) -> tuple[torch.Tensor, Map]:
    draws = torch.Generator().manual_seed(seed)
    keypoints = torch.randn(2, 3, 2, 5, 3, generator=draws)
    known = torch.rand(2, 3, 14, generator=draws) < 0.8
    return keypoints, Map(torch.randn(2, 3, 7, 3, generator=draws), torch.rand(2, 3, 14, generator=draws), known)


def test_the_map_of_keypoints_is_the_distance_to_the_nearest_of_them() -> None:
    keypoints, wanted = wanted_map()
    found = discrepancy(keypoints, wanted)
    apart = np.linalg.norm(keypoints.numpy()[:, :, :, None] - wanted.places_m.numpy()[:, :, None, :, None], axis=-1)
    error = apart.min(axis=-1) - wanted.contact_m.numpy().reshape(2, 3, 2, 7)
    np.testing.assert_allclose(found.error_m, error * wanted.known.numpy().reshape(2, 3, 2, 7), atol=1e-6)
    np.testing.assert_array_equal(found.nearest, apart.argmin(axis=-1))


def test_the_papers_step_is_down_the_gradient_of_the_mean_square_and_of_length_1() -> None:
    keypoints, wanted = wanted_map()
    scale = torch.rand(2, 5, 3) + 0.5
    step = paper_step(keypoints, wanted, scale, window=64)
    normalised = (keypoints / scale).double().requires_grad_()
    apart = (normalised * scale)[:, :, :, None] - wanted.places_m[:, :, None, :, None]
    error = (apart.norm(dim=-1).amin(-1) - wanted.contact_m.unflatten(-1, (2, 7))) * wanted.known.unflatten(-1, (2, 7))
    share = wanted.known.unflatten(-1, (2, 7)).sum((1, 3), keepdim=True)
    (error.square() / share).sum().backward()
    assert normalised.grad is not None
    for row in range(2):
        down = -normalised.grad[row] / normalised.grad[row].norm()
        torch.testing.assert_close(step[row], down.float(), rtol=1e-4, atol=1e-6)


def test_a_step_in_metres_brings_keypoints_to_what_the_map_asks_and_leaves_what_agrees() -> None:
    places = torch.tensor([[0.0, 0, 0]]).expand(1, 1, 1, 3)
    keypoints = torch.tensor([[[0.05, 0, 0], [0.0, 0.3, 0]]]).expand(1, 1, 2, 2, 3)
    wanted = Map(places, torch.tensor([[[0.0, 0.05]]]), torch.ones(1, 1, 2, dtype=torch.bool))
    step = metre_step(keypoints, wanted)
    assert -0.05 <= float(step[0, 0, 0, 0, 0]) < -0.03
    assert not step[0, 0, 0, 1].any()
    torch.testing.assert_close(step[0, 0, 1], torch.zeros(2, 3), atol=1e-7, rtol=0)


def test_classifier_free_guidance_is_the_usual_one_or_equation_7() -> None:
    told, untold = torch.tensor([2.0]), torch.tensor([3.0])
    assert float(combined(told, untold, 0.5, "usual")) == 1.5 * 2 - 0.5 * 3
    assert float(combined(told, untold, 0.5, "paper")) == 1.5 * 2 - 3


@pytest.mark.parametrize("frames", [5, 8, 9, 12, 30])
@pytest.mark.parametrize("overlapping", [True, False])
def test_windows_cover_a_path_and_put_together_are_the_path(frames: int, overlapping: bool) -> None:
    layout, path = layout_of(frames, 8, overlapping), torch.randn(3, frames, 2)
    torch.testing.assert_close(layout.joined(layout.cut(path)), path)
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


def test_the_state_is_the_objects_pose_from_the_first_frame_or_what_it_feels_itself() -> None:
    own, far = scene(12), scene(12, shift_m=3.0)
    rotation, place = own.model_from_canonical.rotation, own.model_from_canonical.translation
    pose = own.state("pose", 4, 9)
    np.testing.assert_allclose(pose[:, :3], rotmat_to_rotvec(rotation[4:9]), atol=1e-12)
    np.testing.assert_allclose(pose[:, 3:], place[4:9] - place[4], atol=1e-12)
    felt = own.state("local", 4, 9)
    np.testing.assert_allclose(felt, own.state("local", 0, 12)[4:9])
    np.testing.assert_allclose(felt, far.state("local", 4, 9), atol=1e-5)
    np.testing.assert_allclose(felt[1, :3], rotation[5].T @ [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(felt[1, 3:6], rotation[5].T @ (place[6] - place[4]) * 15, atol=1e-9)
    np.testing.assert_allclose(felt[1, 6:], rotmat_to_rotvec(rotation[4].T @ rotation[6]) * 15, atol=1e-9)


def test_a_window_is_anchored_alike_in_training_and_in_use() -> None:
    own, config = scene(20), replace(TINY, features=replace(FEATURES, state="pose"))
    asked = [Asked(own, start, start + 8, np.ones(2, bool)) for start in layout_of(20, 8, True).starts]
    together = windows_of(asked, 8, config)
    for row, one in enumerate(asked):
        torch.testing.assert_close(together.state[row], windows_of([one], 8, config).state[0])
        assert not together.state[row, 0, 3:].any()


@pytest.mark.parametrize(
    ("change", "differs"),
    [
        ({"state": "pose"}, {"state"}),
        ({"basis": replace(FEATURES.basis, nearest="surface")}, {"offset"}),
        ({"basis": replace(FEATURES.basis, seed=1)}, {"offset"}),
        ({"keypoints": 5}, set()),
        ({"most_m": 0.0}, set()),
        ({"map_of": "keypoints"}, set()),
    ],
)  # fmt: skip
def test_a_switch_of_what_is_seen_changes_its_own_part_alone(change: dict, differs: set[str]) -> None:
    features = replace(FEATURES, **change)
    kinds = [
        windows_of([Asked(scene(8, basis=own.basis), 0, 8, np.array([True, False]))], 8, replace(TINY, features=own))
        for own in (FEATURES, features)
    ]
    names = ("offset", "state", "scale", "there", "hands", "frames")
    assert {name for name in names if not torch.equal(*(getattr(own, name) for own in kinds))} == differs


def recorded(features: np.ndarray, hand_m: np.ndarray | None = None) -> Recorded:
    """A clip of an object's motion (frame, 10) and of two hands in the world, at rest 30 cm from it or (frame, 3)."""
    own = Scene.of(BOX, features, FEATURES.basis)
    world = np.broadcast_to([0.3, 0, 0], (len(own), 3)) if hand_m is None else hand_m
    seen = (own.model_from_canonical.inverse() @ world[:, None])[:, 0]
    points = np.broadcast_to(seen[None, :, None], (2, len(own), 4, 3))
    nothing = np.zeros((2, len(own), 6), np.float16)
    return Recorded(own, nothing, points, nothing, nothing[..., 0] == 0, np.ones(2))


WAY = np.array([0.6, 0, 0.8], np.float32)


@pytest.mark.parametrize("jump", ["far", "5 cm", "hinge", "turn", "hands"])
def test_no_window_crosses_a_jump_of_object_or_hands_and_ends_may_be_left_out(jump: str) -> None:
    features, hand = path_features(30), None
    if jump in ("far", "5 cm"):
        features[17:, :3] += WAY * (1.0 if jump == "far" else 0.05)
    elif jump == "hinge":
        features[17:, 9] += 0.3
    elif jump == "turn":
        turned = rotvec_to_rotmat(np.array([0, 0, 0.5])) @ rot6d_to_rotmat(features[17:, 3:9].astype(float))
        features[17:, 3:9] = rotmat_to_rot6d(turned)
    else:
        hand = 0.01 * np.arange(30)[:, None] * WAY + 0.07 * (np.arange(30) >= 17)[:, None] * WAY
    clip = recorded(features, hand)
    assert window_starts(clip, 8).tolist() == [*range(10), *range(17, 23)]
    assert middle_start(clip, 8) == [9]  # 11 is the middle
    assert middle_start(clip, 20) == []


def test_fast_motion_and_a_hand_that_rests_beside_an_object_that_spins_are_no_jumps() -> None:
    time = np.arange(30.0)[:, None]
    turn = rotmat_to_rot6d(rotvec_to_rotmat(np.concatenate((0 * time, 0 * time, 0.35 * time), 1)))
    features = np.concatenate((0.06 * time, 0 * time, 0 * time, turn, 0.1 * time), axis=1).astype(np.float32)
    assert window_starts(recorded(features), 8).tolist() == [*range(23)]
    assert middle_start(recorded(features), 8) == [11]


def test_a_hand_that_was_not_tracked_does_not_jump() -> None:
    hand = np.where((np.arange(30) < 17)[:, None], 0, 9) * WAY
    clip = recorded(path_features(30), hand)
    present = np.tile(np.arange(30) >= 17, (2, 1))
    assert window_starts(replace(clip, present=present), 8).tolist() == [*range(23)]


@pytest.fixture(scope="module")
def model() -> BimArt:
    torch.manual_seed(0)
    contact, motion = ContactModel(TINY).eval(), MotionModel(TINY).eval()
    return BimArt(contact, motion, FAST, torch.device("cpu"))


def asked_path(frames: int, seed: int, number: int = 0) -> Path:
    return Path(scene(frames, number), np.array([True, number == 0]), seed)


def test_a_motion_is_drawn_from_its_own_seed_in_any_company(model: BimArt) -> None:
    first, second = asked_path(12, 1), asked_path(12, 2, 1)
    for config in (FAST, replace(FAST, sampler=WalkConfig("ddpm", 3, 0.5))):
        ready = replace(model, config=config)
        alone, again, other = (ready.make([path])[0] for path in (first, first, replace(first, seed=5)))
        together = ready.make([second, first])[1]
        np.testing.assert_array_equal(alone.keypoints_m, again.keypoints_m)
        np.testing.assert_allclose(alone.keypoints_m, together.keypoints_m, atol=1e-4)
        assert np.abs(alone.keypoints_m - other.keypoints_m).max() > 1e-2


def test_windows_apart_do_not_know_their_neighbours_and_overlapping_ones_do(model: BimArt) -> None:
    features = path_features(20)
    changed = features.copy()
    changed[9:, :3] *= -5
    changed[9:, 9] += 0.5
    paths = [Path(Scene.of(BOX, own, FEATURES.basis), np.ones(2, bool), 1) for own in (features, changed)]
    for overlapping in (True, False):
        ready = replace(model, config=replace(FAST, overlapping=overlapping))
        one, other = (ready.make([path])[0].keypoints_m for path in paths)
        assert np.array_equal(one[:, :8], other[:, :8]) != overlapping
        assert not np.allclose(one[:, 8:], other[:, 8:], atol=1e-3)


def test_guidance_brings_the_made_map_nearer_to_the_wanted_one(model: BimArt) -> None:
    paths, wanted = [asked_path(8, 3)], torch.full((1, 8, 12), 0.05)
    errors = []
    for guide in ("off", "metres", "paper"):
        made = replace(model, config=replace(FAST, guide=guide, guide_share=1.0)).make(paths, wanted)[0]
        apart = np.linalg.norm(made.keypoints_m[:, :, None] - paths[0].scene.place_m[None, :, :, None], axis=-1)
        errors.append(np.abs(apart.min(axis=-1) - 0.05).mean())
    assert errors[1] < 0.7 * errors[0]
    assert errors[2] < errors[0]


def test_settings_of_the_sampler_keep_what_they_do_not_tell() -> None:
    assert SamplingConfig() == OURS
    told = build_config(SamplingConfig, {"sampler": {"steps": 20}}, "sample.bimart.sampling")
    assert told == replace(OURS, sampler=replace(OURS.sampler, steps=20))
    assert told.sampler.guidance == 0
    guided = build_config(SamplingConfig, {"sampler": {"guidance": 0.5}}, "sample.bimart.sampling")
    assert guided == replace(OURS, sampler=replace(OURS.sampler, guidance=0.5))


def test_a_preset_keeps_what_is_not_told_beside_it() -> None:
    told = sampling_of("paper", {"sampler": {"steps": 20}, "guide_share": 0.5}, "sample.bimart.sampling")
    assert told == replace(PAPER, sampler=replace(PAPER.sampler, steps=20), guide_share=0.5)
    with pytest.raises(BadInput, match="guidence"):
        sampling_of("ours", {"guidence": 1}, "sample.bimart.sampling")
