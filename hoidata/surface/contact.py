"""Hands of a clip against the exact surface of its object: touched vertices, signed distances, penetration.

Everything is asked in the object frame, so no answer depends on the world a clip is in. Arrays have a row for every
frame of the clip; frames in which the hand is not valid are not looked at.
"""

from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import Clip, Side
from hoidata.hands import HandPair, track_vertices
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.surface.solid_overlap import SolidOverlap

TOUCH_M = 0.005
REACH_M = 0.02


@dataclass(frozen=True)
class PlacedHand:
    """One hand of a clip as its object sees it.

    vertices_m: (valid frame, 778, 3) float64, object frame. frames: (valid frame,) their numbers in the clip;
    hinge_rad: (valid frame,) or None. faces: (face, 3). n_frames: of the clip.
    """

    vertices_m: np.ndarray
    frames: np.ndarray
    hinge_rad: np.ndarray | None
    faces: np.ndarray
    n_frames: int

    def over_clip(self, values: np.ndarray, elsewhere: float | bool) -> np.ndarray:
        """Values of the valid frames (valid frame, ...) with a row for every frame of the clip."""
        rows = np.full((self.n_frames, *values.shape[1:]), elsewhere, values.dtype)
        rows[self.frames] = values
        return rows


def placed_hand(clip: Clip, side: Side, hands: HandPair) -> PlacedHand:
    """The posed mesh of one hand in the object frame of each frame in which it is valid."""
    track, frames = clip.object, np.flatnonzero(clip.hands[side].valid)
    vertices = track.world_from_object.inverse() @ track_vertices(clip.hands[side], hands[side]).astype(np.float64)
    hinge = None if track.hinge_rad is None else track.hinge_rad[frames]
    return PlacedHand(vertices[frames], frames, hinge, hands[side].faces, clip.n_frames)


def touched_vertices(hand: PlacedHand, index: SurfaceIndex, threshold_m: float = TOUCH_M) -> np.ndarray:
    """(frame, 778) bool: the vertex is closer than ``threshold_m`` to the surface; False in frames without the hand."""
    return hand.over_clip(index.within(hand.vertices_m, hand.hinge_rad, threshold_m), False)


def signed_distances_m(hand: PlacedHand, index: SurfaceIndex, most_m: float = REACH_M) -> np.ndarray:
    """(frame, 778) float64 distance of each vertex to the surface, metres, negative inside the solid at any depth.

    Infinite beyond ``most_m`` outside, NaN in frames without the hand. Raises BadInput for an object without an inside.
    """
    depth = index.depth_m(hand.vertices_m, hand.hinge_rad)
    distance = index.distance_m(hand.vertices_m, hand.hinge_rad, most_m)
    return hand.over_clip(np.where(depth > 0, -depth, distance), np.nan)


@dataclass(frozen=True)
class Penetration:
    """How one hand enters the object.

    depth_m: (frame, 778) float64 metres inside the solid, 0 outside, NaN in frames without the hand.
    volume_m3: (frame,) volume that hand and object both fill (``hoidata.surface.solid_overlap``), NaN likewise; None
    where it was not asked for.
    """

    depth_m: np.ndarray
    volume_m3: np.ndarray | None

    @property
    def deepest_m(self) -> np.ndarray:
        """(frame,) depth of the deepest vertex, 0 where none is inside, NaN in frames without the hand."""
        return self.depth_m.max(axis=1)

    def share(self, more_than_m: float = 0.0) -> float:
        """Of the frames with the hand, those in which a vertex is deeper than that; NaN without such frames."""
        deepest = self.deepest_m[np.isfinite(self.deepest_m)]
        return float((deepest > more_than_m).mean()) if len(deepest) else float("nan")


def penetration(hand: PlacedHand, index: SurfaceIndex, overlap: SolidOverlap | None = None) -> Penetration:
    """Depth of every vertex, and the common volume where ``overlap`` (of the same index) is given.

    Raises BadInput for an object without an inside; ``index.solid_note`` says what was repaired or left out.
    """
    depth = hand.over_clip(index.depth_m(hand.vertices_m, hand.hinge_rad), np.nan)
    if overlap is None:
        return Penetration(depth, None)
    volume = overlap.volume_m3(hand.vertices_m, hand.faces, hand.hinge_rad)
    return Penetration(depth, hand.over_clip(volume, np.nan))
