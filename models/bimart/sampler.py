"""Sampling of BimArt: contact maps for an object's motion, then keypoints and vectors to the object for both.

All windows of a motion are denoised together. Each sample has a seed and does not depend on the rest of the batch.
Guidance moves the keypoints towards the contact map during sampling (Sec. 3.3, Eqs. 5-7).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from hoidata.devices import send
from hoidata.errors import BadInput
from hoidata.settings import build_config, merge_settings
from models.bimart.network import (
    ContactModel,
    Denoiser,
    DenoiserConfig,
    EncodedWindows,
    Layout,
    MotionModel,
    SceneWindow,
    build_windows,
)
from models.bimart.scene import Scene, split_motion
from models.common.checkpoints import Checkpoint
from models.common.sampling import SamplerConfig, sample

MAX_PAIRS = 1 << 22  # of object points and keypoints in one distance matrix
GUIDANCE_RANGE_M = 0.02  # weights of object points decay with their target distance, by 1/e in this


@dataclass(frozen=True)
class ContactTarget:
    """The contact map that guidance moves keypoints to."""

    object_point_m: Tensor  # (B, F, N, 3)
    contact_m: Tensor  # (B, F, 2N) target distances
    mask: Tensor  # (B, F, 2N) bool, distances that count


@dataclass(frozen=True)
class Discrepancy:
    """How the contact map of keypoints differs from its target."""

    error_m: Tensor  # (B, F, 2, N) distance minus target distance; 0 where masked
    nearest: Tensor  # (B, F, 2, N) index of the nearest keypoint
    direction: Tensor  # (B, F, 2, N, 3) unit vector from the object point to that keypoint


def discrepancy(keypoints_m: Tensor, target: ContactTarget) -> Discrepancy:
    """Compare the contact map of keypoints (B, F, 2, J, 3) with its target (Eq. 5)."""
    batch, frames, _, count, _ = keypoints_m.shape
    points = target.object_point_m[:, :, None].expand(-1, -1, 2, -1, -1).flatten(0, 2)
    keypoints = keypoints_m.flatten(0, 2)
    chunk = max(1, MAX_PAIRS // (points.shape[1] * count))
    nearest = torch.cat(
        [torch.cdist(a, b).argmin(-1) for a, b in zip(points.split(chunk), keypoints.split(chunk), strict=True)]
    )
    vector = keypoints.gather(1, nearest[..., None].expand(-1, -1, 3)) - points
    distance = vector.norm(dim=-1)
    direction = vector / distance[..., None].clamp_min(1e-9)
    shape = batch, frames, 2, points.shape[1]
    error = distance.reshape(shape) - target.contact_m.unflatten(-1, (2, -1))
    return Discrepancy(error * target.mask.unflatten(-1, (2, -1)), nearest.reshape(shape), direction.reshape(*shape, 3))


def paper_step(keypoints_m: Tensor, target: ContactTarget, scale: Tensor, window_frames: int) -> Tensor:
    """The guidance step of Eq. 6: the negative gradient of the mean squared error, scaled to length 1 per window.

    keypoints_m (B, F, 2, J, 3); scale (2, J, 3), metres per normalised unit. The step is in normalised units. Windows
    of ``window_frames`` follow each other without overlap.
    """
    current = discrepancy(keypoints_m, target)
    count = target.mask.unflatten(-1, (2, -1)).sum((1, 3), keepdim=True).clamp_min(1)
    by_point = 2 * current.error_m[..., None] * current.direction / count[..., None]
    gradient = _sum_at_keypoints(by_point, current.nearest, keypoints_m) * scale
    windows = gradient.split(window_frames, 1)
    lengths = [torch.linalg.vector_norm(window, dim=(1, 2, 3, 4), keepdim=True).clamp_min(1e-12) for window in windows]
    return torch.cat([-window / length for window, length in zip(windows, lengths, strict=True)], 1)


def metre_step(keypoints_m: Tensor, target: ContactTarget) -> Tensor:
    """A guidance step of keypoints (B, F, 2, J, 3) in metres: Gauss-Newton with the diagonal of the Hessian.

    Each keypoint moves by the weighted mean of the corrections of the object points it is nearest to. Object points
    whose target distance is large have little weight.
    """
    current = discrepancy(keypoints_m, target)
    mask = target.mask.unflatten(-1, (2, -1))
    weight = torch.exp(-target.contact_m / GUIDANCE_RANGE_M).unflatten(-1, (2, -1)) * mask
    correction = weight[..., None] * current.error_m[..., None] * current.direction
    correction = _sum_at_keypoints(correction, current.nearest, keypoints_m)
    total = _sum_at_keypoints(weight[..., None].expand_as(current.direction), current.nearest, keypoints_m)
    return -correction / (total + 0.5)  # 0.5 damps keypoints with little weight


def _sum_at_keypoints(values: Tensor, nearest: Tensor, keypoints: Tensor) -> Tensor:
    """Sum values (B, F, 2, N, 3) of object points at their nearest keypoints: (B, F, 2, J, 3)."""
    return torch.zeros_like(keypoints).scatter_add_(3, nearest[..., None].expand_as(values), values)


def combined(conditional: Tensor, unconditional: Tensor, weight: float, rule: Literal["usual", "paper"]) -> Tensor:
    """Classifier-free guidance: (1 + w) c - w u; "paper" is Eq. 7 as printed, (1 + w) c - u."""
    return (1 + weight) * conditional - (weight if rule == "usual" else 1.0) * unconditional


@dataclass(frozen=True)
class BimArtSamplerConfig(SamplerConfig):
    """``SamplerConfig`` with the defaults of BimArt."""

    steps: int = 10
    guidance: float = 0.0  # lambda_f of classifier-free guidance; 0: none


@dataclass(frozen=True)
class SamplingConfig:
    """How both networks are sampled."""

    sampler: BimArtSamplerConfig = field(default_factory=BimArtSamplerConfig)
    guidance_rule: Literal["usual", "paper"] = "usual"  # of classifier-free guidance, see ``combined``
    contact_guidance: Literal["off", "paper", "metres"] = "metres"
    contact_guidance_fraction: float = 1 / 3  # contact guidance acts in this last fraction of the sampler's steps
    # True: windows overlap and are joined at each step. False (paper): windows are sampled independently.
    overlapping: bool = True


OURS = SamplingConfig()
PAPER = SamplingConfig(
    sampler=BimArtSamplerConfig("ddpm", 50, 0.5),
    guidance_rule="paper",
    contact_guidance="paper",
    contact_guidance_fraction=1.0,
    overlapping=False,
)
PRESETS = {"ours": OURS, "paper": PAPER}


def sampling_of(preset: str, changes: Mapping[str, Any], source: str) -> SamplingConfig:
    """The sampling of a preset with some settings changed; ``source``: their section, for BadInput."""
    return build_config(SamplingConfig, merge_settings(asdict(PRESETS[preset]), changes), source)


def preset_of(config: DenoiserConfig) -> Literal["ours", "paper"]:
    """The preset that a network was trained with."""
    return "ours" if config.condition_on_hands else "paper"


@dataclass(frozen=True)
class SamplingTask:
    """One motion to sample."""

    scene: Scene
    active_hands: np.ndarray  # (2,) bool
    seed: int


@dataclass(frozen=True)
class SampledMotion:
    """A sampled contact map and the hands for it, canonical frame, metres."""

    contact_m: np.ndarray  # (frame, 2N) target distances
    keypoints_m: np.ndarray  # (side, frame, keypoint, 3)
    to_object_m: np.ndarray  # (side, frame, keypoint, 3) vectors from keypoints to the object


@dataclass(frozen=True)
class BimArt:
    """Both trained networks with their sampling."""

    contact: ContactModel
    motion: MotionModel
    config: SamplingConfig
    device: torch.device

    @classmethod
    def of(cls, contact: Checkpoint, motion: Checkpoint, config: SamplingConfig, device: torch.device) -> "BimArt":
        """Combine two checkpoints. Raises BadInput if the two networks have different features."""
        contact_model, motion_model = contact.network, motion.network
        assert isinstance(contact_model, ContactModel)
        assert isinstance(motion_model, MotionModel)
        # The features that a pair must have in common; the others are set to fixed values.
        expected, got = (
            replace(model.config.features, state="local", window_frames=0) for model in (contact_model, motion_model)
        )
        if got != expected:
            raise BadInput("bimart-motion", f"features of its contact model, {expected}", f"{got}", "train both alike")
        return cls(contact_model, motion_model, config, device)

    @torch.no_grad()
    def sample_motions(self, tasks: Sequence[SamplingTask], contact_m: Tensor | None = None) -> list[SampledMotion]:
        """Sample hands for tasks of one length; contact_m (B, frame, 2N) replaces the sampled contact maps."""
        generators = [torch.Generator().manual_seed(task.seed) for task in tasks]
        # Contact maps are sampled even if they are given, because the motion's noise follows theirs.
        sampled_maps = self._sample_maps(tasks, generators)
        contact = sampled_maps if contact_m is None else contact_m.to(sampled_maps)
        motion = self.motion.decode(self._sample(self.motion, tasks, generators, contact))
        arrays = zip(contact.cpu().numpy(), motion.cpu().numpy(), strict=True)
        return [SampledMotion(contact_m, *split_motion(values)) for contact_m, values in arrays]

    @torch.no_grad()
    def sample_maps(self, tasks: Sequence[SamplingTask]) -> np.ndarray:
        """(B, frame, 2N) metres: the contact maps that ``sample_motions`` samples for these tasks."""
        return self._sample_maps(tasks, [torch.Generator().manual_seed(task.seed) for task in tasks]).cpu().numpy()

    def _sample_maps(self, tasks: Sequence[SamplingTask], generators: list[torch.Generator]) -> Tensor:
        contact_m = self.contact.decode(self._sample(self.contact, tasks, generators, None))
        return contact_m.clamp(0, self.motion.config.features.max_distance_m or None) * self._contact_mask(tasks)

    def _contact_mask(self, tasks: Sequence[SamplingTask]) -> Tensor:
        """(B, frame, 2N) bool: contact distances of existing object points to active hands."""
        of_all = not self.motion.config.condition_on_hands
        masks = [((task.active_hands | of_all)[:, None] & task.scene.point_exists).ravel() for task in tasks]
        return torch.from_numpy(np.stack(masks)).to(self.device)[:, None].expand(-1, len(tasks[0].scene), -1)

    def _sample(
        self,
        network: Denoiser,
        tasks: Sequence[SamplingTask],
        generators: list[torch.Generator],
        contact_m: Tensor | None,
    ) -> Tensor:
        """(B, frame, D) normalised values of a network, from noise."""
        frames, size = len(tasks[0].scene), len(network.mean)
        # A motion shorter than a window is one window of its length.
        layout = Layout(frames, min(network.config.features.window_frames, frames), self.config.overlapping)
        scene_windows = [
            SceneWindow(task.scene, start, start + layout.length, task.active_hands)
            for task in tasks
            for start in layout.starts
        ]
        windows = build_windows(scene_windows, network.config).to(self.device)
        target, weight = None, 0.0
        if contact_m is not None:
            windows, weight = replace(windows, contact_m=layout.cut(contact_m)), self.config.sampler.guidance
            target = None if self.config.contact_guidance == "off" else self._contact_target(tasks, contact_m)
        denoise = self._denoiser(network, network.prepare(windows), layout, weight, target)

        def draw() -> Tensor:
            noise = torch.stack([torch.randn(frames, size, generator=generator) for generator in generators])
            return send(noise, self.device)

        return sample(denoise, draw(), self.config.sampler, draw, network.config.noise_schedule)

    def _contact_target(self, tasks: Sequence[SamplingTask], contact_m: Tensor) -> ContactTarget:
        points = torch.from_numpy(np.stack([task.scene.object_point_m for task in tasks])).to(self.device)
        mask, max_m = self._contact_mask(tasks), self.motion.config.features.max_distance_m
        # A distance at the clamp is a lower bound only.
        return ContactTarget(points, contact_m, mask & (contact_m < 0.99 * max_m) if max_m else mask)

    def _denoiser(
        self, network: Denoiser, encoded: EncodedWindows, layout: Layout, weight: float, target: ContactTarget | None
    ) -> Callable[[Tensor, Tensor], Tensor]:
        """A network with classifier-free guidance of some weight, and contact guidance if there is a target."""
        config, calls, copies = self.config, 0, 2 if weight else 1
        encoded = encoded.doubled() if weight else encoded

        def denoise(x: Tensor, steps: Tensor) -> Tensor:
            nonlocal calls
            calls += 1
            windows = layout.cut(x).repeat(copies, 1, 1)
            window_steps = steps.repeat_interleave(len(layout.starts)).repeat(copies)
            denoised = network.denoise(windows, window_steps, encoded, encoded.conditional)
            clean, *unconditional = (layout.joined(values) for values in denoised.chunk(copies))
            if target is not None and calls > config.sampler.steps * (1 - config.contact_guidance_fraction):
                clean = self._guide_keypoints(clean, target)
            return combined(clean, unconditional[0], weight, config.guidance_rule) if weight else clean

        return denoise

    def _guide_keypoints(self, clean: Tensor, target: ContactTarget) -> Tensor:
        """(B, frame, D) with keypoints moved by one step of contact guidance; vectors to the object stay."""
        network, half = self.motion, 6 * self.motion.config.features.keypoints
        scale = (network.scale[:half] / network.config.signal_scale).reshape(2, -1, 3)
        keypoints = network.decode(clean)[..., :half].unflatten(-1, (2, -1, 3))
        if self.config.contact_guidance == "paper":
            step = paper_step(keypoints, target, scale, network.config.features.window_frames)
        else:
            step = metre_step(keypoints, target) / scale
        return torch.cat((clean[..., :half] + step.flatten(2), clean[..., half:]), -1)
