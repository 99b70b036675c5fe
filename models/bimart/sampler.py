"""BimArt's answer: contact maps for a motion of an object, and hands for both, all windows of a path at once.

Each motion is drawn from its own seed, whatever else is asked for with it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from hoidata.devices import send
from hoidata.errors import BadInput
from hoidata.objects.model import articulate
from hoidata.sensors.part_bps import distance_map
from hoidata.settings import build_config
from models.bimart.guidance import Guide, Map, combined, metre_step, released_step
from models.bimart.network import ContactModel, Denoiser, DenoiserConfig, MotionModel, Prepared, Windows
from models.bimart.scene import Anchor, FeatureConfig, Scene, split_motion
from models.bimart.windows import Asked, Layout, layout_of, windows_of
from models.common.checkpoints import Checkpoint
from models.common.sampling import SamplerConfig, sample

IDLE_M = 0.2  # a hand that is farther than this from the object takes no part


@dataclass(frozen=True)
class WalkConfig(SamplerConfig):
    """The same with this family's defaults. guidance: lambda_f of classifier-free guidance; 0 is none."""

    steps: int = 10
    guidance: float = 0.0


@dataclass(frozen=True)
class SamplingConfig:
    """How both networks are walked. sampler: the steps, and classifier-free guidance.

    rule: of that guidance. with_map: motions are told contact maps. guide: contact-map guidance, in the last
    ``guide_share`` of the steps. overlapping: windows of a path share their frames at every step; else they are made
    apart and put side by side. contact_anchor: of G for the contact model, otherwise than it learnt (released:
    "before"). hold_m: joints of the first network that come so near to the object stay there, on its part (OMOMO).
    """

    sampler: WalkConfig = field(default_factory=WalkConfig)
    rule: Literal["usual", "paper"] = "usual"
    with_map: bool = True
    guide: Guide = "metres"
    guide_share: float = 1 / 3
    overlapping: bool = True
    contact_anchor: Anchor | None = None
    hold_m: float = 0.0


OURS = SamplingConfig()
PAPER = SamplingConfig(WalkConfig("ddpm", 50, 0.5), rule="paper", guide="released", guide_share=1.0, overlapping=False)
RELEASED = replace(PAPER, rule="usual", contact_anchor="before")
PRESETS = {"ours": OURS, "paper": PAPER, "released": RELEASED}


def sampling_of(preset: str, told: Mapping[str, Any], where: str) -> SamplingConfig:
    """The sampling of a preset with what is told laid over it. Raises BadInput as ``build_config`` does."""
    config = build_config(SamplingConfig, told, where)
    walk = told.get("sampler", {})
    sampler = replace(PRESETS[preset].sampler, **{name: getattr(config.sampler, name) for name in walk})
    own = {name: getattr(config, name) for name in told if name != "sampler"}
    return replace(PRESETS[preset], sampler=sampler, **own)


def preset_of(config: DenoiserConfig) -> str:
    """The preset that a network's settings are of: what sets the three apart."""
    return "ours" if config.told else "paper" if config.untold == "frame" else "released"


@dataclass(frozen=True)
class Path:
    """What hands are made for. hands: (2,) bool, that take part. seed: of everything drawn."""

    scene: Scene
    hands: np.ndarray
    seed: int


@dataclass(frozen=True)
class Made:
    """Canonical frame, metres. contact_m: (frame, 2 x places) wanted distances, or joints. keypoints_m: (side, frame,
    point, 3), or joints; rest: (side, frame, number) ways from them to the object, or rotations. active: (side, frame)
    near the object.
    """

    contact_m: np.ndarray
    keypoints_m: np.ndarray
    rest: np.ndarray
    active: np.ndarray

    @property
    def to_object_m(self) -> np.ndarray:
        """(side, frame, keypoint, 3) ways from keypoints to the object."""
        return self.rest.reshape(self.keypoints_m.shape)


