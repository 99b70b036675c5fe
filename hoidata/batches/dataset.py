"""Annotated clips as training samples: a torch Dataset with split, crop, padding and collate.

A sample lives in the *model frame*: the clip's world turned so that things fall along -z (where the gravity direction
is known) and moved so that the object's origin lies at zero in the first frame. The stored clips are never changed;
``world_from_model`` takes every sample back.

The layout of the features stands in ``hoidata.clips.features``. Sides are ordered left, right.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from hoidata.batches.requests import ObjectPoints, RequestBatch, conditions
from hoidata.batches.sight import Sight
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
    """One clip in the model frame; NumPy arrays, axes (side, frame, ...), metres and radians.

    hands (2, F, 99), object (F, 10), joints_m (2, F, 21, 3): features and true joints, with the clip's own hand shape.
    valid (2, F): frames in which a side was tracked; others have its last tracked pose (``HandTrack.held``).
    active_hands (2,): the sides that take part in the interaction.
    contact (2, 1024): points that came within ``contact_threshold_m``, the contact stage's, of a joint of that side.
    text (4, 512): features of the four sentences. betas (2, 10); template_m (2, 778, 3) personal rest meshes, or None.
    start: first frame within the clip. world_from_model (4, 4). gravity_known: whether the model's -z is down.
    """

    clip_id: str
    dataset: str
    verb: str | None
    object_words: str
    object_key: str
    object_model: ObjectModel
    hand_type: str
    sentences: tuple[str, ...]
    synthetic: bool
    start: int
    hands: np.ndarray
    object: np.ndarray
    joints_m: np.ndarray
    valid: np.ndarray
    active_hands: np.ndarray
    betas: np.ndarray
    template_m: np.ndarray | None
    text: np.ndarray
    points: ObjectPoints
    contact: np.ndarray
    contact_threshold_m: float
    distances: DistanceEntries
    world_from_model: np.ndarray
    gravity_known: bool = True

    @property
    def length(self) -> int:
        return len(self.object)

    @property
    def is_tracked(self) -> bool:
        """Whether the hands that take part are tracked in every frame, so that their motion can be copied."""
        return bool(self.valid[self.active_hands].all())

    @property
    def key(self) -> tuple[str, int, int]:
        """What tells it from all other samples of a dataset: its clip and which of its frames."""
        return self.clip_id, self.start, self.length

    @property
    def nbytes(self) -> int:
        """Memory of what it has for each frame, which is nearly all."""
        frames = self.hands, self.object, self.joints_m, self.valid, self.contact
        return sum(array.nbytes for array in (*frames, *vars(self.distances).values()))

    @property
    def contact_map(self) -> np.ndarray:
        """(1024,) bool contact map of Text2HOI: the points touched by any active hand."""
        return np.logical_or(self.contact[0], self.contact[1])

    def crop(self, start: int, length: int) -> "ClipSample":
        """``length`` frames from ``start``; contact map and distances are restricted to them. The frame stays."""
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
        """The same frames with the object's origin at zero in the first of them."""
        shift = self.object[0, OBJECT_POSITION].copy()
        hands, objects = self.hands.copy(), self.object.copy()
        hands[..., WRIST] -= shift
        objects[:, OBJECT_POSITION] -= shift
        move = np.eye(4)
        move[:3, 3] = shift
        return replace(
            self,
            hands=hands,
            object=objects,
            joints_m=self.joints_m - shift,
            world_from_model=self.world_from_model @ move,
        )


class HoiDataset(Dataset):
    """Clips of one split as :class:`ClipSample`, at most ``max_frames`` long.

    crop: "random" draws a window anew for every epoch (see ``set_epoch``) from (seed, epoch, index), so that the same
    seed gives the same windows in any order of access; "start" takes the first frames. Samples are kept in memory.
    """

    def __init__(
        self, annotated: AnnotatedStore, split: str, max_frames: int = MAX_FRAMES, crop: Crop = "random", seed: int = 0
    ) -> None:
        if crop not in ("random", "start"):
            raise BadInput("HoiDataset crop", '"random" or "start"', repr(crop), "name one of them")
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
        spare = whole.length - self.max_frames
        if spare <= 0:
            return whole
        if self.crop == "start":
            return whole.crop(0, self.max_frames)
        generator = np.random.default_rng([self.seed, self.epoch, index])
        return whole.crop(int(generator.integers(0, spare + 1)), self.max_frames)

    def set_epoch(self, epoch: int) -> None:
        """Choose which random windows the next accesses get."""
        self.epoch = epoch

    def whole(self, clip_id: str) -> ClipSample:
        """The uncropped sample of a clip."""
        if clip_id not in self._samples:
            self._samples[clip_id] = load_sample(self.annotated, clip_id)
        return self._samples[clip_id]


