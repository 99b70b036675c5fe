"""How both networks are trained: windows of clips, noised, against what is clean (Sec. 3.5)."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch
from hoidata.devices import send
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotation_angle
from hoidata.hands import HandPair
from hoidata.sensors.keypoints import hand_keypoints
from models.bimart.network import (
    Asked,
    ContactModel,
    Denoiser,
    DenoiserConfig,
    MotionModel,
    Windows,
    contact_channels,
    windows_of,
)
from models.bimart.scene import Recorded, recorded_clip
from models.common.family import Losses, Network, Setup
from models.common.losses import masked_mean
from models.common.sampling import TRAIN_STEPS, add_noise

VALIDATION_STEPS = (99, 299, 499, 699, 899)
TINY = 1e-10
# A step from a frame to the next that is so much longer than the shorter one beside it was cut there: fast motion is
# fast before or after too. The body's, the hinge's, and a hand's, both in the world and before the body.
JUMP_M, JUMP_RAD, HINGE_JUMP_RAD, HAND_JUMP_M = 0.04, 0.3, 0.2, 0.05


@dataclass(frozen=True)
class LossConfig:
    """windows: drawn of every clip of a batch. contact_dropout: share of windows that are given no contact map.

    velocity_weight: of the same error of differences between frames.
    """

    windows: int = 1
    contact_dropout: float = 0.5
    velocity_weight: float = 0.0


@dataclass(frozen=True)
class Targets:
    """windows: what is told. clean (B, F, D): what is to be made, metres. known (B, F, D), mapped (B, F, 2N): where it
    and the contact map are known.
    """

    windows: Windows
    clean: Tensor
    known: Tensor
    mapped: Tensor

    def to(self, device: torch.device | str) -> "Targets":
        told, *others = (getattr(self, item.name) for item in fields(self))
        return Targets(told.to(device), *(send(own, device) for own in others))


def window_starts(clip: Recorded, length: int) -> np.ndarray:
    """First frames of a clip's windows, none across a jump; a clip that is too short has one, or none."""
    starts = np.arange(max(len(clip.scene) - length, 0) + 1)
    jumps = np.append(0, np.cumsum(_is_jump(clip)))
    stops = np.minimum(starts + length, len(clip.scene)) - 1
    return starts[jumps[stops] == jumps[starts]]


def middle_start(clip: Recorded, length: int) -> list[int]:
    """First frame of the window nearest to the middle of a clip; none where every one crosses a jump."""
    starts, middle = window_starts(clip, length), max(len(clip.scene) - length, 0) // 2
    return starts[np.argsort(np.abs(starts - middle), kind="stable")[:1]].tolist()


def _is_jump(clip: Recorded) -> np.ndarray:
    """(frame - 1,) bool: object or a hand does not go on from a frame to the next."""
    body, hinge_rad = clip.scene.model_from_canonical, clip.scene.hinge_rad
    turns_rad = rotation_angle(body.rotation[:-1].swapaxes(1, 2) @ body.rotation[1:])
    jumps = _beyond(np.linalg.norm(np.diff(body.translation, axis=0), axis=1)) > JUMP_M
    jumps |= (_beyond(turns_rad) > JUMP_RAD) | (_beyond(np.abs(np.diff(hinge_rad))) > HINGE_JUMP_RAD)
    for points, present in zip(clip.keypoints_m, clip.present, strict=True):
        middle = points.mean(axis=1, dtype=np.float64)
        world = (body @ middle[:, None])[:, 0]
        step = np.min([np.linalg.norm(np.diff(own, axis=0), axis=1) for own in (middle, world)], axis=0)
        jumps |= _beyond(np.where(present[1:] & present[:-1], step, np.nan)) > HAND_JUMP_M
    return jumps


def _beyond(step: np.ndarray) -> np.ndarray:
    """(frame - 1,) by how much each step is longer than the shorter one beside it; NaN where it is not known."""
    beside = np.pad(step, 1, constant_values=np.nan)
    return step - np.nan_to_num(np.fmin(beside[:-2], beside[2:]))


