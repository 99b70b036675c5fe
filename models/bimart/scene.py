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
    HAND_ROTATIONS_6D,
    N_ROTATIONS,
    OBJECT_HINGE,
    OBJECT_POSITION,
    OBJECT_ROTATION_6D,
    WRIST,
)
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rotvec
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import HandPair
from hoidata.hands.tracks import kinematics_of
from hoidata.objects.model import ObjectModel
from hoidata.sensors.keypoints import hand_keypoints
from hoidata.sensors.part_bps import BasisSettings, PartBps, canonical_object, distance_map

DOWN = np.array([0.0, 0.0, -1.0])  # the model frame is upright
STATE_SIZES = {"pose": 6, "local": 9}


@dataclass(frozen=True)
class FeatureConfig:
    """What networks see and make; both networks of a pair must agree in all but ``state``.

    keypoints: of each hand. window: frames. state: G is the object's "pose" (axis-angle; position from that in the
    window's first frame), as published; or "local": gravity, velocity and rotation in the object's own frame, which no
    yaw, position or window changes. map_of: contact maps are distances to the whole skin (778 vertices) or to the
    keypoints, over which guidance compares them. most_m: distances end there; 0: they do not.
    """

    basis: BasisSettings = field(default_factory=BasisSettings)
    keypoints: int = 100
    window: int = 64
    state: Literal["pose", "local"] = "pose"
    map_of: Literal["skin", "keypoints"] = "skin"
    most_m: float = 0.0

    @property
    def places(self) -> int:
        """Places of an object that a map of one hand has a value for."""
        return self.basis.places

    @property
    def scene_size(self) -> int:
        """Numbers per frame that the object encoder is given: O, G and the scale."""
        return 3 * self.places + STATE_SIZES[self.state] + 1

    @property
    def contact_size(self) -> int:
        """Numbers per frame of a contact map: distances at places from the left hand, then from the right."""
        return 2 * self.places

    @property
    def motion_size(self) -> int:
        """Numbers per frame: keypoints left, right, then vectors to the object left, right (X = [H | D])."""
        return 12 * self.keypoints

    def of_hands(self, hands: torch.Tensor) -> torch.Tensor:
        """(..., motion_size) what is true (..., 2) of the left and the right hand, for every number of a motion."""
        return torch.cat(2 * [hands.repeat_interleave(3 * self.keypoints, -1)], -1)


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

    def state(self, kind: str, start: int, stop: int) -> np.ndarray:
        """(frame, 6 or 9) G of a window of frames."""
        rotation, position = self.model_from_canonical.rotation, self.model_from_canonical.translation
        if kind == "pose":
            moved = position[start:stop] - position[start]
            return np.concatenate((rotmat_to_rotvec(rotation[start:stop]), moved), axis=1)
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
    """A recorded clip as networks learn it. contact_m: (side, frame, place) float16 distances.

    keypoints_m and to_object_m, the vectors from them to the object: (side, frame, keypoint, 3) float32, canonical
    frame. present: (side, frame) tracked; active_hands: (side,).
    """

    scene: Scene
    contact_m: np.ndarray
    keypoints_m: np.ndarray
    to_object_m: np.ndarray
    present: np.ndarray
    active_hands: np.ndarray

    @property
    def motion(self) -> np.ndarray:
        """(frame, motion_size) X: keypoints left, right, then vectors to the object left, right."""
        own = [part.swapaxes(0, 1).reshape(part.shape[1], -1) for part in (self.keypoints_m, self.to_object_m)]
        return np.concatenate(own, axis=1)


def recorded_clip(sample: ClipSample, pair: HandPair, config: FeatureConfig) -> Recorded:
    """A whole clip's maps, keypoints and vectors to the object."""
    scene = Scene.of(sample.object_model, sample.object, config.basis)
    canonical_from_model = scene.model_from_canonical.inverse()
    ids = hand_keypoints(pair.right, config.keypoints)
    contact, keypoints, to_object = [], [], []
    for row in range(2):
        skin = canonical_from_model @ hand_vertices_m(pair, row, sample).astype(np.float64)
        own = skin[:, ids]
        found = distance_map(scene.place_m, skin if config.map_of == "skin" else own)
        contact.append(np.minimum(found, config.most_m or np.inf).astype(np.float16))
        keypoints.append(own.astype(np.float32))
        to_object.append((scene.bps.nearest_m(own, scene.hinge_rad) - own).astype(np.float32))
    arrays = np.stack(contact), np.stack(keypoints), np.stack(to_object)
    return Recorded(scene, *arrays, sample.valid, sample.active_hands)


@torch.no_grad()
def hand_vertices_m(pair: HandPair, row: int, sample: ClipSample) -> np.ndarray:
    """(frame, 778, 3) float32 skin of one side, model frame."""
    hands = torch.from_numpy(sample.hands[row])
    turns = rot6d_to_rotmat(hands[:, HAND_ROTATIONS_6D].reshape(-1, N_ROTATIONS, 6))
    template = None if sample.template_m is None else torch.from_numpy(sample.template_m[row])
    layer = kinematics_of(pair[SIDES[row]])
    return layer(hands[:, WRIST], turns, torch.from_numpy(sample.betas[row])[None], template)[0].numpy()


def split_motion(motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of ``Recorded.motion``: keypoints and vectors to the object, both (side, frame, keypoint, 3)."""
    keypoints, to_object = motion.reshape(len(motion), 2, 2, -1, 3).transpose(1, 2, 0, 3, 4)
    return keypoints, to_object
