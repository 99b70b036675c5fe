"""A hand with any skeleton: the interface of sensors, feature vectors and post-processing.

It has a joint tree, five fingertips, skin points with normals (the proximity sensors), capsules, hinges and their
limits. ``hoidata.sensors.mano_hand`` builds one in MANO's layout. ManipNet's hand comes from its adapter through the
store (``HandRecording.hand``).

There are three kinds of axes: the world's, the wrist's (results of ``state``), and canonical axes, which are the same
for all hands: x to the fingers, y to the thumb, z out of the back of the hand. The left hand's canonical axes are
mirrored, so that a left hand and its mirror image have equal numbers.
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
    """A posed hand in some frames; in the wrist's frame of reference, or in the world after ``placed``."""

    joint_m: np.ndarray  # (frame, joint, 3), the wrist first
    joint_rotmats: np.ndarray  # (frame, joint, 3, 3)
    tip_m: np.ndarray  # (frame, 5, 3)
    sensor_m: np.ndarray  # (frame, sensor, 3) skin points
    sensor_normal: np.ndarray  # (frame, sensor, 3) unit normals, outward
    capsule_start_m: np.ndarray  # (frame, capsule, 3)
    capsule_end_m: np.ndarray  # (frame, capsule, 3)

    @property
    def point_m(self) -> np.ndarray:
        """(frame, joint + 5, 3) joints, then tips: the points whose signed distance is measured."""
        return np.concatenate([self.joint_m, self.tip_m], axis=1)

    def placed(self, world_from_wrist: RigidTransform) -> "HandState":
        """The hand in another frame of reference; world_from_wrist: (frame,)."""
        rotation = world_from_wrist.rotation[:, None]
        points = {name: world_from_wrist @ getattr(self, name) for name in self._fields if name not in _ROTATED_ONLY}
        normal = world_from_wrist.turn(self.sensor_normal)
        return HandState(**points, joint_rotmats=rotation @ self.joint_rotmats, sensor_normal=normal)

    def taken(self, frames: np.ndarray | slice) -> "HandState":
        """The chosen frames."""
        return HandState(*(array[frames] for array in self))


_ROTATED_ONLY = ("joint_rotmats", "sensor_normal")


@dataclass(frozen=True, eq=False)
class Skin:
    """Points that are skinned linearly: the tips, then the proximity sensors."""

    point_m: np.ndarray  # (point, 3) at rest, skin frame
    normal: np.ndarray  # (point, 3)
    weight: np.ndarray  # (point, joint), rows sum to 1
    joint_from_skin: RigidTransform  # (joint,) from the skin's frame to each joint's frame at rest
    # (point, 3, 9 (joint - 1)) pose blend shapes, metres per element of ``R - I``
    corrective_m: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class JointCapsules:
    """Capsules that move with joints."""

    joint: np.ndarray  # (capsule,) index of the joint
    start_m: np.ndarray  # (capsule, 3) in that joint's frame
    end_m: np.ndarray  # (capsule, 3)
    radius_m: np.ndarray  # (capsule,)


