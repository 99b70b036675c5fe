"""Data augmentation: recorded clips with longer, shorter or redirected paths, scaled rotations and warped time.

With a few hundred clips, contact map, verb and length identify a clip. A network that has memorised the clips ignores
the motion that it is to denoise. Augmentation changes what the condition does not determine.
"""

import math
from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np
import torch
from cachetools import LRUCache, cachedmethod
from scipy.spatial.distance import cdist

from hoidata.batches.dataset import ClipSample, HoiDataset, contact_of
from hoidata.clips.features import OBJECT_HINGE, OBJECT_POSITION
from hoidata.geometry.rotations import rotmat_to_rot6d, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands.model import N_JOINTS
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

# Largest changes: log scale of paths and of rotations, direction of paths in radians, relative speed.
PATH, ROTATION, DIRECTION_RAD, SPEED = 0.2, 0.15, 0.35, 0.1
MAX_CACHE_BYTES = 4 << 30  # some 9,000 copies of 150 frames
# A larger rotation is not scaled: near half a circle the axis becomes ambiguous.
MAX_SCALED_ROTATION_RAD = 2.4


@dataclass(frozen=True)
class Augmentation:
    """Creates ``count`` augmented copies of every clip of ``dataset``, with a cache of recent ones.

    Copies keep hand poses relative to the object, contact, hinge angles and length. Each copy of a clip longer than
    ``dataset.max_frames`` has a fixed window, so that a training sees the same copies again.
    """

    dataset: HoiDataset
    count: int
    cache: LRUCache = field(default_factory=lambda: LRUCache(MAX_CACHE_BYTES, attrgetter("nbytes")))

    @cachedmethod(lambda self: self.cache, key=lambda self, clip_id, number: (clip_id, number))
    def copy_of(self, clip_id: str, number: int) -> ClipSample:
        """The augmented copy with this number, from 1."""
        sample, seed = self.dataset.whole(clip_id), [number, 0, *clip_id.encode()]
        spare = sample.length - self.dataset.max_frames
        if spare > 0:
            start = np.random.default_rng([*seed, 1]).integers(0, spare + 1) if self.dataset.crop == "random" else 0
            sample = sample.crop(int(start), self.dataset.max_frames)
        return augment(sample, np.random.default_rng(seed), number)


def augment(sample: ClipSample, random: np.random.Generator, number: int) -> ClipSample:
    """One augmented copy; ``number`` becomes part of its name.

    Values between two frames are interpolated linearly; distance entries are those of the closest frame.
    """
    moments = warped_moments(sample.length, random)
    objects = torch.from_numpy(sample.object)
    hands = hands_in_object_frame(torch.from_numpy(sample.hands)[None], objects[None])[0]
    joints = to_object_frame(torch.from_numpy(sample.joints_m), objects.expand(2, -1, -1))
    centre = base_middle_m(torch.from_numpy(sample.points.points_m), torch.from_numpy(sample.points.part))
    # The path of the box centre is changed, so that a scaled rotation does not move the object.
    path = proper_object(at_moments(placed_at(objects, centre), moments))
    moved_objects = placed_at(augmented_path(path, random), -centre)
    before, after = np.floor(moments).astype(int), np.ceil(moments).astype(int)
    world = proper_hands(hands_in_world(at_moments(hands, moments, 1)[None], moved_objects[None])[0])
    # Joints are interpolated in the object's frame, then moved with the new path.
    rotated = at_moments(joints, moments, 1) @ object_rotmat(moved_objects).transpose(-1, -2)
    joints_m = rotated + moved_objects[:, None, OBJECT_POSITION]
    distances = entries_at(sample.distances, np.rint(moments).astype(int))
    return replace(
        sample,
        clip_id=f"{sample.clip_id} copy {number}",
        hands=world.numpy(),
        object=moved_objects.numpy(),
        joints_m=joints_m.numpy(),
        valid=sample.valid[:, before] & sample.valid[:, after],
        contact=contact_of(distances, len(sample.points.points_m), sample.contact_threshold_m),
        distances=distances,
    )


