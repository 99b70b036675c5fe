"""A MANO-layout hand as 19 capsules, in the layout ManipNet gives its own: 4 of the palm, then 3 of each finger.

Each capsule is fitted to the skin it stands for in the rest shape and then moves rigidly with its joint. The embedded
corpora search grasps with 21 other capsules (``synthetic.hand_capsules``), tuned for speed and kept as they are.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hoidata.hands import PARENTS, TIP_VERTICES, HandModel, HandTrackLike, track_joints, track_rotmats
from hoidata.physics.capsules import Capsules

N_CAPSULES = 19
THUMB_CAPSULES = (16, 17, 18)
_KNUCKLES = (1, 4, 7, 10)
_PALM_STARTS_AT = 0.25  # of the way from the wrist to a knuckle
_OWN_SKIN = (0.2, 0.9)  # the part of a segment whose skin is its own: not the folds at its joints


class LocalCapsules(NamedTuple):
    """joint: (19,) of MANO's 16. start_m, end_m: (19, 3) in that joint's frame. radius_m: (19,).

    Order: palm towards index, middle, pinky, ring; then segments 1-3 of index, middle, pinky, ring, thumb.
    """

    joint: np.ndarray
    start_m: np.ndarray
    end_m: np.ndarray
    radius_m: np.ndarray


def fit_capsules(model: HandModel, betas: np.ndarray, template_m: np.ndarray | None = None) -> LocalCapsules:
    """Capsules of a hand of shape ``betas (10,)``, either side; template_m (778, 3) replaces the model's rest mesh.

    The radius is the median distance of the segment's own skin from an axis laid through its middle; a fingertip's
    last sphere ends where the skin does.
    """
    vertices = (model.template_m if template_m is None else template_m) + model.shape_directions @ betas
    joints = model.joint_regressor @ vertices
    owner = model.skin_weights.argmax(axis=1)
    palm = vertices[owner == 0]
    wrist, knuckles = joints[0], joints[list(_KNUCKLES)]
    starts = wrist + _PALM_STARTS_AT * (knuckles - wrist)
    nearest = np.argmin([_to_axis(palm, start, end)[0] for start, end in zip(starts, knuckles, strict=True)], axis=0)
    rows = [(0, *_fitted(palm[nearest == i], starts[i], knuckles[i], False)) for i in range(4)]
    for joint in range(1, 16):
        last = joint % 3 == 0
        end = vertices[TIP_VERTICES[joint // 3 - 1]] if last else joints[joint + 1]
        rows.append((joint, *_fitted(vertices[owner == joint], joints[joint], end, last)))
    joint, start, end, radius = (np.array(column) for column in zip(*rows, strict=True))
    return LocalCapsules(joint, start - joints[joint], end - joints[joint], radius)


def hand_capsules(track: HandTrackLike, model: HandModel) -> Capsules:
    """World capsules (frame, 19) of a recorded hand; its shape is that of the first valid frame."""
    template_m = None if track.template_m is None else _float64_bytes(track.template_m)
    first = track.valid.argmax() if len(track.betas) > 1 else 0
    local = _capsules_of(model, _float64_bytes(track.betas[first]), template_m)
    positions = track_joints(track, model)[:, local.joint].astype(np.float64)
    rotmats = world_rotmats(track)[:, local.joint]
    start = positions + np.einsum("fcij,cj->fci", rotmats, local.start_m)
    end = positions + np.einsum("fcij,cj->fci", rotmats, local.end_m)
    return Capsules(start, end, local.radius_m)


@lru_cache(maxsize=64)
def _capsules_of(model: HandModel, betas: bytes, template_m: bytes | None) -> LocalCapsules:
    """``fit_capsules`` of a shape, fitted once: a hand is asked about again and again while it is corrected."""
    template = None if template_m is None else np.frombuffer(template_m).reshape(-1, 3)
    fitted = fit_capsules(model, np.frombuffer(betas), template)
    for array in fitted:
        array.flags.writeable = False
    return fitted


def _float64_bytes(array: np.ndarray) -> bytes:
    return np.asarray(array, dtype=np.float64).tobytes()


def world_rotmats(track: HandTrackLike) -> np.ndarray:
    """(frame, 16, 3, 3) world_from_joint of MANO's joints."""
    rotmats = track_rotmats(track)
    for joint, parent in enumerate(PARENTS[1:], start=1):
        rotmats[:, joint] = rotmats[:, parent] @ rotmats[:, joint]
    return rotmats


def _fitted(skin: np.ndarray, start: np.ndarray, end: np.ndarray, is_tip: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """Axis ends and radius; the axis keeps its direction and moves sideways into the middle of the skin."""
    along = _to_axis(skin, start, end)[1]
    own = skin[(along > _OWN_SKIN[0]) & (along < _OWN_SKIN[1])]
    own = own if len(own) >= 4 else skin
    if not len(own):
        raise ValueError("a hand segment without skin of its own: the model's skin weights leave it out")
    direction = (end - start) / np.linalg.norm(end - start)
    side = (own.min(axis=0) + own.max(axis=0)) / 2 - start
    shift = side - (side @ direction) * direction
    radius = float(np.median(_to_axis(own, start + shift, end + shift)[0]))
    if is_tip:
        reach = ((skin - start) @ direction).max()
        end = start + max(reach - radius, 0.0) * direction
    return start + shift, end + shift, radius


def _to_axis(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of points from the line through two ends, and position along it, 0 at the start and 1 at the end."""
    axis = end - start
    along = (points - start) @ axis / (axis @ axis)
    return np.linalg.norm(points - start - along[:, None] * axis, axis=1), along
