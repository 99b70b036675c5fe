"""What BimArt is told of an object's motion (O, G and scale of Sec. 3.1), and what it learns of hands at it (C and X).

Everything is in the object's canonical frame (``hoidata.sensors.part_bps``). Sides are ordered left, right; parts top
(the moving part, 1), base (0).
"""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample
from hoidata.clips.clip import FPS, SIDES
from hoidata.clips.features import (
    GLOBAL_ORIENT_6D,
    HAND_ROTATIONS_6D,
    N_ROTATIONS,
    OBJECT_HINGE,
    OBJECT_POSITION,
    OBJECT_ROTATION_6D,
    WRIST,
)
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rot6d, rotmat_to_rotvec
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import HandPair
from hoidata.hands.tracks import kinematics_of
from hoidata.objects.model import ObjectModel
from hoidata.sensors.keypoints import hand_keypoints
from hoidata.sensors.part_bps import BasisSettings, PartBps, canonical_object, distance_map

DOWN = np.array([0.0, 0.0, -1.0])  # the model frame is upright
Anchor = Literal["first", "before"]
STATE_SIZES = {"pose": 6, "local": 9, "none": 0}
JOINTS = 21


@dataclass(frozen=True)
class FeatureConfig:
    """What networks see and make; both networks of a pair must agree in all but ``state``, ``anchor`` and ``hands``.

    keypoints: of each hand. window: frames. state: G is the object's "pose" (axis-angle; position from the anchor), as
    published; or "local": gravity, velocity and turning as the object itself feels them, which no yaw, place or window
    changes; or "none". anchor: the window's first frame or the one before it. map_of: contact maps are distances to
    the whole skin (778 vertices) or to the keypoints, over which guidance compares them. most_m: distances end there;
    0: they do not.
    """

    basis: BasisSettings = field(default_factory=BasisSettings)
    keypoints: int = 100
    window: int = 64
    state: Literal["pose", "local", "none"] = "pose"
    anchor: Anchor = "first"
    map_of: Literal["skin", "keypoints"] = "skin"
    most_m: float = 0.0
    hands: Literal["keypoints", "mano"] = "keypoints"
    between: Literal["map", "joints"] = "map"

    @property
    def places(self) -> int:
        """Places of an object that a map of one hand has a value for."""
        return self.basis.places

    @property
    def scene_size(self) -> int:
        """Numbers per frame that the object encoder is given: O, G and the scale."""
        return 3 * self.places + STATE_SIZES[self.state] + 1

    @property
    def told_size(self) -> int:
        """Numbers per frame and hand that the first network makes: distances at places, or coordinates of joints."""
        return self.places if self.between == "map" else 3 * JOINTS

    @property
    def contact_size(self) -> int:
        return 2 * self.told_size

    @property
    def points(self) -> int:
        """Points of a hand whose positions a motion has."""
        return self.keypoints if self.hands == "keypoints" else JOINTS

    @property
    def rest_size(self) -> int:
        """Numbers per frame and hand beside positions: ways to the object, or rotations."""
        return 3 * self.keypoints if self.hands == "keypoints" else 6 * N_ROTATIONS

    @property
    def motion_size(self) -> int:
        """Numbers per frame of both hands: positions left, right, then the rest left, right (X = [H | D])."""
        return 2 * (3 * self.points + self.rest_size)

    def of_hands(self, hands: torch.Tensor) -> torch.Tensor:
        """(..., motion_size) what is true (..., 2) of the left and the right hand, for every number of a motion."""
        return torch.cat([hands.repeat_interleave(size, -1) for size in (3 * self.points, self.rest_size)], -1)


@dataclass(frozen=True)
class Scene:
    """An object's motion. offset, place_m, there: as in ``Seen``. scale: s_o. hinge_rad: (frame,).

    model_from_canonical: of every frame. object_from_canonical: of all. bps: the object's static structures.
    """

    offset: np.ndarray
    place_m: np.ndarray
    there: np.ndarray
    scale: float
    hinge_rad: np.ndarray
    model_from_canonical: RigidTransform
    object_from_canonical: RigidTransform
    bps: PartBps

    def __len__(self) -> int:
        return len(self.hinge_rad)

    @classmethod
    def of(cls, model: ObjectModel, thing: np.ndarray, basis: BasisSettings) -> "Scene":
        """From features (frame, 10) of the model frame (``hoidata.clips.features``)."""
        thing = thing.astype(np.float64)
        bps, object_from_canonical = _structures(_Known(model), basis)
        hinge = thing[:, OBJECT_HINGE] if model.is_articulated else np.zeros(len(thing))
        body = RigidTransform(rot6d_to_rotmat(thing[:, OBJECT_ROTATION_6D]), thing[:, OBJECT_POSITION])
        seen = bps.look(hinge)
        known = seen.offset, seen.place_m, seen.there, bps.scale, hinge
        return cls(*known, body @ object_from_canonical, object_from_canonical, bps)

    def state(self, kind: str, anchor: Anchor, start: int, stop: int) -> np.ndarray:
        """(frame, 6, 9 or 0) G of a window of frames."""
        rotation, position = self.model_from_canonical.rotation, self.model_from_canonical.translation
        if kind == "none":
            return np.zeros((stop - start, 0))
        if kind == "pose":
            origin = position[max(start - (anchor == "before"), 0)]
            return np.concatenate((rotmat_to_rotvec(rotation[start:stop]), position[start:stop] - origin), axis=1)
        rows = np.clip(np.arange(start - 1, stop + 1), 0, len(self) - 1)
        turns, places, seconds = rotation[rows], position[rows], (rows[2:] - rows[:-2]).clip(1)[:, None] / FPS
        own = turns[1:-1].swapaxes(1, 2)
        velocity = np.einsum("fij,fj->fi", own, (places[2:] - places[:-2]) / seconds)
        turning = rotmat_to_rotvec(turns[:-2].swapaxes(1, 2) @ turns[2:]) / seconds
        return np.concatenate((own @ DOWN, velocity, turning), axis=1)