class Objective:
    """Mean squared error of the clean, normalised numbers of hands and parts that are there."""

    frames = entries = 0

    def __init__(self, setup: Setup, network: Denoiser) -> None:
        pair: HandPair = setup.corpus.annotated.store.hand_pair()
        self.loss: LossConfig = setup.loss
        self.device, self.length = setup.device, network.config.features.window
        train = setup.corpus.train
        features = network.config.features
        self.clips = {own: recorded_clip(train.whole(own), pair, features) for own in train.ids}
        self.starts = {own: window_starts(clip, self.length) for own, clip in self.clips.items()}
        network.keypoint_ids.copy_(torch.from_numpy(hand_keypoints(pair.right, features.keypoints)))
        learn_statistics(network, self._every_window())
        self.network = network.to(setup.device)
        held = [recorded_clip(sample, pair, features) for sample in setup.corpus.held_out]
        middles = [(clip, start) for clip in held for start in middle_start(clip, self.length)]
        if held and not middles:
            remedy = "put other clips into the validation part"
            raise BadInput("validation", "a window of a clip without a jump", f"none in {len(held)} clips", remedy)
        self.held_out = targets_of(network, middles).to(self.device) if middles else None

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        drawn = [one for sample in batch.samples for one in self._drawn(sample.clip_id, generator)]
        if not drawn:
            return {"total": self.network.x_out.bias.sum() * 0}
        return window_losses(self.network, targets_of(self.network, drawn).to(self.device), self.loss, generator)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, Denoiser)
        generator, held = torch.Generator().manual_seed(0), self.held_out
        assert held is not None
        clean, total = normalised(network, held), torch.zeros((), device=self.device)
        for step in VALIDATION_STEPS:
            steps = torch.full((len(clean),), step, device=self.device)
            noise = send(torch.randn(clean.shape, generator=generator), self.device)
            made = network(add_noise(clean, noise, steps, network.signal), steps, held.windows)
            total += masked_mean((made - clean).square(), held.known)
        return total / len(VALIDATION_STEPS) / network.config.signal_scale**2

    def _drawn(self, clip_id: str, generator: torch.Generator) -> list[tuple[Recorded, int]]:
        starts = self.starts[clip_id]
        if not len(starts):
            return []
        rows = torch.randint(len(starts), (self.loss.windows,), generator=generator).tolist()
        return [(self.clips[clip_id], int(starts[row])) for row in rows]

    def _every_window(self) -> Sequence[tuple[Recorded, int]]:
        """All windows, but for neighbours that share seven eighths of their frames."""
        apart = max(self.length // 8, 1)
        return [(clip, int(start)) for own, clip in self.clips.items() for start in self.starts[own][::apart]]


def window_losses(network: Denoiser, target: Targets, loss: LossConfig, generator: torch.Generator) -> Losses:
    """Noise windows to steps drawn evenly, and compare what is made of them with what is clean (Sec. 3.5)."""
    clean, device = normalised(network, target), target.clean.device
    batch, count = len(clean), network.config.diffusion_steps
    number = torch.randint(count, (batch,), generator=generator)
    steps = send((number + 1) * (TRAIN_STEPS // count) - 1, device)
    drop = send(torch.rand(batch, generator=generator) < loss.contact_dropout, device)
    noise = send(torch.randn(clean.shape, generator=generator), device)
    made = network(add_noise(clean, noise, steps, network.signal), steps, target.windows, drop)
    wrong = (made - clean) / network.config.signal_scale
    found = {"simple": masked_mean(wrong.square(), target.known)}
    total = found["simple"]
    if loss.velocity_weight:
        found["velocity"] = masked_mean(wrong.diff(dim=1).square(), target.known[:, 1:] & target.known[:, :-1])
        total = total + loss.velocity_weight * found["velocity"]
    return {"total": total, **found}


def normalised(network: Denoiser, target: Targets) -> Tensor:
    """(B, F, D) clean numbers, zero where there are none."""
    return torch.where(target.known, network.encode(target.clean), 0.0)


def targets_of(network: Denoiser, drawn: Sequence[tuple[Recorded, int]]) -> Targets:
    """What a network is to make of windows of clips, by their first frames; on the CPU."""
    config = network.config
    length = max(min(config.features.window, len(clip.scene) - start) for clip, start in drawn)
    asked = [Asked(clip.scene, start, start + length, clip.active_hands) for clip, start in drawn]
    windows = windows_of(asked, length, config)
    rows = [slice(start, start + length) for _, start in drawn]
    contact = [clip.contact_m[:, own].transpose(1, 0, 2) for (clip, _), own in zip(drawn, rows, strict=True)]
    contact_m = _padded([own.reshape(len(own), -1) for own in contact], length)
    windows = replace(windows, contact_m=contact_m)
    motion = [clip.motion[own] for (clip, _), own in zip(drawn, rows, strict=True)]
    clean = contact_m if isinstance(network, ContactModel) else _padded(motion, length)
    present = _padded([clip.present[:, own].T for (clip, _), own in zip(drawn, rows, strict=True)], length).bool()
    mapped = present.repeat_interleave(config.features.places, 2) & contact_channels(windows)
    known = mapped
    if isinstance(network, MotionModel):
        known = config.features.of_hands(present) & network.channel_mask(windows)
    return Targets(windows, clean, known, mapped)


def _padded(rows: Sequence[np.ndarray], length: int) -> Tensor:
    shaped = [np.concatenate((own, np.zeros((length - len(own), own.shape[1]), own.dtype))) for own in rows]
    return torch.from_numpy(np.stack(shaped).astype(np.float32))


@torch.no_grad()
def learn_statistics(network: Denoiser, every: Sequence[tuple[Recorded, int]], at_once: int = 64) -> None:
    """Mean and spread of all that is normalised, over the windows that are trained on."""
    features = network.config.features
    sums = {
        "input": Moments(features.scene_size),
        "": Moments(len(network.mean)),
        "contact": Moments(features.contact_size),
    }
    for first in range(0, len(every), at_once):
        target = targets_of(network, every[first : first + at_once])
        own = target.windows
        assert own.contact_m is not None
        count = own.offset.shape[1]
        scale = own.scale[:, None, None].expand(-1, count, 1)
        frames = own.frames[..., None]
        there = own.there.repeat_interleave(3, 1)[:, None] & frames
        whole = frames.expand(-1, -1, own.state.shape[-1] + 1)
        sums["input"].add(torch.cat((own.offset, own.state, scale), -1), torch.cat((there, whole), -1))
        sums[""].add(target.clean, target.known)
        sums["contact"].add(own.contact_m, target.mapped)
    groups = {
        "input": _scene_groups(features.places * 3, features.scene_size),
        "": [slice(None)],
        "contact": [slice(None)],
    }
    if isinstance(network, MotionModel):
        groups[""] = [slice(0, 6 * features.keypoints), slice(6 * features.keypoints, None)]
    for name, moments in sums.items():
        mean, spread = moments.found()
        for own in groups[name]:
            kind = spread[own].square().mean().sqrt()
            spread[own] = spread[own].clamp_min(float(network.config.floor * kind) + TINY)
        getattr(network, f"{name}_mean".strip("_")).copy_(mean)
        getattr(network, f"{name}_scale".strip("_")).copy_(spread)


def _scene_groups(offsets: int, size: int) -> list[slice]:
    """O, and every number of G and the scale by itself."""
    return [slice(0, offsets), *(slice(one, one + 1) for one in range(offsets, size))]


class Moments:
    """Means and spreads of columns, gathered a batch at a time; a column never seen has mean 0 and spread 1."""

    def __init__(self, size: int) -> None:
        self.count, self.total, self.squares = (torch.zeros(size, dtype=torch.float64) for _ in range(3))

    def add(self, values: Tensor, known: Tensor) -> None:
        """values, known: (..., size)."""
        values, known = values.double().flatten(0, -2), known.flatten(0, -2)
        values = torch.where(known, values, 0.0)
        self.count += known.sum(0)
        self.total += values.sum(0)
        self.squares += values.square().sum(0)

    def found(self) -> tuple[Tensor, Tensor]:
        mean = self.total / self.count.clamp_min(1)
        spread = (self.squares / self.count.clamp_min(1) - mean.square()).clamp_min(0).sqrt()
        return mean, torch.where(self.count > 0, spread, 1.0)


def _network(name: str, build: type[ContactModel] | type[MotionModel]) -> Network:
    return Network(
        name, DenoiserConfig, build, lambda setup: (Objective(setup, build(setup.network)), None), LossConfig
    )


CONTACT, MOTION = _network("bimart-contact", ContactModel), _network("bimart-motion", MotionModel)
