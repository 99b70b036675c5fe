"""Annotated clips as training samples: a torch Dataset with split, crop, padding and collate.

A sample is in the *model frame*: the clip's world, rotated so that gravity is -z (if the direction is known) and
translated so that the object's origin is at zero in the first frame. ``world_from_model`` is the inverse transform.

``hoidata.clips.features`` documents the features. Sides are ordered left, right.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from hoidata.batches.frame_selection import FrameSelection
from hoidata.batches.requests import ObjectPoints, RequestBatch, conditions
from hoidata.clips.clip import SIDES, HandTrack
from hoidata.clips.features import OBJECT_POSITION, WRIST, hand_features, object_features, upright
from hoidata.errors import BadInput
from hoidata.objects.model import ObjectModel
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.distances import DistanceEntries

MAX_FRAMES = 150
Crop = Literal["random", "start"]


@dataclass(frozen=True)
class ClipSample:
    """One clip in the model frame; NumPy arrays, axes (side, frame, ...), metres and radians."""

    clip_id: str
    dataset: str
    verb: str | None
    object_words: str
    object_key: str
    object_model: ObjectModel
    hand_type: str
    sentences: tuple[str, ...]
    synthetic: bool
    start: int  # first frame within the clip
    hands: np.ndarray  # (2, F, 99) features
    object: np.ndarray  # (F, 10) features
    joints_m: np.ndarray  # (2, F, 21, 3) joints with the hand shape of the clip
    valid: np.ndarray  # (2, F) bool: tracked frames; the others repeat the last tracked pose
    active_hands: np.ndarray  # (2,) bool
    betas: np.ndarray  # (2, 10)
    template_m: np.ndarray | None  # (2, 778, 3) personal rest meshes
    text: np.ndarray  # (form, 512) features of the sentences
    points: ObjectPoints
    contact: np.ndarray  # (2, 1024) bool: points within ``contact_threshold_m`` of a joint of each side
    contact_threshold_m: float  # of the contact stage
    distances: DistanceEntries
    world_from_model: np.ndarray  # (4, 4)
    gravity_known: bool = True  # whether -z of the model frame is the direction of gravity

    @property
    def length(self) -> int:
        return len(self.object)

    @property
    def is_tracked(self) -> bool:
        """Whether the active hands are tracked in all frames, so that their motion can be copied."""
        return bool(self.valid[self.active_hands].all())

    @property
    def key(self) -> tuple[str, int, int]:
        """Identifies the sample in a dataset: clip, first frame, length."""
        return self.clip_id, self.start, self.length

    @property
    def nbytes(self) -> int:
        """Memory of the arrays with one row per frame, which are nearly all of the sample."""
        frames = self.hands, self.object, self.joints_m, self.valid, self.contact
        return sum(array.nbytes for array in (*frames, *vars(self.distances).values()))

    @property
    def contact_map(self) -> np.ndarray:
        """(1024,) bool: points that an active hand touches; the contact map of Text2HOI."""
        return np.logical_or(self.contact[0], self.contact[1])

    def crop(self, start: int, length: int) -> "ClipSample":
        """Return ``length`` frames from ``start``, recentred, with the contact map and distances of these frames."""
        stop = start + length
        distances = self.distances.interval(start, stop)
        return replace(
            self,
            start=self.start + start,
            hands=self.hands[:, start:stop],
            object=self.object[start:stop],
            joints_m=self.joints_m[:, start:stop],
            valid=self.valid[:, start:stop],
            contact=contact_of(distances, len(self.points.points_m), self.contact_threshold_m),
            distances=distances,
        ).recentred()

    def recentred(self) -> "ClipSample":
        """Translate the model frame so that the object's origin is at zero in the first frame."""
        shift_m = self.object[0, OBJECT_POSITION].copy()
        hands, objects = self.hands.copy(), self.object.copy()
        hands[..., WRIST] -= shift_m
        objects[:, OBJECT_POSITION] -= shift_m
        old_from_new = np.eye(4)
        old_from_new[:3, 3] = shift_m
        return replace(
            self,
            hands=hands,
            object=objects,
            joints_m=self.joints_m - shift_m,
            world_from_model=self.world_from_model @ old_from_new,
        )


