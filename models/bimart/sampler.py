"""BimArt's answer: contact maps for a motion of an object, and hands for both, all windows of a path at once.

Each motion is drawn from its own seed, whatever else is asked for with it. A motion may be pulled to its contact map
while it is made (Sec. 3.3, eq. 5-7).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from hoidata.devices import send
from hoidata.errors import BadInput
from hoidata.settings import build_config
from models.bimart.network import (
    Asked,
    ContactModel,
    Denoiser,
    DenoiserConfig,
    Layout,
    MotionModel,
    Prepared,
    Windows,
    layout_of,
    windows_of,
)
from models.bimart.scene import FeatureConfig, Scene, split_motion
from models.common.checkpoints import Checkpoint
from models.common.sampling import SamplerConfig, sample

AT_ONCE = 1 << 22  # pairs of a place and a keypoint looked at together
GUIDED_WITHIN_M = 0.02  # places the map says are farther than this from the hand matter less and less


@dataclass(frozen=True)
class Map:
    """What a motion is held to. places_m (B, F, N, 3) of the object; contact_m (B, F, 2N): how far each hand is to be.

    known (B, F, 2N): values that count.
    """

    places_m: Tensor
    contact_m: Tensor
    known: Tensor


Guide = Literal["off", "paper", "metres"]


@dataclass(frozen=True)
class Discrepancy:
    """error_m (B, F, 2, N): made map minus wanted. nearest (B, F, 2, N): the keypoint; away (B, F, 2, N, 3): to it."""

    error_m: Tensor
    nearest: Tensor
    away: Tensor


def discrepancy(keypoints_m: Tensor, wanted: Map) -> Discrepancy:
    """Eq. 5: the map that keypoints (B, F, 2, J, 3) make, beside the wanted one."""
    batch, frames, _, count, _ = keypoints_m.shape
    places = wanted.places_m[:, :, None].expand(-1, -1, 2, -1, -1).flatten(0, 2)
    keypoints = keypoints_m.flatten(0, 2)
    step = max(1, AT_ONCE // (places.shape[1] * count))
    nearest = torch.cat(
        [torch.cdist(a, b).argmin(-1) for a, b in zip(places.split(step), keypoints.split(step), strict=True)]
    )
    way = keypoints.gather(1, nearest[..., None].expand(-1, -1, 3)) - places
    distance = way.norm(dim=-1)
    away = way / distance[..., None].clamp_min(1e-9)
    shape = batch, frames, 2, places.shape[1]
    error = distance.reshape(shape) - wanted.contact_m.unflatten(-1, (2, -1))
    return Discrepancy(error * wanted.known.unflatten(-1, (2, -1)), nearest.reshape(shape), away.reshape(*shape, 3))


def paper_step(keypoints_m: Tensor, wanted: Map, scale: Tensor, window: int) -> Tensor:
    """(B, F, 2, J, 3) the step of eq. 6 in normalised numbers: the gradient of the mean square, made of length 1.

    scale: (2, J, 3) metres of a normalised number. A path longer than a window takes the step every window would.
    """
    found = discrepancy(keypoints_m, wanted)
    count = wanted.known.unflatten(-1, (2, -1)).sum((1, 3), keepdim=True).clamp_min(1)
    gradient = (
        _on_keypoints(2 * found.error_m[..., None] * found.away / count[..., None], found.nearest, keypoints_m) * scale
    )
    length = gradient.flatten(1).norm(dim=1).clamp_min(1e-12)
    windows = max(keypoints_m.shape[1] / window, 1.0) ** 0.5
    return -gradient * (windows / length)[:, None, None, None, None]


def metre_step(keypoints_m: Tensor, wanted: Map) -> Tensor:
    """(B, F, 2, J, 3) metres: each keypoint goes the mean way that the places it is nearest to ask of it.

    A step of Gauss-Newton with the diagonal alone; places the map says are far from the hand count little.
    """
    found = discrepancy(keypoints_m, wanted)
    near = torch.exp(-wanted.contact_m / GUIDED_WITHIN_M).unflatten(-1, (2, -1)) * wanted.known.unflatten(-1, (2, -1))
    ask = _on_keypoints(near[..., None] * found.error_m[..., None] * found.away, found.nearest, keypoints_m)
    total = _on_keypoints(near[..., None].expand_as(found.away), found.nearest, keypoints_m)
    return -ask / (total + 0.5)


def _on_keypoints(values: Tensor, nearest: Tensor, like: Tensor) -> Tensor:
    """Sums over places (B, F, 2, N, 3) at the keypoints they are nearest to (B, F, 2, J, 3)."""
    return torch.zeros_like(like).scatter_add_(3, nearest[..., None].expand_as(values), values)


def combined(told: Tensor, untold: Tensor, weight: float, rule: Literal["usual", "paper"]) -> Tensor:
    """Classifier-free guidance: (1 + w) c - w u, or eq. 7 as printed, (1 + w) c - u."""
    return (1 + weight) * told - (weight if rule == "usual" else 1.0) * untold


IDLE_M = 0.2  # a hand that is farther than this from the object takes no part


@dataclass(frozen=True)
class WalkConfig(SamplerConfig):
    """The same with this family's defaults. guidance: lambda_f of classifier-free guidance; 0 is none."""

    steps: int = 10
    guidance: float = 0.0


