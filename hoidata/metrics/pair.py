"""A predicted clip paired with its reference clip: the input of every metric."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hoidata.actions.action import Actions
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import HandPair
from hoidata.metrics.target_contact import TargetDistances
from hoidata.metrics.unmeasured import NO_GRAVITY, NO_INSIDE, Unmeasured
from hoidata.objects.surface_index import surface_index
from hoidata.physics.scene import Scene, clip_scene


@dataclass(frozen=True, eq=False)
class Motion:
    """One clip and the joints of its hands."""

    clip: Clip
    joints_m: Mapping[Side, np.ndarray]  # per side (frame, 21, 3), world frame
    hands: HandPair  # the model of the clip's hand parameters

    def joints_in_object(self, side: Side, frames: np.ndarray) -> np.ndarray:
        """(chosen frame, 21, 3) float64 joints of one hand in the object frame, metres."""
        return (self.clip.object.world_from_object.inverse() @ self.joints_m[side])[frames]

    def hinge_rad(self, frames: np.ndarray) -> np.ndarray | None:
        """(chosen frame,) hinge angle, None for a rigid object."""
        return None if self.clip.object.hinge_rad is None else self.clip.object.hinge_rad[frames]


@dataclass(frozen=True, eq=False)
class TrueContact:
    """The contact map of the recorded clip, as the contact stage computed it."""

    index: ProximityIndex  # over the sampled points of the object
    part: np.ndarray  # (point,) the object part of each point
    touched: np.ndarray  # (point,) bool: within the threshold of a joint of an acting hand in any frame of the pair
    threshold_m: float


@dataclass(frozen=True, eq=False)
class Pair:
    """A predicted and a reference motion in the world frame of the reference clip."""

    predicted: Motion
    reference: Motion
    sides: tuple[Side, ...]  # the hands that act in the reference clip
    contact: TrueContact
    table_m: float | None  # height of the table under the object in the reference's recording; None without gravity
    # Frame i of both is the same moment, and the prediction has its hands wherever the reference has them.
    # False: the family chose the length.
    aligned: bool = True
    target_contact: np.ndarray | None = None  # (point,) bool, the contact map that the prediction was conditioned on
    verb: str | None = None  # of the reference clip
    actions: Actions | None = None  # usual motion measures per verb
    target_distances: TargetDistances | None = None  # the distance map that the prediction was conditioned on

    @property
    def _timed(self) -> Clip:
        """The clip whose hands and frames select what is measured."""
        return (self.reference if self.aligned else self.predicted).clip

    def valid(self, side: Side) -> np.ndarray:
        """(frame,) bool: the frames of the prediction in which this hand is measured; never an interpolated one."""
        return self._timed.hands[side].valid & self._timed.recorded

    @property
    def measured(self) -> np.ndarray:
        """(frame,) bool: the frames of the prediction in which all acting hands are measured."""
        return np.all([self.valid(side) for side in self.sides], axis=0)

    def frames(self, side: Side, frame_step: int = 1) -> np.ndarray:
        """Indices of every n-th frame in which this hand is measured."""
        return np.flatnonzero(self.valid(side))[::frame_step]

    def triples(self) -> np.ndarray:
        """(triple, 3) indices of three successive recorded frames with equal spacing."""
        recorded = np.flatnonzero(self._timed.recorded)
        triples = np.stack((recorded[:-2], recorded[1:-1], recorded[2:]), axis=1)
        return triples[np.ptp(np.diff(triples, axis=1), axis=1) == 0]

    @cached_property
    def scene(self) -> Scene | Unmeasured:
        """The acting hands of the prediction and its object, on the table of the reference.

        Unmeasured without gravity, for an object that is not a closed solid, and below three frames.
        """
        clip = self.predicted.clip
        if self.table_m is None:
            return NO_GRAVITY
        if clip.n_frames < 3:
            return Unmeasured("the motion has fewer than three frames")
        if not surface_index(clip.object.model).is_solid:
            return NO_INSIDE
        hands = {
            side: replace(track, valid=self.valid(side) & (side in self.sides)) for side, track in clip.hands.items()
        }
        gravity = self.reference.clip.gravity
        return clip_scene(replace(clip, hands=hands, gravity=gravity), self.predicted.hands, self.table_m)


def acting_sides(hand_type: str) -> tuple[Side, ...]:
    """The sides of the hand type "left", "right" or "both", left first."""
    return tuple(side for side in SIDES if hand_type in (side, "both"))