class HoiDataset(Dataset):
    """The clips of one subset as :class:`ClipSample`, at most ``max_frames`` long. Samples are kept in memory.

    Args:
        split: subset of the chosen split.
        max_frames: length of the window.
        crop: "random" samples a window from (seed, epoch, index), so that it does not depend on the order of access;
            "start" takes the first frames.
    """

    def __init__(
        self, annotated: AnnotatedStore, split: str, max_frames: int = MAX_FRAMES, crop: Crop = "random", seed: int = 0
    ) -> None:
        if crop not in ("random", "start"):
            raise BadInput("HoiDataset crop", '"random" or "start"', repr(crop), "choose one of them")
        self.annotated, self.split = annotated, split
        self.max_frames, self.crop, self.seed = max_frames, crop, seed
        self.epoch = 0
        self.ids = list(annotated.ids(split))
        self._samples: dict[str, ClipSample] = {}

    def __len__(self) -> int:
        return len(self.ids)

    def __iter__(self) -> Iterator[ClipSample]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> ClipSample:
        whole = self.whole(self.ids[index])
        surplus_frames = whole.length - self.max_frames
        if surplus_frames <= 0:
            return whole
        if self.crop == "start":
            return whole.crop(0, self.max_frames)
        generator = np.random.default_rng([self.seed, self.epoch, index])
        return whole.crop(int(generator.integers(0, surplus_frames + 1)), self.max_frames)

    def set_epoch(self, epoch: int) -> None:
        """Choose the random windows of the next accesses."""
        self.epoch = epoch

    def whole(self, clip_id: str) -> ClipSample:
        """Return the uncropped sample of a clip."""
        if clip_id not in self._samples:
            self._samples[clip_id] = load_sample(self.annotated, clip_id)
        return self._samples[clip_id]


def load_sample(annotated: AnnotatedStore, clip_id: str) -> ClipSample:
    """Load a whole clip as a sample in the model frame."""
    clip = annotated.clip(clip_id)
    hand_type = annotated.hand_type(clip_id)
    active_hands = np.array([hand_type in (side, "both") for side in SIDES])
    rotation = upright(clip.gravity)
    origin = clip.object.translation_m[0].astype(np.float64)
    points = _points(annotated, annotated.object_key(clip_id))
    distances = _active_entries(annotated.distances(clip_id), active_hands)
    tracks = [clip.hands[side] for side in SIDES]
    joints_m = [annotated.joints(clip_id, side)[clip.hands[side].last_valid_frames] for side in SIDES]
    joints = np.stack([(positions - origin) @ rotation.T for positions in joints_m])
    return ClipSample(
        clip_id=clip_id,
        dataset=clip.dataset,
        verb=annotated.verb(clip_id),
        object_words=clip.object_words,
        object_key=annotated.object_key(clip_id),
        object_model=clip.object.model,
        hand_type=hand_type,
        sentences=tuple(annotated.sentences(clip_id)),
        synthetic=clip.synthetic,
        start=0,
        hands=np.stack([hand_features(track.with_last_valid_pose(), rotation, origin) for track in tracks]),
        object=object_features(clip.object, rotation, origin),
        joints_m=joints.astype(np.float32),
        valid=np.stack([track.valid for track in tracks]).astype(bool),
        active_hands=active_hands,
        betas=np.stack([track.mean_betas for track in tracks]).astype(np.float32),
        template_m=_templates(tracks),
        text=np.asarray(annotated.text_embedding(clip_id), dtype=np.float32),
        points=points,
        contact=contact_of(distances, len(points.points_m), annotated.contact_threshold_m),
        contact_threshold_m=annotated.contact_threshold_m,
        distances=distances,
        world_from_model=_world_from_model(rotation, origin),
        gravity_known=clip.gravity is not None,
    )


def contact_of(distances: DistanceEntries, n_points: int, threshold_m: float) -> np.ndarray:
    """Return (2, point) bool: points closer than ``threshold_m`` to a joint of each side in any frame."""
    contact = np.zeros((2, n_points), dtype=bool)
    near = distances.distance_m < threshold_m
    contact[distances.side[near], distances.point[near]] = True
    return contact


