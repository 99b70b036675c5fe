"""Whether a synthetic action is physically sound, measured on the hands' meshes against the object's mesh."""

from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import HandPair, track_joints, track_vertices
from hoidata.hands.model import TIP_VERTICES
from hoidata.physics.contact_forces import RESIDUAL_LIMIT, force_residual, required_wrench
from hoidata.physics.surface import (
    Contacts,
    SurfaceDistances,
    body_motion,
    hand_patches,
    patch_contacts,
    penetration_depth_m,
    surface_distances,
)
from hoidata.synthetic.truth import GRAVITY, TruthSequence

LARGEST_PENETRATION_M = 0.009
LARGEST_DISTANCE_M = 0.02
_JOINT_TOUCH_M = 0.014
_IDLE_M = 0.2
_SAME_M = 1e-5
# Vertices farther away than this are not looked at; a hand that has none nearer counts as away (infinite distance).
_REACH_M = 0.008


@dataclass(frozen=True)
class Soundness:
    """Of one action at 30 fps. residual: (held frame,) N and N m. distance_m: (held frame,) of the farther acting hand,
    0 inside the object. penetration_m: (frame,) over all frames. joint_m: (held frame,) nearest joint of the farther
    acting hand. idle_m: smallest distance of a present idle hand's joints to the object's vertices."""

    residual: np.ndarray
    distance_m: np.ndarray
    penetration_m: np.ndarray
    joint_m: np.ndarray
    idle_m: float

    @property
    def is_sound(self) -> bool:
        return bool(
            len(self.residual)
            and (self.residual < RESIDUAL_LIMIT).all()
            and (self.distance_m < LARGEST_DISTANCE_M).all()
            and (self.penetration_m < LARGEST_PENETRATION_M).all()
            and (self.joint_m < _JOINT_TOUCH_M).all()
            and self.idle_m > _IDLE_M
        )


def measure(truth: TruthSequence, pair: HandPair, hand_shift_m: np.ndarray | None = None) -> Soundness:
    """Everything the corpus promises, on the truth at 30 fps.

    hand_shift_m: (3,) moves all acting hands in the world, for the control that must fail.
    """
    truth = truth.at_30_fps()
    held = np.flatnonzero(truth.held)
    near: dict[Side, SurfaceDistances] = {
        side: _distances(truth, side, pair, hand_shift_m) for side in truth.acting_sides
    }
    penetration = np.max([penetration_depth_m(one) for one in near.values()], axis=0)
    distance = np.max([one.distance_m[held].min(1) for one in near.values()], axis=0)
    joint = np.max([_joint_distance(truth, side, pair, one, hand_shift_m)[held] for side, one in near.items()], axis=0)
    return Soundness(
        _residuals(truth, near, pair, held), np.maximum(distance, 0), penetration, joint, _idle(truth, pair)
    )


def residuals_without_contact(truth: TruthSequence) -> np.ndarray:
    """(held frame,) what is left when no hand touches: the other control."""
    truth = truth.at_30_fps()
    return np.linalg.norm(_wrench(truth)[0][truth.held], axis=1)


def _wrench(truth: TruthSequence):
    track = truth.object
    motion = body_motion(track.model, rotvec_to_rotmat(track.rotvec), track.translation_m, track.hinge_rad)
    return required_wrench(motion, FPS, GRAVITY), motion


def _residuals(
    truth: TruthSequence, near: dict[Side, SurfaceDistances], pair: HandPair, held: np.ndarray
) -> np.ndarray:
    wrench, motion = _wrench(truth)
    patches = {side: hand_patches(pair[side]) for side in near}
    residual = np.empty(len(held))
    for row, frame in enumerate(held):
        contacts = [patch_contacts(one, patches[side], frame) for side, one in near.items()]
        points, normals = _in_world(truth, frame, contacts)
        residual[row] = force_residual(points, normals, motion.centre_m[frame], wrench[frame])
    return residual


def _in_world(truth: TruthSequence, frame: int, contacts: list[Contacts]) -> tuple[np.ndarray, np.ndarray]:
    world_from_object = truth.object.world_from_object[frame]
    points = np.concatenate([contact.points_m for contact in contacts])
    normals = np.concatenate([contact.normals for contact in contacts])
    return world_from_object @ points, world_from_object.turn(normals)


def _object_points(truth: TruthSequence, points_m: np.ndarray, shift_m: np.ndarray | None) -> np.ndarray:
    moved = points_m.astype(np.float64) + (0.0 if shift_m is None else shift_m)
    return truth.object.world_from_object.inverse() @ moved


def _distances(truth: TruthSequence, side: Side, pair: HandPair, shift_m: np.ndarray | None) -> SurfaceDistances:
    """Of the hand's vertices, computed once for frames in which hand and object stand to each other the same way."""
    points = _object_points(truth, track_vertices(truth.hands[side], pair[side]), shift_m)
    hinge = truth.object.hinge_rad
    angle = np.zeros(len(points)) if hinge is None else hinge
    signature = np.concatenate(
        [points[:, list(TIP_VERTICES)].reshape(len(points), -1), points[:, :8].reshape(len(points), -1)], 1
    )
    keys = np.round(np.column_stack([signature, angle]) / _SAME_M)
    changed = np.concatenate([[True], (np.abs(np.diff(keys, axis=0)) > 1).any(1)])
    first = np.flatnonzero(changed)
    back = np.cumsum(changed) - 1
    found = surface_distances(truth.object.model, None if hinge is None else hinge[first], points[first], _REACH_M)
    return SurfaceDistances(*(array[back] for array in found))


def _joint_distance(truth, side: Side, pair: HandPair, vertices: SurfaceDistances, shift_m) -> np.ndarray:
    """(frame,) of the nearest fingertip vertex, or of any joint where no tip is near."""
    tips = np.abs(vertices.distance_m[:, list(TIP_VERTICES)]).min(1)
    far = np.flatnonzero(tips > _JOINT_TOUCH_M)
    if len(far):
        track = truth.hands[side]
        joints = _object_points(truth, track_joints(track, pair[side]), shift_m)[far]
        hinge = None if truth.object.hinge_rad is None else truth.object.hinge_rad[far]
        tips[far] = np.abs(surface_distances(truth.object.model, hinge, joints).distance_m).min(1)
    return tips


def _idle(truth: TruthSequence, pair: HandPair) -> float:
    """Distance of idle, present hands: their joints to the ball round the object's vertices."""
    track = truth.object
    base = track.model.vertices_m
    middle = (base.min(0) + base.max(0)) / 2
    radius = np.linalg.norm(base - middle, axis=1).max()
    centre = track.world_from_object @ middle[None]
    nearest = np.inf
    for side in SIDES:
        hand = truth.hands[side]
        if side in truth.acting_sides or not hand.valid.any():
            continue
        gap = np.linalg.norm(track_joints(hand, pair[side]) - centre, axis=2).min() - radius
        nearest = min(nearest, float(gap))
    return nearest