@dataclass(frozen=True)
class BimArt:
    """Both trained networks, ready to answer. contact: None where motions are told no map."""

    contact: ContactModel | None
    motion: MotionModel
    config: SamplingConfig
    device: torch.device

    @classmethod
    def of(
        cls, contact: Checkpoint | None, motion: Checkpoint, config: SamplingConfig, device: torch.device
    ) -> "BimArt":
        """Raises BadInput where the two networks do not see alike."""
        first, second = None if contact is None else contact.network, motion.network
        assert isinstance(first, ContactModel | None)
        assert isinstance(second, MotionModel)
        own, wanted = (_seen(one.config.features) for one in (second, first or second))
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
        features = self.motion.config.features
        if self.contact is None:
            return torch.zeros(len(paths), len(paths[0].scene), features.contact_size, device=self.device)
        drawn = self.contact.decode(self._walk(self.contact, paths, generators, None))
        if features.between == "map":
            return drawn.clamp(0, features.most_m or None) * self._known(paths)
        rows = zip(paths, drawn.cpu().numpy(), strict=True)
        held = [held_joints(joints, path.scene, self.config.hold_m) for path, joints in rows]
        return torch.from_numpy(np.stack(held)).to(drawn) * self._known(paths)

    def _known(self, paths: Sequence[Path]) -> Tensor:
        """(B, frame, contact_size) bool: values of maps that are there, or joints of hands that take part."""
        frames, features = len(paths[0].scene), self.motion.config.features
        nothing = np.ones(features.told_size, bool)
        there = [path.scene.there if features.between == "map" else nothing for path in paths]
        rows = zip(paths, there, strict=True)
        own = np.stack([np.concatenate([here & bool(hand) for hand in self._hands(path)]) for path, here in rows])
        return torch.from_numpy(own).to(self.device)[:, None].expand(-1, frames, -1)

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
        anchor = self.config.contact_anchor if contact_m is None else None
        windows = windows_of(asked, layout.length, network.config, anchor).to(self.device)
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
            if not config.with_map:
                return layout.joined(network.denoise(cut, own, known, known.unconditional))
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
        network, half = self.motion, 6 * self.motion.config.features.points
        scale = (network.scale[:half] / network.config.signal_scale).reshape(2, -1, 3)
        keypoints = network.decode(clean)[..., :half].unflatten(-1, (2, -1, 3))
        if self.config.guide == "released":
            step = released_step(keypoints, wanted, scale, network.config.features.window)
        else:
            step = metre_step(keypoints, wanted) / scale
        return torch.cat((clean[..., :half] + step.flatten(2), clean[..., half:]), -1)

    def _made(self, path: Path, contact_m: np.ndarray, motion: np.ndarray) -> Made:
        features = self.motion.config.features
        keypoints, rest = split_motion(motion, features)
        if features.hands == "keypoints":
            near = np.linalg.norm(rest.reshape(keypoints.shape), axis=-1).min(axis=-1) < IDLE_M
        else:
            near = np.stack([distance_map(path.scene.place_m, own).min(axis=1) < IDLE_M for own in keypoints])
        return Made(contact_m, keypoints, rest, near & self._hands(path)[:, None])


def _seen(features: FeatureConfig) -> FeatureConfig:
    """What both networks of a pair must agree in."""
    return replace(features, state="none", anchor="first", window=0, hands="keypoints")


def held_joints(joints_m: np.ndarray, scene: Scene, within_m: float) -> np.ndarray:
    """(frame, 2 x 21 x 3) joints that, once within so many metres of the object, stay at that place of its part.

    OMOMO's contact constraint (Li et al. 2023, Sec. 3.3): frozen where a joint first comes near a vertex, to the end.
    """
    if not within_m:
        return joints_m
    model, joints = scene.bps.model, joints_m.reshape(len(joints_m), -1, 3).astype(np.float64)
    rest, apart = [], []
    for part, own in scene.bps.vertices.items():
        rest.append(np.broadcast_to(model.object_from_part(part, scene.hinge_rad).inverse() @ joints, joints.shape))
        apart.append(own.tree.query(rest[-1])[0])
    near = np.min(apart, axis=0) < within_m
    first, every = near.argmax(axis=0), np.arange(joints.shape[1])
    part = np.array([own[first, every] for own in apart]).argmin(axis=0)
    held = articulate(np.stack(rest)[part, first, every], part, model.hinge, scene.hinge_rad)
    stays = near.any(axis=0) & (np.arange(len(joints))[:, None] >= first)
    return np.where(stays[..., None], held, joints).reshape(joints_m.shape).astype(joints_m.dtype)


def _plain(network: Denoiser, known: Prepared, layout: Layout) -> Callable[[Tensor, Tensor], Tensor]:
    def denoise(x: Tensor, steps: Tensor) -> Tensor:
        own = steps.repeat_interleave(len(layout.starts))
        return layout.joined(network.denoise(layout.cut(x), own, known, known.conditional))

    return denoise
