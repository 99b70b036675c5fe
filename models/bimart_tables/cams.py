"""CAMS-B: where fingers touch in each stage of an interaction, drawn by a conditional VAE, and hands fitted to that.

After CAMS (Zheng et al. 2023) for two hands and any object, as BimArt compares itself with it; the adaptation is ours.
As there, the initial hands and the ends of the stages are told, here from the recorded clip. A stage is an interval in
which each hand touches the same part, or none. Left out of CAMS: contact normals, curves of fingers within a stage, and
its own optimiser, in whose place stands our fit of hands to keypoints.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor, nn
from torch.nn import functional

from hoidata.batches.dataset import ClipBatch, ClipSample, load_sample
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import TIP_VERTICES, HandPair
from hoidata.refinement import GeneratedHand, fit_hands
from hoidata.sensors.keypoints import hand_keypoints
from hoidata.sensors.part_bps import BasisSettings
from hoidata.store.annotated import AnnotatedStore
from models.bimart.family import clip_without_hands, world_from_canonical
from models.bimart.scene import Scene, hand_vertices_m
from models.common.checkpoints import load_checkpoint
from models.common.family import Family, LeftOut, Losses, Network, Setup, Sources, refuse_not_finite

FINGERS, JOINTS = 5, 21
TOUCH_M = 0.02  # from the middle of a finger tip to a vertex of the part
LEAST_FRAMES = 5  # a shorter stage belongs to the one before it
BLEND_FRAMES = 3.0  # stages go over into each other with a Gaussian of this spread
UNIT_M = 0.05
TARGET = 2 * FINGERS * 4  # flag and place of every finger


@dataclass(frozen=True)
class CamsConfig:
    """basis: how the object is seen. hidden: widths of both halves; latent: of what is drawn."""

    basis: BasisSettings = field(default_factory=lambda: BasisSettings(128, nearest="surface", frame="base"))
    hidden: tuple[int, ...] = (512, 512)
    latent: int = 64


@dataclass(frozen=True)
class CamsLoss:
    """Weights of the flags of touching and of the latent's divergence, beside the square of places in 5 cm."""

    flag: float = 0.1
    divergence: float = 0.005


@dataclass(frozen=True)
class Stage:
    """Frames start to stop, in which the left and the right hand touch ``part`` (-1: none)."""

    start: int
    stop: int
    part: tuple[int, int]


def stages_of(joints_m: np.ndarray, scene: Scene) -> list[Stage]:
    """joints_m: (2, frame, 21, 3) canonical. Every frame is in one stage."""
    touched = []
    for hand in joints_m[:, :, -FINGERS:]:
        apart = [own.tree.query(_in_part(scene, part, hand))[0].min(axis=1) for part, own in scene.bps.vertices.items()]
        touched.append(np.where(np.min(apart, axis=0) < TOUCH_M, np.argmin(apart, axis=0), -1))
    both = np.stack(touched, axis=1)
    edges = np.flatnonzero((both[1:] != both[:-1]).any(axis=1)) + 1
    starts = [0]
    for start, stop in pairwise([*edges.tolist(), len(both)]):
        is_new = (both[start] != both[starts[-1]]).any()  # not after a short one that was left out
        starts += [start] if stop - start >= LEAST_FRAMES and is_new else []
    pieces = pairwise([*starts, len(both)])
    return [Stage(start, stop, (int(both[start, 0]), int(both[start, 1]))) for start, stop in pieces]


def _in_part(scene: Scene, part: int, places_m: np.ndarray) -> np.ndarray:
    """(frame, n, 3) canonical places in the rest frame of a part."""
    return scene.bps.model.object_from_part(part, scene.hinge_rad).inverse() @ places_m.astype(np.float64)


def conditions(scene: Scene, stages: Sequence[Stage], joints_m: np.ndarray, hands: np.ndarray) -> np.ndarray:
    """(stage, number) float32: how the object stands at both ends, what is touched, and the initial hands."""
    first = (joints_m[:, 0] * hands[:, None, None]).ravel()
    rows = []
    for stage in stages:
        ends = scene.offset[[stage.start, stage.stop - 1]].ravel()
        touched = np.eye(3)[np.array(stage.part) + 1].ravel()
        when = [scene.scale / 10, stage.start / len(scene), stage.stop / len(scene), *hands]
        rows.append(np.concatenate((ends, touched, first / UNIT_M, when)))
    return np.stack(rows).astype(np.float32)


