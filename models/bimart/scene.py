"""BimArt's features: the object's motion as condition (O, G and scale, Sec. 3.1), and hands at it as targets (C and X).

Everything is in the object's canonical frame (``hoidata.sensors.part_bps``). Sides are ordered left, right. Parts are
ordered top (the moving part, 1), base (0).
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from cachetools import LRUCache, cached

from hoidata.batches.dataset import ClipSample
from hoidata.clips.clip import FPS, SIDES
from hoidata.clips.features import OBJECT_HINGE, OBJECT_POSITION, OBJECT_ROTATION_6D, WRIST
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rotvec
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import HandPair
from hoidata.hands.kinematics import kinematics_of
from hoidata.objects.model import ObjectModel
from hoidata.sensors.part_bps import BasisSettings, PartBps, canonical_object, distance_map, hand_keypoints
from models.common.features import hand_rotmats

DOWN = np.array([0.0, 0.0, -1.0])  # the model frame is upright
STATE_SIZES = {"pose": 6, "local": 9}


@dataclass(frozen=True)
class FeatureConfig:
    """Inputs and outputs of the networks. Both networks of a pair must agree in all but ``state``."""

    basis: BasisSettings = field(default_factory=BasisSettings)
    keypoints: int = 100  # of each hand
    window_frames: int = 64
    # G. "pose" (paper): axis-angle, and position relative to the window's first frame. "local": gravity, velocity and
    # angular velocity in the object frame; yaw, position and window do not change them.
    state: Literal["pose", "local"] = "pose"
    # Contact maps are distances to all 778 vertices of the hand, or to its keypoints, which guidance uses.
    contact_map_target: Literal["skin", "keypoints"] = "skin"
    max_distance_m: float = 0.0  # contact maps are clamped to it; 0: not clamped

    @property
    def object_points(self) -> int:
        """Number N of object points: a contact map has one distance per point and hand."""
        return self.basis.places

    @property
    def scene_size(self) -> int:
        """Numbers per frame of the object encoder's input: O, G and the scale."""
        return 3 * self.object_points + STATE_SIZES[self.state] + 1

    @property
    def contact_size(self) -> int:
        """Numbers per frame of a contact map: distances from the left hand, then from the right."""
        return 2 * self.object_points

    @property
    def motion_size(self) -> int:
        """Numbers per frame of X = [H | D]: keypoints left, right, then vectors to the object left, right."""
        return 12 * self.keypoints

    def spread_over_motion(self, hands: torch.Tensor) -> torch.Tensor:
        """Repeat values (..., 2) of the left and right hand for every number of a motion: (..., motion_size)."""
        return torch.cat(2 * [hands.repeat_interleave(3 * self.keypoints, -1)], -1)


@dataclass(frozen=True)
class Scene:
    """The motion of an object with its part-based basis point set (BPS)."""

    basis_offset: np.ndarray  # (frame, N, 3) scaled vectors from the basis points to the object (O, eq. 2)
    object_point_m: np.ndarray  # (frame, N, 3) the object point nearest to each basis point, canonical frame
    point_exists: np.ndarray  # (N,) bool, False for points of a part that the object does not have
    object_scale: float  # s_o of eq. 1, per metre
    hinge_rad: np.ndarray  # (frame,) as in ``ObjectTrack``
    model_from_canonical: RigidTransform  # (frame,)
    object_from_canonical: RigidTransform  # the same in all frames
    bps: PartBps

    def __len__(self) -> int:
        return len(self.hinge_rad)

    @classmethod
    def of(cls, model: ObjectModel, object_features: np.ndarray, basis: BasisSettings) -> "Scene":
        """Build from features (frame, 10) in the model frame (``hoidata.clips.features``)."""
        object_features = object_features.astype(np.float64)
        bps, object_from_canonical = _basis_structures(model, basis)
        hinge_rad = object_features[:, OBJECT_HINGE] * (model.joint_scale if model.is_articulated else 0)
        rotation = rot6d_to_rotmat(object_features[:, OBJECT_ROTATION_6D])
        model_from_object = RigidTransform(rotation, object_features[:, OBJECT_POSITION])
        nearest, model_from_canonical = bps.nearest_points(hinge_rad), model_from_object @ object_from_canonical
        points = nearest.offset, nearest.point_m, nearest.is_present
        return cls(*points, bps.scale, hinge_rad, model_from_canonical, object_from_canonical, bps)

    def state(self, kind: str, start: int, stop: int) -> np.ndarray:
        """G (frame, 6 or 9) of frames ``start`` to ``stop - 1``; kind: ``FeatureConfig.state``."""
        rotation, position = self.model_from_canonical.rotation, self.model_from_canonical.translation
        if kind == "pose":
            displacement = position[start:stop] - position[start]
            return np.concatenate((rotmat_to_rotvec(rotation[start:stop]), displacement), axis=1)
        # Central differences; one-sided in the first and last frame.
        rows = np.clip(np.arange(start - 1, stop + 1), 0, len(self) - 1)
        rotations, positions = rotation[rows], position[rows]
        elapsed_s = (rows[2:] - rows[:-2]).clip(1)[:, None] / FPS
        canonical_from_model = rotations[1:-1].swapaxes(1, 2)
        velocity = np.einsum("fij,fj->fi", canonical_from_model, (positions[2:] - positions[:-2]) / elapsed_s)
        angular_velocity = rotmat_to_rotvec(rotations[:-2].swapaxes(1, 2) @ rotations[2:]) / elapsed_s
        return np.concatenate((canonical_from_model @ DOWN, velocity, angular_velocity), axis=1)


