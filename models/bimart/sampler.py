"""BimArt's answer: contact maps for a motion of an object, and hands for both, all windows of a path at once.

Each motion is drawn from its own seed, whatever else is asked for with it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from hoidata.errors import BadInput
from models.bimart.guidance import Guide, Map, combined, metre_step, released_step
from models.bimart.network import ContactModel, Denoiser, MotionModel, Prepared, Windows
from models.bimart.scene import Anchor, Scene, split_motion
from models.bimart.windows import Asked, Layout, layout_of, windows_of
from models.common.checkpoints import Checkpoint
from models.common.sampling import SamplerConfig, sample

IDLE_M = 0.2  # a hand that is farther than this from the object takes no part


@dataclass(frozen=True)
class SamplingConfig:
    """How both networks are walked. sampler: ``guidance`` is lambda_f of classifier-free guidance; 0: none.

    rule: of that guidance. with_map: motions are told contact maps. guide: contact-map guidance, in the last
    ``guide_share`` of the steps. overlapping: windows of a path share their frames at every step; else they are made
    apart and put side by side. contact_anchor: of G for the contact model, otherwise than it learnt (released:
    "before").
    """

    sampler: SamplerConfig = field(default_factory=lambda: SamplerConfig("ddim", 10, 0.0))
    rule: Literal["usual", "paper"] = "usual"
    with_map: bool = True
    guide: Guide = "metres"
    guide_share: float = 1 / 3
    overlapping: bool = True
    contact_anchor: Anchor | None = None


OURS = SamplingConfig()
PAPER = SamplingConfig(
    SamplerConfig("ddpm", 50, 0.5), rule="paper", guide="released", guide_share=1.0, overlapping=False
)
RELEASED = replace(PAPER, rule="usual", contact_anchor="before")
PRESETS = {"ours": OURS, "paper": PAPER, "released": RELEASED}


@dataclass(frozen=True)
class Path:
    """What hands are made for. hands: (2,) bool, that take part. seed: of everything drawn."""

    scene: Scene
    hands: np.ndarray
    seed: int


@dataclass(frozen=True)
class Made:
    """Canonical frame, metres. contact_m: (frame, 2 x places) wanted distances. keypoints_m, to_object_m: (side, frame,
    keypoint, 3). active: (side, frame) near the object.
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
        seen = [replace(own.config.features, state="none", anchor="first", window=0) for own in (first, second)]
        if seen[0] != seen[1]:
            raise BadInput(
                "bimart-motion", f"features of its contact model, {seen[0]}", f"{seen[1]}", "train both alike"
            )
        return cls(first, second, config, device)

    @torch.no_grad()
    def make(self, paths: Sequence[Path], contact_m: Tensor | None = None) -> list[Made]:
        """Hands for paths of one length. contact_m: (B, frame, 2N) maps in the place of those that would be drawn."""
        generators = [torch.Generator().manual_seed(path.seed) for path in paths]
        drawn = self._maps(paths, generators)  # even where maps are given: a motion's noise comes after a map's
        contact = drawn if contact_m is None else contact_m.to(drawn)
        motion = self.motion.decode(self._walk(self.motion, paths, generators, contact))
        rows = zip(map(self._hands, paths), contact.cpu().numpy(), motion.cpu().numpy(), strict=True)
        return [_made(*own) for own in rows]

    @torch.no_grad()
    def maps(self, paths: Sequence[Path]) -> np.ndarray:
        """(B, frame, 2N) metres: the maps that hands would be made for."""
        return self._maps(paths, [torch.Generator().manual_seed(path.seed) for path in paths]).cpu().numpy()

    def _maps(self, paths: Sequence[Path], generators: list[torch.Generator]) -> Tensor:
        drawn = self.contact.decode(self._walk(self.contact, paths, generators, None))
        most = self.contact.config.features.most_m or None
        return drawn.clamp(0, most) * self._known(paths)

    def _known(self, paths: Sequence[Path]) -> Tensor:
        """(B, frame, 2N) bool: values of maps that are there."""
        frames = len(paths[0].scene)
        own = np.stack(
            [np.concatenate([path.scene.there & bool(hand) for hand in self._hands(path)]) for path in paths]
        )
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
        noise = torch.stack([torch.randn(frames, size, generator=own) for own in generators]).to(self.device)
        if contact_m is None:
            denoise = _plain(network, known, layout)
        else:
            denoise = self._guided(network, known, layout, self._map(paths, contact_m))
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
        self, network: Denoiser, known: Prepared, layout: Layout, wanted: Map
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
            if config.guide != "off" and calls > config.sampler.steps * (1 - config.guide_share):
                clean = self._pulled(clean, wanted)
            return clean if untold is None else combined(clean, untold, config.sampler.guidance, config.rule)

        return denoise

    def _pulled(self, clean: Tensor, wanted: Map) -> Tensor:
        """(B, frame, D) with its positions moved by a step of contact-map guidance; the ways to the object stay."""
        network, half = self.motion, clean.shape[-1] // 2
        scale = (network.scale[:half] / network.config.signal_scale).reshape(2, -1, 3)
        keypoints = network.decode(clean)[..., :half].unflatten(-1, (2, -1, 3))
        if self.config.guide == "released":
            step = released_step(keypoints, wanted, scale, network.config.features.window)
        else:
            step = metre_step(keypoints, wanted) / scale
        return torch.cat((clean[..., :half] + step.flatten(2), clean[..., half:]), -1)


def _plain(network: Denoiser, known: Prepared, layout: Layout) -> Callable[[Tensor, Tensor], Tensor]:
    def denoise(x: Tensor, steps: Tensor) -> Tensor:
        own = steps.repeat_interleave(len(layout.starts))
        return layout.joined(network.denoise(layout.cut(x), own, known, known.conditional))

    return denoise


def _made(hands: np.ndarray, contact_m: np.ndarray, motion: np.ndarray) -> Made:
    own: Mapping[str, np.ndarray] = split_motion(motion)
    near = np.linalg.norm(own["to_object_m"], axis=-1).min(axis=-1) < IDLE_M
    return Made(contact_m, own["keypoints_m"], own["to_object_m"], near & hands[:, None])
