"""Can frictional contacts produce the motion an object shows? Inverse dynamics as ManipNet's Appendix A, in SI units.

Each contact pushes within its friction cone, here the four edges ``-n +- mu t``. Non-negative multiples of all edges
must add up to the wrench the motion needs, ``[m (a - g); dL/dt]`` about the centre of mass. What is left over,
in N and N m, is the residual; a frame below ``RESIDUAL_LIMIT`` is feasible.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

FRICTION = 0.35
GRAVITY_M_S2 = 9.81
RESIDUAL_LIMIT = 0.01
_NNLS_ITERATIONS = 300


class BodyMotion(NamedTuple):
    """Motion of a body of 1 kg, world frame, one row per frame.

    centre_m: (frame, 3) centre of mass. inertia_kg_m2: (frame, 3, 3) about it, world axes.
    rotmats: (frame, 3, 3) world-from-object.
    """

    centre_m: np.ndarray
    inertia_kg_m2: np.ndarray
    rotmats: np.ndarray


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
