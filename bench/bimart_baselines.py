"""BimArt's baselines, adapted by us: MDM-B and OMOMO-B (diffusion of hand poses) and CAMS-B (a conditional VAE).

All three are given the object's motion (O, local G and scale) in the object's canonical frame.

- MDM-B (Tevet et al. 2023): one Transformer makes the poses of both hands.
- OMOMO-B (Li et al. 2023): a first Transformer makes joints; a joint that comes within 3 cm of the object stays at that
  place of its part; a second Transformer makes poses for these joints. Both have an L1 loss.
- CAMS-B (Zheng et al. 2023): is also given the recorded initial hands and the ends of the stages of an interaction. A
  VAE makes where fingers touch in each stage, and hands are fitted to that. Without contact normals, finger curves
  within a stage and CAMS's own optimiser.
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
from hoidata.refinement import GeneratedHand, fit_hands
from hoidata.sensors.keypoints import hand_keypoints
from hoidata.sensors.part_bps import BasisSettings
from models.bimart.family import clip_without_hands, world_from_canonical
from models.bimart.learning import Moments
from models.bimart.lookups import canonical_hands, moved_hands, told
from models.bimart.network import layout_of
from models.bimart.scene import Scene, hand_vertices_m
from models.common.checkpoints import load_checkpoint
from models.common.family import Family, LeftOut, Losses, Network, Setup, Sources, motion_clip, refuse_not_finite
from models.common.features import proper_hands
from models.common.losses import masked_mean
from models.common.sampling import TRAIN_STEPS, SamplerConfig, add_noise, alphas_cumprod, sample
from models.common.transformer import Encoder, TransformerConfig, sinusoid

BASIS = BasisSettings(128, nearest="surface", frame="base")
JOINTS, FINGERS = 21, 5
POSES, PLACES = 2 * HAND_FEATURES, 2 * 3 * JOINTS  # numbers per frame of both hands
CONDITION = 3 * BASIS.places + 9 + 1 + 2  # O, local G, scale, and which hands act
HELD_WITHIN_M = 0.03  # OMOMO's contact constraint
TOUCH_M = 0.02  # CAMS: from the middle of a finger tip to a vertex of the part
LEAST_FRAMES = 5  # CAMS: a shorter stage belongs to the one before it
BLEND_FRAMES = 3.0  # CAMS: spread of the Gaussian over which stages blend
UNIT_M = 0.05
NO_OBJECT_MOTION = "no motion of an object, or no recorded clip"


class Placed(NamedTuple):
    """A recorded clip in the object's canonical frame.

    condition: (frame, CONDITION). joints_m: (2, frame, 21, 3). hands: (2, frame, 99) features. acting: (2, frame) bool.
    """

    scene: Scene
    condition: np.ndarray
    joints_m: np.ndarray
    hands: np.ndarray
    acting: np.ndarray


def placed(clip: ClipSample) -> Placed:
    scene = Scene.of(clip.object_model, clip.object, BASIS)
    joints_m = scene.model_from_canonical.inverse() @ clip.joints_m.astype(np.float64)
    hands = canonical_hands(clip.hands, scene.model_from_canonical)
    acting = clip.valid & clip.active_hands[:, None]
    return Placed(scene, condition_of(scene, clip.active_hands), joints_m, hands, acting)


def condition_of(scene: Scene, hands: np.ndarray) -> np.ndarray:
    return np.concatenate((told(scene), np.broadcast_to(hands, (len(scene), 2))), axis=1)


def by_frame(values: np.ndarray) -> np.ndarray:
    """(2, frame, ...) of both hands as (frame, number), the left hand first."""
    return values.swapaxes(0, 1).reshape(values.shape[1], -1)


# --- MDM-B and OMOMO-B


@dataclass(frozen=True)
class PoseConfig:
    """window: frames of a training window; longer motions are made of overlapping ones."""

    transformer: TransformerConfig = field(
        default_factory=lambda: TransformerConfig(192, 4, 4, 384, 0.0, norm_first=True)
    )
    window: int = 64


class PoseNetwork(nn.Module):
    """``clean = network(x, steps, condition, frames)``, all (B, F, number) but steps (B,) and frames (B, F) bool."""

    mean: Tensor
    spread: Tensor
    condition_mean: Tensor
    condition_spread: Tensor

    def __init__(self, size: int, condition: int, config: PoseConfig) -> None:
        super().__init__()
        self.config, width = config, config.transformer.width
        self.frame_in, self.frame_out = nn.Linear(size + condition, width), nn.Linear(width, size)
        self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.encoder = Encoder(config.transformer)
        for name, count in (("", size), ("condition_", condition)):
            self.register_buffer(f"{name}mean", torch.zeros(count))
            self.register_buffer(f"{name}spread", torch.ones(count))

    def forward(self, x: Tensor, steps: Tensor, condition: Tensor, frames: Tensor) -> Tensor:
        width = self.config.transformer.width
        seen = (condition - self.condition_mean) / self.condition_spread
        tokens = torch.cat((self.step_in(sinusoid(steps, width))[:, None], self.frame_in(torch.cat((x, seen), -1))), 1)
        tokens = tokens + sinusoid(torch.arange(tokens.shape[1], device=x.device), width)
        mask = torch.cat((frames.new_ones(len(frames), 1), frames), 1)
        return self.frame_out(self.encoder(tokens, mask)[:, 1:])

    def drawn(self, condition: np.ndarray, seed: int) -> np.ndarray:
        """(frame, size) a motion for a condition (frame, number) of any length."""
        device, generator = self.mean.device, torch.Generator().manual_seed(seed)
        layout = layout_of(len(condition), self.config.window, overlapping=True)
        given = layout.cut(torch.from_numpy(condition.astype(np.float32))[None].to(device))
        frames = torch.ones(given.shape[:2], dtype=torch.bool, device=device)

        def denoise(x: Tensor, steps: Tensor) -> Tensor:
            return layout.joined(self(layout.cut(x), steps.repeat_interleave(len(layout.starts)), given, frames))

        noise = torch.randn(1, len(condition), len(self.mean), generator=generator).to(device)
        made = sample(denoise, noise, SamplerConfig("ddim", 20), [generator])[0]
        return (made * self.spread + self.mean).cpu().numpy().astype(np.float64)


class PoseObjective:
    """Windows of clips, noised, against the clean ones. error: of a difference, such as ``torch.abs``."""

    frames = entries = 0

    def __init__(self, setup: Setup, network: PoseNetwork, rows: "Rows", error: Callable[[Tensor], Tensor]) -> None:
        self.error, self.device, self.length = error, setup.device, setup.network.window
        train = setup.corpus.train
        self.rows = {clip_id: rows(placed(train.whole(clip_id))) for clip_id in train.ids}
        for name, values, known in zip(("", "condition_"), *self._all(), strict=True):
            moments = Moments(values.shape[-1])
            moments.add(torch.from_numpy(values), torch.from_numpy(known))
            mean, spread = moments.found()
            getattr(network, f"{name}mean").copy_(mean)
            getattr(network, f"{name}spread").copy_(spread.clamp_min(0.05 * float(spread.mean())))
        self.network = network.to(setup.device)
        self.signal = alphas_cumprod(setup.device)
        held = [rows(placed(clip)) for clip in setup.corpus.held_out]
        self.held_out = self._windows([(own, max(len(own[0]) - self.length, 0) // 2) for own in held]) if held else None

    def _all(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Targets and conditions of all training clips, and which of their numbers are known."""
        target, known, condition = (np.concatenate(own) for own in zip(*self.rows.values(), strict=True))
        return [target, condition], [known, np.ones_like(condition, bool)]

    def _windows(self, chosen: Sequence[tuple["Arrays", int]]) -> list[Tensor]:
        """Targets, known, conditions (B, F, number) and frames (B, F) of windows by their first frames."""
        rows = [[array[start : start + self.length] for array in own] for own, start in chosen]
        rows = [[*own, np.ones(len(own[0]), bool)] for own in rows]
        padded = ([torch.from_numpy(array) for array in column] for column in zip(*rows, strict=True))
        return [nn.utils.rnn.pad_sequence(column, batch_first=True).to(self.device) for column in padded]

    def _losses(self, network: nn.Module, windows: list[Tensor], generator: torch.Generator) -> Losses:
        target, known, condition, frames = windows
        clean = ((target - self.network.mean) / self.network.spread * known).float()
        steps = torch.randint(TRAIN_STEPS, (len(clean),), generator=generator).to(self.device)
        noise = torch.randn(clean.shape, generator=generator).to(self.device)
        made = network(add_noise(clean, noise, steps, self.signal), steps, condition.float(), frames)
        return {"total": masked_mean(self.error(made - clean), known)}

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        chosen = []
        for clip in batch.samples:
            own = self.rows[clip.clip_id]
            last = max(len(own[0]) - self.length, 0)
            chosen.append((own, int(torch.randint(last + 1, (), generator=generator))))
        return self._losses(self.network, self._windows(chosen), generator)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert self.held_out is not None
        return self._losses(network, self.held_out, torch.Generator().manual_seed(0))["total"]


Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]
Rows = Callable[[Placed], Arrays]


