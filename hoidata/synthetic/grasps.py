"""Grasps that could really hold an object: random placement, closing fingers, and a proof of force closure.

Frame of the search: the object standing upright as on the table at the start, origin and hinge where its mesh has them.
Recipe and measured yields: placements come from a cone of directions, fingers close on capsules (closing.py), and what
counts in the end is the hand's mesh against the object's mesh.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import nnls

from hoidata.clips.clip import HandType, Side
from hoidata.geometry.rotations import mirror_rotvec_x, rotvec_to_rotmat
from hoidata.hands import HandPair
from hoidata.hands.tracks import kinematics_of
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.physics.contact_forces import body_motion, hand_patches, patch_contacts, wrench_columns
from hoidata.synthetic.catalogue import ObjectSpec
from hoidata.synthetic.closing import Field, Placement, close_fingers, draw_placements, gradient, grid_field, mirrored
from hoidata.synthetic.hand_capsules import OPEN_RAD, CapsuleHands, capsule_points, hand_pose_rotvec

MIRROR = np.array([-1.0, 1.0, 1.0])
LARGEST_PENETRATION_M = 0.007
LARGEST_JOINT_DISTANCE_M = 0.012
SMALLEST_HAND_GAP_M = 0.006
STAND_RADIUS_M = 0.02
_TORQUE_SCALE_M = 0.05
_CLOSURE_RESIDUAL = 1e-6
_CAPSULE_CONTACT_M = 0.002
# On the way in and out: (how far the fingers are closed, how far the hand is withdrawn in metres).
_STAGES = ((0.75, 0.0), (0.4, 0.0), (0.0, 0.0), (0.0, 0.03))
# Where the elbow may be, seen from the right wrist: towards the person and outwards, not in front.
_ELBOW = np.array([0.5, -0.8, 0.2]) / np.linalg.norm([0.5, -0.8, 0.2])


@dataclass(frozen=True)
class Reach:
    """How one hand comes to the object, written for the upright object and for that very hand.

    direction: from the object to where the hand comes from. width: spread of directions about it.
    through_m: (3,) point aimed at, or None for the middle of the part. blend: palm (0) to fingers (1).
    part: None for the whole object, 0 for its base, 1 for its lid.
    """

    direction: tuple[float, float, float]
    width: float = 0.4
    through_m: tuple[float, float, float] | None = None
    blend: tuple[float, float] = (0.0, 0.8)
    part: int | None = None


@dataclass(frozen=True)
class Hold:
    """Which hands hold an object, and how. hinge_rad: angle while the hands arrive; angles_rad: others to hold at."""

    reaches: tuple[tuple[Side, Reach], ...]
    hinge_rad: float = 0.0
    angles_rad: tuple[float, ...] = ()

    @property
    def hand(self) -> HandType:
        return "both" if len(self.reaches) == 2 else self.reaches[0][0]


@dataclass(frozen=True)
class Grip:
    """One hand on one object. wrist_m (3,), rotmat (3, 3) object-from-hand, canonical object frame at hinge angle 0 of
    its part; hand_pose (45,) absolute; open_pose (45,) before closing; part: 1 where it follows the lid."""

    side: Side
    wrist_m: np.ndarray
    rotmat: np.ndarray
    hand_pose: np.ndarray
    open_pose: np.ndarray
    part: int


@dataclass(frozen=True)
class Scene:
    """An object standing upright, with what the search asks about it."""

    spec: ObjectSpec
    model: ObjectModel
    hinge_rad: float

    @cached_property
    def upright(self) -> np.ndarray:
        return self.spec.upright_from_object

    @cached_property
    def turn(self) -> np.ndarray:
        """(3, 3) rotation of the lid at the starting angle, upright frame."""
        axis = self.upright @ self.model.hinge.axis if self.model.hinge is not None else np.zeros(3)
        return rotvec_to_rotmat(axis * self.hinge_rad)

    @cached_property
    def part_vertices(self) -> list[np.ndarray]:
        """Upright vertices of each part at the starting angle."""
        standing = self.model.vertices_m @ self.upright.T
        if not self.model.is_articulated:
            return [standing]
        return [standing[self.model.part == 0], standing[self.model.part == 1] @ self.turn.T]

    @cached_property
    def part_fields(self) -> list[Field]:
        fields = [grid_field(surface) for surface in surface_index(self.model).filled.values()]
        # Upright points to the rest frame of the part's mesh.
        turns = [self.upright, self.turn @ self.upright]
        return [partial(_turned, field, turn) for field, turn in zip(fields, turns, strict=False)]

    def field(self, points_m: np.ndarray) -> np.ndarray:
        """Signed distance of the whole object."""
        return np.minimum.reduce([field(points_m) for field in self.part_fields])

    @cached_property
    def bottom_m(self) -> float:
        return float(min(vertices[:, 2].min() for vertices in self.part_vertices))

    @cached_property
    def foot_m(self) -> np.ndarray:
        """(2,) middle of the base, where the stand is."""
        return (self.part_vertices[0].min(0) + self.part_vertices[0].max(0))[:2] / 2


class Candidates(NamedTuple):
    """Closed candidate hands of one side, in the right-hand world of the search (mirrored for a left hand).

    hands: a shape per row. wrist_m: (row, 3). flexion_rad: (row, 5, 3).
    """

    side: Side
    placement: Placement
    hands: CapsuleHands
    wrist_m: np.ndarray
    flexion_rad: np.ndarray

    def take(self, rows: np.ndarray) -> "Candidates":
        placement, hands = self.placement.take(rows), self.hands.take(rows)
        return Candidates(self.side, placement, hands, self.wrist_m[rows], self.flexion_rad[rows])

    def points(self, flexion_rad: np.ndarray) -> np.ndarray:
        """(row, 21, 4, 3) capsule points, with fingers curled by ``flexion_rad (row, 5, 3)``."""
        return capsule_points(self.hands, self.placement.rotmats, self.wrist_m, flexion_rad, self.placement.spread_rad)

    @property
    def open_rad(self) -> np.ndarray:
        return np.broadcast_to(OPEN_RAD, self.flexion_rad.shape)


def _turned(field: Field, upright_from_part: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    return field(points_m @ upright_from_part)


def _mirrored(side: Side, field: Field) -> Field:
    return mirrored(field) if side == "left" else field


def draw_candidates(scene: Scene, side: Side, reach: Reach, count: int, rng: np.random.Generator) -> Placement:
    """Placements of one hand that a person standing at -y could take and that keep clear of table and stand."""
    sign = MIRROR if side == "left" else np.ones(3)
    field = _mirrored(side, scene.part_fields[reach.part or 0] if reach.part is not None else scene.field)
    vertices = scene.part_vertices[reach.part] if reach.part is not None else np.concatenate(scene.part_vertices)
    low, high = vertices.min(0), vertices.max(0)
    middle = (low + high) / 2 if reach.through_m is None else np.asarray(reach.through_m)
    extent = (high - low) if reach.through_m is None else np.full(3, 0.02)
    direction = np.asarray(reach.direction) / np.linalg.norm(reach.direction)
    direction = direction + reach.width * rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    through = middle + 0.2 * extent * rng.normal(size=(count, 3))
    placement = draw_placements(field, direction * sign, through * sign, reach.blend, rng)
    forearm = placement.rotmats[:, :, 0]
    return placement.take(np.flatnonzero(forearm @ _ELBOW > 0.1))


def close_candidates(scene: Scene, side: Side, placement: Placement, hands: CapsuleHands) -> Candidates:
    """Close the fingers of every placement with its hand shape."""
    rows = hands.take(placement.hand)
    return Candidates(side, placement, rows, *close_fingers(_mirrored(side, scene.field), rows, placement))


def clear_of_table(scene: Scene, candidates: Candidates) -> np.ndarray:
    """(row,) bool: open and closed, the hand stays above the table and off the stand."""
    clear = np.ones(len(candidates.wrist_m), dtype=bool)
    foot = scene.foot_m * (MIRROR[:2] if candidates.side == "left" else 1.0)
    radii = candidates.hands.radii[:, :, None]
    for flexion in (candidates.open_rad, candidates.flexion_rad):
        points = candidates.points(flexion)
        clear &= (points[..., 2] - radii > scene.bottom_m - scene.spec.stand_m - 0.004).all((1, 2))
        beside = np.linalg.norm(points[..., :2] - foot, axis=-1) - radii > STAND_RADIUS_M
        clear &= (beside | (points[..., 2] - radii > scene.bottom_m - 0.004)).all((1, 2))
    return clear


def capsule_contacts(scene: Scene, candidates: Candidates) -> list[tuple[np.ndarray, np.ndarray]]:
    """Per row, contact points and outward normals (contact, 3) in the upright world, at most one per capsule."""
    field = _mirrored(candidates.side, scene.field)
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
    """Whether the contacts' friction cones span all wrenches: each of the twelve unit wrenches is produced exactly.

    Every other wrench is a non-negative sum of these twelve, so this proves force closure for any motion.
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
    """(row,) smallest distance between the two hands' capsules; infinite for one hand."""
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
    """Candidate hands of one side as true hand parameters, upright world; one row per candidate."""

    side: Side
    wrist_m: np.ndarray
    rotmats: np.ndarray
    hand_pose: np.ndarray
    open_pose: np.ndarray
    betas: np.ndarray

    def mesh(self, pair: HandPair) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (row, 778, 3) and joints (row, 21, 3), upright world, metres."""
        layer = kinematics_of(pair[self.side], torch.float64)
        local = rotvec_to_rotmat(self.hand_pose.reshape(-1, 15, 3))
        rotmats = np.concatenate([self.rotmats[:, None], local], axis=1)
        with torch.no_grad():
            vertices, joints = layer(
                *(torch.from_numpy(np.ascontiguousarray(a)) for a in (self.wrist_m, rotmats, self.betas))
            )
        return vertices.numpy(), joints.numpy()


def posed_hands(candidates: Candidates, betas: np.ndarray) -> PosedHands:
    """Back from the right-hand world of the search to the hand's own side; betas (hand, 10) per hand shape."""
    rotmats, spread, rows = candidates.placement.rotmats, candidates.placement.spread_rad, candidates.placement.hand
    pose = hand_pose_rotvec(candidates.hands, candidates.flexion_rad, spread)
    opened = hand_pose_rotvec(candidates.hands, candidates.open_rad, spread)
    if candidates.side == "right":
        return PosedHands("right", candidates.wrist_m, rotmats, pose, opened, betas[rows])
    mirror = np.diag(MIRROR)
    pose, opened = (mirror_rotvec_x(one.reshape(-1, 15, 3)).reshape(-1, 45) for one in (pose, opened))
    return PosedHands("left", candidates.wrist_m * MIRROR, mirror @ rotmats @ mirror, pose, opened, betas[rows])