@dataclass(frozen=True)
class SamplingConfig:
    """How both networks are walked. sampler: the steps, and classifier-free guidance.

    rule: of that guidance. guide: contact-map guidance, in the last
    ``guide_share`` of the steps. overlapping: windows of a path share their frames at every step; else they are made
    apart and put side by side.
    """

    sampler: WalkConfig = field(default_factory=WalkConfig)
    rule: Literal["usual", "paper"] = "usual"
    guide: Guide = "metres"
    guide_share: float = 1 / 3
    overlapping: bool = True


OURS = SamplingConfig()
PAPER = SamplingConfig(WalkConfig("ddpm", 50, 0.5), rule="paper", guide="paper", guide_share=1.0, overlapping=False)
PRESETS = {"ours": OURS, "paper": PAPER}


def sampling_of(preset: str, told: Mapping[str, Any], where: str) -> SamplingConfig:
    """The sampling of a preset with what is told laid over it. Raises BadInput as ``build_config`` does."""
    config = build_config(SamplingConfig, told, where)
    walk = told.get("sampler", {})
    sampler = replace(PRESETS[preset].sampler, **{name: getattr(config.sampler, name) for name in walk})
    own = {name: getattr(config, name) for name in told if name != "sampler"}
    return replace(PRESETS[preset], sampler=sampler, **own)


def preset_of(config: DenoiserConfig) -> str:
    """The preset that a network's settings are of."""
    return "ours" if config.told else "paper"


@dataclass(frozen=True)
class Path:
    """What hands are made for. hands: (2,) bool, that take part. seed: of everything drawn."""

    scene: Scene
    hands: np.ndarray
    seed: int


@dataclass(frozen=True)
class Made:
    """Canonical frame, metres. contact_m: (frame, 2 x places) wanted distances. keypoints_m and to_object_m, vectors
    from them to the object: (side, frame, keypoint, 3). active: (side, frame) near the object.
    """

    contact_m: np.ndarray
    keypoints_m: np.ndarray
    to_object_m: np.ndarray
    active: np.ndarray


