"""The constant offset of a tracker strapped on a hand from the wrist joint, measured while the hand is flat.

One or both hands lie flat on a sheet of paper on the table, palms down. The sheet's x axis is along the middle fingers,
y to the left, z up out of the table. The wrist joints are above two points on the sheet's y axis, the left one at
``WRIST_M``, the right one at ``-WRIST_M``; their height is that of the hand model.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import TrackedHand

WRIST_M = 0.1
MAX_DISTANCE_M, MAX_ANGLE_RAD = 0.005, np.radians(2)  # from the median pose; a tracker further away has moved
MIN_REST_S, MIN_REST_FRACTION = 1.0, 0.8  # of the frames in which the tracker is not lost
MAX_OFFSET_M = 0.3
MEDIAN_ITERATIONS, MIN_ANGLE_RAD = 20, 1e-6
REMEDY = "record it again with flat hands at rest (docs/fingers.md)"


def sheet_from_wrist(hand: TrackedHand) -> RigidTransform:
    """The wrist joint of a hand that lies flat on the sheet."""
    sign = 1.0 if hand.side == "left" else -1.0
    rotation = np.diag([1.0, -sign, 1.0]) @ hand.wrist_from_canonical.T  # the thumbs point to each other
    return RigidTransform(rotation, np.array([0.0, sign * WRIST_M, hand.palm_depth_m]))


def tracker_from_wrist(
    sheet_from_tracker: RigidTransform, step_s: float, hand: TrackedHand, source: str
) -> RigidTransform:
    """The mean offset over the frames in which the tracker rests.

    sheet_from_tracker: (frame,) poses, every ``step_s`` seconds. Raises BadInput, with the ``source``, if the tracker
    moved or is too far from the wrist joint.
    """
    offsets = sheet_from_tracker.inverse() @ sheet_from_wrist(hand)
    rests = is_near_median(offsets)
    rest_s = float(rests.sum() * step_s)
    if rest_s < MIN_REST_S - 1e-6 or rests.mean() < MIN_REST_FRACTION:
        expected = f"a {hand.side} tracker at rest for {MIN_REST_S:g} s and in {MIN_REST_FRACTION:.0%} of its frames"
        raise BadInput(source, expected, f"{rest_s:.2g} s, {rests.mean():.0%}", REMEDY)
    offset = mean_transform(offsets[rests])
    if (distance_m := float(np.linalg.norm(offset.translation))) > MAX_OFFSET_M:
        expected, got = f"a {hand.side} tracker at most {MAX_OFFSET_M} m from the wrist joint", f"{distance_m:.3g} m"
        raise BadInput(source, expected, got, "check the unit, and that `object` is the sheet of paper")
    return offset


def mean_transform(transforms: RigidTransform) -> RigidTransform:
    """The mean rotation and the mean translation of transforms (frame,)."""
    rotation = Rotation.from_matrix(transforms.rotation).mean().as_matrix()
    return RigidTransform(rotation, transforms.translation.mean(axis=0))


def is_near_median(transforms: RigidTransform) -> np.ndarray:
    """(frame,) whether a transform differs from the median of all by at most MAX_DISTANCE_M and MAX_ANGLE_RAD.

    The median of positions is that of each coordinate. The median of rotations has the least sum of angles; Weiszfeld's
    algorithm finds it (Hartley et al. 2011, L1 rotation averaging).
    """
    rotations, position_m = Rotation.from_matrix(transforms.rotation), transforms.translation
    angle_rad = np.ones(len(position_m))
    for _ in range(MEDIAN_ITERATIONS):
        median = rotations.mean(1 / np.maximum(angle_rad, MIN_ANGLE_RAD))
        angle_rad = (median.inv() * rotations).magnitude()
    distance_m = np.linalg.norm(position_m - np.median(position_m, axis=0), axis=1)
    return (distance_m <= MAX_DISTANCE_M) & (angle_rad <= MAX_ANGLE_RAD)
