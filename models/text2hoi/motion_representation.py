"""The numbers that the diffusion network denoises: control points of a motion, and back to features per frame.

Text2HOI denoises features of every frame, hands in the world. ``MotionRepresentationConfig`` offers alternatives:

- Hands in the object's frame: a hand that does not slip on a moving object is constant.
- B-spline control points instead of frames (``models.common.spline``).
- Object rotation since the first frame, ``R(t) R(0)^T``, next to ``R(0)``. It does not depend on the axes of the mesh.
- Whitening of the object's trajectory with a smoothness prior. A shake of 3 cm then counts as much as a lift of 20 cm,
  and errors of the network come out smooth.

Shapes: B motions, F frames, K control points of a hand, L control points of the object.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from hoidata.batches.dataset import MAX_FRAMES, ClipSample
from hoidata.clips.features import OBJECT_FEATURES, OBJECT_HINGE, OBJECT_POSITION, OBJECT_ROTATION_6D
from hoidata.devices import send
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rot6d
from models.common.features import (
    OBJECT_START_6D,
    base_middle_m,
    hands_in_object_frame,
    hands_in_world,
    object_rotmat,
    placed_at,
    recentred,
)
from models.common.sampling import Motion
from models.common.spline import fit_spline, intervals_of, snapped_to_rest, spline_values, stacked_bases

# Features of an object that has not moved: position, 6D of the identity, hinge.
UNMOVED = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
# Smoothness prior: fraction of the variance that is independent per control point, and the standard deviation. The
# deviation keeps trajectories of a few centimetres above the normaliser's SMALLEST_SCALE.
ROUGH, DEVIATION = 0.3, 0.5


def turned_since_start(objects: Tensor) -> Tensor:
    """Object features (F, 16): rotations become relative to the first frame, whose rotation (6 numbers) is appended."""
    rotation = object_rotmat(objects)
    since_start_6d, start_6d = rotmat_to_rot6d(rotation @ rotation[0].T), rotmat_to_rot6d(rotation[:1])
    start_6d = start_6d.expand(len(objects), -1)
    return torch.cat((objects[:, OBJECT_POSITION], since_start_6d, objects[:, OBJECT_HINGE:], start_6d), -1)


def mean_start(rows: Tensor, mask: Tensor) -> Tensor:
    """First-frame rotations (B, 1, 3, 3): the mean over control points (B, L, 16) that ``mask`` (B, L) marks valid."""
    start_6d = (rows[..., OBJECT_START_6D] * mask[..., None]).sum(1, keepdim=True)
    return rot6d_to_rotmat(start_6d / mask.sum(1)[:, None, None])


def turned_from(rows: Tensor, start: Tensor) -> Tensor:
    """Object features (B, F, 10): the inverse of ``turned_since_start``, for first-frame rotations (B, 1, 3, 3)."""
    rotation = rotmat_to_rot6d(object_rotmat(rows) @ start)
    return torch.cat((rows[..., OBJECT_POSITION], rotation, rows[..., OBJECT_HINGE:OBJECT_FEATURES]), -1)


def whiten(rows: Tensor, reach: float) -> Tensor:
    """Control points (..., L, 10 or 16) decorrelated by the smoothness prior; first-frame rotations are unchanged.

    Args:
        reach: correlation length of the prior, in control points.
    """
    moved = rows[..., :OBJECT_FEATURES] - _as(UNMOVED, rows)
    # Multiplication by the inverse of the Cholesky factor decorrelates the control points.
    whitened = torch.linalg.solve_triangular(_as(smooth_root(rows.shape[-2], reach), rows), moved, upper=False)
    return torch.cat((whitened, rows[..., OBJECT_FEATURES:]), -1)


def unwhiten(rows: Tensor, reach: float) -> Tensor:
    """The inverse of :func:`whiten`."""
    moved = _as(smooth_root(rows.shape[-2], reach), rows) @ rows[..., :OBJECT_FEATURES]
    return torch.cat((moved + _as(UNMOVED, rows), rows[..., OBJECT_FEATURES:]), -1)


def _as(constant: Tensor, rows: Tensor) -> Tensor:
    """``constant`` with the device and dtype of ``rows``."""
    return send(constant, rows.device).to(rows.dtype)


@lru_cache(maxsize=256)
def smooth_root(rows: int, reach: float) -> Tensor:
    """Cholesky factor (rows, rows), lower triangular, of the smoothness prior's covariance.

    The factor of fewer rows is its upper left block, so padding in a batch does not change a motion.
    """
    position = torch.arange(rows, dtype=torch.float64)
    correlation = torch.exp(-0.5 * ((position[:, None] - position) / reach).square())
    covariance = (1 - ROUGH) * correlation + ROUGH * torch.eye(rows, dtype=torch.float64)
    return DEVIATION * torch.linalg.cholesky(covariance).float()


# How much of each feature counts as one metre of movement: 10 units of a 6D rotation, and 5 rad of a hinge (20 cm from
# the axis). Position, rotation and hinge of an object are snapped to rest independently. Fingers have many numbers,
# so each counts less.
OBJECT_REACH = (OBJECT_POSITION, 1.0), (OBJECT_ROTATION_6D, 10.0), (slice(OBJECT_HINGE, OBJECT_FEATURES), 5.0)
HAND_REACH = torch.tensor([1.0] * 3 + [10.0] * 6 + [40.0] * 90)
STILL_HINGE_RAD = 0.05  # a hinge whose whole range is smaller is fixed
REST_FRAMES = 8  # compared on either side of a gap between control points


@dataclass(frozen=True)
class MotionRepresentationConfig:
    """How a motion is written as numbers; the defaults are the paper's."""

    # Frames between two knots of the hands' splines; 0: one control point per frame.
    knot_frames: int = 0
    # Knots of the object per knot of the hands: an object may shake while the hands on it do not move.
    object_knots: int = 1
    # Frame in which hands are given.
    hand_frame: Literal["world", "object"] = "world"
    # The point whose trajectory is the object's position: the origin of its mesh, which may be anywhere, or the centre
    # of the bounding box of its base. A rotation in place moves the origin but not the centre, so position errors and
    # rotation errors do not add up to a wobble.
    object_reference_point: Literal["mesh_origin", "box_centre"] = "mesh_origin"
    # The object's rotation, or its rotation since the first frame with the first frame's rotation appended.
    object_rotation: Literal["absolute", "relative_to_start"] = "absolute"
    # Correlation length in frames of the smoothness prior by which object trajectories are whitened; 0: none.
    whitening_frames: float = 0.0
    # A generated object, or a hand on it, that stays within about this distance for half a second is snapped to rest;
    # 0: never. Movement of twice the distance is kept: a shake of 2 cm counts as rest, one of 2.5 cm does not.
    rest_threshold_m: float = 0.0


