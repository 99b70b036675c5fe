"""A clip's or a request's trajectories as what the network is given, and its fingers as what the network is to give."""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Trajectories
from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.clips.features import (
    GLOBAL_ORIENT_6D,
    HAND_POSE_6D,
    N_ROTATIONS,
    OBJECT_HINGE,
    OBJECT_POSITION,
    OBJECT_ROTATION_6D,
    WRIST,
)
from hoidata.geometry.rotations import rot6d_to_rotmat
from hoidata.hands import HandPair
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.sensors.mano_hand import mano_hand
from models.manipnet.control import Control, Motion

UNSEEN_M = 1.0  # how far away a wrist is taken to be that is never tracked


def control_of(given: Trajectories, model: ObjectModel) -> Control:
    """Wrists and object at 30 fps, time 0 in the first frame; a wrist that is lost stays where it was seen nearest."""
    time_s = np.arange(len(given.object)) / FPS
    thing = given.object.astype(np.float64)
    hinge = thing[:, OBJECT_HINGE] if model.is_articulated else None
    wrists: dict[Side, Motion] = {side: _wrist(given, row, time_s) for row, side in enumerate(SIDES)}
    body = Motion(time_s, rot6d_to_rotmat(thing[:, OBJECT_ROTATION_6D]), thing[:, OBJECT_POSITION])
    return Control(wrists, body, model, hinge)


def _wrist(given: Trajectories, row: int, time_s: np.ndarray) -> Motion:
    seen = np.flatnonzero(given.valid[row])
    if not len(seen):
        away = given.object[:, OBJECT_POSITION] + np.array([UNSEEN_M, 0.0, 0.0])
        return Motion(time_s, np.tile(np.eye(3), (len(time_s), 1, 1)), away.astype(np.float64))
    nearest = seen[abs(np.arange(len(time_s))[:, None] - seen).argmin(axis=1)]
    wrist = given.wrists[row, nearest].astype(np.float64)
    return Motion(time_s, rot6d_to_rotmat(wrist[:, GLOBAL_ORIENT_6D]), wrist[:, WRIST])


def trajectories_of(sample: ClipSample) -> Trajectories:
    """What a recording of the clip without its fingers would know."""
    return Trajectories(sample.hands[..., : GLOBAL_ORIENT_6D.stop], sample.valid, sample.object)


def finger_rotmats_of(hand_features: np.ndarray) -> np.ndarray:
    """(frame, 15, 3, 3) of features (frame, 99)."""
    turns = hand_features[:, HAND_POSE_6D].astype(np.float64).reshape(-1, N_ROTATIONS - 1, 6)
    return rot6d_to_rotmat(turns)


def hands_of(pair: HandPair, betas: np.ndarray, template_m: np.ndarray | None) -> Mapping[Side, TrackedHand]:
    """Both hands of a person: betas (2, 10), personal rest meshes (2, 778, 3) or None."""
    templates = [None, None] if template_m is None else [own.tobytes() for own in template_m]
    return {side: _tracked(pair, side, betas[row].tobytes(), templates[row]) for row, side in enumerate(SIDES)}


@lru_cache(maxsize=64)
def _tracked(pair: HandPair, side: Side, betas: bytes, template: bytes | None) -> TrackedHand:
    """Kept, since a person's hand is in many clips and takes a while to make."""
    shape = np.frombuffer(betas, np.float32).astype(np.float64)
    rest = None if template is None else np.frombuffer(template, np.float32).reshape(-1, 3).astype(np.float64)
    return mano_hand(pair, side, shape, rest)
