"""Baselines: the recorded clip itself, the mean pose and the mean motion of the training clips."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.clips.features import HAND_FEATURES, OBJECT_FEATURES
from hoidata.store.annotated import AnnotatedStore
from models.baselines.retrieval import matched_rows
from models.common.family import Family, SingleRequestSampler, Skipped, motion_clip
from models.common.features import proper_hands, proper_object

TIME_BINS = 50
NO_MEAN = "no training clip in which a hand asked for acts"


@dataclass(frozen=True)
class GroundTruth:
    """Answers every request with its recorded clip."""

    annotated: AnnotatedStore

    def sample(self, requests: Sequence[Request]) -> list[Clip]:
        return [self.recorded(request) for request in requests]

    def sample_with_targets(self, requests: Sequence[Request]) -> tuple[list[Clip], list[np.ndarray]]:
        return self.sample(requests), self.contact_maps(requests)

    def contact_maps(self, requests: Sequence[Request]) -> list[np.ndarray]:
        """Per request, (point,) bool: the points that requested hands touch in requested frames of the recording."""
        maps = []
        for request in requests:
            near = self.annotated.distances(request.clip_id).window(0, request.n_frames)
            touched = np.zeros(len(request.points.points_m), dtype=bool)
            touched[near.point[request.active_hands[near.side]]] = True
            maps.append(touched)
        return maps

    def recorded(self, request: Request) -> Clip:
        """The recorded clip with the requested frames and the id of the motion."""
        clip = self.annotated.clip(request.clip_id).take(slice(0, request.n_frames))
        return replace(clip, clip_id=request.motion_id, other_objects=(), camera=None, body=None, source_contact=None)


@dataclass(frozen=True)
class MeanMotion(SingleRequestSampler):
    """The mean of the training clips per bin of normalised time; one bin gives the mean pose."""

    hands: np.ndarray  # (2, bin, 99) features in the model frame
    objects: np.ndarray  # (bin, 10) features in the model frame
    synthetic: bool
    has_mean: np.ndarray  # (2,) bool, the hands that act in a training clip

    @classmethod
    def of(cls, train: Sequence[ClipSample], bins: int) -> "MeanMotion":
        """Average training clips; frames of a hand that does not act are skipped."""
        hands, objects = np.zeros((2, bins, HAND_FEATURES)), np.zeros((bins, OBJECT_FEATURES))
        hand_weights, object_weights = np.zeros((2, bins, 1)), np.zeros((bins, 1))
        for sample in train:
            # Resample clip and bins to their common multiple, so that a frame counts in a bin by its overlap.
            moments = np.arange(sample.length * bins)
            frames, bins_of_moments = moments // bins, moments // sample.length
            np.add.at(objects, bins_of_moments, sample.object[frames])
            np.add.at(object_weights, bins_of_moments, 1.0)
            for side in range(2):
                active = (sample.valid[side] & sample.active_hands[side])[frames]
                np.add.at(hands[side], bins_of_moments[active], sample.hands[side][frames[active]])
                np.add.at(hand_weights[side], bins_of_moments[active], 1.0)
        synthetic = any(sample.synthetic for sample in train)
        return cls(
            _means(hands, hand_weights),
            _means(objects, object_weights),
            synthetic,
            hand_weights[:, :, 0].sum(axis=1) > 0,
        )

    def motion(self, request: Request) -> Clip | Skipped:
        if (request.active_hands & ~self.has_mean).any():
            return Skipped(request.motion_id, NO_MEAN)
        rows = matched_rows(request.n_frames, len(self.objects))
        hands, objects = torch.from_numpy(self.hands[:, rows]), torch.from_numpy(self.objects[rows])
        return motion_clip(request, proper_hands(hands), proper_object(objects), self.synthetic)


def _means(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Sums (..., bin, D) over counts (..., bin, 1); empty bins get the overall mean, without any the identity pose."""
    overall = total.sum(-2, keepdims=True) / np.maximum(count.sum(-2, keepdims=True), 1)
    means = np.where(count > 0, total / np.maximum(count, 1), overall)
    unturned = np.zeros(total.shape[-1])
    first = np.arange(3, total.shape[-1] - 5, 6)
    unturned[first] = unturned[first + 3] = 1.0  # the 6D of no rotation: R00 and R11
    return np.where(count.sum(-2, keepdims=True) > 0, means, unturned)


GROUND_TRUTH = Family("ground-truth", "ground truth", lambda sources: GroundTruth(sources.annotated))
MEAN_POSE = Family("mean-pose", "mean pose", lambda sources: MeanMotion.of(sources.clips("train"), 1))
MEAN_MOTION = Family("mean-motion", "mean motion", lambda sources: MeanMotion.of(sources.clips("train"), TIME_BINS))