def load_sample(annotated: AnnotatedStore, clip_id: str) -> ClipSample:
    """The whole clip as a sample in the model frame."""
    clip = annotated.clip(clip_id)
    hand_type = annotated.hand_type(clip_id)
    active_hands = np.array([hand_type in (side, "both") for side in SIDES])
    rotation = upright(clip.gravity)
    origin = clip.object.translation_m[0].astype(np.float64)
    points = _points(annotated, annotated.object_key(clip_id))
    distances = _acting_entries(annotated.distances(clip_id), active_hands)
    tracks = [clip.hands[side] for side in SIDES]
    joints_m = [annotated.joints(clip_id, side)[clip.hands[side].shown_frames] for side in SIDES]
    joints = np.stack([(positions - origin) @ rotation.T for positions in joints_m])
    return ClipSample(
        clip_id=clip_id,
        dataset=clip.dataset,
        verb=clip.verb,
        object_words=clip.object_words,
        object_key=annotated.object_key(clip_id),
        object_model=clip.object.model,
        hand_type=hand_type,
        sentences=tuple(annotated.sentences(clip_id)),
        synthetic=clip.synthetic,
        start=0,
        hands=np.stack([hand_features(track.held(), rotation, origin) for track in tracks]),
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
    """(2, point) bool: points closer than ``threshold_m`` to a joint of each side in any frame of the entries."""
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


def _acting_entries(stored: Any, active_hands: np.ndarray) -> DistanceEntries:
    """Entries of the acting hands, in the order of their frames, in numbers as small as they are stored."""
    index = {name: np.asarray(getattr(stored, name), np.int16) for name in ("side", "frame", "joint", "point")}
    entries = DistanceEntries(**index, distance_m=np.asarray(stored.distance_m, np.float32))
    entries = entries.select(active_hands[entries.side])
    return entries.select(np.argsort(entries.frame, kind="stable"))


@dataclass(frozen=True, kw_only=True)
class ClipBatch(RequestBatch):
    """Recorded clips padded to the longest of them, with all a model may be asked of them (:class:`RequestBatch`).

    Axes (clip, side, frame, ...), padding is zero. hands (B, 2, F, 99), object (B, F, 10), joints_m (B, 2, F, 21, 3).
    text (B, 4, 512): the four sentences. present (B, 2, F): the side takes part and is tracked in the frame.
    contact (B, 2, N), at contact_threshold_m, which is that of all clips. chosen (B, K): the frames that losses of
    geometry see. entries: (entry, 5) int64 rows (clip, side, place among the chosen frames, joint, point) and their
    distances (entry,).
    """

    samples: tuple[ClipSample, ...]
    hands: Tensor
    object: Tensor
    joints_m: Tensor
    present: Tensor
    contact: Tensor
    contact_threshold_m: float
    chosen: Tensor
    entries: Tensor
    entry_distance_m: Tensor

    @property
    def contact_map(self) -> Tensor:
        """(B, N) contact map as 0 or 1, float32: both active hands together."""
        return self.contact.any(1).float()


def collate(samples: Sequence[ClipSample], sight: Sight | None = None) -> ClipBatch:
    """Samples to one padded batch. sight: the frames and distance entries that losses of geometry see; none without."""
    lengths = np.array([sample.length for sample in samples])
    asked = conditions(samples, [sample.object_model for sample in samples], lengths)
    n_frames = int(lengths.max())
    sight = sight or Sight.nothing(len(samples))
    rows, distance = sight.entries([sample.distances for sample in samples])
    arrays = {
        "text": np.stack([sample.text for sample in samples]),
        "hands": _padded([sample.hands for sample in samples], 1, n_frames),
        "object": _padded([sample.object for sample in samples], 0, n_frames),
        "joints_m": _padded([sample.joints_m for sample in samples], 1, n_frames),
        "contact": np.stack([sample.contact for sample in samples]),
        "chosen": sight.frames,
        "entries": rows,
        "entry_distance_m": distance,
    }
    tensors: dict[str, Any] = {name: torch.from_numpy(array) for name, array in arrays.items()}
    valid = torch.from_numpy(_padded([sample.valid for sample in samples], 1, n_frames))
    present = valid & asked["active_hands"][:, :, None] & asked["frames"][:, None]
    threshold_m = _batch_threshold_m(samples)
    return ClipBatch(samples=tuple(samples), present=present, contact_threshold_m=threshold_m, **asked, **tensors)


def _padded(arrays: Sequence[np.ndarray], axis: int, n_frames: int) -> np.ndarray:
    """The arrays in one, each with zeros up to ``n_frames`` along ``axis``."""
    shape = list(arrays[0].shape)
    shape[axis] = n_frames
    padded = np.zeros((len(arrays), *shape), arrays[0].dtype)
    for row, array in zip(padded, arrays, strict=True):
        row.swapaxes(0, axis)[: array.shape[axis]] = array.swapaxes(0, axis)
    return padded


def _batch_threshold_m(samples: Sequence[ClipSample]) -> float:
    found = {sample.contact_threshold_m for sample in samples}
    if len(found) > 1:
        raise BadInput("collate", "one contact threshold", f"{sorted(found)} m", "batch one dataset at a time")
    return found.pop()
