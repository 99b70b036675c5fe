"""Retrieval baselines of BimArt: the training window with the most similar object motion, and the mean hand pose."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip, Side
from hoidata.clips.features import GLOBAL_ORIENT_6D, HAND_FEATURES, WRIST
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rot6d
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import HandPair
from hoidata.refinement import GeneratedKeypoints, fit_hands, refine_hands
from hoidata.sensors.part_bps import BasisSettings, hand_keypoints
from models.baselines.families import NO_MEAN
from models.bimart.family import (
    clip_without_hands,
    keypoints_in_world,
    requested_motion,
    requested_scene,
    training_clips,
    world_from_canonical,
)
from models.bimart.scene import FeatureConfig, RecordedClip, Scene, recorded_clip
from models.common.family import Family, SingleRequestSampler, Skipped, Sources, motion_clip
from models.common.features import proper_hands

BASIS = BasisSettings(64, nearest="vertex", frame="base")
NO_WINDOW = "no training window of these hands, or no motion of an object"
FEATURES = FeatureConfig(BASIS, keypoints=64)  # of the refined baseline
WINDOW_FRAMES = 64
STRIDE_FRAMES = 8
# O, and G with the scale: both groups have the same weight in the distance between windows.
FEATURE_GROUPS = (slice(0, 6 * BASIS.count), slice(6 * BASIS.count, None))
ActiveHands = tuple[bool, bool]


def moved_hands(hands: np.ndarray, transform: RigidTransform) -> np.ndarray:
    """Apply a transform (frame,) to wrist positions and orientations of features (side, frame, 99)."""
    moved = hands.astype(np.float64)
    moved[..., WRIST] = (transform @ moved[..., WRIST].swapaxes(0, 1)).swapaxes(0, 1)
    moved[..., GLOBAL_ORIENT_6D] = rotmat_to_rot6d(transform.rotation @ rot6d_to_rotmat(moved[..., GLOBAL_ORIENT_6D]))
    return moved


def scene_features(scene: Scene) -> np.ndarray:
    """(frame, number) what a network is conditioned on in each frame: O, local G, scale."""
    scale = np.full((len(scene), 1), scene.object_scale)
    features = scene.basis_offset.reshape(len(scene), -1), scene.state("local", 0, len(scene)), scale
    return np.concatenate(features, axis=1)


class TrainingClip(NamedTuple):
    """A training clip prepared for the search."""

    features: np.ndarray  # (frame, number) of its scene, normalised
    hands: np.ndarray  # (2, frame, 99) canonical frame
    sample: ClipSample


@dataclass(frozen=True)
class NearestWindow(SingleRequestSampler):
    """Copies the hands of the nearest training window with the same active hands, for each window of a request."""

    clips: dict[ActiveHands, list[TrainingClip]]
    mean: np.ndarray
    std: np.ndarray  # of the features, times the square root of their group's size
    synthetic: bool

    @classmethod
    def load(cls, sources: Sources) -> "NearestWindow":
        samples = training_clips(sources.annotated)
        if not samples:
            return cls({}, np.zeros(0), np.ones(0), False)
        scenes = [Scene.of(sample.object_model, sample.object, BASIS) for sample in samples]
        by_clip = [scene_features(scene) for scene in scenes]
        features = np.concatenate(by_clip)
        mean, std = features.mean(axis=0), features.std(axis=0)
        for group in FEATURE_GROUPS:
            std[group] = np.maximum(std[group], 0.05 * std[group].mean()) * np.sqrt(std[group].size)
        clips: dict[ActiveHands, list[TrainingClip]] = {}
        for sample, scene, clip_features in zip(samples, scenes, by_clip, strict=True):
            if not sample.is_tracked:
                continue
            hands = moved_hands(sample.hands, scene.model_from_canonical.inverse())
            clip = TrainingClip((clip_features - mean) / std, hands, sample)
            clips.setdefault(active_hands_of(sample), []).append(clip)
        return cls(clips, mean, std, any(sample.synthetic for sample in samples))

    def motion(self, request: Request) -> Clip | Skipped:
        if request.trajectories is None or active_hands_of(request) not in self.clips:
            return Skipped(request.motion_id, NO_WINDOW)
        scene, clips = requested_scene(request, BASIS), self.clips[active_hands_of(request)]
        windows = [clips[number].hands[:, frames] for number, frames in self.windows(request, scene)]
        return _clip(request, np.concatenate(windows, axis=1), scene, self.synthetic)

    def windows(self, request: Request, scene: Scene) -> list[tuple[int, np.ndarray]]:
        """For each window of a request: the number of the clip with the same hands, and its frames (frame,)."""
        features = (scene_features(scene) - self.mean) / self.std
        starts = range(0, len(features), WINDOW_FRAMES)
        return [self._nearest(features[start : start + WINDOW_FRAMES], request) for start in starts]

    def _nearest(self, features: np.ndarray, request: Request) -> tuple[int, np.ndarray]:
        """The nearest window; further samples of a request take the next nearest clips."""
        candidates = []
        for number, clip in enumerate(self.clips[active_hands_of(request)]):
            starts = np.arange(0, max(len(clip.features) - len(features), 0) + 1, STRIDE_FRAMES)
            # The last frame of a clip that is too short is repeated.
            frames = np.minimum(starts[:, None] + np.arange(len(features)), len(clip.features) - 1)
            distances = ((clip.features[frames] - features) ** 2).sum(axis=-1).mean(axis=-1)
            candidates.append((distances.min(), number, frames[distances.argmin()]))
        nearest_first = sorted(candidates, key=lambda candidate: candidate[:2])
        _, number, frames = nearest_first[request.number % len(candidates)]
        return number, frames


@dataclass(frozen=True)
class MeanPose(SingleRequestSampler):
    """Places the mean training hand in the object's canonical frame."""

    hands: np.ndarray  # (2, 99) features
    synthetic: bool
    in_training: np.ndarray  # (2,) bool, hands that are active in some training clip

    @classmethod
    def load(cls, sources: Sources) -> "MeanPose":
        total, count = np.zeros((2, HAND_FEATURES)), np.zeros((2, 1))
        samples = training_clips(sources.annotated)
        for sample in samples:
            scene = Scene.of(sample.object_model, sample.object, BASIS)
            hands = moved_hands(sample.hands, scene.model_from_canonical.inverse())
            mask = (sample.valid & sample.active_hands[:, None])[..., None]
            total, count = total + (hands * mask).sum(axis=1), count + mask.sum(axis=1)
        hands = proper_hands(torch.from_numpy(total / count.clip(1))).numpy()
        return cls(hands, any(sample.synthetic for sample in samples), count[:, 0] > 0)

    def motion(self, request: Request) -> Clip | Skipped:
        if request.trajectories is None:
            return Skipped(request.motion_id, "no motion of an object")
        if (request.active_hands & ~self.in_training).any():
            return Skipped(request.motion_id, NO_MEAN)
        hands = np.repeat(self.hands[:, None], request.n_frames, axis=1)
        return _clip(request, hands, requested_scene(request, BASIS), self.synthetic)


