"""BimArt from training to clips: checkpoints are complete, no recorded hand is read."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.clips.clip import SIDES, Clip
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.sensors.part_bps import BasisSettings, distance_map, hand_keypoints
from hoidata.store.annotated import AnnotatedStore
from models.bimart.family import BIMART, OTHER_OBJECT, OTHER_PATH, UNREFINED, ZERO_MAP, BimArtSampler, mean_maps
from models.bimart.network import ContactModel, DenoiserConfig, MotionModel
from models.bimart.retrieval import NEAREST_REFINED, NEAREST_WINDOW, OBJECT_MEAN_POSE
from models.bimart.sampler import BimArt, SamplingTask
from models.bimart.scene import FeatureConfig, Scene, recorded_clip
from models.bimart.training import CONTACT, MOTION, LossConfig, learn_statistics, targets_of, window_losses
from models.common.checkpoints import load_checkpoint
from models.common.family import Skipped, Sources
from models.common.predicting import PredictionConfig, requests_for
from models.common.training import train_network
from models.common.transformer import TransformerConfig
from tests.models.bimart.test_sampling import FAST
from tests.models.toy import BIMART as PARAMS

pytestmark = pytest.mark.slow

HANDS = load_embedded_hands()
STEPS = 500
SETTINGS = {"bimart": {"sampling": {"sampler": {"steps": 2, "guidance": 0.5}}}}


@pytest.fixture(scope="module")
def checkpoints(annotated_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bimart")
    for network in (CONTACT, MOTION):
        train_network(network, annotated_root, out / network.name, PARAMS)
    return out


@pytest.fixture(scope="module")
def sources(annotated: AnnotatedStore, checkpoints: Path) -> Sources:
    device = torch.device("cpu")
    return Sources(annotated=annotated, checkpoints=checkpoints, hands=HANDS, device=device, settings=SETTINGS)


def test_a_checkpoint_stores_keypoints_basis_points_and_statistics(
    annotated: AnnotatedStore, checkpoints: Path
) -> None:
    network = load_checkpoint(checkpoints / "bimart-motion", MOTION).network
    features = network.config.features
    np.testing.assert_array_equal(network.keypoint_ids, hand_keypoints(HANDS.right, 20))
    np.testing.assert_array_equal(network.basis_points, features.basis.points())
    by_window = []
    for sample in HoiDataset(annotated, "train"):
        clip = recorded_clip(sample, HANDS, features)
        for start in range(0, max(sample.length - 16, 0) + 1, 2):
            window = clip.motion[start : start + 16].reshape(-1, 2, 2, 60)[:, :, 0]
            by_window.append(window[clip.present[0, start : start + 16]] if clip.active_hands[0] else window[:0])
    left = np.concatenate(by_window).astype(np.float64)
    mean, std = (values.numpy().reshape(2, 2, 60)[:, 0] for values in (network.mean, network.scale))
    np.testing.assert_allclose(mean, left.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(std, left.std(axis=0), atol=1e-6)


def test_targets_are_the_clips_hands_in_the_objects_frame(samples: list[ClipSample], checkpoints: Path) -> None:
    network = load_checkpoint(checkpoints / "bimart-contact", CONTACT).network
    for sample in samples:
        clip = recorded_clip(sample, HANDS, network.config.features)
        target = targets_of(network, [(clip, 3)])
        scene = clip.scene
        np.testing.assert_allclose(clip.motion[:, :60], clip.keypoints_m[0].reshape(-1, 60))
        nearest_m = scene.bps.nearest_m(clip.keypoints_m[1].astype(np.float64), scene.hinge_rad)
        np.testing.assert_allclose(clip.to_object_m[1], nearest_m - clip.keypoints_m[1], atol=1e-6)
        maps = target.clean[0].reshape(16, 2, -1).numpy()
        skin = distance_map(scene.object_point_m[3:19], clip.keypoints_m[0, 3:19])
        assert (maps[:, 0] <= np.minimum(skin, 0.2) + 1e-3).all()  # the skin has more points than the keypoints
        assert target.clean_mask.reshape(16, 2, -1).any(dim=(0, 2)).tolist() == sample.active_hands.tolist()


def same(one: Clip, other: Clip) -> bool:
    names = ("wrist_m", "global_orient", "hand_pose", "valid")
    return all(np.array_equal(getattr(one.hands[s], n), getattr(other.hands[s], n)) for s in SIDES for n in names)


def test_samples_follow_the_objects_motion_and_do_not_depend_on_recorded_hands(
    sources: Sources, samples: list[ClipSample]
) -> None:
    family, rng = UNREFINED.load(sources), np.random.default_rng(0)
    for sample in samples:
        corrupted = replace(sample, hands=rng.normal(size=sample.hands.shape).astype(np.float32))
        requests = [requests_for(one, PredictionConfig(samples=2)) for one in (sample, corrupted)]
        (first, second), (again, _) = (family.sample(one_requests) for one_requests in requests)
        assert same(first, again)
        assert not same(first, second)
        np.testing.assert_allclose(
            first.object.translation_m, sources.annotated.clip(sample.clip_id).object.translation_m, atol=1e-5
        )
        assert [bool(first.hands[side].valid.all()) for side in SIDES] == sample.active_hands.tolist()


def test_refinement_and_shape_follow_the_preset_unless_they_are_set(sources: Sources) -> None:
    def loaded(**section: Any) -> tuple[str, str]:
        sampler = BimArtSampler.load(replace(sources, settings={"bimart": section}))
        return sampler.refinement, sampler.shape

    assert loaded() == ("ours", "bounded")
    assert loaded(preset="paper") == ("paper", "fitted")
    assert loaded(preset="paper", refinement="none", shape="given") == ("none", "given")
    assert UNREFINED.load(sources).refinement == "none"  # pyright: ignore[reportAttributeAccessIssue]


def test_the_given_shape_is_kept_and_a_fitted_one_is_that_of_the_keypoints(
    sources: Sources, samples: list[ClipSample]
) -> None:
    request = replace(requests_for(samples[1], PredictionConfig(samples=1))[0], betas=np.full((2, 10), 0.5, np.float32))
    sampler = BimArtSampler.load(sources, "none")
    (motion,) = sampler.sample_motions([request])
    side = SIDES[int(np.flatnonzero(request.active_hands)[0])]
    kept = replace(sampler, shape="given").clip(request, motion).hands[side]
    np.testing.assert_array_equal(kept.betas, np.full((1, 10), 0.5, np.float32))
    fitted = sampler.clip(request, motion).hands[side]
    other = sampler.clip(replace(request, betas=np.zeros((2, 10), np.float32)), motion).hands[side]
    np.testing.assert_array_equal(fitted.betas, other.betas)


def test_a_request_without_object_motion_is_skipped_with_the_reason(
    sources: Sources, samples: list[ClipSample]
) -> None:
    requests = requests_for(samples[1], PredictionConfig(samples=2))
    answers = UNREFINED.load(sources).sample([replace(requests[0], trajectories=None), requests[1]])
    assert isinstance(answers[0], Skipped)
    assert "motion of an object" in answers[0].reason
    assert isinstance(answers[1], Clip)


def test_refinement_and_controls_change_the_hands_and_never_the_object(
    sources: Sources, samples: list[ClipSample]
) -> None:
    requests = requests_for(samples[1], PredictionConfig(samples=1))
    plain = UNREFINED.load(sources).sample(requests)[0]
    for family in (BIMART, ZERO_MAP, OTHER_OBJECT, OTHER_PATH):
        changed = family.load(sources).sample(requests)[0]
        assert not same(plain, changed)
        np.testing.assert_array_equal(changed.object.translation_m, plain.object.translation_m)


def test_networks_with_different_features_are_refused(sources: Sources, annotated_root: Path, tmp_path: Path) -> None:
    features = {**PARAMS["network"]["features"], "keypoints": 21}
    params = {**PARAMS, "network": {**PARAMS["network"], "features": features}}
    train_network(
        MOTION, annotated_root, tmp_path / MOTION.name, {**params, "training": {**PARAMS["training"], "steps": 1}}
    )
    (tmp_path / CONTACT.name).symlink_to(sources.checkpoints / CONTACT.name)
    with pytest.raises(BadInput, match="features of its contact model"):
        BimArtSampler.load(replace(sources, checkpoints=tmp_path))


def test_diagnosed_metrics_are_positive_and_the_best_of_ten_maps_is_no_worse_than_the_mean(sources: Sources) -> None:
    metrics = BIMART.diagnose(sources)
    assert set(metrics) == {"bimart-contact", "bimart-motion"}
    assert all(np.isfinite(value) and value > 0 for by_name in metrics.values() for value in by_name.values())
    assert metrics["bimart-contact"]["best_of_10_mm"] <= metrics["bimart-contact"]["map_error_mm"]


def test_mean_maps_are_means_over_tracked_frames_of_acting_hands_by_object(samples: list[ClipSample]) -> None:
    features = FeatureConfig(BasisSettings(4), keypoints=20)
    valid = samples[0].valid.copy()
    valid[:, 3:] = False
    clips = [replace(samples[0], valid=valid), *samples]
    means = mean_maps(clips, HANDS, features)
    assert set(means) == {"", *(clip.object_model.name for clip in clips)}
    for name, mean in means.items():
        for side in range(2):
            frames = [
                recorded_clip(clip, HANDS, features).contact_m[side][clip.valid[side]].astype(np.float64)
                for clip in clips
                if name in ("", clip.object_model.name) and clip.active_hands[side]
            ]
            expected = np.concatenate(frames).mean(axis=0) if frames else np.zeros(8)
            np.testing.assert_allclose(mean[side], expected)


def test_retrieval_baselines_place_training_hands_at_the_object(sources: Sources, annotated: AnnotatedStore) -> None:
    train = HoiDataset(annotated, "train")
    sample = next(one for one in train if one.hand_type == "both")
    requests = requests_for(sample, PredictionConfig(samples=1))
    nearest = NEAREST_WINDOW.load(sources).sample(requests)[0]
    mean = OBJECT_MEAN_POSE.load(sources).sample(requests)[0]
    refined = NEAREST_REFINED.load(sources).sample(requests)[0]
    recorded = annotated.clip(sample.clip_id)
    for side in SIDES:  # a training clip is nearest to itself
        np.testing.assert_allclose(nearest.hands[side].wrist_m, recorded.hands[side].wrist_m, atol=1e-4)
        assert np.abs(mean.hands[side].wrist_m - recorded.hands[side].wrist_m).max() > 1e-3
        # Refinement corrects depth and jitter of recorded hands, by a few millimetres.
        assert np.abs(refined.hands[side].wrist_m - recorded.hands[side].wrist_m).max() < 0.03


@pytest.mark.parametrize("family", [NEAREST_WINDOW, NEAREST_REFINED])
def test_windows_with_an_untracked_hand_are_not_copied(family, sources: Sources, annotated, monkeypatch) -> None:
    train = list(HoiDataset(annotated, "train"))
    untracked = [replace(one, valid=one.valid & (np.arange(one.length) != 3)) for one in train]
    monkeypatch.setattr("models.bimart.retrieval.training_clips", lambda _: untracked)
    (answer,) = family.load(sources).sample(requests_for(train[0], PredictionConfig(samples=1)))
    assert isinstance(answer, Skipped)


@pytest.mark.long
def test_two_windows_are_overfitted_to_5_mm(samples: list[ClipSample]) -> None:
    torch.manual_seed(0)
    features = FeatureConfig(
        basis=BasisSettings(32, nearest="surface"),
        keypoints=20,
        window_frames=24,
        state="local",
        contact_map_target="keypoints",
        max_distance_m=0.2,
    )
    transformer = TransformerConfig(width=96, layers=2, heads=4, feed_forward=192, dropout=0.0, norm_first=True)
    config = DenoiserConfig(
        features=features,
        transformer=transformer,
        encoder=(128,),
        latents="joint",
        condition_on_hands=True,
        diffusion_steps=1000,
        position_dropout=0.0,
        min_std_fraction=0.05,
        knot_frames=4,
        signal_scale=0.2,
    )
    clips, network, loss = (
        [recorded_clip(sample, HANDS, features) for sample in samples],
        MotionModel(config),
        LossConfig(),
    )
    learn_statistics(network, [(clip, 0) for clip in clips])
    target = targets_of(network, [(clip, 0) for clip in clips] * 8)
    optimiser, generator = torch.optim.AdamW(network.parameters(), lr=2e-3), torch.Generator().manual_seed(0)
    losses = []
    for step in range(STEPS):
        optimiser.param_groups[0]["lr"] = 2e-3 * (1 - step / STEPS)
        loss_value = window_losses(network, target, loss, generator)["total"]
        optimiser.zero_grad()
        loss_value.backward()
        optimiser.step()
        losses.append(float(loss_value.detach()))
    model = BimArt(ContactModel(config).eval(), network.eval(), FAST, torch.device("cpu"))
    for clip, sample in zip(clips, samples, strict=True):
        scene = Scene.of(sample.object_model, sample.object[:24], features.basis)
        maps = clip.contact_m[:, :24].transpose(1, 0, 2).reshape(1, 24, -1).astype(np.float32)
        motion = model.sample_motions([SamplingTask(scene, clip.active_hands, 0)], torch.from_numpy(maps))[0]
        error_m = np.linalg.norm(motion.keypoints_m - clip.keypoints_m[:, :24], axis=-1)[clip.active_hands]
        print(f"{1000 * error_m.mean():.2f} mm, loss {losses[0]:.3f} to {np.mean(losses[-20:]):.4f}")
        assert error_m.mean() < 0.005