@dataclass(frozen=True)
class BimArt:
    """Both trained networks, ready to answer."""

    contact: ContactModel
    motion: MotionModel
    config: SamplingConfig
    device: torch.device

    @classmethod
    def of(cls, contact: Checkpoint, motion: Checkpoint, config: SamplingConfig, device: torch.device) -> "BimArt":
        """Raises BadInput where the two networks do not see alike."""
        first, second = contact.network, motion.network
        assert isinstance(first, ContactModel)
        assert isinstance(second, MotionModel)
        own, wanted = (_seen(one.config.features) for one in (second, first))
        if own != wanted:
            raise BadInput("bimart-motion", f"features of its contact model, {wanted}", f"{own}", "train both alike")
        return cls(first, second, config, device)

    @torch.no_grad()
    def make(self, paths: Sequence[Path], contact_m: Tensor | None = None) -> list[Made]:
        """Hands for paths of one length. contact_m: (B, frame, 2N) maps in the place of those that would be drawn."""
        generators = [torch.Generator().manual_seed(path.seed) for path in paths]
        drawn = self._maps(paths, generators)  # even where maps are given: a motion's noise comes after a map's
        contact = drawn if contact_m is None else contact_m.to(drawn)
        motion = self.motion.decode(self._walk(self.motion, paths, generators, contact))
        rows = zip(paths, contact.cpu().numpy(), motion.cpu().numpy(), strict=True)
        return [self._made(*own) for own in rows]

    @torch.no_grad()
    def maps(self, paths: Sequence[Path]) -> np.ndarray:
        """(B, frame, 2N) metres: the maps that hands would be made for."""
        return self._maps(paths, [torch.Generator().manual_seed(path.seed) for path in paths]).cpu().numpy()

    def _maps(self, paths: Sequence[Path], generators: list[torch.Generator]) -> Tensor:
        drawn = self.contact.decode(self._walk(self.contact, paths, generators, None))
        return drawn.clamp(0, self.motion.config.features.most_m or None) * self._known(paths)

    def _known(self, paths: Sequence[Path]) -> Tensor:
        """(B, frame, 2N) bool: values of maps that are there, of hands that take part."""
        own = np.stack([(self._hands(path)[:, None] & path.scene.there).ravel() for path in paths])
        return torch.from_numpy(own).to(self.device)[:, None].expand(-1, len(paths[0].scene), -1)

    def _hands(self, path: Path) -> np.ndarray:
        return path.hands if self.motion.config.told else np.ones(2, bool)

    def _walk(
        self,
        network: Denoiser,
        paths: Sequence[Path],
        generators: list[torch.Generator],
        contact_m: Tensor | None,
    ) -> Tensor:
        """(B, frame, D) normalised numbers of a network, from noise."""
        frames, size = len(paths[0].scene), len(network.mean)
        layout = layout_of(frames, network.config.features.window, self.config.overlapping)
        known = network.prepare(self._windows(network, paths, layout, contact_m))
        noise = send(torch.stack([torch.randn(frames, size, generator=own) for own in generators]), self.device)
        if contact_m is None:
            denoise = _plain(network, known, layout)
        else:
            wanted = None if self.config.guide == "off" else self._map(paths, contact_m)
            denoise = self._guided(network, known, layout, wanted)
        return sample(denoise, noise, self.config.sampler, generators)

    def _windows(self, network: Denoiser, paths: Sequence[Path], layout: Layout, contact_m: Tensor | None) -> Windows:
        asked = [
            Asked(path.scene, start, start + layout.length, path.hands) for path in paths for start in layout.starts
        ]
        windows = windows_of(asked, layout.length, network.config).to(self.device)
        return windows if contact_m is None else replace(windows, contact_m=layout.cut(contact_m))

    def _map(self, paths: Sequence[Path], contact_m: Tensor) -> Map:
        places = torch.from_numpy(np.stack([path.scene.place_m for path in paths])).to(self.device)
        known, most = self._known(paths), self.motion.config.features.most_m
        return Map(places, contact_m, known & (contact_m < 0.99 * most) if most else known)

    def _guided(
        self, network: Denoiser, known: Prepared, layout: Layout, wanted: Map | None
    ) -> Callable[[Tensor, Tensor], Tensor]:
        """The motion model told of its map, pulled to it, and away from what it does untold."""
        config, calls, both = self.config, 0, known.twice()

        def denoise(x: Tensor, steps: Tensor) -> Tensor:
            nonlocal calls
            calls += 1
            cut, own = layout.cut(x), steps.repeat_interleave(len(layout.starts))
            if config.sampler.guidance == 0:
                clean, untold = layout.joined(network.denoise(cut, own, known, known.conditional)), None
            else:
                found = network.denoise(torch.cat((cut, cut)), torch.cat((own, own)), both, both.conditional)
                clean, untold = (layout.joined(part) for part in found.chunk(2))
            if wanted is not None and calls > config.sampler.steps * (1 - config.guide_share):
                clean = self._pulled(clean, wanted)
            return clean if untold is None else combined(clean, untold, config.sampler.guidance, config.rule)

        return denoise

    def _pulled(self, clean: Tensor, wanted: Map) -> Tensor:
        """(B, frame, D) with its positions moved by a step of contact-map guidance; the ways to the object stay."""
        network, half = self.motion, 6 * self.motion.config.features.keypoints
        scale = (network.scale[:half] / network.config.signal_scale).reshape(2, -1, 3)
        keypoints = network.decode(clean)[..., :half].unflatten(-1, (2, -1, 3))
        if self.config.guide == "paper":
            step = paper_step(keypoints, wanted, scale, network.config.features.window)
        else:
            step = metre_step(keypoints, wanted) / scale
        return torch.cat((clean[..., :half] + step.flatten(2), clean[..., half:]), -1)

    def _made(self, path: Path, contact_m: np.ndarray, motion: np.ndarray) -> Made:
        keypoints, to_object = split_motion(motion)
        near = np.linalg.norm(to_object, axis=-1).min(axis=-1) < IDLE_M
        return Made(contact_m, keypoints, to_object, near & self._hands(path)[:, None])


def _seen(features: FeatureConfig) -> FeatureConfig:
    """What both networks of a pair must agree in."""
    return replace(features, state="local", window=0)


def _plain(network: Denoiser, known: Prepared, layout: Layout) -> Callable[[Tensor, Tensor], Tensor]:
    def denoise(x: Tensor, steps: Tensor) -> Tensor:
        own = steps.repeat_interleave(len(layout.starts))
        return layout.joined(network.denoise(layout.cut(x), own, known, known.conditional))

    return denoise
