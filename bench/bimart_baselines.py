"""Baselines of BimArt's paper, adapted: MDM-B and OMOMO-B (diffusion of hand poses) and CAMS-B (a conditional VAE).

All three are conditioned on the object's motion (O, local G and scale) in the object's canonical frame.

- MDM-B (Tevet et al. 2023): one Transformer predicts the poses of both hands.
- OMOMO-B (Li et al. 2023): a first Transformer predicts joints. A joint that comes within 3 cm of the object is fixed
  to its part from then on. A second Transformer predicts poses for these joints. Both have an L1 loss.
- CAMS-B (Zheng et al. 2023): also conditioned on the recorded initial hands and the stages of the interaction. A VAE
  predicts finger contacts per stage, and hands are fitted to them. Contact normals, finger curves within a stage and
  the optimiser of CAMS are not implemented.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from torch import Tensor, nn
from torch.nn import functional

from hoidata.batches.dataset import ClipBatch, ClipSample, load_sample
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip
from hoidata.clips.features import HAND_FEATURES
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import TIP_VERTICES
from hoidata.objects.model import articulate
from hoidata.refinement import GeneratedKeypoints, fit_hands
from hoidata.sensors.part_bps import BasisSettings, hand_keypoints
from models.bimart.family import clip_without_hands, world_from_canonical
from models.bimart.network import Layout
from models.bimart.retrieval import moved_hands, scene_features
from models.bimart.scene import Scene, hand_vertices_m
from models.bimart.training import Moments
from models.common.checkpoints import load_checkpoint
from models.common.family import Family, Losses, Network, Setup, Skipped, Sources, motion_clip, refuse_not_finite
from models.common.features import proper_hands
from models.common.losses import masked_mean
from models.common.sampling import TRAIN_STEPS, SamplerConfig, add_noise, alphas_cumprod, sample
from models.common.transformer import Encoder, TransformerConfig, sinusoid

BASIS = BasisSettings(128, nearest="surface", frame="base")
JOINTS, FINGERS = 21, 5
POSE_NUMBERS, JOINT_NUMBERS = 2 * HAND_FEATURES, 2 * 3 * JOINTS  # per frame, of both hands
CONDITION = 3 * BASIS.places + 9 + 1 + 2  # O, local G, scale, active hands
CONTACT_DISTANCE_M = 0.03  # OMOMO's contact constraint
TOUCH_M = 0.02  # CAMS: from the middle of a finger tip to a vertex of the part
MIN_STAGE_FRAMES = 5  # CAMS: a shorter stage is merged into the one before it
BLEND_FRAMES = 3.0  # CAMS: standard deviation of the Gaussian that blends stages
UNIT_M = 0.05
NO_OBJECT_MOTION = "no motion of an object, or no recorded clip"


class CanonicalClip(NamedTuple):
    """A recorded clip in the object's canonical frame."""

    scene: Scene
    condition: np.ndarray  # (frame, CONDITION)
    joints_m: np.ndarray  # (2, frame, 21, 3)
    hands: np.ndarray  # (2, frame, 99) features
    active: np.ndarray  # (2, frame) bool, tracked in an active hand


def canonical_clip(clip: ClipSample) -> CanonicalClip:
    scene = Scene.of(clip.object_model, clip.object, BASIS)
    joints_m = scene.model_from_canonical.inverse() @ clip.joints_m.astype(np.float64)
    hands = moved_hands(clip.hands, scene.model_from_canonical.inverse())
    active = clip.valid & clip.active_hands[:, None]
    condition = condition_of(scene, clip.active_hands)
    return CanonicalClip(scene=scene, condition=condition, joints_m=joints_m, hands=hands, active=active)


def condition_of(scene: Scene, hands: np.ndarray) -> np.ndarray:
    return np.concatenate((scene_features(scene), np.broadcast_to(hands, (len(scene), 2))), axis=1)


def flattened_by_frame(values: np.ndarray) -> np.ndarray:
    """Flatten (2, frame, ...) of both hands to (frame, number), the left hand first."""
    return values.swapaxes(0, 1).reshape(values.shape[1], -1)


# --- MDM-B and OMOMO-B


@dataclass(frozen=True)
class PoseConfig:
    """Architecture of one Transformer."""

    transformer: TransformerConfig = field(
        default_factory=lambda: TransformerConfig(
            width=192, layers=4, heads=4, feed_forward=384, dropout=0.0, norm_first=True
        )
    )
    window_frames: int = 64  # of a training window; longer motions are sampled in overlapping windows


