"""Can frictional contacts produce the motion an object shows? Inverse dynamics as ManipNet's Appendix A, in SI units.

Each contact pushes within its friction cone, here the four edges ``-n +- mu t``. Non-negative multiples of all edges
must add up to the wrench the motion needs, ``[m (a - g); dL/dt]`` about the centre of mass. What is left over,
in N and N m, is the residual; a frame below ``RESIDUAL_LIMIT`` is feasible.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from hoidata.hands.model import HandModel
from hoidata.objects.distance import SignedDistance
from hoidata.objects.model import ObjectModel

FRICTION = 0.35
GRAVITY_M_S2 = 9.81
RESIDUAL_LIMIT = 0.01
CONTACT_TOLERANCE_M = 0.002
_NNLS_ITERATIONS = 300


class BodyMotion(NamedTuple):
    """Motion of a body of 1 kg, world frame, one row per frame.

    centre_m: (frame, 3) centre of mass. inertia_kg_m2: (frame, 3, 3) about it, world axes.
    rotmats: (frame, 3, 3) world-from-object.
    """

    centre_m: np.ndarray
    inertia_kg_m2: np.ndarray
    rotmats: np.ndarray


class Contacts(NamedTuple):
    """points_m, normals: (contact, 3), object frame; normals point out of the object."""

    points_m: np.ndarray
    normals: np.ndarray


def body_motion(
    model: ObjectModel, rotmats: np.ndarray, translation_m: np.ndarray, hinge_rad: np.ndarray | None
) -> BodyMotion:
    """Centre of mass and inertia of 1 kg in the world at each frame; a hinged object is one body at its angle."""
    n_frames = len(rotmats)
    parts = model.masses
    total = sum(part.volume_m3 for part in parts)
    shares, centres, inertias = [part.volume_m3 / total for part in parts], [], []
    for index, part in enumerate(parts):
        object_from_part = model.object_from_part(index, hinge_rad)
        turn = np.broadcast_to(object_from_part.rotation, (n_frames, 3, 3))
        centres.append((object_from_part @ np.broadcast_to(part.centre_m, (n_frames, 1, 3)))[:, 0])
        inertias.append(turn @ part.inertia_kg_m2 @ turn.transpose(0, 2, 1))
    centre = sum(share * c for share, c in zip(shares, centres, strict=True))
    inertia = np.zeros((n_frames, 3, 3))
    for share, part_centre, part_inertia in zip(shares, centres, inertias, strict=True):
        away = part_centre - centre
        square = (away**2).sum(-1)[:, None, None] * np.eye(3)
        inertia += share * (part_inertia + square - away[:, :, None] * away[:, None, :])
    world_centre = np.einsum("fij,fj->fi", rotmats, np.asarray(centre)) + translation_m
    return BodyMotion(world_centre, rotmats @ inertia @ rotmats.transpose(0, 2, 1), rotmats)


def angular_velocity(rotmats: np.ndarray, fps: float) -> np.ndarray:
    """(frame, 3) rad/s, world axes, by central differences of ``rotmats (frame, 3, 3)``; one-sided at both ends."""
    last = len(rotmats) - 1
    before = np.clip(np.arange(last + 1) - 1, 0, last)
    after = np.clip(np.arange(last + 1) + 1, 0, last)
    step = Rotation.from_matrix(rotmats[after] @ rotmats[before].transpose(0, 2, 1)).as_rotvec()
    return step * (fps / np.maximum(after - before, 1))[:, None]


def required_wrench(motion: BodyMotion, fps: float, gravity: np.ndarray) -> np.ndarray:
    """(frame, 6): force in N and torque in N m about the centre of mass that the contacts of 1 kg must apply.

    gravity: (3,) unit vector, the direction things fall. Derivatives are central differences over frames.
    """
    if len(motion.centre_m) < 3:
        raise ValueError(f"a motion of at least 3 frames is needed for accelerations, got {len(motion.centre_m)}")
    centre = motion.centre_m
    acceleration = np.empty_like(centre)
    acceleration[1:-1] = (centre[2:] - 2 * centre[1:-1] + centre[:-2]) * fps**2
    acceleration[0], acceleration[-1] = acceleration[1], acceleration[-2]
    spin = angular_velocity(motion.rotmats, fps)
    momentum = np.einsum("fij,fj->fi", motion.inertia_kg_m2, spin)
    torque = np.gradient(momentum, 1 / fps, axis=0)
    return np.concatenate([acceleration - GRAVITY_M_S2 * gravity, torque], axis=1)


def hand_patches(model: HandModel) -> np.ndarray:
    """(778,) which of 21 patches a hand vertex belongs to: 15 finger segments, then 6 regions of the palm.

    As ManipNet's capsules (Appendix A): 4 palm regions towards the fingers, the thumb's ball and the heel.
    """
    joint = model.skin_weights.argmax(axis=1)
    rest = model.joint_regressor @ model.template_m
    knuckles = rest[[1, 4, 10, 7]]
    anchors = np.concatenate(
        [rest[0] + 0.7 * (knuckles - rest[0]), [0.5 * (rest[0] + rest[13])], [rest[0] + 0.25 * (rest[7] - rest[0])]]
    )
    region = np.linalg.norm(model.template_m[:, None] - anchors, axis=2).argmin(axis=1)
    return np.where(joint == 0, 15 + region, joint - 1)


def patch_contacts(distances: SignedDistance, patches: np.ndarray, frame: int) -> Contacts:
    """At most one contact per patch: its deepest vertex, where that is nearer than 2 mm.

    The contact point is the closest surface point. distances: of points (frame, point), object frame, as
    ``SurfaceIndex.nearest`` gives them. patches: (point,) as from :func:`hand_patches`, any numbering.
    """
    order = np.argsort(distances.distance_m[frame], kind="stable")
    order = order[distances.distance_m[frame][order] < CONTACT_TOLERANCE_M]
    first = np.unique(patches[order], return_index=True)[1]
    chosen = order[first]
    return Contacts(distances.closest_m[frame][chosen], distances.normal[frame][chosen])


def cone_edges(normals: np.ndarray, friction: float = FRICTION) -> np.ndarray:
    """(contact, 4, 3) edges ``-n +- mu t`` of the friction cones; normals (contact, 3) point out of the object."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    tangents = np.stack([first, -first, second, -second], axis=1)
    return friction * tangents - normals[:, None]


def wrench_columns(
    points_m: np.ndarray, normals: np.ndarray, centre_m: np.ndarray, friction: float = FRICTION
) -> np.ndarray:
    """(6, 4 x contact): the wrench about ``centre_m`` of a unit multiple of each cone edge."""
    edges = cone_edges(normals, friction)
    torques = np.cross((points_m - centre_m)[:, None], edges)
    return np.concatenate([edges, torques], axis=2).reshape(-1, 6).T


def force_residual(
    points_m: np.ndarray, normals: np.ndarray, centre_m: np.ndarray, wrench: np.ndarray, friction: float = FRICTION
) -> float:
    """Residual in N and N m of contacts at ``points_m (contact, 3)`` against the required ``wrench (6,)``."""
    if not len(points_m):
        return float(np.linalg.norm(wrench))
    try:
        columns = wrench_columns(points_m, normals, centre_m, friction)
        return float(nnls(columns, wrench, maxiter=_NNLS_ITERATIONS)[1])
    except RuntimeError:  # no convergence: counted as infeasible, never as feasible
        return float("inf")