def targets(scene: Scene, stages: Sequence[Stage], joints_m: np.ndarray, hands: np.ndarray) -> np.ndarray:
    """(stage, 2, 5, 4) float32: whether a finger touches, and where its tip is on the part at rest, in 5 cm."""
    found = np.zeros((len(stages), 2, FINGERS, 4), np.float32)
    for row, stage in enumerate(stages):
        for side in np.flatnonzero(hands & (np.array(stage.part) >= 0)):
            part = stage.part[side]
            place = _in_part(scene, part, joints_m[side, :, -FINGERS:])[stage.start : stage.stop]
            apart = scene.bps.vertices[part].tree.query(place)[0]
            found[row, side, :, 0] = (apart < TOUCH_M).mean(axis=0) > 0.5
            found[row, side, :, 1:] = place.mean(axis=0) / UNIT_M
    return found


class CamsNetwork(nn.Module):
    """A conditional VAE: ``network.decode(conditions, latent)`` gives flags (as logits) and places."""

    def __init__(self, config: CamsConfig) -> None:
        super().__init__()
        self.config = config
        told = 2 * 3 * config.basis.places + 6 + 2 * JOINTS * 3 + 5
        self.encoder = _layers(told + TARGET, config.hidden, 2 * config.latent)
        self.decoder = _layers(told + config.latent, config.hidden, TARGET)

    def decode(self, told: Tensor, latent: Tensor) -> Tensor:
        return self.decoder(torch.cat((told, latent), -1)).unflatten(-1, (2, FINGERS, 4))

    def losses(self, told: Tensor, target: Tensor, weights: CamsLoss, noise: Tensor) -> Losses:
        mean, log_variance = self.encoder(torch.cat((told, target.flatten(1)), -1)).chunk(2, -1)
        made = self.decode(told, mean + noise * (log_variance / 2).exp())
        touches = target[..., :1]
        wrong = ((made[..., 1:] - target[..., 1:]).square() * touches).sum() / touches.sum().clamp_min(1)
        here = touches.any(dim=2).expand_as(target[..., 0]).float()  # a hand of which a stage says that it touches
        flag = functional.binary_cross_entropy_with_logits(made[..., 0], target[..., 0], here, reduction="sum")
        flag = flag / here.sum().clamp_min(1)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()
        total = wrong + weights.flag * flag + weights.divergence * divergence
        return {"total": total, "places": wrong, "flags": flag, "divergence": divergence}


class CamsObjective:
    """All stages of a batch's clips."""

    frames = entries = 0

    def __init__(self, setup: Setup) -> None:
        self.network, self.loss, self.device = CamsNetwork(setup.network).to(setup.device), setup.loss, setup.device
        self.basis, train = setup.network.basis, setup.corpus.train
        self.rows = {own: self._rows(train.whole(own)) for own in train.ids}
        held = [self._rows(sample) for sample in setup.corpus.held_out]
        self.held_out = _together(held, self.device) if held else None

    def _rows(self, sample: ClipSample) -> tuple[np.ndarray, np.ndarray]:
        scene = Scene.of(sample.object_model, sample.object, self.basis)
        joints_m = scene.model_from_canonical.inverse() @ sample.joints_m.astype(np.float64)
        known = scene, stages_of(joints_m, scene), joints_m, sample.active_hands
        return conditions(*known), targets(*known)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        told, target = _together([self.rows[sample.clip_id] for sample in batch.samples], self.device)
        noise = torch.randn(len(told), self.network.config.latent, generator=generator).to(self.device)
        return self.network.losses(told, target, self.loss, noise)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, CamsNetwork)
        assert self.held_out is not None
        noise = torch.randn(len(self.held_out[0]), network.config.latent, generator=torch.Generator().manual_seed(0))
        return network.losses(*self.held_out, self.loss, noise.to(self.device))["total"]


def _together(rows: Sequence[tuple[np.ndarray, np.ndarray]], device: torch.device) -> tuple[Tensor, Tensor]:
    told, target = (torch.from_numpy(np.concatenate(own)).to(device) for own in zip(*rows, strict=True))
    return told, target