class PoseNetwork(nn.Module):
    """``clean = network(x, steps, condition, frames)``, all (B, F, number) but steps (B,) and frames (B, F) bool."""

    mean: Tensor
    std: Tensor
    condition_mean: Tensor
    condition_std: Tensor

    def __init__(self, size: int, condition: int, config: PoseConfig) -> None:
        super().__init__()
        self.config, width = config, config.transformer.width
        self.frame_in, self.frame_out = nn.Linear(size + condition, width), nn.Linear(width, size)
        self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.encoder = Encoder(config.transformer)
        for name, count in (("", size), ("condition_", condition)):
            self.register_buffer(f"{name}mean", torch.zeros(count))
            self.register_buffer(f"{name}std", torch.ones(count))

    def forward(self, x: Tensor, steps: Tensor, condition: Tensor, frames: Tensor) -> Tensor:
        width = self.config.transformer.width
        normalised = (condition - self.condition_mean) / self.condition_std
        tokens = torch.cat(
            (self.step_in(sinusoid(steps, width))[:, None], self.frame_in(torch.cat((x, normalised), -1))), 1
        )
        tokens = tokens + sinusoid(torch.arange(tokens.shape[1], device=x.device), width)
        mask = torch.cat((frames.new_ones(len(frames), 1), frames), 1)
        return self.frame_out(self.encoder(tokens, mask)[:, 1:])

    def sample_motion(self, condition: np.ndarray, seed: int) -> np.ndarray:
        """Sample a motion (frame, size) for a condition (frame, number) of any length."""
        device, generator = self.mean.device, torch.Generator().manual_seed(seed)
        layout = Layout(len(condition), min(self.config.window_frames, len(condition)))
        windows = layout.cut(torch.from_numpy(condition.astype(np.float32))[None].to(device))
        frames = torch.ones(windows.shape[:2], dtype=torch.bool, device=device)

        def denoise(x: Tensor, steps: Tensor) -> Tensor:
            return layout.joined(self(layout.cut(x), steps.repeat_interleave(len(layout.starts)), windows, frames))

        def draw() -> Tensor:
            return torch.randn(1, len(condition), len(self.mean), generator=generator).to(device)

        x = sample(denoise, draw(), SamplerConfig("ddim", 20), draw)[0]
        return (x * self.std + self.mean).cpu().numpy().astype(np.float64)


