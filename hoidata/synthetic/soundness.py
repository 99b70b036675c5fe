"""Checks that a synthetic action is physically plausible, with the meshes of hands and object."""

import numpy as np
from scipy.spatial import KDTree

from hoidata.clips.clip import FPS, SIDES, ObjectTrack, Side
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import HandPair, track_joints, track_vertices
from hoidata.hands.model import TIP_VERTICES
from hoidata.objects.distance import SignedDistance
from hoidata.objects.surface_index import surface_index
from hoidata.physics.contact_forces import (
    RESIDUAL_LIMIT,
    body_motion,
    force_residual,
    hand_patches,
    patch_contacts,
    required_wrench,
)
from hoidata.synthetic.grasps import REACH_M
from hoidata.synthetic.truth import GRAVITY, TruthSequence

LARGEST_PENETRATION_M = 0.009
LARGEST_DISTANCE_M = 0.02
_JOINT_TOUCH_M = 0.014
_IDLE_M = 0.2
# In clips with ``contact_by_side``, an idle hand may be close, but its joints keep out of the 2 cm within which a hand
# is active. Joints of active hands stay above the table, and joints of the two hands stay apart.
_NEAR_IDLE_M, _TABLE_M, _HANDS_APART_M = 0.028, 0.0, 0.012


def is_sound(truth: TruthSequence, pair: HandPair) -> bool:
    """Whether contact forces explain the motion of the lifted object, and hands touch it without deep penetration.

    Idle hands must be away. With ``contact_by_side``, hands must touch in all frames of their contact, else while the
    object is lifted.
    """
    truth = truth.at_30_fps()
    grasping = {side: truth.in_contact(side) if truth.contact_by_side else truth.lifted for side in truth.active_sides}
    near = surface_distances(truth, pair)
    for side, distances in near.items():
        distance_m, joint_m = distances.distance_m.min(1), _joint_distance(truth, side, pair, distances)
        is_near = (distance_m < LARGEST_DISTANCE_M) & (joint_m < _JOINT_TOUCH_M)
        if distance_m.min() <= -LARGEST_PENETRATION_M or not is_near[grasping[side]].all():
            return False
    if not np.any(list(grasping.values())):
        return False
    if truth.contact_by_side:
        is_clear = _near_idle(truth, pair) > _NEAR_IDLE_M and _is_clear(truth, pair)
    else:
        is_clear = _idle(truth, pair) > _IDLE_M
    return is_clear and bool((force_residuals(truth, near, pair) < RESIDUAL_LIMIT).all())


def surface_distances(truth: TruthSequence, pair: HandPair) -> dict[Side, SignedDistance]:
    """Return the signed distances (frame, 778) of the vertices of each active hand to the object's surface."""
    distances: dict[Side, SignedDistance] = {}
    for side in truth.active_sides:
        vertices = track_vertices(truth.hands[side], pair[side]).astype(np.float64)
        points = truth.object.world_from_object.inverse() @ vertices
        distances[side] = surface_index(truth.object.model).nearest(points, truth.object.hinge_rad, REACH_M)
    return distances


def _near_idle(truth: TruthSequence, pair: HandPair) -> float:
    """Return the distance of an idle hand's joints to the object's vertices, metres."""
    idle: list[Side] = [side for side in SIDES if side not in truth.active_sides]
    if not idle:
        return np.inf
    return float(vertex_distances_m(truth.object, track_joints(truth.hands[idle[0]], pair[idle[0]])).min())


def vertex_distances_m(track: ObjectTrack, points_m: np.ndarray) -> np.ndarray:
    """Return (frame, point) distances of world points (frame, point, 3) to the nearest object vertex, metres."""
    model, local = track.model, track.world_from_object.inverse() @ points_m.astype(np.float64)
    in_parts = {part: model.object_from_part(part, track.hinge_rad).inverse() @ local for part in model.parts}
    trees = {part: KDTree(model.vertices_m[model.part == part]) for part in model.parts}
    return np.min([trees[part].query(points)[0] for part, points in in_parts.items()], axis=0)


def _is_clear(truth: TruthSequence, pair: HandPair) -> bool:
    joints = {side: track_joints(truth.hands[side], pair[side]) for side in SIDES}
    between = np.linalg.norm(joints["left"][:, :, None] - joints["right"][:, None], axis=-1).min()
    lowest = min(joints[side][..., 2].min() for side in truth.active_sides)
    return bool(between > _HANDS_APART_M and lowest > _TABLE_M)


def force_residuals(truth: TruthSequence, near: dict[Side, SignedDistance], pair: HandPair) -> np.ndarray:
    """Return (lifted frame,) the part of the object's wrench that no contact forces explain, N and N m, at 30 fps."""
    track = truth.object
    motion = body_motion(track.model, rotvec_to_rotmat(track.rotvec), track.translation_m, track.hinge_rad)
    wrench = required_wrench(motion, FPS, GRAVITY)
    patches, residuals = {side: hand_patches(pair[side]) for side in near}, []
    poses = track.world_from_object
    for frame in np.flatnonzero(truth.lifted):
        contacts = [patch_contacts(one, patches[side], int(frame)) for side, one in near.items()]
        points = poses[frame] @ np.concatenate([contact.points_m for contact in contacts])
        normals = poses[frame].turn(np.concatenate([contact.normals for contact in contacts]))
        residuals.append(force_residual(points, normals, motion.centre_m[frame], wrench[frame]))
    return np.array(residuals)


def _joint_distance(truth: TruthSequence, side: Side, pair: HandPair, vertices: SignedDistance) -> np.ndarray:
    """Return (frame,) distance of the closest fingertip vertex, or of the closest joint if no tip touches."""
    tips = np.abs(vertices.distance_m[:, list(TIP_VERTICES)]).min(1)
    far = np.flatnonzero(tips > _JOINT_TOUCH_M)
    if len(far):
        joints = track_joints(truth.hands[side], pair[side]).astype(np.float64)
        joints = (truth.object.world_from_object.inverse() @ joints)[far]
        hinge = None if truth.object.hinge_rad is None else truth.object.hinge_rad[far]
        tips[far] = surface_index(truth.object.model).distance_m(joints, hinge).min(1)
    return tips


def _idle(truth: TruthSequence, pair: HandPair) -> float:
    """Return the distance of an idle hand's joints to the bounding sphere of the object."""
    track = truth.object
    base = track.model.vertices_m
    middle = (base.min(0) + base.max(0)) / 2
    radius = np.linalg.norm(base - middle, axis=1).max()
    centre = track.world_from_object @ middle[None]
    idle: list[Side] = [side for side in SIDES if side not in truth.active_sides and truth.hands[side].valid.any()]
    joints = [track_joints(truth.hands[side], pair[side]) for side in idle]
    return min((np.linalg.norm(positions - centre, axis=2).min() - radius for positions in joints), default=np.inf)
