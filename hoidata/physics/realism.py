"""Physical realism, penetration and smoothness of hand-object motion (ManipNet, Zhang et al. 2021, Sec. 8).

``score`` takes lifted frames without a capsule 1.5 cm or more inside the object. There are two variants: SI units, and
the units of ManipNet's release. ``every_frame_passes`` takes all frames, and the table carries an object on it.
"""

from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from hoidata.physics.capsules import CapsuleContacts, capsule_contacts
from hoidata.physics.contact_forces import FRICTION, RESIDUAL_LIMIT, cone_edges
from hoidata.physics.scene import Scene

LARGEST_PENETRATION_M = 0.015
SMOOTHNESS_FPS = 60.0
MAX_STEPS = 300
TABLE_CONTACT_M = 0.005  # vertices of a resting object this far above its lowest one touch the table
_TABLE_CORNERS = 8  # contacts with the table: the outermost vertices in as many horizontal directions
RELEASED_UNITS_PER_METRE = 10.0
RELEASED_GRAVITY_PER_S = 9.8
RELEASED_STEPS = 100
RELEASED_FRICTION = 0.35


class StandardUnits:
    """ManipNet's Appendix A in SI units: do contact forces explain the motion?

    Forces are in N and torques in N m about the centre of mass of 1 kg, with gravity 9.81 m/s^2. All contacts stick. A
    frame passes if the norm of its residual wrench is below the limit.
    """

    limit: ClassVar[float] = RESIDUAL_LIMIT  # of the residual's norm, N and N m
    at_centre: ClassVar[bool] = False

    def residuals(self, scene: Scene, contacts: "CapsuleContacts | WorldContacts") -> np.ndarray:
        """(frame,) norm of the residual wrench after the best contact forces."""
        arms = contacts.point_m - scene.motion.centre_m[contacts.frame]
        columns, offsets = force_columns(contacts.frame, arms, cone_edges(contacts.normal, FRICTION), scene.n_frames)
        return np.linalg.norm(wrench_residuals(columns, offsets, scene.wrench), axis=1)


def force_columns(
    frame: np.ndarray, arms: np.ndarray, edges: np.ndarray, n_frames: int
) -> tuple[np.ndarray, np.ndarray]:
    """Wrenches of the cone edges of all frames.

    Args:
        frame: (contact,) index of the contact's frame.
        arms: (contact, 3) from the reference point to the contact.
        edges: (contact, edge, 3).

    Returns:
        Columns (6, n) sorted by frame, and offsets (frame + 1,) of each frame's first column.
    """
    order = np.argsort(frame, kind="stable")
    edges = edges[order]
    columns = np.concatenate([edges, np.cross(arms[order, None], edges)], axis=2).reshape(-1, 6).T
    return columns, np.r_[0, np.cumsum(np.bincount(frame, minlength=n_frames) * edges.shape[1])]


def wrench_residuals(
    columns: np.ndarray, offsets: np.ndarray, wrenches: np.ndarray, max_steps: int = MAX_STEPS
) -> np.ndarray:
    """Residual ``wrench - columns @ x`` of each frame for the best non-negative ``x``.

    A frame that needs more than ``max_steps`` exchanges of columns keeps its wrench, an upper bound. So it may be
    classified as infeasible wrongly, but never as feasible.

    Args:
        columns: (6, column) of all frames; frame i has ``columns[:, offsets[i] : offsets[i + 1]]``, maybe none.
        offsets: (frame + 1,).
        wrenches: (frame, 6). Force and torque may have any units, which the norm mixes.

    Returns:
        (frame, 6).
    """
    if columns.ndim != 2 or len(columns) != 6 or wrenches.ndim != 2 or wrenches.shape[1] != 6:
        raise ValueError(f"columns (6, n) and wrenches (frame, 6) expected, got {columns.shape} and {wrenches.shape}")
    rising = len(offsets) == len(wrenches) + 1 and offsets[0] == 0 and (np.diff(offsets) >= 0).all()
    if not rising or offsets[-1] != columns.shape[1]:
        raise ValueError("offsets must rise from 0 to the number of columns, one more than there are frames")
    if not (np.isfinite(columns).all() and np.isfinite(wrenches).all()):
        raise ValueError("finite columns and wrenches expected")
    residuals = np.array(wrenches, dtype=np.float64)
    for frame in np.flatnonzero(np.diff(offsets)):
        frame_columns = columns[:, offsets[frame] : offsets[frame + 1]]
        try:
            residuals[frame] -= frame_columns @ nnls(frame_columns, wrenches[frame], maxiter=max_steps)[0]
        except RuntimeError:  # no convergence
            continue
    return residuals


