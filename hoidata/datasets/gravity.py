"""Which way is down, in a recording that does not say: from objects that stand where no hand is near.

An object out of reach stands on one of its stable sides, so each such stretch leaves a few directions. Of these the
one is kept that a head-worn camera, upright and looking ahead or down, can have below it, and below which no hand
reaches and the object never sinks while it is moved. Stretches of different objects, or of one turned about, must
agree; otherwise gravity stays unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.geometry.intervals import runs
from hoidata.objects.resting import Footing

NO_HAND_M = 0.03  # farther from the object's box than any joint's flesh is thick
STILL_M = 0.005
MOSTLY_STILL = 0.6  # share of a stretch: single frames may be tracked badly
FEWEST_FRAMES = 5
WATCHED_FRAMES = 90  # of motion before and after a stretch
REACH_M = 0.15
HANDS_BELOW = 0.02  # share of joints
BELOW_M = 0.015  # joints and objects this far below the support have gone through it
LIFTED_M = 0.03
CAMERA_CONE_RAD = np.deg2rad(50)
AGREEMENT_RAD = np.deg2rad(7)
AGREEING_SHARE = 0.75
TURNED_M = 0.01  # a corner so far from where it was, the object's middle apart: another object, or it was turned


@dataclass(frozen=True)
class TrackedObject:
    """One object of a recording in its world. frames: (frame,) bool, where it is tracked; poses: (frame, 4, 4)."""

    footing: Footing
    frames: np.ndarray
    poses: np.ndarray


class GravityEstimate(NamedTuple):
    """direction: (3,) unit vector in the world, or None. note: how it was found, or why it is not known."""

    direction: np.ndarray | None
    note: str


class _Rest(NamedTuple):
    """One stretch in which an object stands by itself: its directions down (way, 3) and corners (8, 3), world."""

    ways: np.ndarray
    corners: np.ndarray
    n_frames: int
    lifted: bool


class _Scene(NamedTuple):
    """An object and what surrounds it: corners (frame, 8, 3) of its box and joints (frame, joint, 3) in the world."""

    thing: TrackedObject
    corners: np.ndarray
    joints_m: np.ndarray
    below_head: np.ndarray


def estimate_gravity(
    objects: Sequence[TrackedObject], joints_m: np.ndarray, camera_rotation: np.ndarray
) -> GravityEstimate:
    """Gravity of one recording with a static world.

    joints_m: (frame, joint, 3) world positions of both hands, NaN where a hand is not seen. camera_rotation: (frame,
    3, 3) world from a head-worn camera with OpenCV axes.
    """
    rests = [rest for thing in objects for rest in _rests(thing, joints_m, camera_rotation)]
    clear = [rest for rest in rests if len(rest.ways) == 1]
    if not rests:
        return GravityEstimate(None, "unknown: no object stands still with the hands away")
    if _different(clear) < 2:
        return GravityEstimate(None, "unknown: no two objects, or turns of one, show on which side they stand")
    if not any(rest.lifted for rest in clear):
        return GravityEstimate(None, "unknown: no object is lifted from where it rests")
    return _agreed(clear)


def _agreed(rests: list[_Rest]) -> GravityEstimate:
    """The mean of the directions that agree, one vote per stretch; None when too many disagree."""
    downs = np.concatenate([rest.ways for rest in rests])
    near = downs @ downs.T >= np.cos(AGREEMENT_RAD)
    agree = near[int(near.sum(axis=1).argmax())]
    chosen = [rest for rest, agrees in zip(rests, agree, strict=True) if agrees]
    if agree.mean() < AGREEING_SHARE or _different(chosen) < 2:
        return GravityEstimate(None, f"unknown: only {agree.sum()} of {len(rests)} resting stretches agree")
    # Rounded, so that the last bits of a sum do not depend on the machine.
    mean = np.round(downs[agree].mean(axis=0), 6) + 0.0
    mean /= np.linalg.norm(mean)
    spread = np.rad2deg(np.arccos(np.clip(downs[agree] @ mean, -1, 1)).max())
    n_frames = sum(rest.n_frames for rest in chosen)
    what = f"{n_frames} resting frames in {len(chosen)} stretches that agree within {max(spread, 0.1):.1f} degrees"
    return GravityEstimate(mean, f"estimated from {what}")


def _rests(thing: TrackedObject, joints_m: np.ndarray, camera_rotation: np.ndarray) -> list[_Rest]:
    if not len(thing.footing.downs):
        return []
    # Between the image's down and ahead: within 45 degrees of gravity while the head is upright.
    below_head = camera_rotation[:, :, 1:].sum(axis=2) / np.sqrt(2)
    corners = np.array(list(product(*thing.footing.box_m.T)))
    placed = corners @ thing.poses[:, :3, :3].transpose(0, 2, 1) + thing.poses[:, None, :3, 3]
    scene = _Scene(thing, placed, joints_m, below_head)
    rests = []
    for start, stop in runs(thing.frames & _hands_away(thing, joints_m)):
        middle = np.median(scene.corners[start:stop], axis=0)
        off = np.linalg.norm(scene.corners[start:stop] - middle, axis=-1).max(axis=1)
        still = start + np.flatnonzero(off < STILL_M)
        if len(still) >= max(FEWEST_FRAMES, MOSTLY_STILL * (stop - start)):
            rests.append(_rest(scene, still))
    return rests


def _rest(scene: _Scene, still: np.ndarray) -> _Rest:
    """The directions down that neither the camera nor what happens around the stretch speaks against."""
    corners = scene.corners[still].mean(axis=0)
    turn = Rotation.from_matrix(scene.thing.poses[still, :3, :3]).mean().as_matrix()
    # As far as the same object is tracked without a break.
    first, last = next((a, b) for a, b in runs(scene.thing.frames) if a <= still[0] < b)
    around = np.arange(max(first, still[0] - WATCHED_FRAMES), min(last, still[-1] + 1 + WATCHED_FRAMES))
    near = scene.joints_m[around].reshape(-1, 3)
    near = near[np.linalg.norm(near - corners.mean(axis=0), axis=1) < REACH_M + np.ptp(corners, axis=0).max() / 2]
    below_head = scene.below_head[still].mean(axis=0)
    possible, lifted = [], False
    for down in scene.thing.footing.downs @ turn.T:
        support_m = np.median(_depth_m(scene.thing, still, down))
        depth_m = _depth_m(scene.thing, around, down) - support_m
        reaching = (near @ down > support_m + BELOW_M).mean() if len(near) else 0.0
        in_view = down @ below_head >= np.cos(CAMERA_CONE_RAD) * np.linalg.norm(below_head)
        if in_view and depth_m.max() <= BELOW_M and reaching <= HANDS_BELOW:
            possible.append(down)
            lifted |= bool(depth_m.min() < -LIFTED_M)
    return _Rest(np.array(possible).reshape(-1, 3), corners, len(still), lifted)


def _depth_m(thing: TrackedObject, frames: np.ndarray, down: np.ndarray) -> np.ndarray:
    """(frame,) how far along ``down`` the object reaches."""
    turned = down @ thing.poses[frames, :3, :3]
    return (turned @ thing.footing.outline_m.T).max(axis=1) + thing.poses[frames, :3, 3] @ down


def _hands_away(thing: TrackedObject, joints_m: np.ndarray) -> np.ndarray:
    """(frame,) bool: a hand is seen, and no joint of either is near the object's box."""
    low, high = thing.footing.box_m
    local = (joints_m - thing.poses[:, None, :3, 3]) @ thing.poses[:, :3, :3]
    distance = np.linalg.norm(np.maximum(np.maximum(low - local, local - high), 0), axis=-1)
    seen = np.isfinite(distance)
    return seen.any(axis=1) & (np.where(seen, distance, np.inf) > NO_HAND_M).all(axis=1)


def _different(rests: Sequence[_Rest]) -> int:
    """How many stretches differ in the object or its orientation: one that leans the same way twice proves nothing."""
    kept: list[np.ndarray] = []
    for rest in rests:
        shape = rest.corners - rest.corners.mean(axis=0)
        if all(np.linalg.norm(shape - other, axis=1).max() > TURNED_M for other in kept):
            kept.append(shape)
    return len(kept)