class _Known:
    """A model as a key: the same object in memory."""

    def __init__(self, model: ObjectModel) -> None:
        self.model = model

    def __hash__(self) -> int:
        return id(self.model)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Known) and other.model is self.model


@lru_cache(maxsize=64)
def _structures(known: _Known, basis: BasisSettings) -> tuple[PartBps, RigidTransform]:
    canonical, object_from_canonical = canonical_object(known.model, basis.frame)
    return PartBps(canonical, basis), object_from_canonical


@dataclass(frozen=True)
class Recorded:
    """A recorded clip as networks learn it. contact_m: (side, frame, told_size) float16 maps, or float32 joints.

    keypoints_m: (side, frame, point, 3), or joints, and rest: (side, frame, rest_size), float32, canonical frame.
    present: (side, frame) tracked; active_hands: (side,).
    """

    scene: Scene
    contact_m: np.ndarray
    keypoints_m: np.ndarray
    rest: np.ndarray
    present: np.ndarray
    active_hands: np.ndarray

    @property
    def motion(self) -> np.ndarray:
        """(frame, motion_size) X: positions left, right, then the rest left, right."""
        own = [part.swapaxes(0, 1).reshape(part.shape[1], -1) for part in (self.keypoints_m, self.rest)]
        return np.concatenate(own, axis=1)


def recorded_clip(sample: ClipSample, pair: HandPair, config: FeatureConfig) -> Recorded:
    """A whole clip's maps (or joints), positions and what goes with them."""
    scene = Scene.of(sample.object_model, sample.object, config.basis)
    canonical_from_model = scene.model_from_canonical.inverse()
    ids = hand_keypoints(pair.right, config.keypoints)
    contact, points, rest = [], [], []
    for row in range(2):
        skin = canonical_from_model @ hand_vertices_m(pair, row, sample).astype(np.float64)
        joints = (canonical_from_model @ sample.joints_m[row].astype(np.float64)).astype(np.float32)
        own = skin[:, ids]
        if config.between == "map":
            found = distance_map(scene.place_m, skin if config.map_of == "skin" else own)
            contact.append(np.minimum(found, config.most_m or np.inf).astype(np.float16))
        else:
            contact.append(joints.reshape(len(joints), -1))
        if config.hands == "keypoints":
            points.append(own.astype(np.float32))
            ways = scene.bps.nearest_m(own, scene.hinge_rad) - own
            rest.append(ways.reshape(len(ways), -1).astype(np.float32))
        else:
            points.append(joints)
            rest.append(_turned(sample.hands[row], canonical_from_model))
    arrays = np.stack(contact), np.stack(points), np.stack(rest)
    return Recorded(scene, *arrays, sample.valid, sample.active_hands)


def _turned(hand: np.ndarray, canonical_from_model: RigidTransform) -> np.ndarray:
    """(frame, 96) rotations of a hand's features (frame, 99), of which the wrist's turns with the frame."""
    turns = hand[:, HAND_ROTATIONS_6D].astype(np.float32)
    wrist = canonical_from_model.rotation @ rot6d_to_rotmat(hand[:, GLOBAL_ORIENT_6D].astype(np.float64))
    turns[:, :6] = rotmat_to_rot6d(wrist)
    return turns


@torch.no_grad()
def hand_vertices_m(pair: HandPair, row: int, sample: ClipSample) -> np.ndarray:
    """(frame, 778, 3) float32 skin of one side, model frame."""
    hands = torch.from_numpy(sample.hands[row])
    turns = rot6d_to_rotmat(hands[:, HAND_ROTATIONS_6D].reshape(-1, N_ROTATIONS, 6))
    template = None if sample.template_m is None else torch.from_numpy(sample.template_m[row])
    layer = kinematics_of(pair[SIDES[row]])
    return layer(hands[:, WRIST], turns, torch.from_numpy(sample.betas[row])[None], template)[0].numpy()


def split_motion(motion: np.ndarray, config: FeatureConfig) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of ``Recorded.motion``: positions (side, frame, point, 3) and the rest (side, frame, rest_size)."""
    own = motion[:, : 6 * config.points], motion[:, 6 * config.points :]
    points, rest = (part.reshape(len(motion), 2, -1).swapaxes(0, 1) for part in own)
    return points.reshape(*points.shape[:2], -1, 3), rest
