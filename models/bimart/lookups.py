"""Rivals that learn nothing: the training window whose object and motion are nearest, the mean pose at the object."""

from dataclasses import dataclass, field, replace

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.clips.features import GLOBAL_ORIENT_6D, HAND_FEATURES, WRIST
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rot6d
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import HandPair
from hoidata.refinement import GeneratedHand, fit_hands, refine_hands
from hoidata.sensors.keypoints import hand_keypoints
from hoidata.sensors.part_bps import BasisSettings
from models.baselines.families import NO_MEAN
from models.bimart.family import clip_without_hands, training_clips, world_from_canonical
from models.bimart.sampler import IDLE_M
from models.bimart.scene import FeatureConfig, Recorded, Scene, recorded_clip
from models.common.family import EachAlone, Family, LeftOut, Sources, motion_clip
from models.common.features import proper_hands

BASIS = BasisSettings(64, nearest="vertex", frame="base")
NO_WINDOW = "no training window of these hands, or no motion of an object"
FEATURES = FeatureConfig(BASIS, keypoints=64)  # of the refined rival
WINDOW = 64
STRIDE = 8
KINDS = (slice(0, 6 * BASIS.count), slice(6 * BASIS.count, None))  # O, and G with the scale: they count alike


def canonical_hands(hands: np.ndarray, model_from_canonical: RigidTransform) -> np.ndarray:
    """Features (side, frame, 99) of the model frame in the canonical one."""
    return moved_hands(hands, model_from_canonical.inverse())


def moved_hands(hands: np.ndarray, frame: RigidTransform) -> np.ndarray:
    """Features (side, frame, 99) taken along by a transform of every frame."""
    made = hands.astype(np.float64)
    made[..., WRIST] = (frame @ made[..., WRIST].swapaxes(0, 1)).swapaxes(0, 1)
    made[..., GLOBAL_ORIENT_6D] = rotmat_to_rot6d(frame.rotation @ rot6d_to_rotmat(made[..., GLOBAL_ORIENT_6D]))
    return made


def told(scene: Scene) -> np.ndarray:
    """(frame, number) what a network is told of each frame: O, local G, scale."""
    scale = np.full((len(scene), 1), scene.scale)
    own = scene.offset.reshape(len(scene), -1), scene.state("local", 0, len(scene)), scale
    return np.concatenate(own, axis=1)


@dataclass(frozen=True)
class NearestWindow(EachAlone):
    """For every window of a request the hands of the training window most like it, of the same hands.

    clips: by hands that take part, what is told (frame, number), normalised, hands (2, frame, 99) canonical, the clip.
    """

    clips: dict[tuple[bool, bool], list[tuple[np.ndarray, np.ndarray, ClipSample]]]
    mean: np.ndarray
    spread: np.ndarray
    synthetic: bool

    @classmethod
    def load(cls, sources: Sources) -> "NearestWindow":
        samples = training_clips(sources.annotated)
        if not samples:
            return cls({}, np.zeros(0), np.ones(0), False)
        scenes = [Scene.of(sample.object_model, sample.object, BASIS) for sample in samples]
        rows = [told(scene) for scene in scenes]
        every = np.concatenate(rows)
        spread = every.std(axis=0)
        for kind in KINDS:
            spread[kind] = np.maximum(spread[kind], 0.05 * spread[kind].mean()) * np.sqrt(spread[kind].size)
        clips: dict[tuple[bool, bool], list[tuple[np.ndarray, np.ndarray, ClipSample]]] = {}
        for sample, scene, row in zip(samples, scenes, rows, strict=True):
            if not sample.is_tracked:
                continue
            hands = canonical_hands(sample.hands, scene.model_from_canonical)
            clips.setdefault(hands_of(sample), []).append(((row - every.mean(axis=0)) / spread, hands, sample))
        return cls(clips, every.mean(axis=0), spread, any(sample.synthetic for sample in samples))

    def motion(self, request: Request) -> Clip | LeftOut:
        if request.trajectories is None or hands_of(request) not in self.clips:
            return LeftOut(request.motion_id, NO_WINDOW)
        thing = request.trajectories.object[: request.n_frames]
        scene = Scene.of(request.object, thing, BASIS)
        clips = self.clips[hands_of(request)]
        parts = [clips[number][1][:, frames] for number, frames in self.windows(request, scene)]
        hands = moved_hands(np.concatenate(parts, axis=1), scene.model_from_canonical)
        return motion_clip(request, torch.from_numpy(hands), torch.from_numpy(thing), self.synthetic)

    def windows(self, request: Request, scene: Scene) -> list[tuple[int, np.ndarray]]:
        """For every window of a request the number of a clip among those of its hands, and frames (frame,) of it."""
        asked = (told(scene) - self.mean) / self.spread
        return [self._nearest(asked[start : start + WINDOW], request) for start in range(0, len(asked), WINDOW)]

    def _nearest(self, asked: np.ndarray, request: Request) -> tuple[int, np.ndarray]:
        """The nearest window; of the next nearest clip for each further motion of a request."""
        found = []
        for number, (row, *_) in enumerate(self.clips[hands_of(request)]):
            starts = np.arange(0, max(len(row) - len(asked), 0) + 1, STRIDE)
            frames = np.minimum(starts[:, None] + np.arange(len(asked)), len(row) - 1)
            apart = ((row[frames] - asked) ** 2).sum(axis=-1).mean(axis=-1)
            found.append((apart.min(), number, frames[apart.argmin()]))
        _, number, frames = sorted(found, key=lambda one: one[:2])[request.number % len(found)]
        return number, frames