@cached(LRUCache(64), key=lambda model, basis: (model.digest, basis))
def _basis_structures(model: ObjectModel, basis: BasisSettings) -> tuple[PartBps, RigidTransform]:
    canonical, object_from_canonical = canonical_object(model, basis.frame)
    return PartBps(canonical, basis), object_from_canonical


@dataclass(frozen=True)
class RecordedClip:
    """Training targets of a recorded clip, canonical frame."""

    scene: Scene
    contact_m: np.ndarray  # (side, frame, N) float16 distances from object points to the hand
    keypoints_m: np.ndarray  # (side, frame, keypoint, 3) float32
    to_object_m: np.ndarray  # (side, frame, keypoint, 3) float32 vectors from keypoints to the object's surface
    present: np.ndarray  # (side, frame) bool, tracked
    active_hands: np.ndarray  # (side,) bool

    @property
    def motion(self) -> np.ndarray:
        """(frame, motion_size) X: keypoints left, right, then vectors to the object left, right."""
        by_frame = [array.swapaxes(0, 1).reshape(array.shape[1], -1) for array in (self.keypoints_m, self.to_object_m)]
        return np.concatenate(by_frame, axis=1)


def recorded_clip(sample: ClipSample, pair: HandPair, config: FeatureConfig) -> RecordedClip:
    """Contact maps, keypoints and vectors to the object of a whole clip."""
    scene = Scene.of(sample.object_model, sample.object, config.basis)
    canonical_from_model = scene.model_from_canonical.inverse()
    keypoint_ids = hand_keypoints(pair.right, config.keypoints)
    contact, keypoints, to_object = [], [], []
    for side in range(2):
        skin_m = canonical_from_model @ hand_vertices_m(pair, side, sample).astype(np.float64)
        keypoints_m = skin_m[:, keypoint_ids]
        target_m = skin_m if config.contact_map_target == "skin" else keypoints_m
        distance_m = distance_map(scene.object_point_m, target_m)
        contact.append(np.minimum(distance_m, config.max_distance_m or np.inf).astype(np.float16))
        keypoints.append(keypoints_m.astype(np.float32))
        to_object.append((scene.bps.nearest_m(keypoints_m, scene.hinge_rad) - keypoints_m).astype(np.float32))
    contact_m, keypoints_m, to_object_m = map(np.stack, (contact, keypoints, to_object))
    return RecordedClip(scene, contact_m, keypoints_m, to_object_m, sample.valid, sample.active_hands)


@torch.no_grad()
def hand_vertices_m(pair: HandPair, side: int, sample: ClipSample) -> np.ndarray:
    """(frame, 778, 3) float32 vertices of one hand, model frame; side: 0 left, 1 right."""
    hands = torch.from_numpy(sample.hands[side])
    template = None if sample.template_m is None else torch.from_numpy(sample.template_m[side])
    layer, betas = kinematics_of(pair[SIDES[side]]), torch.from_numpy(sample.betas[side])[None]
    return layer(hands[:, WRIST], hand_rotmats(hands), betas, template)[0].numpy()


def split_motion(motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split X into keypoints and vectors to the object, both (side, frame, keypoint, 3)."""
    keypoints, to_object = motion.reshape(len(motion), 2, 2, -1, 3).transpose(1, 2, 0, 3, 4)
    return keypoints, to_object
