"""A hand in MANO's layout as ManipNet's 19 capsules: 4 of the palm, then 3 of each finger.

Each capsule is fitted to its segment of the skin in the rest shape and moves rigidly with its joint. The grasp search
that generates the synthetic corpora uses a different hand of 21 capsules (``synthetic.hand_capsules``).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hoidata.hands import PARENTS, TIP_VERTICES, HandModel, HandTrackLike, track_joints, track_rotmats
from hoidata.physics.capsules import Capsules

N_CAPSULES = 19
_KNUCKLES = (1, 4, 7, 10)
_PALM_START = 0.25  # fraction of the distance from the wrist to a knuckle
_SEGMENT_RANGE = (0.2, 0.9)  # part of a segment's axis whose skin is used, without the folds at the joints


class LocalCapsules(NamedTuple):
    """Capsules of a hand: palm towards index, middle, pinky, ring; then 3 segments of these fingers and the thumb."""

    joint: np.ndarray  # (19,) of MANO's 16
    start_m: np.ndarray  # (19, 3) in the joint's frame
    end_m: np.ndarray  # (19, 3) in the joint's frame
    radius_m: np.ndarray  # (19,)


def fit_capsules(model: HandModel, betas: np.ndarray, template_m: np.ndarray | None = None) -> LocalCapsules:
    """Fit capsules to a hand of shape ``betas (10,)``; template_m (778, 3) replaces the model's rest mesh.

    The axis passes through the middle of the segment's skin, and the radius is the skin's median distance from it. The
    last sphere of a finger ends at the fingertip.
    """
    vertices = (model.template_m if template_m is None else template_m) + model.shape_directions @ betas
    joints = model.joint_regressor @ vertices
    joint_of_vertex = model.skin_weights.argmax(axis=1)
    palm = vertices[joint_of_vertex == 0]
    wrist, knuckles = joints[0], joints[list(_KNUCKLES)]
    starts = wrist + _PALM_START * (knuckles - wrist)
    nearest = np.argmin([_to_axis(palm, start, end)[0] for start, end in zip(starts, knuckles, strict=True)], axis=0)
    capsules = [(0, *_fit_axis(palm[nearest == i], starts[i], knuckles[i], False)) for i in range(4)]
    for joint in range(1, 16):
        last = joint % 3 == 0
        end = vertices[TIP_VERTICES[joint // 3 - 1]] if last else joints[joint + 1]
        capsules.append((joint, *_fit_axis(vertices[joint_of_vertex == joint], joints[joint], end, last)))
    joint, start, end, radius = (np.array(column) for column in zip(*capsules, strict=True))
    return LocalCapsules(joint, start - joints[joint], end - joints[joint], radius)


def hand_capsules(track: HandTrackLike, model: HandModel) -> Capsules:
    """World capsules (frame, 19) of a hand track, with the shape of the first valid frame."""
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
    """``fit_capsules`` with a cache, because refinement queries a hand many times."""
    template = None if template_m is None else np.frombuffer(template_m).reshape(-1, 3)
    fitted = fit_capsules(model, np.frombuffer(betas), template)
    for array in fitted:
        array.flags.writeable = False
    return fitted


def _float64_bytes(array: np.ndarray) -> bytes:
    return np.asarray(array, dtype=np.float64).tobytes()


def world_rotmats(track: HandTrackLike) -> np.ndarray:
    """(frame, 16, 3, 3) world_from_joint rotations of MANO's joints."""
    rotmats = track_rotmats(track)
    for joint, parent in enumerate(PARENTS[1:], start=1):
        rotmats[:, joint] = rotmats[:, parent] @ rotmats[:, joint]
    return rotmats


def _fit_axis(
    skin: np.ndarray, start: np.ndarray, end: np.ndarray, is_tip: bool
) -> tuple[np.ndarray, np.ndarray, float]:
    """Axis ends and radius of a capsule; the axis is shifted sideways into the middle of the skin."""
    along = _to_axis(skin, start, end)[1]
    segment_skin = skin[(along > _SEGMENT_RANGE[0]) & (along < _SEGMENT_RANGE[1])]
    segment_skin = segment_skin if len(segment_skin) >= 4 else skin
    if not len(segment_skin):
        raise ValueError("a hand segment without skin: no vertex has its largest skin weight there")
    direction = (end - start) / np.linalg.norm(end - start)
    side = (segment_skin.min(axis=0) + segment_skin.max(axis=0)) / 2 - start
    shift = side - (side @ direction) * direction
    radius = float(np.median(_to_axis(segment_skin, start + shift, end + shift)[0]))
    if is_tip:
        reach = ((skin - start) @ direction).max()
        end = start + max(reach - radius, 0.0) * direction
    return start + shift, end + shift, radius


def _to_axis(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of points from the line through two ends, and position along the line, 0 at start and 1 at end."""
    axis = end - start
    along = (points - start) @ axis / (axis @ axis)
    return np.linalg.norm(points - start - along[:, None] * axis, axis=1), along