class PoseObjective:
    """Prediction of clean windows from noised ones; error: elementwise loss of a difference, such as ``torch.abs``."""

    frames = entries = 0

    def __init__(
        self, setup: Setup, network: PoseNetwork, features: "ToArrays", error: Callable[[Tensor], Tensor]
    ) -> None:
        self.error, self.device, self.length = error, setup.device, setup.network.window_frames
        train = setup.corpus.train
        self.arrays = {clip_id: features(canonical_clip(train.whole(clip_id))) for clip_id in train.ids}
        for name, values, mask in zip(("", "condition_"), *self._training_arrays(), strict=True):
            moments = Moments(values.shape[-1])
            moments.add(torch.from_numpy(values), torch.from_numpy(mask))
            mean, std = moments.mean_and_std()
            getattr(network, f"{name}mean").copy_(mean)
            getattr(network, f"{name}std").copy_(std.clamp_min(0.05 * float(std.mean())))
        self.network = network.to(setup.device)
        self.signal = alphas_cumprod(setup.device)
        validation = [features(canonical_clip(clip)) for clip in setup.corpus.held_out]
        middles = [(arrays, max(len(arrays[0]) - self.length, 0) // 2) for arrays in validation]
        self.held_out = self._windows(middles) if middles else None

    def _training_arrays(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Targets and conditions of all training clips, and masks of their known values."""
        target, mask, condition = (np.concatenate(arrays) for arrays in zip(*self.arrays.values(), strict=True))
        return [target, condition], [mask, np.ones_like(condition, bool)]

    def _windows(self, chosen: Sequence[tuple["Arrays", int]]) -> list[Tensor]:
        """Targets, masks, conditions (B, F, number) and frame masks (B, F) of windows with their first frames."""
        windows = [[array[start : start + self.length] for array in arrays] for arrays, start in chosen]
        windows = [[*arrays, np.ones(len(arrays[0]), bool)] for arrays in windows]
        padded = ([torch.from_numpy(array) for array in column] for column in zip(*windows, strict=True))
        return [nn.utils.rnn.pad_sequence(column, batch_first=True).to(self.device) for column in padded]

    def _losses(self, network: nn.Module, windows: list[Tensor], generator: torch.Generator) -> Losses:
        target, mask, condition, frames = windows
        clean = ((target - self.network.mean) / self.network.std * mask).float()
        steps = torch.randint(TRAIN_STEPS, (len(clean),), generator=generator).to(self.device)
        noise = torch.randn(clean.shape, generator=generator).to(self.device)
        predicted = network(add_noise(clean, noise, steps, self.signal), steps, condition.float(), frames)
        return {"total": masked_mean(self.error(predicted - clean), mask)}

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        chosen = []
        for clip in batch.samples:
            arrays = self.arrays[clip.clip_id]
            last = max(len(arrays[0]) - self.length, 0)
            chosen.append((arrays, int(torch.randint(last + 1, (), generator=generator))))
        return self._losses(self.network, self._windows(chosen), generator)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert self.held_out is not None
        return self._losses(network, self.held_out, torch.Generator().manual_seed(0))["total"]


Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]
ToArrays = Callable[[CanonicalClip], Arrays]


def _number_mask(clip: CanonicalClip, per_hand: int) -> np.ndarray:
    return np.repeat(clip.active.T, per_hand, axis=1)


def _joint_arrays(clip: CanonicalClip) -> Arrays:
    return flattened_by_frame(clip.joints_m), _number_mask(clip, JOINT_NUMBERS // 2), clip.condition


def _pose_arrays(clip: CanonicalClip) -> Arrays:
    return flattened_by_frame(clip.hands), _number_mask(clip, HAND_FEATURES), clip.condition


def _pose_arrays_for_joints(clip: CanonicalClip) -> Arrays:
    joints = flattened_by_frame(clip.joints_m) * _number_mask(clip, JOINT_NUMBERS // 2)
    return (
        flattened_by_frame(clip.hands),
        _number_mask(clip, HAND_FEATURES),
        np.concatenate((clip.condition, joints), axis=1),
    )


def _network(name: str, size: int, condition: int, features: ToArrays, error: Callable[[Tensor], Tensor]) -> Network:
    build = partial(PoseNetwork, size, condition)
    return Network(
        name, PoseConfig, build, lambda setup: (PoseObjective(setup, build(setup.network), features, error), None)
    )


MDM = _network("mdm-b", POSE_NUMBERS, CONDITION, _pose_arrays, torch.square)
OMOMO_JOINTS = _network("omomo-b-joints", JOINT_NUMBERS, CONDITION, _joint_arrays, torch.abs)
OMOMO_HANDS = _network("omomo-b-hands", POSE_NUMBERS, CONDITION + JOINT_NUMBERS, _pose_arrays_for_joints, torch.abs)


def fixed_contact_joints(joints_m: np.ndarray, scene: Scene, within_m: float = CONTACT_DISTANCE_M) -> np.ndarray:
    """Fix joints to a part of the object from the first frame in which they are near: (frame, joint, 3) canonical."""
    model, rest, distances = scene.bps.model, [], []
    for part, part_vertices in scene.bps.vertices.items():
        rest.append(_in_part(scene, part, joints_m))
        distances.append(part_vertices.tree.query(rest[-1])[0])
    near = np.min(distances, axis=0) < within_m
    first, joint_ids = near.argmax(axis=0), np.arange(joints_m.shape[1])
    part = np.array([part_vertices[first, joint_ids] for part_vertices in distances]).argmin(axis=0)
    fixed_m = articulate(np.stack(rest)[part, first, joint_ids], part, model.hinge, scene.hinge_rad)
    is_fixed = near.any(axis=0) & (np.arange(len(joints_m))[:, None] >= first)
    return np.where(is_fixed[..., None], fixed_m, joints_m)


@dataclass(frozen=True)
class PoseSampler:
    """Trained MDM-B or OMOMO-B."""

    networks: Sequence[PoseNetwork]  # of poses alone, or of joints and then of poses
    synthetic: bool

    @classmethod
    def load(cls, sources: Sources, *networks: Network) -> "PoseSampler":
        trained = [load_checkpoint(sources.checkpoints / network.name, network, sources.device) for network in networks]
        return cls([cast(PoseNetwork, network.network) for network in trained], bool(trained[0].facts["synthetic"]))

    def sample(self, requests: Sequence[Request]) -> list[Clip | Skipped]:
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Clip | Skipped:
        if request.trajectories is None:
            return Skipped(request.motion_id, NO_OBJECT_MOTION)
        motion = request.trajectories.object[: request.n_frames]
        scene = Scene.of(request.object, motion, BASIS)
        condition = condition_of(scene, request.active_hands)
        if len(self.networks) > 1:
            joints = self.networks[0].sample_motion(condition, request.seed).reshape(len(scene), -1, 3)
            joint_features = flattened_by_frame(
                fixed_contact_joints(joints, scene).reshape(len(scene), 2, JOINTS, 3).swapaxes(0, 1)
            )
            active = np.repeat(request.active_hands, JOINT_NUMBERS // 2)
            condition = np.concatenate((condition, joint_features * active), axis=1)
        features = self.networks[-1].sample_motion(condition, request.seed).reshape(len(scene), 2, -1).swapaxes(0, 1)
        hands = moved_hands(proper_hands(torch.from_numpy(features)).numpy(), scene.model_from_canonical)
        return motion_clip(request, torch.from_numpy(hands), torch.from_numpy(motion), self.synthetic)


# --- CAMS-B


@dataclass(frozen=True)
class CamsConfig:
    hidden: tuple[int, ...] = (512, 512)
    latent: int = 64


class Stage(NamedTuple):
    """Frames ``start`` to ``stop - 1``, in which each hand touches the same part."""

    start: int
    stop: int
    part: tuple[int, int]  # touched by the left and the right hand; -1: none


def stages_of(joints_m: np.ndarray, scene: Scene) -> list[Stage]:
    """Split a motion into stages; joints_m: (2, frame, 21, 3) canonical."""
    by_hand = []
    for hand in joints_m[:, :, -FINGERS:]:
        distances_m = [
            part_vertices.tree.query(_in_part(scene, part, hand))[0].min(axis=1)
            for part, part_vertices in scene.bps.vertices.items()
        ]
        by_hand.append(np.where(np.min(distances_m, axis=0) < TOUCH_M, np.argmin(distances_m, axis=0), -1))
    touched_parts = np.stack(by_hand, axis=1)
    edges = np.flatnonzero((touched_parts[1:] != touched_parts[:-1]).any(axis=1)) + 1
    starts = [0]
    for start, stop in pairwise([*edges.tolist(), len(touched_parts)]):
        is_new = (touched_parts[start] != touched_parts[starts[-1]]).any()  # False after a short stage that was skipped
        starts += [start] if stop - start >= MIN_STAGE_FRAMES and is_new else []
    pieces = pairwise([*starts, len(touched_parts)])
    return [Stage(start, stop, (int(touched_parts[start, 0]), int(touched_parts[start, 1]))) for start, stop in pieces]


def _in_part(scene: Scene, part: int, points_m: np.ndarray) -> np.ndarray:
    """Transform canonical points to the rest frame of a part: (frame, n, 3)."""
    in_part_m = scene.bps.model.object_from_part(part, scene.hinge_rad).inverse() @ points_m.astype(np.float64)
    return np.broadcast_to(in_part_m, points_m.shape)


def conditions(clip: CanonicalClip, stages: Sequence[Stage]) -> np.ndarray:
    """(stage, number) float32: the object at both ends, the parts touched, the initial hands, scale and times."""
    active, scene = clip.active.any(axis=1), clip.scene
    first_joints_m = (clip.joints_m[:, 0] * active[:, None, None]).ravel()
    by_stage = []
    for stage in stages:
        ends = scene.basis_offset[[stage.start, stage.stop - 1]].ravel()
        parts = np.eye(3)[np.array(stage.part) + 1].ravel()
        stage_values = [scene.object_scale / 10, stage.start / len(scene), stage.stop / len(scene), *active]
        by_stage.append(np.concatenate((ends, parts, first_joints_m / UNIT_M, stage_values)))
    return np.stack(by_stage).astype(np.float32)


def targets(clip: CanonicalClip, stages: Sequence[Stage]) -> np.ndarray:
    """(stage, 2, 5, 4) float32: contact flag of each finger, and its tip in the part's rest frame in units of 5 cm."""
    values = np.zeros((len(stages), 2, FINGERS, 4), np.float32)
    for number, stage in enumerate(stages):
        for side in np.flatnonzero(clip.active.any(axis=1) & (np.array(stage.part) >= 0)):
            part = stage.part[side]
            tips_m = _in_part(clip.scene, part, clip.joints_m[side, :, -FINGERS:])[stage.start : stage.stop]
            distance_m = clip.scene.bps.vertices[part].tree.query(tips_m)[0]
            values[number, side, :, 0] = (distance_m < TOUCH_M).mean(axis=0) > 0.5
            values[number, side, :, 1:] = tips_m.mean(axis=0) / UNIT_M
    return values


class CamsNetwork(nn.Module):
    """A conditional VAE: ``decode(condition, latent)`` gives contact logits and tip positions of all fingers."""

    def __init__(self, config: CamsConfig) -> None:
        super().__init__()
        self.config = config
        condition, target = 2 * 3 * BASIS.places + 6 + JOINT_NUMBERS + 5, 2 * FINGERS * 4
        self.encoder = _layers(condition + target, config.hidden, 2 * config.latent)
        self.decoder = _layers(condition + config.latent, config.hidden, target)

    def decode(self, condition: Tensor, latent: Tensor) -> Tensor:
        return self.decoder(torch.cat((condition, latent), -1)).unflatten(-1, (2, FINGERS, 4))

    def losses(self, condition: Tensor, target: Tensor, generator: torch.Generator) -> Losses:
        noise = torch.randn(len(condition), self.config.latent, generator=generator).to(condition.device)
        mean, log_variance = self.encoder(torch.cat((condition, target.flatten(1)), -1)).chunk(2, -1)
        predicted = self.decode(condition, mean + noise * (log_variance / 2).exp())
        touches = target[..., 0]
        errors = (predicted[..., 1:] - target[..., 1:]).square().sum(-1)
        positions = (errors * touches).sum() / touches.sum().clamp_min(1)
        acts = touches.any(dim=-1, keepdim=True).expand_as(touches)  # a hand that touches in this stage
        flags = masked_mean(
            functional.binary_cross_entropy_with_logits(predicted[..., 0], touches, reduction="none"), acts
        )
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()
        total = positions + 0.1 * flags + 0.005 * divergence
        return {"total": total, "places": positions, "flags": flags, "divergence": divergence}


class CamsObjective:
    """The VAE's loss over all stages of a batch."""

    frames = entries = 0

    def __init__(self, setup: Setup) -> None:
        self.network, self.device = CamsNetwork(setup.network).to(setup.device), setup.device
        train = setup.corpus.train
        self.arrays = {clip_id: _stage_arrays(train.whole(clip_id)) for clip_id in train.ids}
        self.held_out = [_stage_arrays(clip) for clip in setup.corpus.held_out]

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        return self.network.losses(*self._batch([self.arrays[clip.clip_id] for clip in batch.samples]), generator)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        batch = self._batch(self.held_out)
        return cast(CamsNetwork, network).losses(*batch, torch.Generator().manual_seed(0))["total"]

    def _batch(self, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[Tensor]:
        return [torch.from_numpy(np.concatenate(arrays)).to(self.device) for arrays in zip(*pairs, strict=True)]


def _stage_arrays(sample: ClipSample) -> tuple[np.ndarray, np.ndarray]:
    clip = canonical_clip(sample)
    stages = stages_of(clip.joints_m, clip.scene)
    return conditions(clip, stages), targets(clip, stages)


@dataclass(frozen=True)
class CamsSampler:
    """The trained network, with the clips that provide initial hands and stages."""

    network: CamsNetwork
    sources: Sources
    synthetic: bool

    @classmethod
    def load(cls, sources: Sources) -> "CamsSampler":
        trained = load_checkpoint(sources.checkpoints / CAMS.name, CAMS, sources.device)
        return cls(cast(CamsNetwork, trained.network), sources, bool(trained.facts["synthetic"]))

    def sample(self, requests: Sequence[Request]) -> list[Clip | Skipped]:
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Clip | Skipped:
        if request.trajectories is None or not request.clip_id:
            return Skipped(request.motion_id, NO_OBJECT_MOTION)
        recorded, pair = load_sample(self.sources.annotated, request.clip_id), self.sources.hands
        clip = canonical_clip(recorded)
        stages = stages_of(clip.joints_m, clip.scene)
        fingers = self._sample_fingers(conditions(clip, stages), request.seed)
        ids, world = np.union1d(hand_keypoints(pair.right, 64), TIP_VERTICES), world_from_canonical(request, clip.scene)
        generated = {}
        for side_index in np.flatnonzero(request.active_hands).tolist():
            skin_m = clip.scene.model_from_canonical.inverse()[0] @ hand_vertices_m(pair, side_index, recorded)[0]
            tips = np.searchsorted(ids, TIP_VERTICES)
            points_m = carried_keypoints(skin_m[ids], tips, fingers[:, side_index], stages, clip.scene, side_index)
            refuse_not_finite(request, points_m)
            everywhere = np.ones(len(points_m), bool)
            generated[SIDES[side_index]] = GeneratedKeypoints(world @ points_m, np.zeros_like(points_m), everywhere)
        bare = clip_without_hands(request, self.synthetic)
        tracks = fit_hands(pair, request.betas, ids, generated, request.template_m)
        return replace(bare, hands={**bare.hands, **tracks})

    @torch.no_grad()
    def _sample_fingers(self, condition: np.ndarray, seed: int) -> np.ndarray:
        """(stage, 2, 5, 4) contact logits and tip positions of the fingers; all stages share one latent."""
        device = next(self.network.parameters()).device
        latent = torch.randn(1, self.network.config.latent, generator=torch.Generator().manual_seed(seed)).to(device)
        latents = latent.expand(len(condition), -1)
        return self.network.decode(torch.from_numpy(condition).to(device), latents).cpu().numpy()


def carried_keypoints(
    first_m: np.ndarray, tips: np.ndarray, fingers: np.ndarray, stages: Sequence[Stage], scene: Scene, side: int
) -> np.ndarray:
    """Move the initial keypoints of a hand rigidly to the finger contacts of each stage, and with the touched part.

    Args:
        first_m: (point, 3) initial keypoints, canonical.
        tips: indices of the five finger tips.
        fingers: (stage, 5, 4) as of ``targets``, with logits instead of flags.
        stages: of the motion.
        scene: the object's motion.
        side: 0 left, 1 right.

    Returns:
        (frame, point, 3) canonical; touching tips are exactly at their contact before blending.
    """
    keypoints_m, hand_m, part = np.empty((len(scene), *first_m.shape)), first_m, 0
    for stage, finger in zip(stages, fingers, strict=True):
        touching = finger[:, 0] > 0
        if stage.part[side] >= 0 and touching.any():
            part, target_m = stage.part[side], finger[touching, 1:].astype(np.float64) * UNIT_M
            hand_m = _fitted_transform(first_m[tips[touching]], target_m) @ first_m
            hand_m[tips[touching]] = target_m
        pose = scene.bps.model.object_from_part(part, scene.hinge_rad)
        rows = slice(stage.start, stage.stop)
        keypoints_m[rows] = (pose @ np.broadcast_to(hand_m, keypoints_m.shape))[rows]
    return gaussian_filter1d(keypoints_m, BLEND_FRAMES, axis=0, mode="nearest")


def _fitted_transform(points_m: np.ndarray, targets_m: np.ndarray) -> RigidTransform:
    """The rigid transform that fits points to targets in least squares; a translation for fewer than three points."""
    middle, target_middle = points_m.mean(axis=0), targets_m.mean(axis=0)
    rotation = np.eye(3)
    if len(points_m) >= 3:
        rotation = Rotation.align_vectors(targets_m - target_middle, points_m - middle)[0].as_matrix()
    return RigidTransform(rotation, target_middle - rotation @ middle)


def _layers(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    sizes = (inputs, *hidden)
    layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ELU())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


CAMS = Network("cams-b", CamsConfig, CamsNetwork, lambda setup: (CamsObjective(setup), None))


def _family(name: str, title: str, load: Callable[[Sources], Any], *networks: Network) -> Family:
    uses = tuple(network.name for network in networks)
    return Family(name=name, title=title, load=load, networks=networks, uses=uses)


MDM_B = _family("mdm-b", "MDM-B", lambda sources: PoseSampler.load(sources, MDM), MDM)
OMOMO = OMOMO_JOINTS, OMOMO_HANDS
OMOMO_B = _family("omomo-b", "OMOMO-B", lambda sources: PoseSampler.load(sources, *OMOMO), *OMOMO)
CAMS_B = _family("cams-b", "CAMS-B, conditioned on the first hands and the stages", CamsSampler.load, CAMS)
