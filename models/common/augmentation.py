"""Recorded clips as they might have been: paths longer, shorter and to another side, turns larger, moments earlier.

Of a few hundred clips a contact map, a verb and a length name one; a network that has learnt them by name looks away
from what it is to denoise. What its condition cannot know it has to look for.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from cachetools import LRUCache, cachedmethod

from hoidata.batches.dataset import ClipSample, HoiDataset, contact_of
from hoidata.clips.features import OBJECT_HINGE, OBJECT_POSITION
from hoidata.geometry.rotations import rotmat_to_rot6d, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.store.distances import DistanceEntries
from models.common.features import (
    base_middle_m,
    hands_in_object_frame,
    hands_in_world,
    object_rotmat,
    placed_at,
    proper_hands,
    proper_object,
    to_object_frame,
)

# Logarithms of how much longer paths and turns become, radians of where paths lead, changes of speed: at most.
PATH, TURN, SIDE_RAD, SPEED = 0.2, 0.15, 0.35, 0.1
MOST_BYTES = 4 << 30  # some 9,000 copies of 150 frames
# A turn that comes near to half a circle is left as it is: beyond that its axis is another one.
LARGEST_TURN_RAD = 2.4


@dataclass(frozen=True)
class Augmentation:
    """Makes ``count`` augmented copies of every clip of ``dataset`` and keeps the last that were asked for.

    A copy has the clip's hands, contact, hinge angles and length; of a clip longer than a batch takes, it has a window
    of its own, so that a training meets the same copies again. Hands go with the object as they did.
    """

    dataset: HoiDataset
    count: int
    made: LRUCache = field(default_factory=lambda: LRUCache(MOST_BYTES, _bytes))

    @cachedmethod(lambda self: self.made, key=lambda self, clip_id, number: (clip_id, number))
    def copy_of(self, clip_id: str, number: int) -> ClipSample:
        """The augmented copy of that number, from 1."""
        sample, seed = self.dataset.whole(clip_id), [number, 0, *clip_id.encode()]
        spare = sample.length - self.dataset.max_frames
        if spare > 0:
            start = np.random.default_rng([*seed, 1]).integers(0, spare + 1) if self.dataset.crop == "random" else 0
            sample = sample.crop(int(start), self.dataset.max_frames)
        return augment(sample, np.random.default_rng(seed), number)


def _bytes(sample: ClipSample) -> int:
    return sample.nbytes


def augment(sample: ClipSample, random: np.random.Generator, number: int) -> ClipSample:
    """One augmented copy, drawn from ``random``; ``number`` becomes part of its name.

    Between two frames all is on straight lines, but for distances to points, which are those of the nearer frame.
    """
    moments = warped_moments(sample.length, random)
    thing = torch.from_numpy(sample.object)
    hands = hands_in_object_frame(torch.from_numpy(sample.hands)[None], thing[None])[0]
    joints = to_object_frame(torch.from_numpy(sample.joints_m), thing.expand(2, -1, -1))
    middle = base_middle_m(torch.from_numpy(sample.points.points_m), torch.from_numpy(sample.points.part))
    path = proper_object(at_moments(placed_at(thing, middle), moments))
    moved = placed_at(augmented_path(path, random), -middle)
    before, after = np.floor(moments).astype(int), np.ceil(moments).astype(int)
    world = proper_hands(hands_in_world(at_moments(hands, moments, 1)[None], moved[None])[0])
    placed = at_moments(joints, moments, 1) @ object_rotmat(moved).transpose(-1, -2) + moved[:, None, OBJECT_POSITION]
    distances = entries_at(sample.distances, np.rint(moments).astype(int))
    return replace(
        sample,
        clip_id=f"{sample.clip_id} copy {number}",
        hands=world.numpy(),
        object=moved.numpy(),
        joints_m=placed.numpy(),
        valid=sample.valid[:, before] & sample.valid[:, after],
        contact=contact_of(distances, len(sample.points.points_m), sample.contact_threshold_m),
        distances=distances,
    )


def warped_moments(length: int, random: np.random.Generator) -> np.ndarray:
    """(length,) frames of a clip, from its first to its last, that the frames of a copy show."""
    share = np.linspace(0, 1, length)
    first, second = random.uniform(-SPEED, SPEED, 2)
    moved = share + first * np.sin(math.pi * share) / math.pi + second * np.sin(2 * math.pi * share) / (2 * math.pi)
    return np.clip(moved, 0, 1) * (length - 1)


def augmented_path(thing: torch.Tensor, random: np.random.Generator) -> torch.Tensor:
    """Object features (F, 10), their position that of the object's middle, with another path and other turns."""
    side, up, turn = np.exp(random.uniform(-1, 1, 3) * (PATH, PATH, TURN))
    yaw = rotvec_to_rotmat(np.array([0.0, 0.0, random.uniform(-SIDE_RAD, SIDE_RAD)])) * (side, side, up)
    start = thing[:1, OBJECT_POSITION]
    position = start + (thing[:, OBJECT_POSITION] - start) @ torch.from_numpy(yaw).to(thing).T
    rotation = object_rotmat(thing)
    turned = rotmat_to_rotvec(rotation @ rotation[0].T)
    if turned.norm(dim=-1).max() < LARGEST_TURN_RAD:
        rotation = rotvec_to_rotmat(turned * turn) @ rotation[0]
    return torch.cat((position, rotmat_to_rot6d(rotation), thing[:, OBJECT_HINGE:]), -1)


def at_moments(rows: torch.Tensor, moments: np.ndarray, axis: int = 0) -> torch.Tensor:
    """Rows at moments between frames of ``axis``, on straight lines."""
    before = np.floor(moments).astype(int)
    share = torch.from_numpy(moments - before).to(rows).reshape(-1, *[1] * (rows.ndim - 1 - axis))
    first, second = (rows.index_select(axis, torch.from_numpy(own)) for own in (before, np.ceil(moments).astype(int)))
    return first + share * (second - first)


def entries_at(entries: DistanceEntries, frames: np.ndarray) -> DistanceEntries:
    """Entries, in the order of their frames, of a clip that shows these frames (F,) one after the other."""
    first, last = (np.searchsorted(entries.frame, frames, side) for side in ("left", "right"))
    counts = last - first
    rows = np.arange(counts.sum()) + np.repeat(first - np.concatenate(([0], counts.cumsum()[:-1])), counts)
    chosen = entries.select(rows)
    return replace(chosen, frame=np.repeat(np.arange(len(frames)), counts).astype(chosen.frame.dtype))
