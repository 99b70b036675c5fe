"""Can the contacts carry the motion? ManipNet's Appendix A in consistent SI units: the variant "SI".

Forces in N and torques in N m about the centre of mass for 1 kg, gravity 9.81 m/s^2; a frame passes when the norm of
what no contact forces give is below 0.01.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hoidata.physics.capsules import CapsuleContacts
from hoidata.physics.contact_forces import FRICTION, RESIDUAL_LIMIT, cone_edges
from hoidata.physics.nnls import wrench_residuals
from hoidata.physics.scene import Scene

SUPPORT_M = 0.002
_SUPPORT_DIRECTIONS = 16


@dataclass(frozen=True)
class StandardUnits:
    """friction: Coulomb's coefficient. limit: of the residual's norm, N and N m.

    tolerance_m: a capsule this near counts as touching. torque_length_m: torques are divided by it before they are
    mixed with forces; 1 leaves them in N m. sliding_m_s: a contact whose two surfaces slide faster than this gets one
    force, kinetic friction in the direction the hand slides over the object; None takes every contact as sticking.
    table_m: height of a table that also supports the object, or None.
    """

    friction: float = FRICTION
    limit: float = RESIDUAL_LIMIT
    tolerance_m: float = 0.0
    torque_length_m: float = 1.0
    sliding_m_s: float | None = None
    table_m: float | None = None
    name: ClassVar[str] = "SI"
    at_centre: ClassVar[bool] = False

    def residuals(self, scene: Scene, contacts: CapsuleContacts) -> np.ndarray:
        """(frame,) norm of the wrench that no friction forces at these contacts give."""
        edges, kept = cone_edges(contacts.normal, self.friction), np.ones((len(contacts.frame), 4), dtype=bool)
        if self.sliding_m_s is not None:
            velocity = sliding_velocity(scene, contacts)
            speed = np.linalg.norm(velocity, axis=1)
            slides = speed > self.sliding_m_s
            edges[slides, 0] = self.friction * velocity[slides] / speed[slides, None] - contacts.normal[slides]
            kept[slides, 1:] = False
        frame, point = contacts.frame, contacts.point_m
        if self.table_m is not None:
            table_frame, table_point = table_contacts(scene, self.table_m)
            normal = np.broadcast_to(scene.gravity, (len(table_frame), 3))
            frame, point = np.concatenate([frame, table_frame]), np.concatenate([point, table_point])
            edges = np.concatenate([edges, cone_edges(normal, self.friction)])
            kept = np.concatenate([kept, np.ones((len(table_frame), 4), dtype=bool)])
        arms = (point - scene.motion.centre_m[frame]) / self.torque_length_m
        columns, offsets = force_columns(frame, arms, edges, kept, scene.n_frames)
        wrench = scene.wrench / np.repeat([1.0, self.torque_length_m], 3)
        return np.linalg.norm(wrench_residuals(columns, offsets, wrench), axis=1)


def force_columns(
    frame: np.ndarray, arms: np.ndarray, edges: np.ndarray, kept: np.ndarray, n_frames: int
) -> tuple[np.ndarray, np.ndarray]:
    """Columns (6, n) of force and torque of the ``kept (contact, edge)`` edges, frame by frame, and where each begins.

    frame: (contact,). arms: (contact, 3) from the reference point. edges: (contact, edge, 3).
    """
    order = np.argsort(frame, kind="stable")
    frame, arms, edges, kept = frame[order], arms[order], edges[order], kept[order]
    columns = np.concatenate([edges, np.cross(arms[:, None], edges)], axis=2)[kept].T
    counts = np.bincount(frame, weights=kept.sum(axis=1), minlength=n_frames).astype(np.int64)
    return columns, np.r_[0, np.cumsum(counts)]


def sliding_velocity(scene: Scene, contacts: CapsuleContacts) -> np.ndarray:
    """(contact, 3) m/s, world axes, along the surface: how the hand's skin moves over the touched part.

    From central differences in the part's frame. A capsule's spin about its own axis is not known and left out.
    """
    result = np.zeros((len(contacts.frame), 3))
    for part in np.unique(contacts.part):
        own = contacts.part == part
        world_from_part = scene.poses.world_from_part(scene.model, int(part))
        frame, capsule = contacts.frame[own], contacts.capsule[own]
        before, after = np.maximum(frame - 1, 0), np.minimum(frame + 1, scene.n_frames - 1)
        start, end = (world_from_part.inverse() @ ends for ends in (scene.capsules.start_m, scene.capsules.end_m))
        rate = (scene.fps / np.maximum(after - before, 1))[:, None]
        start_rate = (start[after, capsule] - start[before, capsule]) * rate
        axis_rate = (end[after, capsule] - end[before, capsule]) * rate - start_rate
        axis, along = (end - start)[frame, capsule], contacts.along[own, None]
        spin = np.cross(axis, axis_rate) / np.maximum((axis**2).sum(axis=1), 1e-12)[:, None]
        point = (world_from_part[frame].inverse() @ contacts.point_m[own, None])[:, 0]
        skin = start_rate + along * axis_rate + np.cross(spin, point - start[frame, capsule] - along * axis)
        result[own] = world_from_part[frame].turn(np.nan_to_num(skin)[:, None])[:, 0]
    inward = np.einsum("ni,ni->n", result, contacts.normal)
    return result - inward[:, None] * contacts.normal


def table_contacts(scene: Scene, table_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Frames (contact,) and world points (contact, 3) where the object stands on a table top of this height.

    Vertices within 2 mm of it; of many, those farthest out in 16 directions.
    """
    normal = cone_edges(scene.gravity[None], 1.0)[0] + scene.gravity
    angles = np.arange(_SUPPORT_DIRECTIONS) * (2 * np.pi / _SUPPORT_DIRECTIONS)
    directions = np.cos(angles)[:, None] * normal[0] + np.sin(angles)[:, None] * normal[2]
    frames, points = [], []
    for frame in np.flatnonzero(np.abs(scene.lowest_m - table_m) < SUPPORT_M):
        vertices = scene.vertices_m[frame]
        touching = vertices[np.abs(-vertices @ scene.gravity - table_m) < SUPPORT_M]
        outer = touching[np.unique((touching @ directions.T).argmax(axis=0))]
        frames.append(np.full(len(outer), frame))
        points.append(outer)
    if not frames:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    return np.concatenate(frames), np.concatenate(points)