def scaled_contact(sample: ClipSample, factor: float, chosen: np.ndarray) -> np.ndarray:
    """The contact map (2, K) bool of the sampled points ``chosen`` (K,) on the object scaled by ``factor``.

    The hand keeps its size: every touching joint stays in metres as far above the same place of the surface. So its
    reach covers more of a small object than of a large one.
    """
    points, normals, part = sample.points.points_m * factor, sample.points.normals, sample.points.part
    side, point, gap_m = nearest_points(sample.distances)
    joints_m = points[point] + gap_m[:, None] * normals[point]
    distance_m = np.where(part[point, None] == part[chosen], cdist(joints_m, points[chosen]), np.inf)
    touched = distance_m < sample.contact_threshold_m
    return np.stack([touched[side == index].any(axis=0) for index in range(2)])


def nearest_points(distances: DistanceEntries) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points that are nearest to a touching joint in a frame: side, point and the smallest distance in metres, (K,)."""
    by_distance = distances.select(np.argsort(distances.distance_m, kind="stable"))
    side, frame, joint = (getattr(by_distance, name).astype(np.int64) for name in ("side", "frame", "joint"))
    nearest = by_distance.select(np.sort(np.unique((frame * 2 + side) * N_JOINTS + joint, return_index=True)[1]))
    first = np.unique(nearest.point.astype(np.int64) * 2 + nearest.side, return_index=True)[1]
    return nearest.side[first], nearest.point[first], nearest.distance_m[first]


def warped_moments(length: int, random: np.random.Generator) -> np.ndarray:
    """Time warp: for each frame of a copy, the time in the clip in frames (length,); first and last are fixed."""
    time = np.linspace(0, 1, length)
    first, second = random.uniform(-SPEED, SPEED, 2)
    warped = time + first * np.sin(math.pi * time) / math.pi + second * np.sin(2 * math.pi * time) / (2 * math.pi)
    return np.clip(warped, 0, 1) * (length - 1)


def augmented_path(objects: torch.Tensor, random: np.random.Generator) -> torch.Tensor:
    """Object features (F, 10) with random path and rotations; their position is the object's box centre."""
    horizontal, vertical, angle_factor = np.exp(random.uniform(-1, 1, 3) * (PATH, PATH, ROTATION))
    yaw = rotvec_to_rotmat(np.array([0.0, 0.0, random.uniform(-DIRECTION_RAD, DIRECTION_RAD)]))
    yaw = yaw * (horizontal, horizontal, vertical)
    start = objects[:1, OBJECT_POSITION]
    position = start + (objects[:, OBJECT_POSITION] - start) @ torch.from_numpy(yaw).to(objects).T
    rotation = object_rotmat(objects)
    rotation_vector = rotmat_to_rotvec(rotation @ rotation[0].T)
    if rotation_vector.norm(dim=-1).max() < MAX_SCALED_ROTATION_RAD:
        rotation = rotvec_to_rotmat(rotation_vector * angle_factor) @ rotation[0]
    return torch.cat((position, rotmat_to_rot6d(rotation), objects[:, OBJECT_HINGE:]), -1)


def at_moments(values: torch.Tensor, moments: np.ndarray, axis: int = 0) -> torch.Tensor:
    """Linear interpolation of ``values`` at times in frames along ``axis``."""
    before = np.floor(moments).astype(int)
    fraction = torch.from_numpy(moments - before).to(values).reshape(-1, *[1] * (values.ndim - 1 - axis))
    after = np.ceil(moments).astype(int)
    first, second = (values.index_select(axis, torch.from_numpy(frames)) for frames in (before, after))
    return first + fraction * (second - first)


def entries_at(entries: DistanceEntries, frames: np.ndarray) -> DistanceEntries:
    """Distance entries, ordered by frame, of a clip that consists of these frames (F,) of the original."""
    first, last = (np.searchsorted(entries.frame, frames, side) for side in ("left", "right"))
    counts = last - first
    indices = np.arange(counts.sum()) + np.repeat(first - np.concatenate(([0], counts.cumsum()[:-1])), counts)
    chosen = entries.select(indices)
    return replace(chosen, frame=np.repeat(np.arange(len(frames)), counts).astype(chosen.frame.dtype))
