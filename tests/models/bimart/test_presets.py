"""BimArt's presets in params.yaml, and the numbers of preset `paper` as printed in Zhang et al. 2025."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hoidata.batches.dataset import ClipSample
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.settings import build_config
from models.bimart.network import DenoiserConfig
from models.bimart.sampler import SamplingConfig, preset_of, sampling_of
from models.bimart.scene import FeatureConfig, Scene, hand_vertices_m, recorded_clip
from models.bimart.training import LossConfig
from models.common.training import TrainingSpec
from models.registry import load_network
from pipelines.stages.train import TrainParams

SECTION: dict[str, Any] = yaml.safe_load((Path(__file__).parents[3] / "params.yaml").read_text())["train"]
NETWORKS = ("bimart-contact", "bimart-motion")


def training_plan(preset: str, size: str, name: str) -> TrainingSpec:
    params = build_config(TrainParams, {**SECTION, "preset": preset, "size": size}, "params.yaml: train")
    return TrainingSpec.of(load_network(name), params.of(name))


def differences(first: Any, second: Any, name: str = "") -> set[str]:
    if not isinstance(first, dict):
        return set() if first == second else {name}
    return {
        difference for key in first for difference in differences(first[key], second[key], f"{name}.{key}".strip("."))
    }


@pytest.mark.parametrize("preset", ["paper", "ours"])
@pytest.mark.parametrize("size", ["small", "full"])
def test_the_preset_of_a_network_is_recognised(preset: str, size: str) -> None:
    assert preset_of(training_plan(preset, size, "bimart-motion").network) == preset


@pytest.mark.parametrize("preset", ["paper", "ours"])
@pytest.mark.parametrize("size", ["small", "full"])
def test_both_networks_of_a_preset_have_the_same_features_but_for_the_state(preset: str, size: str) -> None:
    contact, motion = (asdict(training_plan(preset, size, name).network.features) for name in NETWORKS)
    assert differences(contact, motion) <= {"state"}


def test_the_papers_networks_and_training_have_the_numbers_of_section_3_5() -> None:
    for name in NETWORKS:
        plan = training_plan("paper", "full", name)
        network, training = plan.network, plan.training
        assert (network.transformer.layers, network.transformer.width) == (8, 512)
        assert (network.diffusion_steps, network.latents, network.condition_on_hands) == (50, "concatenate", False)
        assert (network.noise_schedule, network.knot_frames, network.signal_scale) == ("linear", 0, 1)
        assert (network.encoder, network.transformer.heads, network.transformer.norm_first) == ((1024, 1024), 4, False)
        assert (network.min_std_fraction, network.transformer.frames_per_token) == (0, 1)
        features = network.features
        assert (features.basis.nearest, features.basis.frame, features.state) == ("vertex", "axis", "pose")
        assert (features.window_frames, features.max_distance_m, features.contact_map_target) == (64, 0, "skin")
        assert (features.basis.count, features.keypoints) == (512, 100)
        assert (training.batch, training.steps) == (100, 218_000)
        assert (training.learning_rate, training.weight_decay, training.schedule) == (1e-4, 0, "cosine")
        assert training.ema_decay > 0
        assert (plan.loss.contact_dropout, plan.loss.velocity_weight) == (0.5, 0)


@pytest.mark.parametrize(("preset", "rate"), [("ours", 2e-3), ("paper", 5e-4)])
def test_small_networks_of_the_paper_learn_more_slowly_than_ours(preset: str, rate: float) -> None:
    """Their Transformers normalise after each block; Text2HOI's diverges at 0.002."""
    assert [training_plan(preset, "small", name).training.learning_rate for name in NETWORKS] == [rate, rate]


def test_the_papers_sampler_takes_50_ancestral_steps_with_guidance_of_a_half_in_all_of_them() -> None:
    config = sampling_of("paper", {}, "params.yaml")
    assert (config.sampler.kind, config.sampler.steps, config.sampler.guidance) == ("ddpm", 50, 0.5)
    assert (config.guidance_rule, config.contact_guidance, config.contact_guidance_fraction) == ("paper", "paper", 1)
    assert not config.overlapping


def test_the_papers_contact_map_is_the_distance_to_the_nearest_of_all_hand_vertices(samples: list[ClipSample]) -> None:
    sample, hands = samples[0], load_embedded_hands()
    features = training_plan("paper", "full", "bimart-contact").network.features
    clip = recorded_clip(sample, hands, features)
    side, frame = int(sample.active_hands[1]), 4
    model_m = hand_vertices_m(hands, side, sample)[frame].astype(np.float64)
    pose = clip.scene.model_from_canonical
    skin_m = (model_m - pose.translation[frame]) @ pose.rotation[frame]
    exists = clip.scene.point_exists
    apart = np.linalg.norm(clip.scene.object_point_m[frame, exists][:, None] - skin_m, axis=-1)
    np.testing.assert_allclose(clip.contact_m[side, frame, exists], apart.min(axis=1), rtol=1e-3)
    keypoints = np.linalg.norm(
        clip.scene.object_point_m[frame, exists][:, None] - clip.keypoints_m[side, frame], axis=-1
    )
    assert (keypoints.min(axis=1) - apart.min(axis=1)).mean() > 1e-4


def test_the_papers_scale_leaves_a_margin_of_15_percent(samples: list[ClipSample]) -> None:
    features = training_plan("paper", "full", "bimart-contact").network.features
    rigid = next(sample for sample in samples if not sample.object_model.is_articulated)
    scene = Scene.of(rigid.object_model, rigid.object, features.basis)
    vertices_m = rigid.object_model.vertices_m
    # Eq. 1; the axis of a rigid object goes through its origin.
    farthest_m = np.linalg.norm(vertices_m - scene.object_from_canonical.translation, axis=1).max()
    assert scene.object_scale * farthest_m == pytest.approx(0.85)


@pytest.mark.parametrize(
    ("config", "old", "new"),
    [
        (FeatureConfig, "most_m", "max_distance_m"),
        (DenoiserConfig, "floor", "min_std_fraction"),
        (LossConfig, "windows", "windows_per_clip"),
        (SamplingConfig, "guide", "contact_guidance"),
    ],
)
def test_a_renamed_key_is_refused_with_its_new_name(config: type, old: str, new: str) -> None:
    with pytest.raises(BadInput, match=f"{old} is now {new}"):
        build_config(config, {old: 1}, "params.yaml: train")
