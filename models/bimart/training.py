"""Training of both networks: predict the clean values of noised windows of clips (Sec. 3.5)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch
from hoidata.devices import send
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotation_angle
from hoidata.hands import HandPair
from hoidata.sensors.part_bps import hand_keypoints
from models.bimart.network import (
    ContactModel,
    Denoiser,
    DenoiserConfig,
    MotionModel,
    SceneWindow,
    Windows,
    build_windows,
    contact_channels,
    padded,
    scene_inputs,
)
from models.bimart.scene import RecordedClip, recorded_clip
from models.common.family import Losses, Network, Setup
from models.common.losses import masked_mean
from models.common.sampling import TRAIN_STEPS, add_noise

VALIDATION_STEPS = (99, 299, 499, 699, 899)
MIN_STD = 1e-10
# Limits of a jump: by how much the step between two frames exceeds the shorter of its two neighbours. Fast motion has
# fast neighbours; a cut in the recording has not. Of the object, its rotation, its hinge and a hand.
JUMP_M, JUMP_RAD, HINGE_JUMP_RAD, HAND_JUMP_M = 0.04, 0.3, 0.2, 0.05

ClipWindow = tuple[RecordedClip, int]  # a clip and the first frame of a window


@dataclass(frozen=True)
class LossConfig:
    """Loss weights and sampling of windows."""

    windows_per_clip: int = 1
    contact_dropout: float = 0.5  # fraction of windows whose contact map is dropped
    velocity_weight: float = 0.0  # of the same error for differences between frames


@dataclass(frozen=True)
class Targets:
    """A batch of windows with the values to predict."""

    windows: Windows
    clean: Tensor  # (B, F, D) metres
    clean_mask: Tensor  # (B, F, D) bool, known values
    contact_mask: Tensor  # (B, F, 2N) bool, known contact distances

    def to(self, device: torch.device | str) -> "Targets":
        windows, *tensors = vars(self).values()
        return Targets(windows.to(device), *(send(tensor, device) for tensor in tensors))


def window_starts(clip: RecordedClip, length: int) -> np.ndarray:
    """First frames of a clip's windows that contain no jump. A clip shorter than a window has one window or none."""
    starts = np.arange(max(len(clip.scene) - length, 0) + 1)
    jumps = np.append(0, np.cumsum(_is_jump(clip)))
    last_frames = np.minimum(starts + length, len(clip.scene)) - 1
    return starts[jumps[last_frames] == jumps[starts]]


def middle_start(clip: RecordedClip, length: int) -> list[int]:
    """First frame of the window nearest to the clip's middle; empty if each window contains a jump."""
    starts, middle = window_starts(clip, length), max(len(clip.scene) - length, 0) // 2
    return starts[np.argsort(np.abs(starts - middle), kind="stable")[:1]].tolist()


def _is_jump(clip: RecordedClip) -> np.ndarray:
    """(frame - 1,) bool: the object or a hand is not continuous between two frames."""
    body, hinge_rad = clip.scene.model_from_canonical, clip.scene.hinge_rad
    angle_rad = rotation_angle(body.rotation[:-1].swapaxes(1, 2) @ body.rotation[1:])
    jumps = _excess_over_neighbours(np.linalg.norm(np.diff(body.translation, axis=0), axis=1)) > JUMP_M
    jumps |= (_excess_over_neighbours(angle_rad) > JUMP_RAD) | (
        _excess_over_neighbours(np.abs(np.diff(hinge_rad))) > HINGE_JUMP_RAD
    )
    for keypoints_m, present in zip(clip.keypoints_m, clip.present, strict=True):
        canonical_m = keypoints_m.mean(axis=1, dtype=np.float64)
        model_m = (body @ canonical_m[:, None])[:, 0]
        # The smaller step of both frames: a resting hand near a spinning object moves fast in the object's frame.
        steps_m = [np.linalg.norm(np.diff(centre_m, axis=0), axis=1) for centre_m in (canonical_m, model_m)]
        step_m = np.where(present[1:] & present[:-1], np.min(steps_m, axis=0), np.nan)
        jumps |= _excess_over_neighbours(step_m) > HAND_JUMP_M
    return jumps


def _excess_over_neighbours(step: np.ndarray) -> np.ndarray:
    """(frame - 1,) each step minus the shorter of its two neighbours; NaN for an unknown step."""
    padded = np.pad(step, 1, constant_values=np.nan)
    return step - np.nan_to_num(np.fmin(padded[:-2], padded[2:]))


