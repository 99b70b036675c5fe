"""Grasp search: random placement, closing of the fingers, and a test of force closure.

Frame of the search: the object upright on the table, with the origin of its mesh. Placements are sampled in a cone of
directions. Fingers close as capsules (hand_capsules.py). The final test uses the meshes of hand and object. The grasps
of a pair of verb and object are searched with an average hand, then closed for each subject.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import nnls

from hoidata.clips.clip import HandType, Side
from hoidata.errors import HoidataError
from hoidata.geometry.rotations import mirror_rotvec_x, rotvec_to_rotmat
from hoidata.hands import HandPair
from hoidata.hands.kinematics import kinematics_of
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.physics.contact_forces import body_motion, hand_patches, patch_contacts, wrench_columns
from hoidata.synthetic.catalogue import ObjectSpec
from hoidata.synthetic.hand_capsules import (
    OPEN_RAD,
    CapsuleHands,
    Field,
    Placement,
    capsule_hands,
    capsule_points,
    close_fingers,
    gradient,
    grid_field,
    hand_pose_rotvec,
    sample_placements,
    seen_by,
)

MIRROR = np.array([-1.0, 1.0, 1.0])
LARGEST_PENETRATION_M = 0.007
REACH_M = 0.008  # vertices that are farther from the object than this have an infinite distance
LARGEST_JOINT_DISTANCE_M = 0.012
SMALLEST_HAND_GAP_M = 0.006
STAND_RADIUS_M = 0.02
_TORQUE_SCALE_M = 0.05
_CLOSURE_RESIDUAL = 1e-6
_CAPSULE_CONTACT_M = 0.002
# Poses during approach and retreat: (closure of the fingers, distance of the hand in metres).
_STAGES = ((0.75, 0.0), (0.4, 0.0), (0.0, 0.0), (0.0, 0.03))
# Direction of the elbow from the right wrist: towards the person and outwards.
_ELBOW = np.array([0.5, -0.8, 0.2]) / np.linalg.norm([0.5, -0.8, 0.2])


@dataclass(frozen=True)
class Approach:
    """How one hand approaches the upright object."""

    direction: tuple[float, float, float]  # from the object to the hand
    width: float = 0.4  # spread of directions
    through_m: tuple[float, float, float] | None = None  # target point; None: centre of the part
    blend: tuple[float, float] = (0.0, 0.8)  # range of the touching region, palm (0) to fingers (1)
    part: int | None = None  # None: the whole object, 0: base, 1: lid


@dataclass(frozen=True)
class GraspSpec:
    """The hands of a grasp and their approaches."""

    approaches: tuple[tuple[Side, Approach], ...]
    hinge_rad: float = 0.0  # hinge angle when the hands arrive
    angles_rad: tuple[float, ...] = ()  # hinge angles at which the grasp must be stable

    @property
    def hand(self) -> HandType:
        return "both" if len(self.approaches) == 2 else self.approaches[0][0]


@dataclass(frozen=True)
class Grip:
    """Pose of one hand on an object, in the frame of the object's part."""

    side: Side
    wrist_m: np.ndarray  # (3,)
    rotmat: np.ndarray  # (3, 3) object_from_hand
    hand_pose: np.ndarray  # (45,) absolute
    open_pose: np.ndarray  # (45,) before closing
    part: int  # 1: the hand follows the lid


@dataclass(frozen=True)
class Scene:
    """An upright object, with its geometry for the grasp search."""

    spec: ObjectSpec
    model: ObjectModel
    hinge_rad: float

    @cached_property
    def upright(self) -> np.ndarray:
        return self.spec.upright_from_object

    @cached_property
    def lid_rotation(self) -> np.ndarray:
        """(3, 3) rotation of the lid at the starting angle, upright frame."""
        axis = self.upright @ self.model.hinge.axis if self.model.hinge is not None else np.zeros(3)
        return rotvec_to_rotmat(axis * self.hinge_rad)

    @cached_property
    def part_vertices(self) -> list[np.ndarray]:
        """Upright vertices of each part at the starting angle."""
        standing = self.model.vertices_m @ self.upright.T
        if not self.model.is_articulated:
            return [standing]
        return [standing[self.model.part == 0], standing[self.model.part == 1] @ self.lid_rotation.T]

    @cached_property
    def part_fields(self) -> list[Field]:
        fields = [grid_field(surface) for surface in surface_index(self.model).filled.values()]
        # Upright points to the rest frame of the part's mesh.
        rotations = [self.upright, self.lid_rotation @ self.upright]
        return [partial(_in_part, field, rotation) for field, rotation in zip(fields, rotations, strict=False)]

    def field(self, points_m: np.ndarray) -> np.ndarray:
        """Signed distance of the whole object."""
        return np.minimum.reduce([field(points_m) for field in self.part_fields])

    @cached_property
    def bottom_m(self) -> float:
        return float(min(vertices[:, 2].min() for vertices in self.part_vertices))

    @cached_property
    def foot_m(self) -> np.ndarray:
        """(2,) centre of the base, the position of the stand."""
        return (self.part_vertices[0].min(0) + self.part_vertices[0].max(0))[:2] / 2


