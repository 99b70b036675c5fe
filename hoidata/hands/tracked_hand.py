"""A hand of any skeleton, as sensors, feature vectors and post-processing need it: one interface for all of them.

Joints in a tree, five fingertips, skin points with normals (the proximity sensors), capsules, hinges and their limits.
``hoidata.sensors.mano_hand`` makes one of the MANO layout; ManipNet's own comes from its adapter, by way of the store
(``HandRecording.hand``).

Three kinds of axes: the world; the wrist's (``state`` answers in them); and canonical ones, the same for every hand:
x to the fingers, y to the thumb, z out of the back of the hand. The left hand's are seen in a mirror, so that a left
hand has the same numbers in canonical axes as the right hand that is its mirror image.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hoidata.geometry.transform import RigidTransform
from hoidata.hands.model import Side

N_TIPS = 5
_MIRROR = np.array([-1.0, 1.0, 1.0])


class HandState(NamedTuple):
    """Hands of some frames, all in one frame of reference (the wrist's, or the world once ``placed``), metres.

    joint_m: (frame, joint, 3) and joint_rotmats: (frame, joint, 3, 3), the wrist first. tip_m: (frame, 5, 3).
    sensor_m, sensor_normal: (frame, sensor, 3) skin points and their unit normals, outward.
    capsule_start_m, capsule_end_m: (frame, capsule, 3).
    """

    joint_m: np.ndarray
    joint_rotmats: np.ndarray
    tip_m: np.ndarray
    sensor_m: np.ndarray
    sensor_normal: np.ndarray
    capsule_start_m: np.ndarray
    capsule_end_m: np.ndarray

    @property
    def point_m(self) -> np.ndarray:
        """(frame, joint + 5, 3): joints, then tips; where the signed distance is measured."""
        return np.concatenate([self.joint_m, self.tip_m], axis=1)

    def placed(self, world_from_wrist: RigidTransform) -> "HandState":
        """Taken to another frame of reference by (frame,) transforms."""
        rotation = world_from_wrist.rotation[:, None]
        moved = {name: world_from_wrist @ getattr(self, name) for name in self._fields if name not in _TURNED}
        normal = world_from_wrist.turn(self.sensor_normal)
        return HandState(**moved, joint_rotmats=rotation @ self.joint_rotmats, sensor_normal=normal)

    def taken(self, frames: np.ndarray | slice) -> "HandState":
        """Some frames only."""
        return HandState(*(array[frames] for array in self))


_TURNED = ("joint_rotmats", "sensor_normal")


@dataclass(frozen=True, eq=False)
class Skin:
    """Points that follow the joints by linear blend skinning: the tips, then the proximity sensors.

    point_m, normal: (point, 3) at rest, skin frame. weight: (point, joint), rows summing to 1.
    joint_from_skin: (joint,) transforms from the skin's frame to each joint's at rest.
    corrective_m: (point, 3, 9 (joint - 1)) pose blend shapes, metres per element of ``R - I``; None without any.
    """

    point_m: np.ndarray
    normal: np.ndarray
    weight: np.ndarray
    joint_from_skin: RigidTransform
    corrective_m: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class JointCapsules:
    """joint: (capsule,) each moves with. start_m, end_m: (capsule, 3) in that joint's frame. radius_m: (capsule,)."""

    joint: np.ndarray
    start_m: np.ndarray
    end_m: np.ndarray
    radius_m: np.ndarray


@dataclass(frozen=True, eq=False)
class TrackedHand:
    """One side of a hand. All arrays float64, metres and radians, right-handed axes.

    layout: "manipnet" or "mano". joint_names: parents before children, the wrist first. parents: (joint,), -1 first.
    offset_m: (joint, 3) of each joint in its parent's frame. rest_rotmats: (joint - 1, 3, 3) finger rotations of the
    neutral pose. skin: tips (in the order of ``tip_joint``), then sensors. tip_joint: (5,) last joint of each finger.
    capsules: palm's (those of the wrist) first. middle_knuckle: the joint that the ambient sensor's cells turn with.
    wrist_from_canonical: (3, 3) columns are the canonical axes in the wrist's; determinant -1 for a left hand.
    hinge_axis: (joint, 3) in the joint's own axes, zero for joints that turn freely. limit_rad: (joint, 2) angles
    about it from the neutral pose, least and most; 0 for free joints.
    """

    side: Side
    layout: str
    joint_names: tuple[str, ...]
    parents: np.ndarray
    offset_m: np.ndarray
    rest_rotmats: np.ndarray
    skin: Skin
    tip_joint: np.ndarray
    capsules: JointCapsules
    middle_knuckle: int
    wrist_from_canonical: np.ndarray
    hinge_axis: np.ndarray
    limit_rad: np.ndarray

    @property
    def n_joints(self) -> int:
        return len(self.parents)

    @property
    def n_points(self) -> int:
        """Joints and tips."""
        return self.n_joints + N_TIPS

    @property
    def n_sensors(self) -> int:
        return len(self.skin.point_m) - N_TIPS

    @property
    def palm_capsules(self) -> np.ndarray:
        """Numbers of the capsules that move with the wrist."""
        return np.flatnonzero(self.capsules.joint == 0)

    @cached_property
    def point_radius_m(self) -> np.ndarray:
        """(joint + 5,) radius of the finger capsule that begins at each joint; 0 for the wrist, tips, and the rest."""
        radius = np.zeros(self.n_points)
        fingers = self.capsules.joint > 0
        radius[self.capsules.joint[fingers]] = self.capsules.radius_m[fingers]
        return radius

    def state(self, finger_rotmats: np.ndarray) -> HandState:
        """The hand in the wrist's frame. finger_rotmats: (frame, joint - 1, 3, 3), each relative to its parent."""
        finger_rotmats = np.asarray(finger_rotmats, dtype=np.float64)
        rotation, position = self._chain(finger_rotmats)
        point, normal = self._skinned(finger_rotmats, rotation, position)
        capsules = self.capsules
        at, turn = position[:, capsules.joint], rotation[:, capsules.joint]
        start, end = (at + (turn @ ends[..., None])[..., 0] for ends in (capsules.start_m, capsules.end_m))
        return HandState(
            position, rotation, point[:, :N_TIPS], point[:, N_TIPS:], normal[:, N_TIPS:], capsule_start_m=start,
            capsule_end_m=end,
        )  # fmt: skip

    def finger_rotmats(self, joint_rotmats: np.ndarray) -> np.ndarray:
        """(frame, joint - 1, 3, 3) relative to each joint's parent, of ``joint_rotmats (frame, joint, 3, 3)``."""
        parent = joint_rotmats[:, self.parents[1:]]
        return parent.swapaxes(-1, -2) @ joint_rotmats[:, 1:]

    def mirrored(self) -> "TrackedHand":
        """The other hand: this one in a mirror with normal x of the wrist's axes (and of every joint's)."""
        skin, capsules = self.skin, self.capsules
        corrective = skin.corrective_m
        if corrective is not None:
            signs = np.tile((_MIRROR[:, None] * _MIRROR).ravel(), self.n_joints - 1)
            corrective = corrective * _MIRROR[:, None] * signs
        move = skin.joint_from_skin
        return replace(
            self,
            side="left" if self.side == "right" else "right",
            offset_m=self.offset_m * _MIRROR,
            rest_rotmats=_seen_in_mirror(self.rest_rotmats),
            skin=Skin(
                skin.point_m * _MIRROR,
                skin.normal * _MIRROR,
                skin.weight,
                RigidTransform(_seen_in_mirror(move.rotation), move.translation * _MIRROR),
                corrective,
            ),
            capsules=replace(capsules, start_m=capsules.start_m * _MIRROR, end_m=capsules.end_m * _MIRROR),
            wrist_from_canonical=_MIRROR[:, None] * self.wrist_from_canonical,
            hinge_axis=self.hinge_axis * -_MIRROR,
        )

    @cached_property
    def _levels(self) -> list[np.ndarray]:
        """Joints by their depth below the wrist."""
        depth = np.zeros(self.n_joints, dtype=np.int64)
        for joint, parent in enumerate(self.parents[1:], start=1):
            depth[joint] = depth[parent] + 1
        return [np.flatnonzero(depth == level) for level in range(1, depth.max() + 1)]

    def _chain(self, finger_rotmats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (frame, joint, 3, 3) and positions (frame, joint, 3) in the wrist's frame."""
        n_frames = len(finger_rotmats)
        rotation = np.tile(np.eye(3), (n_frames, self.n_joints, 1, 1))
        position = np.zeros((n_frames, self.n_joints, 3))
        for joints in self._levels:
            above = self.parents[joints]
            position[:, joints] = position[:, above] + (rotation[:, above] @ self.offset_m[joints, :, None])[..., 0]
            rotation[:, joints] = rotation[:, above] @ finger_rotmats[:, joints - 1]
        return rotation, position

    def _skinned(
        self, finger_rotmats: np.ndarray, rotation: np.ndarray, position: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Skin points and unit normals (frame, point, 3) in the wrist's frame."""
        n_frames, skin = len(rotation), self.skin
        turn = rotation @ skin.joint_from_skin.rotation
        move = position + (rotation @ skin.joint_from_skin.translation[..., None])[..., 0]
        blended = skin.weight @ np.concatenate([turn.reshape(n_frames, -1, 9), move], axis=2)
        turn = blended[..., :9].reshape(n_frames, -1, 3, 3)
        rest = skin.point_m
        if skin.corrective_m is not None:
            bends = (finger_rotmats - np.eye(3)).reshape(n_frames, -1)
            rest = rest + (bends @ skin.corrective_m.reshape(-1, bends.shape[1]).T).reshape(n_frames, -1, 3)
        point = (turn @ rest[..., None])[..., 0] + blended[..., 9:]
        normal = (turn @ skin.normal[..., None])[..., 0]
        return point, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _seen_in_mirror(rotmats: np.ndarray) -> np.ndarray:
    return _MIRROR[:, None] * rotmats * _MIRROR
