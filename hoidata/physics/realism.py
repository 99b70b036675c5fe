"""Physical realism, penetration and smoothness of hand-object motion, as ManipNet (Zhang et al. 2021, Sec. 8) measures.

Scored are lifted frames in which no capsule is 1.5 cm or more inside the object, in two variants: SI units, and as
released.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from hoidata.physics.capsules import CapsuleContacts, capsule_contacts
from hoidata.physics.contact_forces import FRICTION, RESIDUAL_LIMIT, cone_edges
from hoidata.physics.scene import Scene

LARGEST_PENETRATION_M = 0.015
SMOOTHNESS_FPS = 60.0
SUPPORT_M = 0.002
MOST_STEPS = 300
RELEASED_UNITS_PER_METRE = 10.0
RELEASED_GRAVITY_PER_S = 9.8
RELEASED_STEPS = 100
_SUPPORT_DIRECTIONS = 16


@dataclass(frozen=True)
class StandardUnits:
    """ManipNet's Appendix A in consistent SI units: can the contacts carry the motion?

    Forces in N and torques in N m about the centre of mass for 1 kg, gravity 9.81 m/s^2; a frame passes when the norm
    of what no contact forces give is below the limit.

    friction: Coulomb's coefficient. limit: of the residual's norm, N and N m.

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


@dataclass(frozen=True)
class AsReleased:
    """The units of ManipNet's released sources, kept so that figures can be set beside the paper's.

    Its floor should be seen: gravity is ten times too small for lengths in decimetres, so part of a motion passes with
    no contact at all. Facts: ``reference/manipnet-data.md``; the driver of the evaluation is not public.

    Lengths in dm; velocity a forward difference per second, acceleration its difference per frame, not divided by
    the frame time; gravity 9.8 times the frame time; mass 1, inertia of the mesh in dm^2 about its centre of mass;
    angular velocity in object axes used as if in the world's; friction edges (+-1, 1/mu, 0), (0, 1/mu, +-1), not
    normalised; at most 100 steps; a frame passes when the mean of the six squared residuals is below 0.01.

    reference: the point that moves and that torques are about. The sources say the object's origin; the paper's Eq. 9
    the centre of mass. They agree where a mesh is centred; the released meshes are not, by up to 10 cm.
    """

    friction: float = 0.35
    limit: float = 0.01
    tolerance_m: float = 0.0
    reference: Literal["centre of mass", "origin"] = "centre of mass"
    at_centre: ClassVar[bool] = True

    def residuals(self, scene: Scene, contacts: CapsuleContacts) -> np.ndarray:
        """(frame,) mean of the six squared residuals."""
        centre = scene.motion.centre_m if self.reference == "centre of mass" else scene.poses.translation_m
        edges = friction_edges(contacts.normal, self.friction)
        arms = (contacts.point_m - centre[contacts.frame]) * RELEASED_UNITS_PER_METRE
        columns, offsets = force_columns(contacts.frame, arms, edges, scene.n_frames)
        return np.square(wrench_residuals(columns, offsets, self.wrench(scene, centre), RELEASED_STEPS)).mean(axis=1)

    def wrench(self, scene: Scene, centre_m: np.ndarray) -> np.ndarray:
        """(frame, 6) change of momentum per frame, gravity taken off; last frames repeat the one before."""
        step_s = 1 / scene.fps
        velocity = _forward(centre_m * RELEASED_UNITS_PER_METRE) / step_s
        rotmats, inertia = scene.poses.rotmats, scene.motion.inertia_kg_m2 * RELEASED_UNITS_PER_METRE**2
        turned = Rotation.from_matrix(rotmats[:-1].transpose(0, 2, 1) @ rotmats[1:]).as_rotvec() / step_s
        spin = np.concatenate([turned, turned[-1:]])
        force = _forward(velocity) - RELEASED_GRAVITY_PER_S * step_s * scene.gravity
        momentum = np.einsum("fij,fj->fi", inertia, spin)
        torque = np.einsum("fij,fj->fi", inertia, _forward(spin)) + step_s * np.cross(spin, momentum)
        return np.concatenate([force, torque], axis=1)


def friction_edges(normals: np.ndarray, friction: float) -> np.ndarray:
    """(contact, 4, 3) edges (+-1, 1/mu, 0), (0, 1/mu, +-1); the second axis turned onto the inward normal."""
    inward = -normals
    along = inward[:, 1].clip(-1 + 1e-9)
    x, _, z = inward.T
    # The smallest turn that takes (0, 1, 0) to the inward normal, column by column.
    first = np.stack([1 - x * x / (1 + along), -x, -x * z / (1 + along)], axis=1)
    third = np.stack([-x * z / (1 + along), -z, 1 - z * z / (1 + along)], axis=1)
    push = inward / friction
    return np.stack([first + push, -first + push, third + push, -third + push], axis=1)