def verify(scene: Scene, hold: Hold, hands: list[PosedHands], pair: HandPair) -> np.ndarray:
    """(row,) score of each candidate against the meshes; 0 where it fails, higher is better.

    At every angle the hold names: force closure, little penetration, and a joint of each hand near the surface.
    """
    meshes = [hand.mesh(pair) for hand in hands]
    score = np.full(len(hands[0].wrist_m), np.inf)
    angles = hold.angles_rad or (hold.hinge_rad,)
    for angle in angles:
        score = np.minimum(score, _verify_at(scene, hold, hands, meshes, pair, angle))
    for angle in {angles[0], angles[-1]}:
        score = np.where(_comes_and_goes(scene, hold, hands, pair, angle), score, 0.0)
    return score


def _comes_and_goes(scene: Scene, hold: Hold, hands: list[PosedHands], pair: HandPair, angle: float) -> np.ndarray:
    """(row,) whether opening, half-closed and withdrawing hands, too, stay out of the object."""
    follow = follow_lid(scene, angle)
    surface, clear = surface_index(scene.model), np.ones(len(hands[0].wrist_m), dtype=bool)
    hinge = np.full(len(clear), angle) if scene.model.is_articulated else None
    for (_, reach), hand in zip(hold.reaches, hands, strict=True):
        turn = scene.upright.T @ (follow if reach.part == 1 else np.eye(3))
        for closed, away_m in _STAGES:
            pose = hand.open_pose + closed * (hand.hand_pose - hand.open_pose)
            wrist = hand.wrist_m + away_m * hand.rotmats[:, :, 1]
            vertices = replace(hand, hand_pose=pose, wrist_m=wrist).mesh(pair)[0]
            clear &= surface.depth_m(vertices @ turn.T, hinge).max(1) < LARGEST_PENETRATION_M
    return clear


