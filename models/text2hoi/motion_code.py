"""What the diffusion network denoises: the numbers that stand for a motion, and the way back.

Text2HOI denoises the features of every frame, hands in the world. Two switches change that: hands may be given in the
frame the object has at the same moment, where a hand that holds still on a moving object is constant; and curves may
stand for frames, as control points of B-splines (``models.common.spline``).

Two more make verbs alike in the rows of an object. A turn of the object in the world, ``R(t) R(0)^T``, is the same
whatever its mesh calls front or up; ``R(0)`` stands beside it. And rows of a path are nearly the same as those before:
a shake of 3 cm hardly counts beside a lift of 20. Whitened rows, each what the smooth course of those before does not
say, give slow and quick movement the same weight, and what a network gets wrong in them comes out smooth.
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
from models.common.spline import fit_spline, intervals_of, settled, spline_values, stacked_bases

# An object that has not moved: position, 6D of no turn, hinge.
UNMOVED = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
# Share of a row's variance that no neighbour tells; and the deviation of a row, which keeps those of a path of some
# centimetres above the smallest spread a normaliser knows.
ROUGH, DEVIATION = 0.3, 0.5


def turned_since_start(thing: Tensor) -> Tensor:
    """Object features (F, 10) as rows (F, 16): turned since the first frame, and how it lay in that."""
    rotation = object_rotmat(thing)
    turn, start = (rotmat_to_rot6d(own) for own in (rotation @ rotation[0].T, rotation[:1].expand_as(rotation)))
    return torch.cat((thing[:, OBJECT_POSITION], turn, thing[:, OBJECT_HINGE:], start), -1)


def mean_start(rows: Tensor, there: Tensor) -> Tensor:
    """(B, 1, 3, 3) rotations of the first frame: the mean of what the rows (B, L, 16) of ``there`` (B, L) say."""
    said = (rows[..., OBJECT_START_6D] * there[..., None]).sum(1, keepdim=True)
    return rot6d_to_rotmat(said / there.sum(1)[:, None, None])


def turned_from(rows: Tensor, start: Tensor) -> Tensor:
    """Object features (B, F, 10) of rows (B, F, 16) and first rotations (B, 1, 3, 3)."""
    rotation = rotmat_to_rot6d(object_rotmat(rows) @ start)
    return torch.cat((rows[..., OBJECT_POSITION], rotation, rows[..., OBJECT_HINGE:OBJECT_FEATURES]), -1)


def whiten(rows: Tensor, reach: float) -> Tensor:
    """Rows (..., L, 10 or 16) as what is new in each. reach: rows over which a path is alike."""
    moved = rows[..., :OBJECT_FEATURES] - _as(UNMOVED, rows)
    new = torch.linalg.solve_triangular(_as(smooth_root(rows.shape[-2], reach), rows), moved, upper=False)
    return torch.cat((new, rows[..., OBJECT_FEATURES:]), -1)


def unwhiten(rows: Tensor, reach: float) -> Tensor:
    """The inverse of :func:`whiten`."""
    moved = _as(smooth_root(rows.shape[-2], reach), rows) @ rows[..., :OBJECT_FEATURES]
    return torch.cat((moved + _as(UNMOVED, rows), rows[..., OBJECT_FEATURES:]), -1)


def _as(known: Tensor, rows: Tensor) -> Tensor:
    """What is known beforehand, of the device and kind of ``rows``."""
    return send(known, rows.device).to(rows.dtype)


@lru_cache(maxsize=256)
def smooth_root(rows: int, reach: float) -> Tensor:
    """(rows, rows) lower triangular, the Cholesky factor of the covariance of smooth rows.

    Of fewer rows it is the upper left part: a motion's rows do not depend on how long others of its batch are.
    """
    place = torch.arange(rows, dtype=torch.float64)
    alike = torch.exp(-0.5 * ((place[:, None] - place) / reach).square())
    covariance = (1 - ROUGH) * alike + ROUGH * torch.eye(rows, dtype=torch.float64)
    return DEVIATION * torch.linalg.cholesky(covariance).float()


# What is like a metre of movement: 0.1 of a rotation's numbers per centimetre, a hinge's angle at 20 cm from it, and
# fingers, of which there are many, more. Place, turn and hinge of an object come to rest each for itself.
OBJECT_REACH = (OBJECT_POSITION, 1.0), (OBJECT_ROTATION_6D, 10.0), (slice(OBJECT_HINGE, OBJECT_FEATURES), 5.0)
HAND_REACH = torch.tensor([1.0] * 3 + [10.0] * 6 + [40.0] * 90)
STILL_HINGE_RAD = 0.05  # a hinge that nowhere moves by more stands still
REST_FRAMES = 8  # before and after, in which what is at rest stays where it is


@dataclass(frozen=True)
class MotionCodeConfig:
    """knot_frames: of the hands' splines; 0: a row for every frame, as in the paper. object_knots: knots of the object
    per knot of the hands; it may shake while the hands on it keep still. hand_frame: where hands are given. rest_m: an
    object, or a hand on it, that is generated within about this of one place for half a second stands still there
    (0: as generated), and so does a hinge that nowhere moves by three degrees. What moves by twice as much keeps its
    way: a shake of 2 cm from end to end is at rest, one of 2.5 cm is not.

    object_place: which point of an object its position is, and hands in its frame are measured from: the origin of its
    mesh, which may lie anywhere, or the middle of the box about the sampled points of its base. An object that is
    turned in one place keeps its middle there; its origin moves, and what is wrong of the one and of the other adds up
    to a wobble.

    object_turn: an object's rotation, or how it has turned in the world since the first frame and, beside that, how it
    lay there. whitening_frames: an object's rows are what is new in each beside a course that changes in about so many
    frames (0: the course itself).
    """

    knot_frames: int = 0
    object_knots: int = 1
    hand_frame: Literal["world", "object"] = "world"
    object_place: Literal["origin", "box"] = "origin"
    object_turn: Literal["absolute", "since start"] = "absolute"
    whitening_frames: float = 0.0
    rest_m: float = 0.0


@dataclass(frozen=True)
class CodedClip:
    """One recorded clip: hands (2, K, 99), object (L, 10 or 16), and where each hand is there (2, K) bool."""

    hands: Tensor
    object: Tensor
    present: Tensor


@dataclass(frozen=True)
class MotionCode:
    """Motions of hands (B, 2, F, 99) and object (B, F, 10) as rows (B, 2, K, 99) and (B, L, 10 or 16), and back."""

    config: MotionCodeConfig

    def sizes(self, n_frames: int) -> tuple[int, int]:
        """Rows of a hand and of the object in a motion of ``n_frames``."""
        if not self.config.knot_frames:
            return n_frames, n_frames
        intervals = intervals_of(n_frames, self.config.knot_frames)
        return intervals + 3, intervals * self.config.object_knots + 3

    @property
    def object_features(self) -> int:
        """Numbers in a row of the object."""
        return OBJECT_START_6D.stop if self.config.object_turn == "since start" else OBJECT_FEATURES

    @property
    def largest(self) -> tuple[int, int]:
        """Rows of the longest motion there can be."""
        return self.sizes(MAX_FRAMES)

    def rows(self, counts: Sequence[int], device: torch.device) -> tuple[Tensor, Tensor]:
        """(B, K) and (B, L) bool: the rows that motions of so many frames have."""
        sizes = np.array([self.sizes(n) for n in counts])
        hand, thing = (send(torch.from_numpy(np.arange(own.max()) < own[:, None]), device) for own in sizes.T)
        return hand, thing

    def encode(self, sample: ClipSample) -> CodedClip:
        """A recorded clip's rows."""
        hands, thing = recentred(torch.from_numpy(sample.hands), self.placed(sample))
        present = torch.from_numpy(sample.valid & sample.active_hands[:, None])
        if self.config.hand_frame == "object":
            hands = hands_in_object_frame(hands[None], thing[None])[0]
        if self.config.object_turn == "since start":
            thing = turned_since_start(thing)
        if not self.config.knot_frames:
            return CodedClip(hands, self._whitened(thing), present)
        intervals = intervals_of(len(thing), self.config.knot_frames)
        curves = torch.stack([fit_spline(hand, own, intervals) for hand, own in zip(hands, present, strict=True)])
        objects = fit_spline(thing, torch.ones(len(thing)), intervals * self.config.object_knots)
        # A control point moves four intervals; it is there where the hand is in any frame of them.
        touched = stacked_bases([len(thing)], [intervals], len(thing), torch.device("cpu"))[0].T > 0
        return CodedClip(curves, self._whitened(objects), (present.float() @ touched.T.float()) > 0)

    def place_m(self, points_m: Tensor, part: Tensor) -> Tensor:
        """(..., 3) the point whose place an object's position is, in its frame; points (..., N, 3), part (..., N)."""
        if self.config.object_place == "box":
            return base_middle_m(points_m, part)
        return points_m.new_zeros((*points_m.shape[:-2], 3))

    def placed(self, sample: ClipSample) -> Tensor:
        """(F, 10) a recorded clip's object, its position that of ``place_m``."""
        points = torch.from_numpy(sample.points.points_m), torch.from_numpy(sample.points.part)
        return placed_at(torch.from_numpy(sample.object), self.place_m(*points))

    def curves(self, hands: Tensor, objects: Tensor, counts: Sequence[int]) -> Motion:
        """Features of every frame, hands in the frame they are coded in; the 6D as they come, not made proper.

        The object's position is that of ``place_m``; ``at_origin`` makes it the origin's.
        """
        objects, there = self._course(objects), self.rows(counts, objects.device)[1]
        start = mean_start(objects, there) if self.config.object_turn == "since start" else None
        if not self.config.knot_frames:
            return hands, objects if start is None else turned_from(objects, start)
        n_frames = max(counts)
        knots = [intervals_of(n, self.config.knot_frames) for n in counts]
        hands = spline_values(hands, stacked_bases(list(counts), knots, n_frames, hands.device))
        knots = [n * self.config.object_knots for n in knots]
        objects = spline_values(objects, stacked_bases(list(counts), knots, n_frames, hands.device))
        return hands, objects if start is None else turned_from(objects, start)

    def settled(self, hands: Tensor, objects: Tensor, counts: Sequence[int]) -> Motion:
        """Rows of generated motions, those at rest alike; hands only where they are given in the object's frame."""
        if not (self.config.rest_m and self.config.knot_frames):
            return hands, objects
        present, there = self.rows(counts, hands.device)
        around = max(1, round(REST_FRAMES / self.config.knot_frames))
        if self.config.hand_frame == "object":
            reach = self.config.rest_m * send(HAND_REACH, hands.device)
            hands = settled(hands, present[:, None].expand(-1, 2, -1), reach, around)
        course, around = self._course(objects).clone(), around * self.config.object_knots
        for numbers, like_a_metre in OBJECT_REACH:
            course[..., numbers] = settled(course[..., numbers], there, self.config.rest_m * like_a_metre, around)
        course[..., OBJECT_HINGE] = _still_hinge(course[..., OBJECT_HINGE], there)
        return hands, self._whitened(course)

    def _whitened(self, objects: Tensor) -> Tensor:
        return whiten(objects, self._reach) if self.config.whitening_frames else objects

    def _course(self, objects: Tensor) -> Tensor:
        """Rows of an object that lie on its course, from those that may be whitened."""
        return unwhiten(objects, self._reach) if self.config.whitening_frames else objects

    @property
    def _reach(self) -> float:
        """Rows of an object in ``whitening_frames``."""
        frames = self.config.knot_frames / self.config.object_knots if self.config.knot_frames else 1
        return self.config.whitening_frames / frames

    def at_origin(self, objects: Tensor, points_m: Tensor, part: Tensor) -> Tensor:
        """Objects (B, F, 10) of ``curves`` with the position of their mesh's origin; points as in ``place_m``."""
        return placed_at(objects, -self.place_m(points_m, part))

    def in_world(self, hands: Tensor, objects: Tensor) -> Tensor:
        """Hands (B, 2, F, 99) of ``curves`` in the model frame."""
        return hands_in_world(hands, objects) if self.config.hand_frame == "object" else hands

    def in_object_frame(self, hands: Tensor, objects: Tensor) -> Tensor:
        """Hands (B, 2, F, 99) of ``curves`` in the object's frame."""
        return hands if self.config.hand_frame == "object" else hands_in_object_frame(hands, objects)


def _still_hinge(angle: Tensor, there: Tensor) -> Tensor:
    """Angles (B, L), radians, at their mean where all of ``there`` (B, L) lie close together."""
    most, least = (angle.masked_fill(~there, bound) for bound in (-math.inf, math.inf))
    moves = most.amax(-1) - least.amin(-1) > STILL_HINGE_RAD
    mean = (angle * there).sum(-1) / there.sum(-1)
    return torch.where(moves[:, None], angle, mean[:, None])
