"""Measures one hand of a clip against the surface of its object: contact, depth, nearest joint, BimArt's map."""

from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import Clip, Side
from hoidata.hands import HandPair, track_joints
from hoidata.objects.sampling import SampledPoints
from hoidata.objects.surface_index import surface_index
from hoidata.surface.bimart_maps import bimart_map
from hoidata.surface.contact import deepest_m, hand_in_object_frame, touched_vertices


class HandSurfaceMeasures(NamedTuple):
    """Measures of one hand in each frame."""

    touched: np.ndarray  # (frame, 778) bool, vertices closer than 5 mm to the surface; False without the hand
    depth_m: np.ndarray  # (frame,) penetration of the deepest vertex; NaN without the hand or for an open object
    joint_m: np.ndarray  # (frame,) distance of the nearest of 21 joints to the surface; infinite without the hand
    map_m: np.ndarray  # (frame, point) BimArt's map; infinite without the hand and beyond 20 cm


def measure_hand(clip: Clip, side: Side, hands: HandPair, points: SampledPoints) -> HandSurfaceMeasures:
    """Measure one hand of a clip against its object's surface.

    Args:
        clip: the clip.
        side: of the hand.
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