class Objective:
    """Mean squared error of clean, normalised values of active hands and existing parts."""

    frames = entries = 0

    def __init__(self, setup: Setup, network: Denoiser) -> None:
        pair: HandPair = setup.corpus.annotated.store.hand_pair()
        self.loss: LossConfig = setup.loss
        self.device, self.length = setup.device, network.config.features.window_frames
        train = setup.corpus.train
        features = network.config.features
        self.clips = {clip_id: recorded_clip(train.whole(clip_id), pair, features) for clip_id in train.ids}
        self.starts = {clip_id: window_starts(clip, self.length) for clip_id, clip in self.clips.items()}
        network.keypoint_ids.copy_(torch.from_numpy(hand_keypoints(pair.right, features.keypoints)))
        # All windows of the training clips, thinned to those an eighth of a window apart.
        starts = [(clip, self.starts[clip_id][:: max(self.length // 8, 1)]) for clip_id, clip in self.clips.items()]
        learn_statistics(network, [(clip, int(start)) for clip, clip_starts in starts for start in clip_starts])
        self.network = network.to(setup.device)
        validation_clips = [recorded_clip(sample, pair, features) for sample in setup.corpus.held_out]
        windows = [(clip, start) for clip in validation_clips for start in middle_start(clip, self.length)]
        if validation_clips and not windows:
            remedy = "put other clips into the validation part"
            got = f"none in {len(validation_clips)} clips"
            raise BadInput("validation", "a window of a clip without a jump", got, remedy)
        self.validation_targets = targets_of(network, windows).to(self.device) if windows else None

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        windows = [window for sample in batch.samples for window in self._sampled(sample.clip_id, generator)]
        if not windows:
            return {"total": self.network.x_out.bias.sum() * 0}
        return window_losses(self.network, targets_of(self.network, windows).to(self.device), self.loss, generator)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, Denoiser)
        generator, targets = torch.Generator().manual_seed(0), self.validation_targets
        assert targets is not None
        clean, total = normalised(network, targets), torch.zeros((), device=self.device)
        for step in VALIDATION_STEPS:
            steps = torch.full((len(clean),), step, device=self.device)
            noise = send(torch.randn(clean.shape, generator=generator), self.device)
            predicted = network(add_noise(clean, noise, steps, network.signal), steps, targets.windows)
            total += masked_mean((predicted - clean).square(), targets.clean_mask)
        return total / len(VALIDATION_STEPS) / network.config.signal_scale**2

    def _sampled(self, clip_id: str, generator: torch.Generator) -> list[ClipWindow]:
        starts = self.starts[clip_id]
        if not len(starts):
            return []
        chosen = torch.randint(len(starts), (self.loss.windows_per_clip,), generator=generator).tolist()
        return [(self.clips[clip_id], int(starts[number])) for number in chosen]


def window_losses(network: Denoiser, target: Targets, loss: LossConfig, generator: torch.Generator) -> Losses:
    """Noise windows to uniformly sampled steps and compare the prediction with the clean values (Sec. 3.5)."""
    clean, device = normalised(network, target), target.clean.device
    batch, count = len(clean), network.config.diffusion_steps
    trained_step = torch.randint(count, (batch,), generator=generator)
    steps = send((trained_step + 1) * (TRAIN_STEPS // count) - 1, device)
    drop = send(torch.rand(batch, generator=generator) < loss.contact_dropout, device)
    noise = send(torch.randn(clean.shape, generator=generator), device)
    predicted = network(add_noise(clean, noise, steps, network.signal), steps, target.windows, drop)
    # The loss does not depend on the scale of the signal, so that learning rates compare.
    error = (predicted - clean) / network.config.signal_scale
    losses = {"simple": masked_mean(error.square(), target.clean_mask)}
    total = losses["simple"]
    if loss.velocity_weight:
        both_known = target.clean_mask[:, 1:] & target.clean_mask[:, :-1]
        losses["velocity"] = masked_mean(error.diff(dim=1).square(), both_known)
        total = total + loss.velocity_weight * losses["velocity"]
    return {"total": total, **losses}


def normalised(network: Denoiser, target: Targets) -> Tensor:
    """(B, F, D) normalised clean values, zero for unknown ones."""
    return torch.where(target.clean_mask, network.encode(target.clean), 0.0)


def targets_of(network: Denoiser, clip_windows: Sequence[ClipWindow]) -> Targets:
    """The condition and the clean values of windows of clips, on the CPU."""
    config = network.config
    length = max(min(config.features.window_frames, len(clip.scene) - start) for clip, start in clip_windows)
    scene_windows = [SceneWindow(clip.scene, start, start + length, clip.active_hands) for clip, start in clip_windows]
    cut = [(clip, slice(start, start + length)) for clip, start in clip_windows]
    contact_m = padded([clip.contact_m[:, frames].transpose(1, 0, 2) for clip, frames in cut]).flatten(2)
    windows = replace(build_windows(scene_windows, config), contact_m=contact_m)
    present = padded([clip.present[:, frames].T for clip, frames in cut]).bool()
    contact_mask = present.repeat_interleave(config.features.object_points, 2) & contact_channels(windows)
    if isinstance(network, ContactModel):
        return Targets(windows, contact_m, contact_mask, contact_mask)
    motion_mask = config.features.spread_over_motion(present) & network.channel_mask(windows)
    return Targets(windows, padded([clip.motion[frames] for clip, frames in cut]), motion_mask, contact_mask)


@torch.no_grad()
def learn_statistics(network: Denoiser, clip_windows: Sequence[ClipWindow], batch: int = 64) -> None:
    """Set the network's means and standard deviations (its ``*_mean`` and ``*_scale`` buffers) from training windows.

    Standard deviations have a lower limit relative to their group: O; each value of G and the scale by itself;
    keypoints; vectors to the object; contact distances.
    """
    features = network.config.features
    offsets, keypoints = 3 * features.object_points, 6 * features.keypoints
    groups = {
        "input": [slice(0, offsets), *(slice(column, column + 1) for column in range(offsets, features.scene_size))],
        "": [slice(0, keypoints), slice(keypoints, None)] if isinstance(network, MotionModel) else [slice(None)],
        "contact": [slice(None)],
    }
    sizes = features.scene_size, len(network.mean), features.contact_size
    moments = {name: Moments(size) for name, size in zip(groups, sizes, strict=True)}
    for first in range(0, len(clip_windows), batch):
        target = targets_of(network, clip_windows[first : first + batch])
        assert target.windows.contact_m is not None
        scene, exists = scene_inputs(target.windows)
        moments["input"].add(scene, exists & target.windows.frame_mask[..., None])
        moments[""].add(target.clean, target.clean_mask)
        moments["contact"].add(target.windows.contact_m, target.contact_mask)
    for name, sums in moments.items():
        mean, std = sums.mean_and_std()
        for group in groups[name]:
            group_std = std[group].square().mean().sqrt()
            std[group] = std[group].clamp_min(float(network.config.min_std_fraction * group_std) + MIN_STD)
        getattr(network, f"{name}_mean".strip("_")).copy_(mean)
        getattr(network, f"{name}_scale".strip("_")).copy_(std)


class Moments:
    """Running means and standard deviations of columns; a column without a value has mean 0 and deviation 1."""

    def __init__(self, size: int) -> None:
        self.count, self.total, self.squares = (torch.zeros(size, dtype=torch.float64) for _ in range(3))

    def add(self, values: Tensor, mask: Tensor) -> None:
        """Add values (..., size); mask (..., size) bool: known values."""
        values, mask = values.double().flatten(0, -2), mask.flatten(0, -2)
        values = torch.where(mask, values, 0.0)
        self.count += mask.sum(0)
        self.total += values.sum(0)
        self.squares += values.square().sum(0)

    def mean_and_std(self) -> tuple[Tensor, Tensor]:
        """Both (size,) float64."""
        mean = self.total / self.count.clamp_min(1)
        std = (self.squares / self.count.clamp_min(1) - mean.square()).clamp_min(0).sqrt()
        return mean, torch.where(self.count > 0, std, 1.0)


def _network(name: str, build: type[ContactModel] | type[MotionModel]) -> Network:
    return Network(
        name=name,
        config=DenoiserConfig,
        build=build,
        objective=lambda setup: (Objective(setup, build(setup.network)), None),
        loss=LossConfig,
    )


CONTACT, MOTION = _network("bimart-contact", ContactModel), _network("bimart-motion", MotionModel)
