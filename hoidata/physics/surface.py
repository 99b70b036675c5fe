"""Hands against an object's surface: signed distances per frame, contacts, penetration.

Everything happens in the object frame, where the surface of a rigid object does not change from frame to frame; the
moving part of a hinged object is met in its own rest frame.
"""

from typing import NamedTuple

import numpy as np

from hoidata.geometry.transform import RigidTransform
from hoidata.hands.model import HandModel
from hoidata.objects.distance import signed_distance
from hoidata.objects.model import ObjectModel
from hoidata.physics.contact_forces import BodyMotion

REACH_M = 0.03
CONTACT_TOLERANCE_M = 0.002


class SurfaceDistances(NamedTuple):
    """Of points (frame, point): distance_m, negative inside, ``inf`` beyond the reach; closest_m, normal (..., 3).

    ``closest_m`` and ``normal`` are in the object frame and zero beyond the reach.
    """

    distance_m: np.ndarray
    closest_m: np.ndarray
    normal: np.ndarray


class Contacts(NamedTuple):
    """points_m, normals: (contact, 3), object frame; normals point out of the object."""

    points_m: np.ndarray
    normals: np.ndarray


def surface_distances(
    model: ObjectModel, hinge_rad: np.ndarray | None, points_m: np.ndarray, reach_m: float = REACH_M
) -> SurfaceDistances:
    """Signed distances of ``points_m (frame, point, 3)``, object frame, to the object at each frame's hinge angle."""
    shape = points_m.shape[:2]
    best = SurfaceDistances(np.full(shape, np.inf), np.zeros((*shape, 3)), np.zeros((*shape, 3)))
    for part in model.parts:
        object_from_part = model.object_from_part(part, hinge_rad)
        found = _part_distances(*model.filled_part(part), object_from_part, points_m, reach_m)
        nearer = found.distance_m < best.distance_m
        for mine, new in zip(best, found, strict=True):
            mine[nearer] = new[nearer]
    return best


def _part_distances(
    vertices_m: np.ndarray,
    faces: np.ndarray,
    object_from_part: RigidTransform,
    points_m: np.ndarray,
    reach_m: float,
) -> SurfaceDistances:
    local = object_from_part.inverse() @ points_m
    used = vertices_m[np.unique(faces)]
    near = ((local > used.min(0) - reach_m) & (local < used.max(0) + reach_m)).all(-1)
    distance = np.full(points_m.shape[:2], np.inf)
    closest, normal = np.zeros(points_m.shape), np.zeros(points_m.shape)
    if near.any():
        found = signed_distance(vertices_m, faces, local[near])
        distance[near], closest[near], normal[near] = found.distance_m, found.closest_m, found.normal
        distance[distance > reach_m] = np.inf
    return SurfaceDistances(distance, object_from_part @ closest, object_from_part.turn(normal))


def penetration_depth_m(distances: SurfaceDistances) -> np.ndarray:
    """(frame,) depth of the deepest point inside the object, metres; 0 where none is inside."""
    return np.maximum(-distances.distance_m.min(axis=1), 0.0)


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


def patch_contacts(distances: SurfaceDistances, patches: np.ndarray, frame: int) -> Contacts:
    """At most one contact per patch: its deepest vertex, where that is nearer than 2 mm.

    The contact point is the closest surface point. patches: (point,) as from :func:`hand_patches`, any numbering.
    """
    order = np.argsort(distances.distance_m[frame], kind="stable")
    order = order[distances.distance_m[frame][order] < CONTACT_TOLERANCE_M]
    first = np.unique(patches[order], return_index=True)[1]
    chosen = order[first]
    return Contacts(distances.closest_m[frame][chosen], distances.normal[frame][chosen])


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