class AsReleased:
    """The units of ManipNet's released sources, for comparison with the paper's results.

    Gravity is ten times too small for lengths in decimetres, so part of a motion passes without any contact. The driver
    of the evaluation is not public. The moving point, and reference of torques, is the centre of mass of the paper's
    Eq. 9; in the sources it is the object's origin, up to 10 cm away in the released meshes.

    - Lengths are in dm.
    - Velocity is a forward difference per second; acceleration is its difference per frame, not divided by the frame
      time. Gravity is 9.8 times the frame time.
    - Mass is 1; the inertia of the mesh is in dm^2 about its centre of mass.
    - Angular velocity in object axes is used as if in world axes.
    - Friction edges are (+-1, 1/mu, 0) and (0, 1/mu, +-1), not normalized.
    - The solver takes at most 100 steps. A frame passes if the mean of the six squared residuals is below 0.01.
    """

    limit: ClassVar[float] = 0.01
    at_centre: ClassVar[bool] = True

    def residuals(self, scene: Scene, contacts: CapsuleContacts) -> np.ndarray:
        """(frame,) mean of the six squared residuals."""
        edges = friction_edges(contacts.normal)
        arms = (contacts.point_m - scene.motion.centre_m[contacts.frame]) * RELEASED_UNITS_PER_METRE
        columns, offsets = force_columns(contacts.frame, arms, edges, scene.n_frames)
        return np.square(wrench_residuals(columns, offsets, self.wrench(scene), RELEASED_STEPS)).mean(axis=1)

    def wrench(self, scene: Scene) -> np.ndarray:
        """(frame, 6) change of momentum per frame minus gravity; the last frames repeat the previous value."""
        step_s = 1 / scene.fps
        velocity = _forward(scene.motion.centre_m * RELEASED_UNITS_PER_METRE) / step_s
        rotmats, inertia = scene.poses.rotmats, scene.motion.inertia_kg_m2 * RELEASED_UNITS_PER_METRE**2
        spin_steps = Rotation.from_matrix(rotmats[:-1].transpose(0, 2, 1) @ rotmats[1:]).as_rotvec() / step_s
        spin = np.concatenate([spin_steps, spin_steps[-1:]])
        force = _forward(velocity) - RELEASED_GRAVITY_PER_S * step_s * scene.gravity
        momentum = np.einsum("fij,fj->fi", inertia, spin)
        torque = np.einsum("fij,fj->fi", inertia, _forward(spin)) + step_s * np.cross(spin, momentum)
        return np.concatenate([force, torque], axis=1)


def friction_edges(normals: np.ndarray) -> np.ndarray:
    """(contact, 4, 3) edges (+-1, 1/mu, 0) and (0, 1/mu, +-1), with the second axis rotated to the inward normal."""
    inward = -normals
    along = inward[:, 1].clip(-1 + 1e-9)
    x, _, z = inward.T
    # Columns of the smallest rotation that takes (0, 1, 0) to the inward normal.
    first = np.stack([1 - x * x / (1 + along), -x, -x * z / (1 + along)], axis=1)
    third = np.stack([-x * z / (1 + along), -z, 1 - z * z / (1 + along)], axis=1)
    push = inward / RELEASED_FRICTION
    return np.stack([first + push, -first + push, third + push, -third + push], axis=1)


def _forward(values: np.ndarray) -> np.ndarray:
    change = np.diff(values, axis=0)
    return np.concatenate([change, change[-1:]])


Variant = StandardUnits | AsReleased


class Realism(NamedTuple):
    """Physical realism of a scene's selected frames."""

    frames: np.ndarray  # (scored frame,) index in the scene
    residual: np.ndarray  # (scored frame,) in the variant's unit
    passed: np.ndarray  # (scored frame,) bool
    penetration_m: np.ndarray  # (frame,) depth of the deepest capsule, 0 without overlap; NaN for other frames
    colliding_m: float  # mean depth over overlapping capsules of the selected frames; NaN without any

    @property
    def share(self) -> float:
        """Fraction of scored frames that passed; NaN without scored frames."""
        return float(self.passed.mean()) if len(self.passed) else float("nan")


def score(scene: Scene, variant: Variant, frames: np.ndarray | None = None) -> Realism:
    """Score the physical realism of a scene of at least 3 frames.

    Args:
        frames: (frame,) bool, the frames to select; ``scene.lifted`` by default.
    """
    frames = scene.lifted if frames is None else frames
    selected, touching = np.flatnonzero(frames), contacts_in(scene, frames)
    contacts = touching.at_middle() if variant.at_centre else touching
    penetration = np.full(scene.n_frames, np.nan)
    penetration[selected] = 0.0
    np.maximum.at(penetration, contacts.frame, contacts.depth_m)
    scored = selected[penetration[selected] < LARGEST_PENETRATION_M]
    residual = variant.residuals(scene, contacts)[scored]
    inside = contacts.depth_m[contacts.depth_m > 0]
    mean_depth = float(inside.mean()) if len(inside) else float("nan")
    return Realism(
        frames=scored,
        residual=residual,
        passed=residual < variant.limit,
        penetration_m=penetration,
        colliding_m=mean_depth,
    )


