"""What the diffusion network denoises: the numbers that stand for a motion, and the way back.

Text2HOI denoises the features of every frame, hands in the world. Two switches change that: hands may be given in the
frame the object has at the same moment, where a hand that holds still on a moving object is constant; and curves may
stand for frames, as control points of B-splines (``models.common.spline``).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from hoidata.batches.dataset import MAX_FRAMES, ClipSample
from models.common.features import hands_in_object_frame, hands_in_world
from models.common.sampling import Motion
from models.common.spline import fit_spline, intervals_of, spline_values, stacked_bases


@dataclass(frozen=True)
class MotionCodeConfig:
    """knot_frames: of the hands' splines; 0: a row for every frame, as in the paper. object_knots: knots of the object
    per knot of the hands; it may shake while the hands on it keep still. hand_frame: where hands are given.
    """

    knot_frames: int = 0
    object_knots: int = 1
    hand_frame: Literal["world", "object"] = "world"


@dataclass(frozen=True)
class CodedClip:
    """One recorded clip: hands (2, K, 99), object (L, 10), and where each hand is there (2, K) bool."""

    hands: Tensor
    object: Tensor
    present: Tensor


@dataclass(frozen=True)
class MotionCode:
    """Motions of hands (B, 2, F, 99) and object (B, F, 10) as rows (B, 2, K, 99) and (B, L, 10), and back."""

    config: MotionCodeConfig

    def sizes(self, n_frames: int) -> tuple[int, int]:
        """Rows of a hand and of the object in a motion of ``n_frames``."""
        if not self.config.knot_frames:
            return n_frames, n_frames
        intervals = intervals_of(n_frames, self.config.knot_frames)
        return intervals + 3, intervals * self.config.object_knots + 3

    @property
    def largest(self) -> tuple[int, int]:
        """Rows of the longest motion there can be."""
        return self.sizes(MAX_FRAMES)

    def rows(self, counts: Sequence[int], device: torch.device) -> tuple[Tensor, Tensor]:
        """(B, K) and (B, L) bool: the rows that motions of so many frames have."""
        sizes = np.array([self.sizes(n) for n in counts])
        hand, thing = (torch.from_numpy(np.arange(own.max()) < own[:, None]).to(device) for own in sizes.T)
        return hand, thing

    def encode(self, sample: ClipSample) -> CodedClip:
        """A recorded clip's rows."""
        hands, thing = torch.from_numpy(sample.hands), torch.from_numpy(sample.object)
        present = torch.from_numpy(sample.valid & sample.active_hands[:, None])
        if self.config.hand_frame == "object":
            hands = hands_in_object_frame(hands[None], thing[None])[0]
        if not self.config.knot_frames:
            return CodedClip(hands, thing, present)
        intervals = intervals_of(len(thing), self.config.knot_frames)
        curves = torch.stack([fit_spline(hand, own, intervals) for hand, own in zip(hands, present, strict=True)])
        objects = fit_spline(thing, torch.ones(len(thing)), intervals * self.config.object_knots)
        # A control point moves four intervals; it is there where the hand is in any frame of them.
        touched = stacked_bases([len(thing)], [intervals], len(thing), torch.device("cpu"))[0].T > 0
        return CodedClip(curves, objects, (present.float() @ touched.T.float()) > 0)

    def curves(self, hands: Tensor, objects: Tensor, counts: Sequence[int]) -> Motion:
        """Features of every frame, hands in the frame they are coded in; the 6D as they come, not made proper."""
        if not self.config.knot_frames:
            return hands, objects
        n_frames = max(counts)
        knots = [intervals_of(n, self.config.knot_frames) for n in counts]
        hands = spline_values(hands, stacked_bases(list(counts), knots, n_frames, hands.device))
        knots = [n * self.config.object_knots for n in knots]
        return hands, spline_values(objects, stacked_bases(list(counts), knots, n_frames, hands.device))

    def in_world(self, hands: Tensor, objects: Tensor) -> Tensor:
        """Hands (B, 2, F, 99) of ``curves`` in the model frame."""
        return hands_in_world(hands, objects) if self.config.hand_frame == "object" else hands

    def in_object_frame(self, hands: Tensor, objects: Tensor) -> Tensor:
        """Hands (B, 2, F, 99) of ``curves`` in the object's frame."""
        return hands if self.config.hand_frame == "object" else hands_in_object_frame(hands, objects)