def _verify_at(scene: Scene, hold: Hold, hands, meshes, pair: HandPair, angle: float) -> np.ndarray:
    n_rows = len(hands[0].wrist_m)
    hinge = np.full(n_rows, angle) if scene.model.is_articulated else None
    follow = follow_lid(scene, angle)
    surface, near, touch, patches = surface_index(scene.model), [], [], []
    for (side, reach), (vertices, joints) in zip(hold.reaches, meshes, strict=True):
        turn = scene.upright.T @ (follow if reach.part == 1 else np.eye(3))
        near.append(surface.nearest(vertices @ turn.T, hinge))
        touch.append(surface.nearest(joints @ turn.T, hinge).distance_m.min(1))
        patches.append(hand_patches(pair[side]))
    centre = body_motion(scene.model, np.eye(3)[None].repeat(n_rows, 0), np.zeros((n_rows, 3)), hinge).centre_m
    score = np.zeros(n_rows)
    for row in range(n_rows):
        depth = max(-one.distance_m[row].min() for one in near)
        if depth > LARGEST_PENETRATION_M or max(distance[row] for distance in touch) > LARGEST_JOINT_DISTANCE_M:
            continue
        contacts = [patch_contacts(one, own, row) for one, own in zip(near, patches, strict=True)]
        points = np.concatenate([contact.points_m for contact in contacts])
        normals = np.concatenate([contact.normals for contact in contacts])
        if min(len(contact.points_m) for contact in contacts) >= 2 and closes_force(points, normals, centre[row]):
            score[row] = len(points) + 1 - 100 * depth
    return score


def follow_lid(scene: Scene, angle: float) -> np.ndarray:
    """(3, 3) turns a hand on the lid from the starting angle to another, upright frame."""
    if scene.model.hinge is None:
        return np.eye(3)
    return rotvec_to_rotmat(scene.upright @ scene.model.hinge.axis * (angle - scene.hinge_rad))


def to_grip(scene: Scene, reach: Reach, hands: PosedHands, row: int) -> Grip:
    """One candidate as a grip in the canonical object frame; on a lid, in the lid's frame at hinge angle 0."""
    back = scene.upright.T @ (scene.turn.T if reach.part == 1 else np.eye(3))
    return Grip(
        hands.side, back @ hands.wrist_m[row], back @ hands.rotmats[row],
        hands.hand_pose[row], hands.open_pose[row], int(reach.part == 1),
    )  # fmt: skip