class Candidates(NamedTuple):
    """Closed candidate hands of one side, in the right-hand world of the search (mirrored for a left hand)."""

    side: Side
    placement: Placement
    hands: CapsuleHands  # hand shape of each candidate
    wrist_m: np.ndarray  # (candidate, 3)
    flexion_rad: np.ndarray  # (candidate, 5, 3)

    def take(self, rows: np.ndarray) -> "Candidates":
        placement, hands = self.placement.take(rows), self.hands.take(rows)
        return Candidates(self.side, placement, hands, self.wrist_m[rows], flexion_rad=self.flexion_rad[rows])

    def points(self, flexion_rad: np.ndarray) -> np.ndarray:
        """Return (candidate, 21, 4, 3) capsule points, with fingers flexed by ``flexion_rad (candidate, 5, 3)``."""
        return capsule_points(self.hands, self.placement.rotmats, self.wrist_m, flexion_rad, self.placement.spread_rad)

    @property
    def open_rad(self) -> np.ndarray:
        return np.broadcast_to(OPEN_RAD, self.flexion_rad.shape)


def _in_part(field: Field, upright_from_part: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    return field(points_m @ upright_from_part)


def sample_candidates(scene: Scene, side: Side, approach: Approach, count: int, rng: np.random.Generator) -> Placement:
    """Sample placements of one hand whose forearm comes from a person at -y."""
    sign = MIRROR if side == "left" else np.ones(3)
    field = seen_by(side, scene.part_fields[approach.part or 0] if approach.part is not None else scene.field)
    vertices = scene.part_vertices[approach.part] if approach.part is not None else np.concatenate(scene.part_vertices)
    low, high = vertices.min(0), vertices.max(0)
    centre = (low + high) / 2 if approach.through_m is None else np.asarray(approach.through_m)
    extent = (high - low) if approach.through_m is None else np.full(3, 0.02)
    direction = np.asarray(approach.direction) / np.linalg.norm(approach.direction)
    direction = direction + approach.width * rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    through = centre + 0.2 * extent * rng.normal(size=(count, 3))
    placement = sample_placements(field, direction * sign, through * sign, approach.blend, rng)
    forearm = placement.rotmats[:, :, 0]
    return placement.take(np.flatnonzero(forearm @ _ELBOW > 0.1))


def close_candidates(scene: Scene, side: Side, placement: Placement, hands: CapsuleHands) -> Candidates:
    """Close the fingers of each placement with its hand shape."""
    rows = hands.take(placement.hand)
    return Candidates(side, placement, rows, *close_fingers(seen_by(side, scene.field), rows, placement))


def clear_of_table(scene: Scene, candidates: Candidates) -> np.ndarray:
    """Return (candidate,) bool: whether the open and the closed hand keep clear of table and stand."""
    clear = np.ones(len(candidates.wrist_m), dtype=bool)
    foot = scene.foot_m * (MIRROR[:2] if candidates.side == "left" else 1.0)
    radii = candidates.hands.radii[:, :, None]
    for flexion in (candidates.open_rad, candidates.flexion_rad):
        points = candidates.points(flexion)
        clear &= (points[..., 2] - radii > scene.bottom_m - scene.spec.stand_m - 0.004).all((1, 2))
        off_stand = np.linalg.norm(points[..., :2] - foot, axis=-1) - radii > STAND_RADIUS_M
        clear &= (off_stand | (points[..., 2] - radii > scene.bottom_m - 0.004)).all((1, 2))
    return clear


def capsule_contacts(scene: Scene, candidates: Candidates) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return, by candidate, contact points and outward normals (contact, 3), upright world; one per capsule."""
    field = seen_by(candidates.side, scene.field)
    points = candidates.points(candidates.flexion_rad)
    distance = field(points)
    nearest = distance.argmin(-1)
    clearance = np.take_along_axis(distance, nearest[..., None], -1)[..., 0]
    point = np.take_along_axis(points, nearest[..., None, None], -2)[..., 0, :]
    touching = clearance - candidates.hands.radii < _CAPSULE_CONTACT_M
    sign = MIRROR if candidates.side == "left" else np.ones(3)
    normal = gradient(field, point)
    surface = point - clearance[..., None] * normal
    return [(s[t] * sign, n[t] * sign) for s, n, t in zip(surface, normal, touching, strict=True)]


def closes_force(points_m: np.ndarray, normals: np.ndarray, centre_m: np.ndarray) -> bool:
    """Test force closure: the friction cones must produce each of the twelve unit wrenches.

    Any other wrench is a non-negative sum of these twelve.
    """
    if len(points_m) < 3:
        return False
    columns = wrench_columns(points_m, normals, centre_m)
    columns[3:] /= _TORQUE_SCALE_M
    for axis in (2, 5, 0, 1, 3, 4):
        for sign in (1.0, -1.0):
            unit = np.zeros(6)
            unit[axis] = sign
            try:
                if nnls(columns, unit, maxiter=200)[1] > _CLOSURE_RESIDUAL:
                    return False
            except RuntimeError:
                return False
    return True


def hand_gap_m(candidates: list[Candidates]) -> np.ndarray:
    """Return (candidate,) smallest distance between the two hands' capsules; infinite for one hand."""
    if len(candidates) == 1:
        return np.full(len(candidates[0].wrist_m), np.inf)
    clouds, radii = [], []
    for one in candidates:
        points = one.points(one.flexion_rad) * (MIRROR if one.side == "left" else np.ones(3))
        clouds.append(points.reshape(len(points), -1, 3))
        radii.append(np.repeat(one.hands.radii / 1.25, points.shape[2], axis=1))
    distance = np.linalg.norm(clouds[0][:, :, None] - clouds[1][:, None], axis=-1)
    return (distance - radii[0][:, :, None] - radii[1][:, None]).min((1, 2))


@dataclass(frozen=True)
class PosedHands:
    """Candidate hands of one side as hand parameters, upright world."""

    side: Side
    wrist_m: np.ndarray
    rotmats: np.ndarray
    hand_pose: np.ndarray
    open_pose: np.ndarray
    betas: np.ndarray

    def mesh(self, pair: HandPair) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (candidate, 778, 3) and joints (candidate, 21, 3), upright world, metres."""
        layer = kinematics_of(pair[self.side], torch.float64)
        local = rotvec_to_rotmat(self.hand_pose.reshape(-1, 15, 3))
        rotmats = np.concatenate([self.rotmats[:, None], local], axis=1)
        inputs = (torch.from_numpy(np.ascontiguousarray(a)) for a in (self.wrist_m, rotmats, self.betas))
        with torch.no_grad():
            vertices, joints = layer(*inputs)
        return vertices.numpy(), joints.numpy()


def posed_hands(candidates: Candidates, betas: np.ndarray) -> PosedHands:
    """Convert candidates from the right-hand world of the search to hand parameters. betas: (hand shape, 10)."""
    rotmats, spread, rows = candidates.placement.rotmats, candidates.placement.spread_rad, candidates.placement.hand
    pose = hand_pose_rotvec(candidates.hands, candidates.flexion_rad, spread)
    opened = hand_pose_rotvec(candidates.hands, candidates.open_rad, spread)
    wrist_m = candidates.wrist_m
    if candidates.side == "left":
        wrist_m, rotmats = wrist_m * MIRROR, np.diag(MIRROR) @ rotmats @ np.diag(MIRROR)
        pose, opened = mirrored_pose(pose), mirrored_pose(opened)
    return PosedHands(candidates.side, wrist_m, rotmats, pose, open_pose=opened, betas=betas[rows])


def mirrored_pose(hand_pose: np.ndarray) -> np.ndarray:
    """Mirror finger axis-angles (..., 45) to the other hand."""
    return mirror_rotvec_x(hand_pose.reshape(-1, 15, 3)).reshape(hand_pose.shape)


def verify(scene: Scene, grasp: GraspSpec, hands: list[PosedHands], pair: HandPair) -> np.ndarray:
    """Return the (candidate,) score against the meshes: 0 for failure, higher is better.

    At each hinge angle, a candidate needs force closure, little penetration, and a joint of each hand close to the
    surface.
    """
    meshes = [hand.mesh(pair) for hand in hands]
    score = np.full(len(hands[0].wrist_m), np.inf)
    angles = grasp.angles_rad or (grasp.hinge_rad,)
    for angle in angles:
        score = np.minimum(score, _verify_at(scene, grasp, hands, meshes, pair, angle))
    for angle in {angles[0], angles[-1]}:
        score = np.where(_can_approach(scene, grasp, hands, pair, angle), score, 0.0)
    return score


def _can_approach(scene: Scene, grasp: GraspSpec, hands: list[PosedHands], pair: HandPair, angle: float) -> np.ndarray:
    """Return (candidate,) bool: whether hands also avoid penetration during approach and retreat."""
    lid_rotation = follow_lid(scene, angle)
    surface, clear = surface_index(scene.model), np.ones(len(hands[0].wrist_m), dtype=bool)
    hinge = np.full(len(clear), angle) if scene.model.is_articulated else None
    for (_, approach), hand in zip(grasp.approaches, hands, strict=True):
        object_from_world = scene.upright.T @ (lid_rotation if approach.part == 1 else np.eye(3))
        for closed, away_m in _STAGES:
            pose = hand.open_pose + closed * (hand.hand_pose - hand.open_pose)
            wrist = hand.wrist_m + away_m * hand.rotmats[:, :, 1]
            vertices = replace(hand, hand_pose=pose, wrist_m=wrist).mesh(pair)[0]
            clear &= surface.depth_m(vertices @ object_from_world.T, hinge).max(1) < LARGEST_PENETRATION_M
    return clear


def _verify_at(scene: Scene, grasp: GraspSpec, hands, meshes, pair: HandPair, angle: float) -> np.ndarray:
    n_candidates = len(hands[0].wrist_m)
    hinge = np.full(n_candidates, angle) if scene.model.is_articulated else None
    lid_rotation = follow_lid(scene, angle)
    surface, near, touch, patches = surface_index(scene.model), [], [], []
    for (side, approach), (vertices, joints) in zip(grasp.approaches, meshes, strict=True):
        object_from_world = scene.upright.T @ (lid_rotation if approach.part == 1 else np.eye(3))
        near.append(surface.nearest(vertices @ object_from_world.T, hinge, REACH_M))
        touch.append(surface.nearest(joints @ object_from_world.T, hinge).distance_m.min(1))
        patches.append(hand_patches(pair[side]))
    upright = np.eye(3)[None].repeat(n_candidates, 0)
    centre = body_motion(scene.model, upright, np.zeros((n_candidates, 3)), hinge).centre_m
    score = np.zeros(n_candidates)
    for index in range(n_candidates):
        depth = max(-one.distance_m[index].min() for one in near)
        if depth > LARGEST_PENETRATION_M or max(distance[index] for distance in touch) > LARGEST_JOINT_DISTANCE_M:
            continue
        contacts = [patch_contacts(one, patch, index) for one, patch in zip(near, patches, strict=True)]
        points = np.concatenate([contact.points_m for contact in contacts])
        normals = np.concatenate([contact.normals for contact in contacts])
        if min(len(contact.points_m) for contact in contacts) >= 2 and closes_force(points, normals, centre[index]):
            score[index] = len(points) + 1 - 100 * depth
    return score


def follow_lid(scene: Scene, angle: float) -> np.ndarray:
    """Return the (3, 3) rotation of a hand on the lid from the start angle to another, upright frame."""
    if scene.model.hinge is None:
        return np.eye(3)
    return rotvec_to_rotmat(scene.upright @ scene.model.hinge.axis * (angle - scene.hinge_rad))


def to_grip(scene: Scene, approach: Approach, hands: PosedHands, index: int) -> Grip:
    """Convert one candidate to a grip in the frame of the object, or of the lid at hinge angle 0."""
    object_from_world = scene.upright.T @ (scene.lid_rotation.T if approach.part == 1 else np.eye(3))
    return Grip(
        side=hands.side,
        wrist_m=object_from_world @ hands.wrist_m[index],
        rotmat=object_from_world @ hands.rotmats[index],
        hand_pose=hands.hand_pose[index],
        open_pose=hands.open_pose[index],
        part=int(approach.part == 1),
    )


GRASPS_PER_PAIR = 2
_MAX_GRASPS = 8  # per subject
_RESERVES = 2
_CANDIDATES_PER_ROUND = 96
_MAX_ROUNDS = 40
_STRICT_ROUNDS = 4  # after these rounds, grasps need not work for all subjects
_VERIFIED_PER_ROUND = 6


def search_pool(
    scene: Scene,
    grasp: GraspSpec,
    pair: HandPair,
    betas: np.ndarray,
    rng: np.random.Generator,
    enough: int = GRASPS_PER_PAIR,
    rounds: int = _MAX_ROUNDS,
    complete: bool = True,
) -> list[list[tuple[Grip, ...]]]:
    """Search grasps for several subjects: by subject, the grasps, each with one grip per hand.

    betas: (subject, 10) hand shapes. The search ends with ``enough`` grasps that all subjects can use, or after
    ``rounds``. complete: raise HoidataError if a subject has no grasp.
    """
    average = capsule_hands(pair.right, np.zeros((1, 10)))
    subject_hands = capsule_hands(pair.right, betas)
    grasps_of: list[list[tuple[Grip, ...]]] = [[] for _ in betas]
    ranked: list[tuple[np.ndarray, list[tuple[Grip, ...] | None]]] = []
    for round_number in range(rounds):
        placements = _promising(scene, grasp, average, rng)
        if placements is None:
            continue
        ranked += _for_subjects(scene, grasp, placements, subject_hands, betas, pair)
        if _enough(np.array([scores > 0 for scores, _ in ranked]), round_number, enough):
            break
    ranked.sort(key=lambda entry: (-(entry[0] > 0).sum(), -entry[0].mean()))
    for _, grips in ranked:
        for subject, grip in enumerate(grips):
            if grip is not None and len(grasps_of[subject]) < _MAX_GRASPS:
                grasps_of[subject].append(grip)
    missing = [index for index, grips in enumerate(grasps_of) if not grips]
    if missing and complete:
        raise HoidataError(f"{scene.spec.name}: no {grasp.hand} grasp found for subjects {missing} of {len(grasps_of)}")
    return grasps_of


def _enough(works: np.ndarray, round_number: int, enough: int) -> bool:
    """Whether to stop: enough grasps for all subjects, later enough for each. works: (placement, subject) bool."""
    shared = int(works.all(axis=1).sum())
    return shared >= enough or (
        round_number >= _STRICT_ROUNDS and int(works.sum(axis=0).min()) >= max(enough, _RESERVES)
    )


def _promising(scene: Scene, grasp: GraspSpec, hands: CapsuleHands, rng: np.random.Generator) -> list[Placement] | None:
    """Sample placements, one per hand, whose capsule hands have force closure."""
    sides = []
    for side, reach in grasp.approaches:
        placement = sample_candidates(scene, side, reach, 3 * _CANDIDATES_PER_ROUND, rng)
        placement = placement.take(np.arange(min(_CANDIDATES_PER_ROUND, len(placement.hand))))
        closed = close_candidates(scene, side, placement, hands)
        sides.append(closed.take(np.flatnonzero(clear_of_table(scene, closed))))
    count = min(len(side.placement.hand) for side in sides)
    if count == 0:
        return None
    sides = [side.take(np.arange(count)) for side in sides]
    good = np.flatnonzero(_has_force_closure(scene, sides))[:_VERIFIED_PER_ROUND]
    return [side.placement.take(good) for side in sides] if len(good) else None


def _has_force_closure(scene: Scene, sides: list[Candidates]) -> np.ndarray:
    hinge = np.full(1, scene.hinge_rad) if scene.model.is_articulated else None
    centre = scene.upright @ body_motion(scene.model, np.eye(3)[None], np.zeros((1, 3)), hinge).centre_m[0]
    contacts = [capsule_contacts(scene, side) for side in sides]
    apart = hand_gap_m(sides) > SMALLEST_HAND_GAP_M
    is_closed = np.zeros(len(apart), dtype=bool)
    for index in np.flatnonzero(apart):
        points = np.concatenate([side[index][0] for side in contacts])
        normals = np.concatenate([side[index][1] for side in contacts])
        is_closed[index] = closes_force(points, normals, centre)
    return is_closed


def _for_subjects(
    scene: Scene, grasp: GraspSpec, placements, subject_hands: CapsuleHands, betas: np.ndarray, pair: HandPair
):
    """Return (subject,) scores and grips of each placement, closed with the hand of each subject."""
    n_subjects = len(betas)
    sides = [
        close_candidates(scene, side, placement.for_hands(n_subjects), subject_hands)
        for (side, _), placement in zip(grasp.approaches, placements, strict=True)
    ]
    posed = [posed_hands(side, betas) for side in sides]
    score = verify(scene, grasp, posed, pair)
    clear = np.all([clear_of_table(scene, side) for side in sides], axis=0) & (hand_gap_m(sides) > SMALLEST_HAND_GAP_M)
    score = np.where(clear, score, 0.0).reshape(-1, n_subjects)
    reaches = [(reach, hand) for (_, reach), hand in zip(grasp.approaches, posed, strict=True)]
    entries = []
    for index, scores in enumerate(score):
        rows = [index * n_subjects + subject if scores[subject] > 0 else None for subject in range(n_subjects)]
        grips = [None if pose is None else tuple(to_grip(scene, *reach, pose) for reach in reaches) for pose in rows]
        entries.append((scores, grips))
    return entries