@dataclass(frozen=True)
class MeanPose(EachAlone):
    """The mean hand at the object, canonical frame. hands: (2, 99). seen: (2,) bool, that act in a training clip."""

    hands: np.ndarray
    synthetic: bool
    seen: np.ndarray

    @classmethod
    def load(cls, sources: Sources) -> "MeanPose":
        total, count = np.zeros((2, HAND_FEATURES)), np.zeros((2, 1))
        samples = training_clips(sources.annotated)
        for sample in samples:
            scene = Scene.of(sample.object_model, sample.object, BASIS)
            own = canonical_hands(sample.hands, scene.model_from_canonical)
            known = (sample.valid & sample.active_hands[:, None])[..., None]
            total, count = total + (own * known).sum(axis=1), count + known.sum(axis=1)
        hands = proper_hands(torch.from_numpy(total / count.clip(1))).numpy()
        return cls(hands, any(sample.synthetic for sample in samples), count[:, 0] > 0)

    def motion(self, request: Request) -> Clip | LeftOut:
        if request.trajectories is None:
            return LeftOut(request.motion_id, "no motion of an object")
        if (request.active_hands & ~self.seen).any():
            return LeftOut(request.motion_id, NO_MEAN)
        thing = request.trajectories.object[: request.n_frames]
        scene = Scene.of(request.object, thing, BASIS)
        hands = np.repeat(self.hands[:, None], len(thing), axis=1)
        moved = torch.from_numpy(moved_hands(hands, scene.model_from_canonical))
        return motion_clip(request, moved, torch.from_numpy(thing), self.synthetic)


def hands_of(one: Request | ClipSample) -> tuple[bool, bool]:
    """Which hands take part."""
    return bool(one.active_hands[0]), bool(one.active_hands[1])


@dataclass(frozen=True)
class RefinedWindow(EachAlone):
    """Hands of the nearest training window, refined as ours are: the rival that has everything but the networks."""

    nearest: NearestWindow
    pair: HandPair
    known: dict[str, Recorded] = field(default_factory=dict)

    @classmethod
    def load(cls, sources: Sources) -> "RefinedWindow":
        return cls(NearestWindow.load(sources), sources.hands)

    def motion(self, request: Request) -> Clip | LeftOut:
        if request.trajectories is None or hands_of(request) not in self.nearest.clips:
            return LeftOut(request.motion_id, NO_WINDOW)
        hands, ids = self._hands(request), hand_keypoints(self.pair.right, FEATURES.keypoints)
        clip = clip_without_hands(request, self.nearest.synthetic)
        tracks = fit_hands(self.pair, request.betas, ids, hands, request.template_m)
        tracks = refine_hands(self.pair, ids, hands, tracks, clip.object)
        return replace(clip, hands={**clip.hands, **tracks})

    def _hands(self, request: Request) -> dict[Side, GeneratedHand]:
        """Keypoints of the windows, each as far from the object as it was recorded, world frame."""
        assert request.trajectories is not None
        scene = Scene.of(request.object, request.trajectories.object[: request.n_frames], BASIS)
        windows = [(self._recorded(request, number), frames) for number, frames in self.nearest.windows(request, scene)]
        keypoints = np.concatenate([clip.keypoints_m[:, frames] for clip, frames in windows], axis=1)
        ways = np.concatenate([clip.to_object_m[:, frames] for clip, frames in windows], axis=1)
        near = np.linalg.norm(ways, axis=-1).min(axis=-1) < IDLE_M
        world = world_from_canonical(request, scene)
        return {
            side: GeneratedHand(
                world @ keypoints[row].astype(np.float64), world.turn(ways[row].astype(np.float64)), near[row]
            )
            for row, side in enumerate(SIDES)
            if request.active_hands[row]
        }

    def _recorded(self, request: Request, number: int) -> Recorded:
        sample = self.nearest.clips[hands_of(request)][number][2]
        if sample.clip_id not in self.known:
            self.known[sample.clip_id] = recorded_clip(sample, self.pair, FEATURES)
        return self.known[sample.clip_id]


NEAREST_WINDOW = Family("nearest-window", "nearest training window by object and its motion", NearestWindow.load)
OBJECT_MEAN_POSE = Family("mean-pose-at-object", "mean pose in the object's frame", MeanPose.load)
NEAREST_REFINED = Family("nearest-window-refined", "nearest training window, refined", RefinedWindow.load)
