"""The numbers that the diffusion network denoises: control points of a motion, and back to features per frame.

Text2HOI denoises features of every frame, hands in the world. ``MotionRepresentationConfig`` offers alternatives:

- Hands in the object's frame: a hand that does not slip on a moving object is constant.
- B-spline control points instead of frames (``models.common.spline``).
- Object rotation since the first frame, ``R(t) R(0)^T``, next to ``R(0)``. It does not depend on the axes of the mesh.
- Whitening of the object's trajectory with a smoothness prior. A shake of 3 cm then counts as much as a lift of 20 cm,
  and errors of the network come out smooth.

Shapes: B motions, F frames, K control points of a hand, L control points of the object.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from hoidata.batches.dataset import ClipSample
from hoidata.clips.features import OBJECT_FEATURES
from hoidata.devices import send
from models.common.features import (
    OBJECT_START_6D,
    base_middle_m,
    hands_in_object_frame,
    hands_in_world,
    mean_start,
    placed_at,
    recentred,
    turned_from,
    turned_since_start,
)
from models.common.sampling import Motion
from models.common.spline import fit_spline, intervals_of, spline_values, stacked_bases, unwhiten, whiten

# Knots of the object per knot of the hands: an object may shake while the hands on it do not move.
OBJECT_KNOTS = 2


@dataclass(frozen=True)
class MotionRepresentationConfig:
    """How a motion is written as numbers; the defaults are the paper's."""

    # Frames between two knots of the hands' splines; 0: one control point per frame.
    knot_frames: int = 0
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
        return intervals + 3, intervals * OBJECT_KNOTS + 3

    @property
    def object_features(self) -> int:
        """Features of one control point of the object."""
        return OBJECT_START_6D.stop if self.config.object_rotation == "relative_to_start" else OBJECT_FEATURES

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
        object_points = fit_spline(objects, torch.ones(len(objects)), intervals * OBJECT_KNOTS)
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
        objects = unwhiten(objects, self._reach) if self.config.whitening_frames else objects
        object_mask = self.valid_masks(counts, objects.device)[1]
        # Every control point repeats the first frame's rotation; the mean is the best estimate.
        start = mean_start(objects, object_mask) if self.config.object_rotation == "relative_to_start" else None
        if not self.config.knot_frames:
            return hands, objects if start is None else turned_from(objects, start)
        n_frames = max(counts)
        knots = [intervals_of(n, self.config.knot_frames) for n in counts]
        hands = spline_values(hands, stacked_bases(list(counts), knots, n_frames, hands.device))
        knots = [n * OBJECT_KNOTS for n in knots]
        objects = spline_values(objects, stacked_bases(list(counts), knots, n_frames, hands.device))
        return hands, objects if start is None else turned_from(objects, start)

    def _whitened(self, objects: Tensor) -> Tensor:
        return whiten(objects, self._reach) if self.config.whitening_frames else objects

    @property
    def _reach(self) -> float:
        """Control points of the object in ``whitening_frames``."""
        frames = self.config.knot_frames / OBJECT_KNOTS if self.config.knot_frames else 1
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