def _forward(values: np.ndarray) -> np.ndarray:
    change = np.diff(values, axis=0)
    return np.concatenate([change, change[-1:]])


# A way to score frames.
Variant = StandardUnits | AsReleased


class Realism(NamedTuple):
    """frames: (scored frame,) index in the scene. residual: (scored frame,) in the variant's unit. passed: bool.

    penetration_m: (frame,) deepest capsule of each frame of the scene that was looked at, 0 without overlap; NaN for
    frames not looked at. colliding_m: mean depth over overlapping capsules and frames looked at; NaN without any.
    """

    frames: np.ndarray
    residual: np.ndarray
    passed: np.ndarray
    penetration_m: np.ndarray
    colliding_m: float

    @property
    def share(self) -> float:
        """Of scored frames, those that passed; NaN when none is scored."""
        return float(self.passed.mean()) if len(self.passed) else float("nan")


def score(scene: Scene, variant: Variant, frames: np.ndarray | None = None) -> Realism:
    """frames: (frame,) bool, which to look at, such as ``scene.lifted`` (if not given) or ``scene.held``.

    At least 3 frames are needed for accelerations.
    """
    frames = scene.lifted if frames is None else frames
    looked_at, near = np.flatnonzero(frames), contacts_in(scene, frames, variant.tolerance_m)
    contacts = near.at_middle() if variant.at_centre else near
    penetration = np.full(scene.n_frames, np.nan)
    penetration[looked_at] = 0.0
    np.maximum.at(penetration, contacts.frame, contacts.depth_m)
    scored = looked_at[penetration[looked_at] < LARGEST_PENETRATION_M]
    residual = variant.residuals(scene, contacts)[scored]
    inside = contacts.depth_m[contacts.depth_m > 0]
    mean_depth = float(inside.mean()) if len(inside) else float("nan")
    return Realism(scored, residual, residual < variant.limit, penetration, mean_depth)


def contacts_in(scene: Scene, frames: np.ndarray, tolerance_m: float = 0.0) -> CapsuleContacts:
    """Capsules that touch in frames (frame,) bool, numbered as in the scene; kept for the next to ask."""
    looked_at = np.flatnonzero(frames)
    near = _near(scene, looked_at.tobytes(), tolerance_m)
    return near._replace(frame=looked_at[near.frame])


@lru_cache(maxsize=2)
def _near(scene: Scene, looked_at: bytes, tolerance_m: float) -> CapsuleContacts:
    """Contacts in some frames (int64 numbers), kept for a scene and its floor: every variant asks, and it is dear."""
    frames = np.frombuffer(looked_at, np.int64)
    return capsule_contacts(scene.model, scene.poses.taken(frames), scene.capsules.taken(frames), tolerance_m)


VARIANTS: Mapping[str, Variant] = MappingProxyType({"SI": StandardUnits(), "as released": AsReleased()})


def smoothness_m_s2(joints_m: np.ndarray, wrist_rotmats: np.ndarray, fps: float) -> float:
    """Mean acceleration of a hand's joints in the wrist's frame, m/s^2: jitter shows as a large figure.

    joints_m: (frame, joint, 3) world, the wrist first, NaN where the hand is not there; wrist_rotmats: (frame, 3, 3)
    world_from_wrist. Second differences at ManipNet's 60 Hz where the frames are a multiple of it, else at ``fps``.
    Raises ValueError without three frames in a row.
    """
    if not has_acceleration(joints_m, fps):
        rate = fps / _stride(fps)
        raise ValueError(f"three frames in a row are needed for accelerations, got {len(joints_m)} at {rate:g} Hz")
    every = _stride(fps)
    local = ((joints_m - joints_m[:, :1]) @ wrist_rotmats)[::every]
    return float(np.nanmean(np.linalg.norm(np.diff(local, n=2, axis=0) * (fps / every) ** 2, axis=-1)))


def _stride(fps: float) -> int:
    return max(1, round(fps / SMOOTHNESS_FPS))


def has_acceleration(joints_m: np.ndarray, fps: float) -> bool:
    """Whether ``smoothness_m_s2`` finds three frames in a row with the hand. Arguments as there."""
    there = np.asarray(np.isfinite(joints_m).all(axis=(1, 2)))[:: _stride(fps)]
    return bool((there[2:] & there[1:-1] & there[:-2]).any())