@dataclass(frozen=True, eq=False)
class TrackedHand:
    """One side of a hand; arrays are float64, axes right-handed."""

    side: Side
    layout: str  # "manipnet" or "mano"
    joint_names: tuple[str, ...]  # parents before children, the wrist first
    parents: np.ndarray  # (joint,), -1 for the wrist
    offset_m: np.ndarray  # (joint, 3) position of each joint in its parent's frame
    rest_rotmats: np.ndarray  # (joint - 1, 3, 3) finger rotations of the neutral pose
    skin: Skin  # tips in the order of ``tip_joint``, then sensors
    tip_joint: np.ndarray  # (5,) last joint of each finger
    capsules: JointCapsules  # those of the wrist (the palm) first
    middle_knuckle: int  # the joint with which the cells of the ambient sensor rotate
    wrist_from_canonical: np.ndarray  # (3, 3) canonical axes in columns; determinant -1 for a left hand
    hinge_axis: np.ndarray  # (joint, 3) in the joint's axes, zero for joints that rotate freely
    limit_rad: np.ndarray  # (joint, 2) smallest and largest hinge angle from the neutral pose; 0 for free joints

    @property
    def n_joints(self) -> int:
        return len(self.parents)

    @property
    def n_points(self) -> int:
        """Number of joints and tips."""
        return self.n_joints + N_TIPS

    @property
    def n_sensors(self) -> int:
        return len(self.skin.point_m) - N_TIPS

    @property
    def palm_capsules(self) -> np.ndarray:
        """Indices of the capsules that move with the wrist."""
        return np.flatnonzero(self.capsules.joint == 0)

    @cached_property
    def point_radius_m(self) -> np.ndarray:
        """(joint + 5,) radius of the finger capsule that starts at each joint; 0 if none does."""
        radius = np.zeros(self.n_points)
        fingers = self.capsules.joint > 0
        radius[self.capsules.joint[fingers]] = self.capsules.radius_m[fingers]
        return radius

    @property
    def palm_depth_m(self) -> float:
        """How far the palm's skin reaches below the wrist joint, along the back's normal; the hand is flat."""
        flat = self.state(np.tile(np.eye(3), (1, self.n_joints - 1, 1, 1)))
        is_palm = self.skin.weight[N_TIPS:].argmax(axis=1) == 0
        return float(-(flat.sensor_m[0, is_palm] @ self.wrist_from_canonical)[:, 2].min())

    def state(self, finger_rotmats: np.ndarray) -> HandState:
        """Pose the hand, in the wrist's frame. finger_rotmats: (frame, joint - 1, 3, 3) relative to the parent."""
        finger_rotmats = np.asarray(finger_rotmats, dtype=np.float64)
        rotation, position = self._chain(finger_rotmats)
        point, normal = self._skinned(finger_rotmats, rotation, position)
        capsules = self.capsules
        joint_m, joint_rotmats = position[:, capsules.joint], rotation[:, capsules.joint]
        start, end = (
            joint_m + (joint_rotmats @ ends[..., None])[..., 0] for ends in (capsules.start_m, capsules.end_m)
        )
        return HandState(
            joint_m=position,
            joint_rotmats=rotation,
            tip_m=point[:, :N_TIPS],
            sensor_m=point[:, N_TIPS:],
            sensor_normal=normal[:, N_TIPS:],
            capsule_start_m=start,
            capsule_end_m=end,
        )

    def finger_rotmats(self, joint_rotmats: np.ndarray) -> np.ndarray:
        """(frame, joint - 1, 3, 3) rotations relative to the parent, from ``joint_rotmats (frame, joint, 3, 3)``."""
        parent = joint_rotmats[:, self.parents[1:]]
        return parent.swapaxes(-1, -2) @ joint_rotmats[:, 1:]

    def mirrored(self) -> "TrackedHand":
        """The other hand: mirrored with normal x in the wrist's axes and in all joints' axes."""
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
            rest_rotmats=_mirrored_rotmats(self.rest_rotmats),
            skin=Skin(
                point_m=skin.point_m * _MIRROR,
                normal=skin.normal * _MIRROR,
                weight=skin.weight,
                joint_from_skin=RigidTransform(_mirrored_rotmats(move.rotation), move.translation * _MIRROR),
                corrective_m=corrective,
            ),
            capsules=replace(capsules, start_m=capsules.start_m * _MIRROR, end_m=capsules.end_m * _MIRROR),
            wrist_from_canonical=_MIRROR[:, None] * self.wrist_from_canonical,
            hinge_axis=self.hinge_axis * -_MIRROR,
        )

    @cached_property
    def _levels(self) -> list[np.ndarray]:
        """Joints of each depth of the tree, for batched forward kinematics."""
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
            parents = self.parents[joints]
            position[:, joints] = position[:, parents] + (rotation[:, parents] @ self.offset_m[joints, :, None])[..., 0]
            rotation[:, joints] = rotation[:, parents] @ finger_rotmats[:, joints - 1]
        return rotation, position

    def _skinned(
        self, finger_rotmats: np.ndarray, rotation: np.ndarray, position: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Skin points and unit normals (frame, point, 3) in the wrist's frame."""
        n_frames, skin = len(rotation), self.skin
        joint_rotation = rotation @ skin.joint_from_skin.rotation
        joint_shift = position + (rotation @ skin.joint_from_skin.translation[..., None])[..., 0]
        blended = skin.weight @ np.concatenate([joint_rotation.reshape(n_frames, -1, 9), joint_shift], axis=2)
        blended_rotation = blended[..., :9].reshape(n_frames, -1, 3, 3)
        rest = skin.point_m
        if skin.corrective_m is not None:
            features = (finger_rotmats - np.eye(3)).reshape(n_frames, -1)
            rest = rest + (features @ skin.corrective_m.reshape(-1, features.shape[1]).T).reshape(n_frames, -1, 3)
        point = (blended_rotation @ rest[..., None])[..., 0] + blended[..., 9:]
        normal = (blended_rotation @ skin.normal[..., None])[..., 0]
        return point, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _mirrored_rotmats(rotmats: np.ndarray) -> np.ndarray:
    return _MIRROR[:, None] * rotmats * _MIRROR