def _clip(request: Request, hands: np.ndarray, scene: Scene, synthetic: bool) -> Clip:
    """The requested clip with hand features (2, frame, 99), canonical frame."""
    moved = moved_hands(hands, scene.model_from_canonical)
    return motion_clip(request, torch.from_numpy(moved), torch.from_numpy(requested_motion(request)), synthetic)


def active_hands_of(clip: Request | ClipSample) -> ActiveHands:
    """The active hands as a dictionary key: left, right."""
    return bool(clip.active_hands[0]), bool(clip.active_hands[1])


@dataclass(frozen=True)
class RefinedWindow(SingleRequestSampler):
    """The nearest training window with the fit and refinement of BimArt: everything but the networks."""

    nearest: NearestWindow
    pair: HandPair
    recorded: dict[str, RecordedClip] = field(default_factory=dict)  # a cache by clip id

    @classmethod
    def load(cls, sources: Sources) -> "RefinedWindow":
        return cls(NearestWindow.load(sources), sources.hands)

    def motion(self, request: Request) -> Clip | Skipped:
        if request.trajectories is None or active_hands_of(request) not in self.nearest.clips:
            return Skipped(request.motion_id, NO_WINDOW)
        hands, ids = self._hands(request), hand_keypoints(self.pair.right, FEATURES.keypoints)
        clip = clip_without_hands(request, self.nearest.synthetic)
        tracks = refine_hands(self.pair, ids, hands, fit_hands(self.pair, None, ids, hands), clip.object)
        return replace(clip, hands={**clip.hands, **tracks})

    def _hands(self, request: Request) -> dict[Side, GeneratedKeypoints]:
        """Keypoints and vectors to the object of the nearest windows, world frame."""
        scene = requested_scene(request, BASIS)
        windows = [(self._recorded(request, number), frames) for number, frames in self.nearest.windows(request, scene)]
        keypoints = np.concatenate([clip.keypoints_m[:, frames] for clip, frames in windows], axis=1)
        to_object = np.concatenate([clip.to_object_m[:, frames] for clip, frames in windows], axis=1)
        return keypoints_in_world(request, world_from_canonical(request, scene), keypoints, to_object)

    def _recorded(self, request: Request, number: int) -> RecordedClip:
        sample = self.nearest.clips[active_hands_of(request)][number].sample
        if sample.clip_id not in self.recorded:
            self.recorded[sample.clip_id] = recorded_clip(sample, self.pair, FEATURES)
        return self.recorded[sample.clip_id]


NEAREST_WINDOW = Family("nearest-window", "nearest training window by object and its motion", NearestWindow.load)
OBJECT_MEAN_POSE = Family("mean-pose-at-object", "mean pose in the object's frame", MeanPose.load)
NEAREST_REFINED = Family("nearest-window-refined", "nearest training window, refined", RefinedWindow.load)
