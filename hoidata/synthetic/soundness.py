"""Checks that a synthetic action is physically plausible, with the meshes of hands and object."""

from dataclasses import dataclass

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
    Contacts,
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


@dataclass(frozen=True)
class Soundness:
    """Measures of one action at 30 fps. "Grasp frames" are the lifted frames, or each hand's ``contact_by_side``."""

    residual: np.ndarray  # (lifted frame,) unexplained wrench, N and N m
    distance_m: np.ndarray  # (grasp frame,) distance of the farther active hand, 0 inside the object
    penetration_m: np.ndarray  # (frame,) depth, in all frames
    joint_m: np.ndarray  # (grasp frame,) distance of the closest joint of the farther hand
    idle_m: float  # smallest distance of an idle hand's joints to the object's vertices
    least_idle_m: float  # minimum of ``idle_m``
    clear: bool  # whether hands keep clear of the table and of each other

    @property
    def is_sound(self) -> bool:
        return bool(
            len(self.distance_m)
            and (self.residual < RESIDUAL_LIMIT).all()
            and (self.distance_m < LARGEST_DISTANCE_M).all()
            and (self.penetration_m < LARGEST_PENETRATION_M).all()
            and (self.joint_m < _JOINT_TOUCH_M).all()
            and self.idle_m > self.least_idle_m
            and self.clear
        )


def measure(truth: TruthSequence, pair: HandPair, hand_shift_m: np.ndarray | None = None) -> Soundness:
    """Measure an action at 30 fps. hand_shift_m: (3,) translation of the active hands, for the negative control."""
    truth = truth.at_30_fps()
    lifted = np.flatnonzero(truth.lifted)
    near, distances, joints = dict[Side, SignedDistance](), dict[Side, np.ndarray](), dict[Side, np.ndarray]()
    for side in truth.active_sides:
        near[side] = _distances(truth, side, pair, hand_shift_m)
        distances[side] = near[side].distance_m.min(1)
        joints[side] = _joint_distance(truth, side, pair, near[side], hand_shift_m)
    penetration = np.max([-distance for distance in distances.values()], axis=0).clip(0)
    if truth.contact_by_side:
        distance, joint = _during_contact(truth, distances), _during_contact(truth, joints)
        idle_m, least_idle_m, clear = _near_idle(truth, pair), _NEAR_IDLE_M, _is_clear(truth, pair)
    else:
        distance, joint = (np.max([d[lifted] for d in by_side.values()], axis=0) for by_side in (distances, joints))
        idle_m, least_idle_m, clear = _idle(truth, pair), _IDLE_M, True
    return Soundness(
        residual=_residuals(truth, near, pair, lifted),
        distance_m=np.maximum(distance, 0),
        penetration_m=penetration,
        joint_m=joint,
        idle_m=idle_m,
        least_idle_m=least_idle_m,
        clear=clear,
    )


def _during_contact(truth: TruthSequence, values: dict[Side, np.ndarray]) -> np.ndarray:
    """Concatenate the values (frame,) of each hand during its contact."""
    return np.concatenate([values[side][truth.in_contact(side)] for side in truth.contact_by_side])


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


def residuals_without_contact(truth: TruthSequence) -> np.ndarray:
    """Return (lifted frame,) residuals without any contact, for the negative control."""
    truth = truth.at_30_fps()
    return np.linalg.norm(_wrench(truth)[0][truth.lifted], axis=1)


def _wrench(truth: TruthSequence):
    track = truth.object
    motion = body_motion(track.model, rotvec_to_rotmat(track.rotvec), track.translation_m, track.hinge_rad)
    return required_wrench(motion, FPS, GRAVITY), motion


def _residuals(
    truth: TruthSequence, near: dict[Side, SignedDistance], pair: HandPair, lifted: np.ndarray
) -> np.ndarray:
    wrench, motion = _wrench(truth)
    patches = {side: hand_patches(pair[side]) for side in near}
    residual = np.empty(len(lifted))
    for index, frame in enumerate(lifted):
        contacts = [patch_contacts(one, patches[side], frame) for side, one in near.items()]
        points, normals = _in_world(truth, frame, contacts)
        residual[index] = force_residual(points, normals, motion.centre_m[frame], wrench[frame])
    return residual


def _in_world(truth: TruthSequence, frame: int, contacts: list[Contacts]) -> tuple[np.ndarray, np.ndarray]:
    world_from_object = truth.object.world_from_object[frame]
    points = np.concatenate([contact.points_m for contact in contacts])
    normals = np.concatenate([contact.normals for contact in contacts])
    return world_from_object @ points, world_from_object.turn(normals)


def _object_points(truth: TruthSequence, points_m: np.ndarray, shift_m: np.ndarray | None) -> np.ndarray:
    moved = points_m.astype(np.float64) + (0.0 if shift_m is None else shift_m)
    return truth.object.world_from_object.inverse() @ moved


def _distances(truth: TruthSequence, side: Side, pair: HandPair, shift_m: np.ndarray | None) -> SignedDistance:
    """Return signed distances of the hand's vertices."""
    points = _object_points(truth, track_vertices(truth.hands[side], pair[side]), shift_m)
    return surface_index(truth.object.model).nearest(points, truth.object.hinge_rad, REACH_M)


def _joint_distance(truth, side: Side, pair: HandPair, vertices: SignedDistance, shift_m) -> np.ndarray:
    """Return (frame,) distance of the closest fingertip vertex, or of the closest joint if no tip touches."""
    tips = np.abs(vertices.distance_m[:, list(TIP_VERTICES)]).min(1)
    far = np.flatnonzero(tips > _JOINT_TOUCH_M)
    if len(far):
        track = truth.hands[side]
        joints = _object_points(truth, track_joints(track, pair[side]), shift_m)[far]
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
    nearest = np.inf
    for side in SIDES:
        hand = truth.hands[side]
        if side in truth.active_sides or not hand.valid.any():
            continue
        gap = np.linalg.norm(track_joints(hand, pair[side]) - centre, axis=2).min() - radius
        nearest = min(nearest, float(gap))
    return nearest
