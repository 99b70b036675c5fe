"""Rivals as families: the recorded clip itself, mean pose, mean motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.clips.features import HAND_FEATURES, OBJECT_FEATURES
from hoidata.store.annotated import AnnotatedStore
from models.baselines.lookups import matched_rows, train_clips
from models.common.family import EachAlone, Family, LeftOut, motion_clip
from models.common.features import proper_hands, proper_object

TIME_BINS = 50
NO_MEAN = "no training clip in which a hand asked for acts"


@dataclass(frozen=True)
class GroundTruth:
    """The recorded clip whose place the motion takes."""

    annotated: AnnotatedStore

    def sample(self, requests: Sequence[Request]) -> list[Clip]:
        return [self.recorded(request) for request in requests]

    def sample_asked(self, requests: Sequence[Request]) -> tuple[list[Clip], list[np.ndarray]]:
        return self.sample(requests), self.contact_maps(requests)

    def contact_maps(self, requests: Sequence[Request]) -> list[np.ndarray]:
        """(point,) bool: what the hands asked for touch in the recorded clips, in the frames asked for."""
        maps = []
        for request in requests:
            near = self.annotated.distances(request.clip_id).window(0, request.n_frames)
            touched = np.zeros(len(request.points.points_m), dtype=bool)
            touched[near.point[request.active_hands[near.side]]] = True
            maps.append(touched)
        return maps

    def recorded(self, request: Request) -> Clip:
        """The recorded clip under the name and with the frames that are asked for."""
        clip = self.annotated.clip(request.clip_id).take(slice(0, request.n_frames))
        return replace(clip, clip_id=request.motion_id, other_objects=(), camera=None, body=None, source_contact=None)


@dataclass(frozen=True)
class MeanMotion(EachAlone):
    """The mean of the training clips, over equal intervals of each clip's own time.

    hands (2, bin, 99), objects (bin, 10): features in the model frame; one bin is the mean pose. seen: (2,) bool, the
    hands that act in a training clip; the others have no mean.
    """

    hands: np.ndarray
    objects: np.ndarray
    synthetic: bool
    seen: np.ndarray

    @classmethod
    def of(cls, train: Sequence[ClipSample], bins: int) -> "MeanMotion":
        """From training clips; frames of a hand that takes no part are left out."""
        hands, objects = np.zeros((2, bins, HAND_FEATURES)), np.zeros((bins, OBJECT_FEATURES))
        n_hands, n_objects = np.zeros((2, bins, 1)), np.zeros((bins, 1))
        for sample in train:
            # Clip and bins divide the same time: every frame counts in a bin by how long it lies in it.
            moments = np.arange(sample.length * bins)
            frames, rows = moments // bins, moments // sample.length
            np.add.at(objects, rows, sample.object[frames])
            np.add.at(n_objects, rows, 1.0)
            for side in range(2):
                there = (sample.valid[side] & sample.active_hands[side])[frames]
                np.add.at(hands[side], rows[there], sample.hands[side][frames[there]])
                np.add.at(n_hands[side], rows[there], 1.0)
        synthetic = any(sample.synthetic for sample in train)
        return cls(_means(hands, n_hands), _means(objects, n_objects), synthetic, n_hands[:, :, 0].sum(axis=1) > 0)

    def motion(self, request: Request) -> Clip | LeftOut:
        if (request.active_hands & ~self.seen).any():
            return LeftOut(request.motion_id, NO_MEAN)
        rows = matched_rows(request.n_frames, len(self.objects))
        hands, objects = torch.from_numpy(self.hands[:, rows]), torch.from_numpy(self.objects[rows])
        return motion_clip(request, proper_hands(hands), proper_object(objects), self.synthetic)


def _means(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Sums (..., bin, D) over counts (..., bin, 1); bins without any get the mean of all, or no motion at all."""
    overall = total.sum(-2, keepdims=True) / np.maximum(count.sum(-2, keepdims=True), 1)
    means = np.where(count > 0, total / np.maximum(count, 1), overall)
    unturned = np.zeros(total.shape[-1])
    first = np.arange(3, total.shape[-1] - 5, 6)
    unturned[first] = unturned[first + 3] = 1.0  # the 6D of no rotation: R00 and R11
    return np.where(count.sum(-2, keepdims=True) > 0, means, unturned)


GROUND_TRUTH = Family("ground-truth", "ground truth", lambda sources: GroundTruth(sources.annotated))
MEAN_POSE = Family("mean-pose", "mean pose", lambda sources: MeanMotion.of(train_clips(sources), 1))
MEAN_MOTION = Family("mean-motion", "mean motion", lambda sources: MeanMotion.of(train_clips(sources), TIME_BINS))