class WorldContacts(NamedTuple):
    """Contacts with an object in the world frame."""

    frame: np.ndarray  # (contact,) int
    point_m: np.ndarray  # (contact, 3)
    normal: np.ndarray  # (contact, 3) unit, outward of the object


def every_frame_passes(scene: Scene, frames: np.ndarray) -> np.ndarray:
    """(selected frame,) bool: contact forces of hands and table explain the motion, and no capsule is 1.5 cm inside.

    The table pushes in frames in which the object is not lifted. SI units; frames (frame,) bool.
    """
    hands, table = contacts_in(scene, frames), table_contacts(scene, np.flatnonzero(frames & ~scene.lifted))
    columns = zip((hands.frame, hands.point_m, hands.normal), table, strict=True)
    contacts = WorldContacts(*(np.concatenate(column) for column in columns))
    passed = StandardUnits().residuals(scene, contacts) < StandardUnits.limit
    passed[hands.frame[hands.depth_m >= LARGEST_PENETRATION_M]] = False
    return passed[frames]


def table_contacts(scene: Scene, frames: np.ndarray) -> WorldContacts:
    """Contacts with the table in frames (frame,) int: the outermost of the object's lowest vertices."""
    model, poses = scene.model, scene.poses.taken(frames)
    side, other = np.linalg.svd(scene.gravity[None])[2][1:]  # horizontal unit vectors
    angles = 2 * np.pi * np.arange(_TABLE_CORNERS) / _TABLE_CORNERS
    directions = np.outer(np.cos(angles), side) + np.outer(np.sin(angles), other)
    parts = [(poses.world_from_part(model, part), model.vertices_of(part)) for part in model.parts]
    points = []
    for index, lowest_m in enumerate(scene.lowest_m[frames]):
        vertices = np.concatenate([world_from_part[[index]] @ rows[None] for world_from_part, rows in parts], axis=1)[0]
        touching = vertices[-vertices @ scene.gravity <= lowest_m + TABLE_CONTACT_M]
        points.append(touching[np.unique((touching @ directions.T).argmax(axis=0))])
    counts = [len(rows) for rows in points]
    point = np.concatenate([np.zeros((0, 3)), *points])
    return WorldContacts(np.repeat(frames, counts), point, np.broadcast_to(scene.gravity, point.shape))


def contacts_in(scene: Scene, frames: np.ndarray) -> CapsuleContacts:
    """Capsule contacts in frames (frame,) bool, with the scene's frame indices; cached."""
    selected = np.flatnonzero(frames)
    contacts = _cached_contacts(scene, selected.tobytes())
    return contacts._replace(frame=selected[contacts.frame])


@lru_cache(maxsize=2)
def _cached_contacts(scene: Scene, selected: bytes) -> CapsuleContacts:
    """Contacts in some frames (int64 indices as bytes), cached because all variants need them."""
    frames = np.frombuffer(selected, np.int64)
    return capsule_contacts(scene.model, scene.poses.taken(frames), scene.capsules.taken(frames))


VARIANTS: Mapping[str, Variant] = MappingProxyType({"SI": StandardUnits(), "as released": AsReleased()})


def smoothness_m_s2(joints_m: np.ndarray, wrist_rotmats: np.ndarray, fps: float) -> float:
    """Mean acceleration of a hand's joints in the wrist's frame, m/s^2, which is large for jitter.

    Second differences are at ManipNet's 60 Hz if ``fps`` is a multiple, else at ``fps``.

    Args:
        joints_m: (frame, joint, 3) world, the wrist first, NaN without the hand.
        wrist_rotmats: (frame, 3, 3) world_from_wrist.

    Raises:
        ValueError: the hand has fewer than three successive frames.
    """
    if not has_acceleration(joints_m, fps):
        rate = fps / _stride(fps)
        raise ValueError(f"three frames in a row are needed for accelerations, got {len(joints_m)} at {rate:g} Hz")
    stride = _stride(fps)
    local = ((joints_m - joints_m[:, :1]) @ wrist_rotmats)[::stride]
    return float(np.nanmean(np.linalg.norm(np.diff(local, n=2, axis=0) * (fps / stride) ** 2, axis=-1)))


def _stride(fps: float) -> int:
    return max(1, round(fps / SMOOTHNESS_FPS))


def has_acceleration(joints_m: np.ndarray, fps: float) -> bool:
    """Whether three successive frames have the hand, as ``smoothness_m_s2`` requires. Same arguments."""
    is_finite = np.asarray(np.isfinite(joints_m).all(axis=(1, 2)))[:: _stride(fps)]
    return bool((is_finite[2:] & is_finite[1:-1] & is_finite[:-2]).any())
