"""Estimates the direction of gravity from objects at rest, for recordings whose world axes are not documented.

An object without a hand near it rests on one of its stable sides, so each resting interval allows a few directions.
A direction is rejected if

- it contradicts a head-worn camera that is upright and looks ahead or down;
- hands reach below the support;
- the object sinks below the support while it is moved.

Intervals of different objects, or of one object in different poses, must agree. Otherwise gravity is unknown.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import HandTrack, Side
from hoidata.geometry.intervals import runs
from hoidata.hands import HandPair, track_joints
from hoidata.objects.resting import Footing

NO_HAND_M = 0.03  # distance from the object's box, more than the tissue around any joint
STILL_M = 0.005
MIN_STILL_FRACTION = 0.6  # of an interval: single frames may be tracked badly
MIN_FRAMES = 5
CONTEXT_FRAMES = 90  # frames before and after an interval that are checked for contradictions
REACH_M = 0.15
MAX_BELOW_FRACTION = 0.02  # of the joints near the object
BELOW_SUPPORT_M = 0.015  # joints and objects this far below the support penetrate it
LIFTED_M = 0.03
CAMERA_CONE_RAD = np.deg2rad(50)
AGREEMENT_RAD = np.deg2rad(7)
MIN_AGREEING_FRACTION = 0.75
DIFFERENT_POSE_M = 0.01  # corner distance, centres aligned, above which two intervals differ in object or orientation


@dataclass(frozen=True)
class TrackedObject:
    """One object of a recording."""

    footing: Footing  # its stable sides
    frames: np.ndarray  # (frame,) bool: it is tracked
    poses: np.ndarray  # (frame, 4, 4) world from object


class GravityEstimate(NamedTuple):
    """Gravity of one recording."""

    direction: np.ndarray | None  # (3,) unit vector in the world; None if unknown
    note: str  # the evidence, or why it is unknown


class _RestingInterval(NamedTuple):
    """An interval in which an object rests without a hand near it."""

    downs: np.ndarray  # (direction, 3) possible directions of gravity, world
    corners: np.ndarray  # (8, 3) of its box, world, metres
    n_frames: int
    lifted: bool  # it is lifted before or after the interval


class _Scene(NamedTuple):
    """An object with the hands and the camera around it, in the world."""

    tracked_object: TrackedObject
    corners: np.ndarray  # (frame, 8, 3) of its box, metres
    joints_m: np.ndarray  # (frame, joint, 3), NaN if a hand is not tracked
    below_head: np.ndarray  # (frame, 3) unit vector between the camera's down and forward axes


def estimate_gravity(
    objects: Sequence[TrackedObject], joints_m: np.ndarray, camera_rotation: np.ndarray
) -> GravityEstimate:
    """Estimate gravity of one recording whose world is static.

    joints_m: (frame, joint, 3) joints of both hands in the world, NaN if a hand is not tracked. camera_rotation:
    (frame, 3, 3) world from a head-worn camera with OpenCV axes.
    """
    rests = [rest for item in objects for rest in _resting_intervals(item, joints_m, camera_rotation)]
    unambiguous = [rest for rest in rests if len(rest.downs) == 1]
    if not rests:
        return GravityEstimate(None, "unknown: no object stands still with the hands away")
    if _n_different_poses(unambiguous) < 2:
        return GravityEstimate(None, "unknown: no two objects, or turns of one, show on which side they stand")
    if not any(rest.lifted for rest in unambiguous):
        return GravityEstimate(None, "unknown: no object is lifted from where it rests")
    return _consensus(unambiguous)


def hand_joints_m(tracks: Mapping[Side, HandTrack], hands: HandPair) -> np.ndarray:
    """(frame, 42, 3) joints of left and right hand in the world, metres; NaN if a hand is not tracked."""
    joints = [np.where(t.valid[:, None, None], track_joints(t, hands[side]), np.nan) for side, t in tracks.items()]
    return np.concatenate(joints, axis=1).astype(np.float64)


def _consensus(rests: list[_RestingInterval]) -> GravityEstimate:
    """The mean of the largest set of directions within 7 degrees, one vote per interval."""
    downs = np.concatenate([rest.downs for rest in rests])
    near = downs @ downs.T >= np.cos(AGREEMENT_RAD)
    agreeing = near[int(near.sum(axis=1).argmax())]
    chosen = [rest for rest, agrees in zip(rests, agreeing, strict=True) if agrees]
    if agreeing.mean() < MIN_AGREEING_FRACTION or _n_different_poses(chosen) < 2:
        return GravityEstimate(None, f"unknown: only {agreeing.sum()} of {len(rests)} resting stretches agree")
    # Rounded, because the last bits of a sum depend on the processor.
    mean = np.round(downs[agreeing].mean(axis=0), 6) + 0.0
    mean /= np.linalg.norm(mean)
    spread = np.rad2deg(np.arccos(np.clip(downs[agreeing] @ mean, -1, 1)).max())
    n_frames = sum(rest.n_frames for rest in chosen)
    evidence = f"{n_frames} resting frames in {len(chosen)} stretches that agree within {max(spread, 0.1):.1f} degrees"
    return GravityEstimate(mean, f"estimated from {evidence}")


def _resting_intervals(
    tracked_object: TrackedObject, joints_m: np.ndarray, camera_rotation: np.ndarray
) -> list[_RestingInterval]:
    if not len(tracked_object.footing.downs):
        return []
    # Halfway between the camera's down (y) and forward (z) axes: within 45 degrees of gravity if the head is upright.
    below_head = camera_rotation[:, :, 1:].sum(axis=2) / np.sqrt(2)
    corners = np.array(list(product(*tracked_object.footing.box_m.T)))
    corners_world = corners @ tracked_object.poses[:, :3, :3].transpose(0, 2, 1) + tracked_object.poses[:, None, :3, 3]
    scene = _Scene(tracked_object, corners_world, joints_m, below_head)
    rests = []
    for start, stop in runs(tracked_object.frames & _hands_away(tracked_object, joints_m)):
        middle = np.median(scene.corners[start:stop], axis=0)
        offset_m = np.linalg.norm(scene.corners[start:stop] - middle, axis=-1).max(axis=1)
        still = start + np.flatnonzero(offset_m < STILL_M)
        if len(still) >= max(MIN_FRAMES, MIN_STILL_FRACTION * (stop - start)):
            rests.append(_resting_interval(scene, still))
    return rests


def _resting_interval(scene: _Scene, still: np.ndarray) -> _RestingInterval:
    """Reject directions that contradict the camera or the motion around the interval. still: indices of frames."""
    corners = scene.corners[still].mean(axis=0)
    rotation = Rotation.from_matrix(scene.tracked_object.poses[still, :3, :3]).mean().as_matrix()
    # Restrict the context to frames of the same uninterrupted track.
    first, last = next((a, b) for a, b in runs(scene.tracked_object.frames) if a <= still[0] < b)
    around = np.arange(max(first, still[0] - CONTEXT_FRAMES), min(last, still[-1] + 1 + CONTEXT_FRAMES))
    joints, reach_m = scene.joints_m[around].reshape(-1, 3), REACH_M + np.ptp(corners, axis=0).max() / 2
    near_joints = joints[np.linalg.norm(joints - corners.mean(axis=0), axis=1) < reach_m]
    below_head = scene.below_head[still].mean(axis=0)
    possible, lifted = [], False
    for down in scene.tracked_object.footing.downs @ rotation.T:
        support_m = np.median(_depth_m(scene.tracked_object, still, down))
        depth_m = _depth_m(scene.tracked_object, around, down) - support_m
        reaching = (near_joints @ down > support_m + BELOW_SUPPORT_M).mean() if len(near_joints) else 0.0
        in_view = down @ below_head >= np.cos(CAMERA_CONE_RAD) * np.linalg.norm(below_head)
        if in_view and depth_m.max() <= BELOW_SUPPORT_M and reaching <= MAX_BELOW_FRACTION:
            possible.append(down)
            lifted |= bool(depth_m.min() < -LIFTED_M)
    return _RestingInterval(np.array(possible).reshape(-1, 3), corners, len(still), lifted)


def _depth_m(tracked_object: TrackedObject, frames: np.ndarray, down: np.ndarray) -> np.ndarray:
    """(frame,) coordinate along ``down`` of the object's lowest point, metres."""
    down_local = down @ tracked_object.poses[frames, :3, :3]
    return (down_local @ tracked_object.footing.outline_m.T).max(axis=1) + tracked_object.poses[frames, :3, 3] @ down


def _hands_away(tracked_object: TrackedObject, joints_m: np.ndarray) -> np.ndarray:
    """(frame,) bool: a hand is tracked, and no joint of either hand is near the object's box."""
    low, high = tracked_object.footing.box_m
    joints_local = (joints_m - tracked_object.poses[:, None, :3, 3]) @ tracked_object.poses[:, :3, :3]
    distance = np.linalg.norm(np.maximum(np.maximum(low - joints_local, joints_local - high), 0), axis=-1)
    has_joint = np.isfinite(distance)
    return has_joint.any(axis=1) & (np.where(has_joint, distance, np.inf) > NO_HAND_M).all(axis=1)


def _n_different_poses(rests: Sequence[_RestingInterval]) -> int:
    """Number of intervals that differ in object or orientation. Repeats of one resting pose are no evidence."""
    shapes: list[np.ndarray] = []
    for rest in rests:
        shape = rest.corners - rest.corners.mean(axis=0)
        if all(np.linalg.norm(shape - other, axis=1).max() > DIFFERENT_POSE_M for other in shapes):
            shapes.append(shape)
    return len(shapes)
