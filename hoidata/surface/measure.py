"""Measures one hand of a clip against the surface of its object: contact, depth, nearest joint, BimArt's map.

BimArt's map (Zhang et al. 2024, section 3.2, equation 4) has one value per hand and frame for each object point: its
distance to the nearest vertex of the hand, as in the paper's text. The paper's equation has the vector to that vertex,
of which this is the length. As in the paper, the index of the nearest vertex is not stored. There are two differences.
The points are those of ``sample_points``; BimArt uses the mesh vertices nearest to its basis points (equations 2 and
3). Pages pack maps in steps of 0.8 mm up to 20 cm, the range of the paper's figure 9, which loses at most 0.4 mm.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from hoidata.clips.clip import Clip, Side
from hoidata.hands import HandPair, track_joints
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import SampledPoints
from hoidata.objects.surface_index import surface_index
from hoidata.surface.contact import HandInObjectFrame, deepest_m, hand_in_object_frame, touched_vertices

REACH_M = 0.2
STEP_M = 0.0008  # of a packed map
BEYOND = 255  # packed value beyond REACH_M


class HandSurfaceMeasures(NamedTuple):
    """Measures of one hand in each frame."""

    touched: np.ndarray  # (frame, 778) bool, vertices closer than 5 mm to the surface; False without the hand
    depth_m: np.ndarray  # (frame,) penetration of the deepest vertex; NaN without the hand or for an open object
    joint_m: np.ndarray  # (frame,) distance of the nearest of 21 joints to the surface; infinite without the hand
    map_m: np.ndarray  # (frame, point) BimArt's map; infinite without the hand and beyond 20 cm


def measure_hand(clip: Clip, side: Side, hands: HandPair, points: SampledPoints) -> HandSurfaceMeasures:
    """Measure one hand of a clip against its object's surface.

    Args:
        hands: the model of the clip's hands.
        points: sampled points of the object.

    Raises:
        BadInput: the mesh has no triangles.
    """
    index, hand = surface_index(clip.object.model), hand_in_object_frame(clip, side, hands)
    joints_m = track_joints(clip.hands[side], hands[side]).astype(np.float64)
    joints_m = (clip.object.world_from_object.inverse() @ joints_m)[hand.frames]
    return HandSurfaceMeasures(
        touched=touched_vertices(hand, index),
        depth_m=deepest_m(hand, index) if index.is_solid else np.full(clip.n_frames, np.nan),
        joint_m=hand.expand_to_clip(index.distance_m(joints_m, hand.hinge_rad).min(axis=1), np.inf),
        map_m=bimart_map(hand, points, clip.object.model),
    )


def bimart_map(hand: HandInObjectFrame, points: SampledPoints, model: ObjectModel) -> np.ndarray:
    """Distance from each sampled point to the nearest vertex of one hand.

    points: of the object; points of the moving part follow the hinge.
    Returns (frame, point) float32 metres; infinite in frames without the hand, and beyond 20 cm.
    """
    nearest = np.full((len(hand.vertices_m), len(points)), np.inf, np.float32)
    for part in np.unique(points.part) if len(hand.vertices_m) else ():
        positions = model.object_from_part(int(part), hand.hinge_rad).inverse() @ hand.vertices_m
        members = np.flatnonzero(points.part == part)
        cloud = np.ascontiguousarray(points.points_m[members].T, np.float32)
        nearest[:, members] = _nearest_m(np.ascontiguousarray(positions.transpose(0, 2, 1), np.float32), cloud)
    return hand.expand_to_clip(nearest, np.inf)


def packed_map(distances_m: np.ndarray) -> np.ndarray:
    """Quantize distances to uint8 in steps of 0.8 mm; 255 beyond 20 cm."""
    near = distances_m <= REACH_M
    return np.where(near, np.rint(np.where(near, distances_m, 0.0) / STEP_M), BEYOND).astype(np.uint8)


def _nearest_m(positions_m: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """(frame, point) float32 distance to the nearest position, infinite beyond 20 cm.

    positions_m: (frame, 3, position), points_m: (3, point), float32. Frames with distant bounding boxes are skipped.
    """
    gap_m = np.maximum(
        positions_m.min(axis=2) - points_m.max(axis=1), points_m.min(axis=1) - positions_m.max(axis=2)
    )  # (frame, 3) gap along each axis
    distances = np.sqrt(_nearest_squares(positions_m, points_m, (gap_m <= REACH_M).all(axis=1)))
    return np.where(distances <= np.float32(REACH_M), distances, np.float32(np.inf))


@njit(cache=True)
def _nearest_squares(positions_m, points_m, is_near):  # pragma: no cover (compiled)
    """(frame, point) float32 squared distance to the nearest position; infinite in frames that are not near.

    Brute force over all pairs is vectorized and takes 0.08 ns per pair, far less than a tree over 778 positions.
    """
    squares = np.full((len(positions_m), points_m.shape[1]), np.float32(np.inf), np.float32)
    xs, ys, zs = points_m[0], points_m[1], points_m[2]
    for frame in range(len(positions_m)):
        best = squares[frame]
        for vertex in range(positions_m.shape[2] if is_near[frame] else 0):
            x, y, z = positions_m[frame, 0, vertex], positions_m[frame, 1, vertex], positions_m[frame, 2, vertex]
            for point in range(len(best)):
                dx, dy, dz = xs[point] - x, ys[point] - y, zs[point] - z
                square = dx * dx + dy * dy + dz * dz
                best[point] = square if square < best[point] else best[point]
    return squares