def _world_from_model(rotation: np.ndarray, origin: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.T, origin
    return matrix


def _templates(tracks: list[HandTrack]) -> np.ndarray | None:
    left, right = (track.template_m for track in tracks)
    return None if left is None or right is None else np.stack((left, right)).astype(np.float32)


def _points(annotated: AnnotatedStore, object_key: str) -> ObjectPoints:
    stored = annotated.points(object_key)
    return ObjectPoints(
        np.asarray(stored.points_m, np.float32), np.asarray(stored.normals, np.float32), np.asarray(stored.part)
    )


def _active_entries(stored: Any, active_hands: np.ndarray) -> DistanceEntries:
    """Select the entries of the active hands, sorted by frame, with 16-bit indices to save memory."""
    index = {name: np.asarray(getattr(stored, name), np.int16) for name in ("side", "frame", "joint", "point")}
    entries = DistanceEntries(**index, distance_m=np.asarray(stored.distance_m, np.float32))
    entries = entries.select(active_hands[entries.side])
    return entries.select(np.argsort(entries.frame, kind="stable"))


@dataclass(frozen=True, kw_only=True)
class ClipBatch(RequestBatch):
    """Recorded clips padded with zeros to the longest one. Axes (clip, side, frame, ...); ``text`` (B, form, 512)."""

    samples: tuple[ClipSample, ...]
    hands: Tensor  # (B, 2, F, 99)
    object: Tensor  # (B, F, 10)
    joints_m: Tensor  # (B, 2, F, 21, 3)
    present: Tensor  # (B, 2, F) bool: the side is active and tracked
    contact: Tensor  # (B, 2, N) bool
    contact_threshold_m: float  # of all clips
    chosen: Tensor  # (B, K) int64: the frames of geometric losses
    entries: Tensor  # (entry, 5) int64: clip, side, index in ``chosen``, joint, point
    entry_distance_m: Tensor  # (entry,)

    @property
    def contact_map(self) -> Tensor:
        """(B, N) float32, 0 or 1: contact map of both hands together."""
        return self.contact.any(1).float()


def collate(samples: Sequence[ClipSample], sight: FrameSelection | None = None) -> ClipBatch:
    """Pad samples to one batch. sight: frames and distance entries of geometric losses; by default none."""
    lengths = np.array([sample.length for sample in samples])
    shared = conditions(samples, [sample.object_model for sample in samples], lengths)
    n_frames = int(lengths.max())
    sight = sight or FrameSelection.nothing(len(samples))
    entries, distance = sight.entries([sample.distances for sample in samples])
    arrays = {
        "text": np.stack([sample.text for sample in samples]),
        "hands": _padded([sample.hands for sample in samples], 1, n_frames),
        "object": _padded([sample.object for sample in samples], 0, n_frames),
        "joints_m": _padded([sample.joints_m for sample in samples], 1, n_frames),
        "contact": np.stack([sample.contact for sample in samples]),
        "chosen": sight.frames,
        "entries": entries,
        "entry_distance_m": distance,
    }
    tensors: dict[str, Any] = {name: torch.from_numpy(array) for name, array in arrays.items()}
    valid = torch.from_numpy(_padded([sample.valid for sample in samples], 1, n_frames))
    present = valid & shared["active_hands"][:, :, None] & shared["frames"][:, None]
    threshold_m = _batch_threshold_m(samples)
    return ClipBatch(samples=tuple(samples), present=present, contact_threshold_m=threshold_m, **shared, **tensors)


def _padded(arrays: Sequence[np.ndarray], axis: int, n_frames: int) -> np.ndarray:
    """Stack arrays, each padded with zeros to ``n_frames`` along ``axis``."""
    shape = list(arrays[0].shape)
    shape[axis] = n_frames
    padded = np.zeros((len(arrays), *shape), arrays[0].dtype)
    for target, array in zip(padded, arrays, strict=True):
        target.swapaxes(0, axis)[: array.shape[axis]] = array.swapaxes(0, axis)
    return padded


def _batch_threshold_m(samples: Sequence[ClipSample]) -> float:
    thresholds_m = {sample.contact_threshold_m for sample in samples}
    if len(thresholds_m) > 1:
        raise BadInput("collate", "one contact threshold", f"{sorted(thresholds_m)} m", "batch one dataset at a time")
    return thresholds_m.pop()
