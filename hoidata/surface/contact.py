"""Contact of a clip's hands with the exact surface of its object: touched vertices and penetration depth.

Queries are in the object frame, so results do not depend on the clip's world frame. Result arrays cover all frames of
the clip; frames with an invalid hand have a fill value.
"""

from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import Clip, Side
from hoidata.hands import HandPair, track_vertices
from hoidata.objects.surface_index import SurfaceIndex

TOUCH_M = 0.005  # distance below which a vertex touches the surface


@dataclass(frozen=True)
class HandInObjectFrame:
    """One hand of a clip in the object frame, in the frames in which it is valid."""

    vertices_m: np.ndarray  # (valid frame, 778, 3) float64, object frame
    frames: np.ndarray  # (valid frame,) indices in the clip
    hinge_rad: np.ndarray | None  # (valid frame,)
    faces: np.ndarray  # (face, 3)
    n_frames: int  # of the clip

    def expand_to_clip(self, values: np.ndarray, elsewhere: float | bool) -> np.ndarray:
        """Expand values (valid frame, ...) to all frames of the clip, with ``elsewhere`` in the others."""
        over_frames = np.full((self.n_frames, *values.shape[1:]), elsewhere, values.dtype)
        over_frames[self.frames] = values
        return over_frames


def hand_in_object_frame(clip: Clip, side: Side, hands: HandPair) -> HandInObjectFrame:
    """The posed mesh of one hand in the object frame of each frame in which it is valid."""
    track, frames = clip.object, np.flatnonzero(clip.hands[side].valid)
    vertices = track.world_from_object.inverse() @ track_vertices(clip.hands[side], hands[side]).astype(np.float64)
    hinge = None if track.hinge_rad is None else track.hinge_rad[frames]
    return HandInObjectFrame(
        vertices_m=vertices[frames], frames=frames, hinge_rad=hinge, faces=hands[side].faces, n_frames=clip.n_frames
    )


def touched_vertices(hand: HandInObjectFrame, index: SurfaceIndex, threshold_m: float = TOUCH_M) -> np.ndarray:
    """(frame, 778) bool: vertices closer than ``threshold_m`` to the surface; False in frames without the hand."""
    return hand.expand_to_clip(index.within(hand.vertices_m, hand.hinge_rad, threshold_m), False)


def deepest_m(hand: HandInObjectFrame, index: SurfaceIndex) -> np.ndarray:
    """(frame,) penetration depth of the deepest vertex in metres, 0 without one, NaN in frames without the hand.

    Raises BadInput for an object without an inside. ``index.repair_note`` has its repairs.
    """
    return hand.expand_to_clip(index.depth_m(hand.vertices_m, hand.hinge_rad).max(axis=1), np.nan)