@dataclass(frozen=True)
class CamsHands:
    """The trained network of a dataset with its hands, and the clips that tell initial hands and stages."""

    network: CamsNetwork
    pair: HandPair
    annotated: AnnotatedStore
    synthetic: bool

    @classmethod
    def load(cls, sources: Sources) -> "CamsHands":
        trained = load_checkpoint(sources.checkpoints / CAMS.name, CAMS, sources.device)
        assert isinstance(trained.network, CamsNetwork)
        return cls(trained.network, sources.hands, sources.annotated, bool(trained.facts["synthetic"]))

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Clip | LeftOut:
        if request.trajectories is None or not request.clip_id:
            return LeftOut(request.motion_id, "it is told initial hands and stages by a recorded clip")
        recorded = load_sample(self.annotated, request.clip_id)
        thing = request.trajectories.object[: request.n_frames]
        scene = Scene.of(request.object, thing, self.network.config.basis)
        canonical_from_model = scene.model_from_canonical.inverse()
        joints_m = canonical_from_model @ recorded.joints_m[:, : len(thing)].astype(np.float64)
        stages = stages_of(joints_m, scene)
        drawn = self._drawn(conditions(scene, stages, joints_m, request.active_hands), request.seed)
        ids = np.union1d(hand_keypoints(self.pair.right, 64), TIP_VERTICES)
        hands = np.zeros((2, len(thing), len(ids), 3))
        for side in np.flatnonzero(request.active_hands).tolist():
            skin = canonical_from_model[0] @ hand_vertices_m(self.pair, side, recorded)[0].astype(np.float64)
            hands[side] = carried(skin[ids], np.searchsorted(ids, TIP_VERTICES), drawn[:, side], stages, scene, side)
        refuse_not_finite(request, hands)
        world, there = world_from_canonical(request, scene), np.ones(len(thing), bool)
        generated: dict[Side, GeneratedHand] = {
            side: GeneratedHand(world @ hands[row], np.zeros_like(hands[row]), there)
            for row, side in enumerate(SIDES)
            if request.active_hands[row]
        }
        clip = clip_without_hands(request, self.synthetic)
        tracks = fit_hands(self.pair, request.betas, ids, generated, request.template_m)
        return replace(clip, hands={**clip.hands, **tracks})

    @torch.no_grad()
    def _drawn(self, told: np.ndarray, seed: int) -> np.ndarray:
        """(stage, 2, 5, 4) what the fingers do."""
        latent = torch.randn(1, self.network.config.latent, generator=torch.Generator().manual_seed(seed))
        device = next(self.network.parameters()).device
        latent = latent.expand(len(told), -1).to(device)
        return self.network.decode(torch.from_numpy(told).to(device), latent).cpu().numpy()


def carried(
    first_m: np.ndarray, tips: np.ndarray, drawn: np.ndarray, stages: Sequence[Stage], scene: Scene, side: int
) -> np.ndarray:
    """(frame, point, 3) canonical keypoints of a hand: the initial ones, moved as a whole to where its fingers touch
    and on with the part, the touching tips put there.

    first_m: (point, 3); tips: the rows of the five tips; drawn: (stage, 5, 4) as ``targets`` has them, flags as logits.
    """
    made, own, part = np.empty((len(scene), *first_m.shape)), first_m, 0
    for stage, fingers in zip(stages, drawn, strict=True):
        touching = fingers[:, 0] > 0
        if stage.part[side] >= 0 and touching.any():
            part, wanted = stage.part[side], fingers[touching, 1:].astype(np.float64) * UNIT_M
            own = _rigid_to(first_m[tips[touching]], wanted) @ first_m
            own[tips[touching]] = wanted
        pose = scene.bps.model.object_from_part(part, scene.hinge_rad)
        rows = slice(stage.start, stage.stop)
        made[rows] = (pose @ np.broadcast_to(own, made.shape))[rows]
    return gaussian_filter1d(made, BLEND_FRAMES, axis=0, mode="nearest")


def _rigid_to(points_m: np.ndarray, wanted_m: np.ndarray) -> RigidTransform:
    """The rigid transform that brings points nearest to where they are wanted; of fewer than three, a shift."""
    middle, goal = points_m.mean(axis=0), wanted_m.mean(axis=0)
    if len(points_m) < 3:
        return RigidTransform(np.eye(3), goal - middle)
    left, _, right = np.linalg.svd((points_m - middle).T @ (wanted_m - goal))
    turn = right.T @ np.diag([1, 1, np.sign(np.linalg.det(right.T @ left.T))]) @ left.T
    return RigidTransform(turn, goal - turn @ middle)


def _layers(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    sizes = (inputs, *hidden)
    layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ELU())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


CAMS = Network("cams-b", CamsConfig, CamsNetwork, lambda setup: (CamsObjective(setup), None), CamsLoss)
CAMS_B = Family("cams-b", "CAMS-B", CamsHands.load, networks=(CAMS,), uses=(CAMS.name,))
