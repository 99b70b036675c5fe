"""Hands of a clip against the exact surface of its object: touched vertices, penetration.

Everything is asked in the object frame, so no answer depends on the world a clip is in. Arrays have a row for every
frame of the clip; frames in which the hand is not valid are not looked at.
"""

from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import Clip, Side
from hoidata.hands import HandPair, track_vertices
from hoidata.objects.surface_index import SurfaceIndex

TOUCH_M = 0.005


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


def deepest_m(hand: PlacedHand, index: SurfaceIndex) -> np.ndarray:
    """(frame,) metres the deepest vertex is inside the solid, 0 where none is, NaN in frames without the hand.

    Raises BadInput for an object without an inside; ``index.solid_note`` says what was repaired or left out.
    """
    return hand.over_clip(index.depth_m(hand.vertices_m, hand.hinge_rad).max(axis=1), np.nan)
