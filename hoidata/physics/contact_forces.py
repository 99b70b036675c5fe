"""Inverse dynamics: can frictional contacts explain an object's motion? ManipNet's Appendix A in SI units.

Each contact force is in a friction cone, approximated by the four edges ``-n +- mu t``. Non-negative multiples of all
edges must sum to the wrench of the motion, ``[m (a - g); dL/dt]`` about the centre of mass. The residual is the norm of
the difference, in N and N m. A frame is feasible if its residual is below ``RESIDUAL_LIMIT``.
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
    """Motion of a body of 1 kg in the world frame."""

    centre_m: np.ndarray  # (frame, 3) centre of mass
    inertia_kg_m2: np.ndarray  # (frame, 3, 3) about the centre of mass, world axes
    rotmats: np.ndarray  # (frame, 3, 3) world_from_object


class Contacts(NamedTuple):
    """Contact points on an object, in the object frame."""

    points_m: np.ndarray  # (contact, 3)
    normals: np.ndarray  # (contact, 3) unit, outward


def body_motion(
    model: ObjectModel, rotmats: np.ndarray, translation_m: np.ndarray, hinge_rad: np.ndarray | None
) -> BodyMotion:
    """Centre of mass and inertia of an object of 1 kg in each frame; a hinged object is one body at its angle."""
    n_frames = len(rotmats)
    parts = model.masses
    total = sum(part.volume_m3 for part in parts)
    mass_fractions, centres, inertias = [part.volume_m3 / total for part in parts], [], []
    for index, part in enumerate(parts):
        object_from_part = model.object_from_part(index, hinge_rad)
        part_rotation = np.broadcast_to(object_from_part.rotation, (n_frames, 3, 3))
        centres.append((object_from_part @ np.broadcast_to(part.centre_m, (n_frames, 1, 3)))[:, 0])
        inertias.append(part_rotation @ part.inertia_kg_m2 @ part_rotation.transpose(0, 2, 1))
    centre = sum(mass_fraction * c for mass_fraction, c in zip(mass_fractions, centres, strict=True))
    inertia = np.zeros((n_frames, 3, 3))
    for mass_fraction, part_centre, part_inertia in zip(mass_fractions, centres, inertias, strict=True):
        offset = part_centre - centre
        # Parallel axis theorem: shift the inertia of the part to the common centre of mass.
        squared_offset = (offset**2).sum(-1)[:, None, None] * np.eye(3)
        inertia += mass_fraction * (part_inertia + squared_offset - offset[:, :, None] * offset[:, None, :])
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
    """Wrench that contacts must apply to a body of 1 kg, by central differences over frames.

    Args:
        gravity: (3,) unit vector, downwards.

    Returns:
        (frame, 6) force in N and torque in N m about the centre of mass.
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
    """(778,) patch of each hand vertex, 0 to 20: 15 finger segments, then 6 regions of the palm.

    As in ManipNet's capsules (Appendix A), the palm has 4 regions towards the fingers, the thumb's ball and the heel.
    """
    joint = model.skin_weights.argmax(axis=1)
    rest = model.joint_regressor @ model.template_m
    knuckles = rest[[1, 4, 10, 7]]  # index, middle, ring, pinky
    anchors = np.concatenate(
        [rest[0] + 0.7 * (knuckles - rest[0]), [0.5 * (rest[0] + rest[13])], [rest[0] + 0.25 * (rest[7] - rest[0])]]
    )
    region = np.linalg.norm(model.template_m[:, None] - anchors, axis=2).argmin(axis=1)
    return np.where(joint == 0, 15 + region, joint - 1)


def patch_contacts(distances: SignedDistance, patches: np.ndarray, frame: int) -> Contacts:
    """Contacts of one frame: of each patch, the deepest vertex if it is within 2 mm of the surface.

    Args:
        distances: of points (frame, point), object frame, from ``SurfaceIndex.nearest``.
        patches: (point,) labels, such as those of :func:`hand_patches`.

    Returns:
        The closest surface points and their normals.
    """
    # Sorted by distance, the first vertex of each patch is the deepest.
    order = np.argsort(distances.distance_m[frame], kind="stable")
    order = order[distances.distance_m[frame][order] < CONTACT_TOLERANCE_M]
    first = np.unique(patches[order], return_index=True)[1]
    chosen = order[first]
    return Contacts(distances.closest_m[frame][chosen], distances.normal[frame][chosen])


def cone_edges(normals: np.ndarray, friction: float = FRICTION) -> np.ndarray:
    """(contact, 4, 3) edges ``-n +- mu t`` of the friction cones; outward normals (contact, 3)."""
    # A vector that is not parallel to the normal.
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    tangents = np.stack([first, -first, second, -second], axis=1)
    return friction * tangents - normals[:, None]


def wrench_columns(
    points_m: np.ndarray, normals: np.ndarray, centre_m: np.ndarray, friction: float = FRICTION
) -> np.ndarray:
    """(6, 4 x contact) wrench about ``centre_m`` of a unit multiple of each cone edge."""
    edges = cone_edges(normals, friction)
    torques = np.cross((points_m - centre_m)[:, None], edges)
    return np.concatenate([edges, torques], axis=2).reshape(-1, 6).T


def force_residual(
    points_m: np.ndarray, normals: np.ndarray, centre_m: np.ndarray, wrench: np.ndarray, friction: float = FRICTION
) -> float:
    """Residual in N and N m of contacts at ``points_m`` (contact, 3) for the required ``wrench`` (6,)."""
    if not len(points_m):
        return float(np.linalg.norm(wrench))
    try:
        columns = wrench_columns(points_m, normals, centre_m, friction)
        return float(nnls(columns, wrench, maxiter=_NNLS_ITERATIONS)[1])
    except RuntimeError:  # no convergence: never count as feasible
        return float("inf")
