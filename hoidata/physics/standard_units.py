"""Can the contacts carry the motion? ManipNet's Appendix A in consistent SI units: the variant "SI".

Forces in N and torques in N m about the centre of mass for 1 kg, gravity 9.81 m/s^2; a frame passes when the norm of
what no contact forces give is below 0.01.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.optimize import nnls

from hoidata.physics.capsules import CapsuleContacts
from hoidata.physics.contact_forces import FRICTION, RESIDUAL_LIMIT, cone_edges
from hoidata.physics.scene import Scene

SUPPORT_M = 0.002
_SUPPORT_DIRECTIONS = 16
MOST_STEPS = 300


@dataclass(frozen=True)
class StandardUnits:
    """friction: Coulomb's coefficient. limit: of the residual's norm, N and N m.

    tolerance_m: a capsule this near counts as touching. table_m: height of a table that also supports the object, or
    None. Every contact is taken as sticking.
    """

    friction: float = FRICTION
    limit: float = RESIDUAL_LIMIT
    tolerance_m: float = 0.0
    table_m: float | None = None
    at_centre: ClassVar[bool] = False

    def residuals(self, scene: Scene, contacts: CapsuleContacts) -> np.ndarray:
        """(frame,) norm of the wrench that no friction forces at these contacts give."""
        frame, point, normal = contacts.frame, contacts.point_m, contacts.normal
        if self.table_m is not None:
            table_frame, table_point = table_contacts(scene, self.table_m)
            frame, point = np.concatenate([frame, table_frame]), np.concatenate([point, table_point])
            normal = np.concatenate([normal, np.broadcast_to(scene.gravity, (len(table_frame), 3))])
        arms = point - scene.motion.centre_m[frame]
        columns, offsets = force_columns(frame, arms, cone_edges(normal, self.friction), scene.n_frames)
        return np.linalg.norm(wrench_residuals(columns, offsets, scene.wrench), axis=1)


def force_columns(
    frame: np.ndarray, arms: np.ndarray, edges: np.ndarray, n_frames: int
) -> tuple[np.ndarray, np.ndarray]:
    """Columns (6, n) of force and torque of the edges, frame by frame, and where each frame's begin.

    frame: (contact,). arms: (contact, 3) from the reference point. edges: (contact, edge, 3).
    """
    order = np.argsort(frame, kind="stable")
    edges = edges[order]
    columns = np.concatenate([edges, np.cross(arms[order, None], edges)], axis=2).reshape(-1, 6).T
    return columns, np.r_[0, np.cumsum(np.bincount(frame, minlength=n_frames) * edges.shape[1])]


def wrench_residuals(
    columns: np.ndarray, offsets: np.ndarray, wrenches: np.ndarray, most_steps: int = MOST_STEPS
) -> np.ndarray:
    """(frame, 6) what is left of each wrench: ``wrench - columns @ x`` at the non-negative ``x`` that leaves least.

    columns: (6, column) of all frames one after another; frame i owns ``columns[:, offsets[i] : offsets[i + 1]]``,
    maybe none. offsets: (frame + 1,). wrenches: (frame, 6). Rows may have any units; the norm mixes them as they come.
    A frame that needs more than ``most_steps`` exchanges of columns keeps its wrench, whose norm is an upper bound: it
    may be called infeasible wrongly, never feasible.
    """
    if columns.ndim != 2 or len(columns) != 6 or wrenches.ndim != 2 or wrenches.shape[1] != 6:
        raise ValueError(f"columns (6, n) and wrenches (frame, 6) expected, got {columns.shape} and {wrenches.shape}")
    rising = len(offsets) == len(wrenches) + 1 and offsets[0] == 0 and (np.diff(offsets) >= 0).all()
    if not rising or offsets[-1] != columns.shape[1]:
        raise ValueError("offsets must rise from 0 to the number of columns, one more than there are frames")
    if not (np.isfinite(columns).all() and np.isfinite(wrenches).all()):
        raise ValueError("finite columns and wrenches expected")
    left = np.array(wrenches, dtype=np.float64)
    for frame in np.flatnonzero(np.diff(offsets)):
        own = columns[:, offsets[frame] : offsets[frame + 1]]
        try:
            left[frame] -= own @ nnls(own, wrenches[frame], maxiter=most_steps)[0]
        except RuntimeError:  # no convergence
            continue
    return left


def table_contacts(scene: Scene, table_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Frames (contact,) and world points (contact, 3) where the object stands on a table top of this height.

    Vertices within 2 mm of it; of many, those farthest out in 16 directions.
    """
    normal = cone_edges(scene.gravity[None], 1.0)[0] + scene.gravity
    angles = np.arange(_SUPPORT_DIRECTIONS) * (2 * np.pi / _SUPPORT_DIRECTIONS)
    directions = np.cos(angles)[:, None] * normal[0] + np.sin(angles)[:, None] * normal[2]
    frames, points = [], []
    for frame in np.flatnonzero(np.abs(scene.lowest_m - table_m) < SUPPORT_M):
        vertices = scene.vertices_m(slice(frame, frame + 1))[0]
        touching = vertices[np.abs(-vertices @ scene.gravity - table_m) < SUPPORT_M]
        outer = touching[np.unique((touching @ directions.T).argmax(axis=0))]
        frames.append(np.full(len(outer), frame))
        points.append(outer)
    if not frames:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    return np.concatenate(frames), np.concatenate(points)
