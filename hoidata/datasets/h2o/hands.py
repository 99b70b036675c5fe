"""H2O's hands in the world: from MANO parameters, or fitted to the 21 joints, which needs no MANO file."""

from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import SIDES, HandTrack, Side
from hoidata.clips.hand_parameters import FrameChange, HandConvention, SourceHand, hand_track, to_track
from hoidata.datasets.h2o.files import SequenceFrames
from hoidata.geometry.intervals import runs
from hoidata.hands import HandPair, track_joints
from hoidata.hands.fitting import fit_hands, fit_shape
from hoidata.hands.model import openpose_to_mano_order

PARAMETERS = HandConvention(
    translation="transl",
    fingers="absolute",
    shape="betas per frame",
    left_shape="as released",
    note="MANO in the camera's frame: absolute axis-angles, betas per frame, translation added to the rest wrist",
)
FITTED = HandConvention(
    translation="wrist",
    fingers="absolute",
    shape="fitted",
    left_shape="unused",
    note="21 joints in the camera's frame: a MANO-layout hand was fitted to them, one shape per sequence",
)
_PARAMETERS, _KEYPOINTS = 62, 64  # numbers of one hand; left comes first


@dataclass(frozen=True)
class ParameterHands:
    """Hands from ``hand_pose_mano``: left then right: flag, transl 3, orient 3, fingers 45, betas 10."""

    frames: SequenceFrames
    models: HandPair

    def tracks(self, start: int, stop: int) -> tuple[dict[Side, HandTrack], float | None]:
        """Hands of frames ``start`` to ``stop`` (exclusive), and None in place of a fit error."""
        return {side: self._track(side, slice(start, stop)) for side in SIDES}, None

    def joints_m(self) -> np.ndarray:
        """(frame, 42, 3) joints of left and right hand in the world, metres; NaN if a hand is not annotated."""
        return np.concatenate([self._side_joints_m(side) for side in SIDES], axis=1)

    def _side_joints_m(self, side: Side) -> np.ndarray:
        track = self._track(side, slice(None))
        joints = track_joints(track, self.models[side]).astype(np.float64)
        return np.where(track.valid[:, None, None], joints, np.nan)

    def _track(self, side: Side, rows: slice) -> HandTrack:
        numbers = self.frames.hands[rows]
        block = numbers[:, :_PARAMETERS] if side == "left" else numbers[:, _PARAMETERS:]
        camera = self.frames.camera[rows]
        source = SourceHand(
            translation_m=block[:, 1:4],
            global_orient=block[:, 4:7],
            fingers=block[:, 7:52],
            betas=block[:, 52:62],
            valid=block[:, 0] != 0,
        )
        return to_track(source, PARAMETERS, self.models[side], FrameChange(camera[:, :3, :3], camera[:, :3, 3]))


class KeypointHands:
    """Hands from ``hand_pose``: left then right: flag, 21 joints in OpenPose's order. One shape for the sequence."""

    def __init__(self, frames: SequenceFrames, models: HandPair) -> None:
        self.models = models
        self.points: dict[Side, np.ndarray] = {side: _world_joints(frames, side) for side in SIDES}
        valid_points: dict[Side, np.ndarray] = {side: self.points[side][_is_valid(self.points[side])] for side in SIDES}
        present_points: dict[Side, np.ndarray] = {side: valid_points[side] for side in SIDES if len(valid_points[side])}
        self.betas = fit_shape(present_points, models) if present_points else np.zeros(10)

    def joints_m(self) -> np.ndarray:
        """(frame, 42, 3) joints of left and right hand in the world, metres; NaN if a hand is not annotated."""
        return np.concatenate([self.points[side] for side in SIDES], axis=1)

    def tracks(self, start: int, stop: int) -> tuple[dict[Side, HandTrack], float | None]:
        """Fitted hands of frames ``start`` to ``stop`` (exclusive), and the mean fit error in metres."""
        tracks: dict[Side, HandTrack] = {}
        errors = []
        for side in SIDES:
            tracks[side], error = self._fit(side, self.points[side][start:stop])
            errors.append(error)
        all_errors = np.concatenate(errors)
        return tracks, float(all_errors.mean()) if len(all_errors) else None

    def _fit(self, side: Side, points: np.ndarray) -> tuple[HandTrack, np.ndarray]:
        """Fit one hand, each run of valid frames separately. Returns track and (valid frame, 21) error in metres."""
        valid = _is_valid(points)
        numbers, errors = np.zeros((len(points), 3 + 3 + 45)), [np.zeros((0, 21))]
        for first, last in runs(valid):
            fit = fit_hands({side: points[first:last]}, self.models, self.betas)[side]
            numbers[first:last] = np.concatenate((fit.wrist_m, fit.global_orient, fit.hand_pose), axis=1)
            errors.append(fit.error_m)
        track = hand_track(numbers[:, :3], numbers[:, 3:6], numbers[:, 6:], self.betas[None], valid)
        return track, np.concatenate(errors)


def _is_valid(points: np.ndarray) -> np.ndarray:
    return np.asarray(np.isfinite(points).all(axis=(1, 2)))


def _world_joints(frames: SequenceFrames, side: Side) -> np.ndarray:
    """(frame, 21, 3) joints in hoidata's order and the world, metres; NaN if the flag is 0."""
    block = frames.hands[:, :_KEYPOINTS] if side == "left" else frames.hands[:, _KEYPOINTS:]
    joints_camera = openpose_to_mano_order(block[:, 1:].reshape(-1, 21, 3))
    joints_world = joints_camera @ frames.camera[:, :3, :3].transpose(0, 2, 1) + frames.camera[:, None, :3, 3]
    return np.where(block[:, :1, None] != 0, joints_world, np.nan)