def _known(clip: Placed, per_hand: int) -> np.ndarray:
    return np.repeat(clip.acting.T, per_hand, axis=1)


def _joint_rows(clip: Placed) -> Arrays:
    return by_frame(clip.joints_m), _known(clip, PLACES // 2), clip.condition


def _pose_rows(clip: Placed) -> Arrays:
    return by_frame(clip.hands), _known(clip, HAND_FEATURES), clip.condition


def _pose_rows_for_joints(clip: Placed) -> Arrays:
    given = by_frame(clip.joints_m) * _known(clip, PLACES // 2)
    return by_frame(clip.hands), _known(clip, HAND_FEATURES), np.concatenate((clip.condition, given), axis=1)


def _network(name: str, size: int, condition: int, rows: Rows, error: Callable[[Tensor], Tensor]) -> Network:
    build = partial(PoseNetwork, size, condition)
    return Network(
        name, PoseConfig, build, lambda setup: (PoseObjective(setup, build(setup.network), rows, error), None)
    )


MDM = _network("mdm-b", POSES, CONDITION, _pose_rows, torch.square)
OMOMO_JOINTS = _network("omomo-b-joints", PLACES, CONDITION, _joint_rows, torch.abs)
OMOMO_HANDS = _network("omomo-b-hands", POSES, CONDITION + PLACES, _pose_rows_for_joints, torch.abs)


def held_joints(joints_m: np.ndarray, scene: Scene, within_m: float = HELD_WITHIN_M) -> np.ndarray:
    """(frame, joint, 3) joints that stay, from the first frame within so many metres, at that place of their part."""
    model, rest, apart = scene.bps.model, [], []
    for part, own in scene.bps.vertices.items():
        rest.append(_in_part(scene, part, joints_m))
        apart.append(own.tree.query(rest[-1])[0])
    near = np.min(apart, axis=0) < within_m
    first, every = near.argmax(axis=0), np.arange(joints_m.shape[1])
    part = np.array([own[first, every] for own in apart]).argmin(axis=0)
    held = articulate(np.stack(rest)[part, first, every], part, model.hinge, scene.hinge_rad)
    stays = near.any(axis=0) & (np.arange(len(joints_m))[:, None] >= first)
    return np.where(stays[..., None], held, joints_m)


@dataclass(frozen=True)
class PoseSampler:
    """networks: of poses alone, or of joints and of poses for them."""

    networks: Sequence[PoseNetwork]
    synthetic: bool

    @classmethod
    def load(cls, sources: Sources, *networks: Network) -> "PoseSampler":
        trained = [load_checkpoint(sources.checkpoints / own.name, own, sources.device) for own in networks]
        return cls([cast(PoseNetwork, own.network) for own in trained], bool(trained[0].facts["synthetic"]))

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Clip | LeftOut:
        if request.trajectories is None:
            return LeftOut(request.motion_id, NO_OBJECT_MOTION)
        motion = request.trajectories.object[: request.n_frames]
        scene = Scene.of(request.object, motion, BASIS)
        condition = condition_of(scene, request.active_hands)
        if len(self.networks) > 1:
            joints = self.networks[0].drawn(condition, request.seed).reshape(len(scene), -1, 3)
            given = by_frame(held_joints(joints, scene).reshape(len(scene), 2, JOINTS, 3).swapaxes(0, 1))
            acting = np.repeat(request.active_hands, PLACES // 2)
            condition = np.concatenate((condition, given * acting), axis=1)
        made = self.networks[-1].drawn(condition, request.seed).reshape(len(scene), 2, -1).swapaxes(0, 1)
        hands = moved_hands(proper_hands(torch.from_numpy(made)).numpy(), scene.model_from_canonical)
        return motion_clip(request, torch.from_numpy(hands), torch.from_numpy(motion), self.synthetic)


# --- CAMS-B


@dataclass(frozen=True)
class CamsConfig:
    hidden: tuple[int, ...] = (512, 512)
    latent: int = 64


class Stage(NamedTuple):
    """Frames start to stop, in which the left and the right hand touch ``part`` (-1: none)."""

    start: int
    stop: int
    part: tuple[int, int]


def stages_of(joints_m: np.ndarray, scene: Scene) -> list[Stage]:
    """Every frame is in one stage. joints_m: (2, frame, 21, 3) canonical."""
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
    place = scene.bps.model.object_from_part(part, scene.hinge_rad).inverse() @ places_m.astype(np.float64)
    return np.broadcast_to(place, places_m.shape)


def conditions(clip: Placed, stages: Sequence[Stage]) -> np.ndarray:
    """(stage, number) float32: the object at both ends, the part each hand touches, and the initial hands."""
    acting, scene = clip.acting.any(axis=1), clip.scene
    first = (clip.joints_m[:, 0] * acting[:, None, None]).ravel()
    rows = []
    for stage in stages:
        ends = scene.offset[[stage.start, stage.stop - 1]].ravel()
        parts = np.eye(3)[np.array(stage.part) + 1].ravel()
        when = [scene.scale / 10, stage.start / len(scene), stage.stop / len(scene), *acting]
        rows.append(np.concatenate((ends, parts, first / UNIT_M, when)))
    return np.stack(rows).astype(np.float32)


def targets(clip: Placed, stages: Sequence[Stage]) -> np.ndarray:
    """(stage, 2, 5, 4) float32: whether a finger touches, and where its tip is on the part at rest, in 5 cm."""
    found = np.zeros((len(stages), 2, FINGERS, 4), np.float32)
    for row, stage in enumerate(stages):
        for side in np.flatnonzero(clip.acting.any(axis=1) & (np.array(stage.part) >= 0)):
            part = stage.part[side]
            place = _in_part(clip.scene, part, clip.joints_m[side, :, -FINGERS:])[stage.start : stage.stop]
            apart = clip.scene.bps.vertices[part].tree.query(place)[0]
            found[row, side, :, 0] = (apart < TOUCH_M).mean(axis=0) > 0.5
            found[row, side, :, 1:] = place.mean(axis=0) / UNIT_M
    return found


class CamsNetwork(nn.Module):
    """A conditional VAE: ``decode(condition, latent)`` gives flags (as logits) and places of all fingers."""

    def __init__(self, config: CamsConfig) -> None:
        super().__init__()
        self.config = config
        given, target = 2 * 3 * BASIS.places + 6 + PLACES + 5, 2 * FINGERS * 4
        self.encoder = _layers(given + target, config.hidden, 2 * config.latent)
        self.decoder = _layers(given + config.latent, config.hidden, target)

    def decode(self, condition: Tensor, latent: Tensor) -> Tensor:
        return self.decoder(torch.cat((condition, latent), -1)).unflatten(-1, (2, FINGERS, 4))

    def losses(self, condition: Tensor, target: Tensor, generator: torch.Generator) -> Losses:
        noise = torch.randn(len(condition), self.config.latent, generator=generator).to(condition.device)
        mean, log_variance = self.encoder(torch.cat((condition, target.flatten(1)), -1)).chunk(2, -1)
        made = self.decode(condition, mean + noise * (log_variance / 2).exp())
        touches = target[..., 0]
        places = ((made[..., 1:] - target[..., 1:]).square().sum(-1) * touches).sum() / touches.sum().clamp_min(1)
        acts = touches.any(dim=-1, keepdim=True).expand_as(touches)  # a hand that touches in this stage
        flags = masked_mean(functional.binary_cross_entropy_with_logits(made[..., 0], touches, reduction="none"), acts)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()
        total = places + 0.1 * flags + 0.005 * divergence
        return {"total": total, "places": places, "flags": flags, "divergence": divergence}


class CamsObjective:
    """All stages of a batch's clips."""

    frames = entries = 0

    def __init__(self, setup: Setup) -> None:
        self.network, self.device = CamsNetwork(setup.network).to(setup.device), setup.device
        train = setup.corpus.train
        self.rows = {clip_id: _rows(train.whole(clip_id)) for clip_id in train.ids}
        self.held_out = [_rows(clip) for clip in setup.corpus.held_out]

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        return self.network.losses(*self._together([self.rows[clip.clip_id] for clip in batch.samples]), generator)

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        rows = self._together(self.held_out)
        return cast(CamsNetwork, network).losses(*rows, torch.Generator().manual_seed(0))["total"]

    def _together(self, rows: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[Tensor]:
        return [torch.from_numpy(np.concatenate(own)).to(self.device) for own in zip(*rows, strict=True)]


def _rows(sample: ClipSample) -> tuple[np.ndarray, np.ndarray]:
    clip = placed(sample)
    stages = stages_of(clip.joints_m, clip.scene)
    return conditions(clip, stages), targets(clip, stages)


@dataclass(frozen=True)
class CamsSampler:
    """The trained network, and the clips that give initial hands and stages."""

    network: CamsNetwork
    sources: Sources
    synthetic: bool

    @classmethod
    def load(cls, sources: Sources) -> "CamsSampler":
        trained = load_checkpoint(sources.checkpoints / CAMS.name, CAMS, sources.device)
        return cls(cast(CamsNetwork, trained.network), sources, bool(trained.facts["synthetic"]))

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Clip | LeftOut:
        if request.trajectories is None or not request.clip_id:
            return LeftOut(request.motion_id, NO_OBJECT_MOTION)
        recorded, pair = load_sample(self.sources.annotated, request.clip_id), self.sources.hands
        clip = placed(recorded)
        stages = stages_of(clip.joints_m, clip.scene)
        fingers = self._drawn(conditions(clip, stages), request.seed)
        ids, world = np.union1d(hand_keypoints(pair.right, 64), TIP_VERTICES), world_from_canonical(request, clip.scene)
        generated = {}
        for row in np.flatnonzero(request.active_hands).tolist():
            skin_m = clip.scene.model_from_canonical.inverse()[0] @ hand_vertices_m(pair, row, recorded)[0]
            tips = np.searchsorted(ids, TIP_VERTICES)
            points_m = carried(skin_m[ids], tips, fingers[:, row], stages, clip.scene, row)
            refuse_not_finite(request, points_m)
            everywhere = np.ones(len(points_m), bool)
            generated[SIDES[row]] = GeneratedHand(world @ points_m, np.zeros_like(points_m), everywhere)
        bare = clip_without_hands(request, self.synthetic)
        tracks = fit_hands(pair, request.betas, ids, generated, request.template_m)
        return replace(bare, hands={**bare.hands, **tracks})

    @torch.no_grad()
    def _drawn(self, condition: np.ndarray, seed: int) -> np.ndarray:
        """(stage, 2, 5, 4) flags and places of the fingers; one latent for all stages."""
        device = next(self.network.parameters()).device
        latent = torch.randn(1, self.network.config.latent, generator=torch.Generator().manual_seed(seed)).to(device)
        given = torch.from_numpy(condition).to(device)
        return self.network.decode(given, latent.expand(len(given), -1)).cpu().numpy()


def carried(
    first_m: np.ndarray, tips: np.ndarray, fingers: np.ndarray, stages: Sequence[Stage], scene: Scene, side: int
) -> np.ndarray:
    """(frame, point, 3) canonical keypoints of a hand: the initial ones, moved rigidly to where its fingers touch and
    on with the part; touching tips are put exactly there.

    first_m: (point, 3); tips: rows of the five tips; fingers: (stage, 5, 4) as ``targets`` has them, flags as logits.
    """
    made, own, part = np.empty((len(scene), *first_m.shape)), first_m, 0
    for stage, finger in zip(stages, fingers, strict=True):
        touching = finger[:, 0] > 0
        if stage.part[side] >= 0 and touching.any():
            part, wanted = stage.part[side], finger[touching, 1:].astype(np.float64) * UNIT_M
            own = _rigid_to(first_m[tips[touching]], wanted) @ first_m
            own[tips[touching]] = wanted
        pose = scene.bps.model.object_from_part(part, scene.hinge_rad)
        rows = slice(stage.start, stage.stop)
        made[rows] = (pose @ np.broadcast_to(own, made.shape))[rows]
    return gaussian_filter1d(made, BLEND_FRAMES, axis=0, mode="nearest")


def _rigid_to(points_m: np.ndarray, wanted_m: np.ndarray) -> RigidTransform:
    """The rigid transform that brings points nearest to where they are wanted; of fewer than three, a shift."""
    middle, goal = points_m.mean(axis=0), wanted_m.mean(axis=0)
    rotation = np.eye(3)
    if len(points_m) >= 3:
        rotation = Rotation.align_vectors(wanted_m - goal, points_m - middle)[0].as_matrix()
    return RigidTransform(rotation, goal - rotation @ middle)


def _layers(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    sizes = (inputs, *hidden)
    layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ELU())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


CAMS = Network("cams-b", CamsConfig, CamsNetwork, lambda setup: (CamsObjective(setup), None))


def _family(name: str, title: str, load: Callable[[Sources], Any], *networks: Network) -> Family:
    return Family(name, title, load, networks, tuple(own.name for own in networks))


MDM_B = _family("mdm-b", "MDM-B", lambda sources: PoseSampler.load(sources, MDM), MDM)
OMOMO = OMOMO_JOINTS, OMOMO_HANDS
OMOMO_B = _family("omomo-b", "OMOMO-B", lambda sources: PoseSampler.load(sources, *OMOMO), *OMOMO)
CAMS_B = _family("cams-b", "CAMS-B, given the first hands and the stages", CamsSampler.load, CAMS)