@dataclass(frozen=True)
class EncodedClip:
    """Control points of one recorded clip."""

    hands: Tensor  # (2, K, 99)
    object: Tensor  # (L, 10 or 16)
    present: Tensor  # (2, K) bool, control points that influence a frame with that hand


@dataclass(frozen=True)
class MotionRepresentation:
    """Converts features (B, 2, F, 99), (B, F, 10) to control points (B, 2, K, 99), (B, L, 10 or 16) and back."""

    config: MotionRepresentationConfig

    def sizes(self, n_frames: int) -> tuple[int, int]:
        """Numbers of control points (K, L) of a hand and of the object in a motion of ``n_frames``."""
        if not self.config.knot_frames:
            return n_frames, n_frames
        intervals = intervals_of(n_frames, self.config.knot_frames)
        return intervals + 3, intervals * self.config.object_knots + 3

    @property
    def object_features(self) -> int:
        """Features of one control point of the object."""
        return OBJECT_START_6D.stop if self.config.object_rotation == "relative_to_start" else OBJECT_FEATURES

    @property
    def max_sizes(self) -> tuple[int, int]:
        """Numbers of control points (K, L) of the longest motion."""
        return self.sizes(MAX_FRAMES)

    def valid_masks(self, counts: Sequence[int], device: torch.device) -> tuple[Tensor, Tensor]:
        """Masks (B, K) and (B, L) of the control points that motions of these frame counts have."""
        sizes = np.array([self.sizes(n) for n in counts])
        hand_mask, object_mask = (np.arange(size.max()) < size[:, None] for size in sizes.T)
        return send(torch.from_numpy(hand_mask), device), send(torch.from_numpy(object_mask), device)

    def encode(self, sample: ClipSample) -> EncodedClip:
        """Control points of a recorded clip."""
        hands, objects = recentred(torch.from_numpy(sample.hands), self.object_features_of(sample))
        present = torch.from_numpy(sample.valid & sample.active_hands[:, None])
        if self.config.hand_frame == "object":
            hands = hands_in_object_frame(hands[None], objects[None])[0]
        if self.config.object_rotation == "relative_to_start":
            objects = turned_since_start(objects)
        if not self.config.knot_frames:
            return EncodedClip(hands, self._whitened(objects), present)
        intervals = intervals_of(len(objects), self.config.knot_frames)
        hand_points = torch.stack([fit_spline(*hand, intervals) for hand in zip(hands, present, strict=True)])
        object_points = fit_spline(objects, torch.ones(len(objects)), intervals * self.config.object_knots)
        # A control point influences four intervals; it counts as present if any of their frames has the hand.
        influences = stacked_bases([len(objects)], [intervals], len(objects), torch.device("cpu"))[0].T > 0
        return EncodedClip(hand_points, self._whitened(object_points), (present.float() @ influences.T.float()) > 0)

    def reference_point_m(self, points_m: Tensor, part: Tensor) -> Tensor:
        """Reference point (..., 3) in the object's frame, from surface points (..., N, 3) and their part (..., N)."""
        if self.config.object_reference_point == "box_centre":
            return base_middle_m(points_m, part)
        return points_m.new_zeros((*points_m.shape[:-2], 3))

    def object_features_of(self, sample: ClipSample) -> Tensor:
        """Object features (F, 10) of a recorded clip, with the reference point as position."""
        points = torch.from_numpy(sample.points.points_m), torch.from_numpy(sample.points.part)
        return placed_at(torch.from_numpy(sample.object), self.reference_point_m(*points))

    def features_per_frame(self, hands: Tensor, objects: Tensor, counts: Sequence[int]) -> Motion:
        """Features per frame from control points; ``in_world`` and ``at_origin`` bring them to the model frame.

        Hands (B, 2, F, 99) are in the configured frame, the object's position is its reference point, and 6D rotations
        are not orthonormal yet.
        """
        objects, object_mask = self._unwhitened(objects), self.valid_masks(counts, objects.device)[1]
        # Every control point repeats the first frame's rotation; the mean is the best estimate.
        start = mean_start(objects, object_mask) if self.config.object_rotation == "relative_to_start" else None
        if not self.config.knot_frames:
            return hands, objects if start is None else turned_from(objects, start)
        n_frames = max(counts)
        knots = [intervals_of(n, self.config.knot_frames) for n in counts]
        hands = spline_values(hands, stacked_bases(list(counts), knots, n_frames, hands.device))
        knots = [n * self.config.object_knots for n in knots]
        objects = spline_values(objects, stacked_bases(list(counts), knots, n_frames, hands.device))
        return hands, objects if start is None else turned_from(objects, start)

    def snapped_to_rest(self, hands: Tensor, objects: Tensor, counts: Sequence[int]) -> Motion:
        """Control points of generated motions with slow drift removed; hands only if given in the object's frame."""
        if not (self.config.rest_threshold_m and self.config.knot_frames):
            return hands, objects
        hand_mask, object_mask = self.valid_masks(counts, hands.device)
        around = max(1, round(REST_FRAMES / self.config.knot_frames))
        if self.config.hand_frame == "object":
            reach = self.config.rest_threshold_m * send(HAND_REACH, hands.device)
            hands = snapped_to_rest(hands, hand_mask[:, None].expand(-1, 2, -1), reach, around)
        unwhitened, around = self._unwhitened(objects).clone(), around * self.config.object_knots
        for numbers, per_metre in OBJECT_REACH:
            reach = self.config.rest_threshold_m * per_metre
            unwhitened[..., numbers] = snapped_to_rest(unwhitened[..., numbers], object_mask, reach, around)
        unwhitened[..., OBJECT_HINGE] = _still_hinge(unwhitened[..., OBJECT_HINGE], object_mask)
        return hands, self._whitened(unwhitened)

    def _whitened(self, objects: Tensor) -> Tensor:
        return whiten(objects, self._reach) if self.config.whitening_frames else objects

    def _unwhitened(self, objects: Tensor) -> Tensor:
        return unwhiten(objects, self._reach) if self.config.whitening_frames else objects

    @property
    def _reach(self) -> float:
        """Control points of the object in ``whitening_frames``."""
        frames = self.config.knot_frames / self.config.object_knots if self.config.knot_frames else 1
        return self.config.whitening_frames / frames

    def at_origin(self, objects: Tensor, points_m: Tensor, part: Tensor) -> Tensor:
        """Object features (B, F, 10) with the mesh origin as position; points as in ``reference_point_m``."""
        return placed_at(objects, -self.reference_point_m(points_m, part))

    def in_world(self, hands: Tensor, objects: Tensor) -> Tensor:
        """Hands (B, 2, F, 99) of ``features_per_frame`` in the model frame."""
        return hands_in_world(hands, objects) if self.config.hand_frame == "object" else hands

    def in_object_frame(self, hands: Tensor, objects: Tensor) -> Tensor:
        """Hands (B, 2, F, 99) of ``features_per_frame`` in the object's frame."""
        return hands if self.config.hand_frame == "object" else hands_in_object_frame(hands, objects)


def _still_hinge(angle: Tensor, mask: Tensor) -> Tensor:
    """Hinge angles (B, L), radians, replaced by their mean if their range is below ``STILL_HINGE_RAD``."""
    highest, lowest = (angle.masked_fill(~mask, bound) for bound in (-math.inf, math.inf))
    moves = highest.amax(-1) - lowest.amin(-1) > STILL_HINGE_RAD
    mean = (angle * mask).sum(-1) / mask.sum(-1)
    return torch.where(moves[:, None], angle, mean[:, None])
