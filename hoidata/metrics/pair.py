"""A predicted clip beside the clip it was made for: what every metric is a function of."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hoidata.actions.action import Actions
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import HandPair
from hoidata.metrics.asked import AskedDistances
from hoidata.metrics.unmeasured import NO_GRAVITY, NO_INSIDE, Unmeasured
from hoidata.objects.surface_index import surface_index
from hoidata.physics.scene import Scene, clip_scene


@dataclass(frozen=True, eq=False)
class Motion:
    """One clip and the joints of its hands.

    joints_m: per side (frame, 21, 3) world, metres. hands: the model of the clip's hand parameters.
    """

    clip: Clip
    joints_m: Mapping[Side, np.ndarray]
    hands: HandPair

    def joints_in_object(self, side: Side, frames: np.ndarray) -> np.ndarray:
        """(chosen frame, 21, 3) float64 joints of one hand in the object frame, metres."""
        return (self.clip.object.world_from_object.inverse() @ self.joints_m[side])[frames]

    def hinge_rad(self, frames: np.ndarray) -> np.ndarray | None:
        """(chosen frame,) hinge angle, None for a rigid object."""
        return None if self.clip.object.hinge_rad is None else self.clip.object.hinge_rad[frames]


@dataclass(frozen=True, eq=False)
class TrueContact:
    """The contact map a clip was recorded with, as the contact stage made it.

    index: over the sampled points of the object; part: (point,) the part each of them belongs to. touched: (point,)
    bool, nearer to a joint of an acting hand than ``threshold_m`` (metres) in any frame of the pair.
    """

    index: ProximityIndex
    part: np.ndarray
    touched: np.ndarray
    threshold_m: float


@dataclass(frozen=True, eq=False)
class Pair:
    """Two motions in the world of the reference clip.

    sides: the hands that act in the reference clip. table_m: height of the table the object of the whole reference clip
    rests on; None where gravity is not known. aligned: frame ``i`` of both is the same moment, and the prediction has
    its hands wherever the reference has; else the family chose its own length. asked: (point,) bool, the contact map
    the prediction was made for, or None; asked_distances: the map of distances, or None. verb: of the reference clip;
    actions: what verbs ask of a motion.
    """

    predicted: Motion
    reference: Motion
    sides: tuple[Side, ...]
    contact: TrueContact
    table_m: float | None
    aligned: bool = True
    asked: np.ndarray | None = None
    verb: str | None = None
    actions: Actions | None = None
    asked_distances: AskedDistances | None = None

    @property
    def _timed(self) -> Clip:
        """The clip that says which frames are looked at."""
        return (self.reference if self.aligned else self.predicted).clip

    def valid(self, side: Side) -> np.ndarray:
        """(frame,) bool: the frames of the prediction in which this hand is looked at: none that was made."""
        return self._timed.hands[side].valid & self._timed.recorded

    def frames(self, side: Side, every: int = 1) -> np.ndarray:
        """Every n-th of the frames in which this hand is looked at."""
        return np.flatnonzero(self.valid(side))[::every]

    def looked_at(self) -> np.ndarray:
        """(frame,) bool: the frames in which any acting hand is looked at."""
        return np.any([self.valid(side) for side in self.sides], axis=0)

    def triples(self) -> np.ndarray:
        """(triple, 3) numbers of recorded frames that follow each other, as far apart before the middle as after it."""
        recorded = np.flatnonzero(self._timed.recorded)
        triples = np.stack((recorded[:-2], recorded[1:-1], recorded[2:]), axis=1)
        return triples[np.ptp(np.diff(triples, axis=1), axis=1) == 0]

    @cached_property
    def scene(self) -> Scene | Unmeasured:
        """The acting hands of the prediction and its object, on the table of the reference clip.

        Unmeasured where gravity is not known, where the object encloses no solid, and for less than three frames.
        """
        clip = self.predicted.clip
        if self.table_m is None:
            return NO_GRAVITY
        if clip.n_frames < 3:
            return Unmeasured("the motion has fewer than three frames")
        if not surface_index(clip.object.model).is_solid:
            return NO_INSIDE
        hands = {side: replace(track, valid=self._present(side)) for side, track in clip.hands.items()}
        gravity = self.reference.clip.gravity
        return clip_scene(replace(clip, hands=hands, gravity=gravity), self.predicted.hands, self.table_m)

    def _present(self, side: Side) -> np.ndarray:
        """(frame,) bool: the hand acts and is looked at."""
        valid = self.valid(side)
        return valid if side in self.sides else np.zeros_like(valid)


def acting_sides(hand_type: str) -> tuple[Side, ...]:
    """The sides that "left", "right" or "both" names, left first."""
    return tuple(side for side in SIDES if hand_type in (side, "both"))
