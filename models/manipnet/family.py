"""The ManipNet family: finger poses for given trajectories of wrists and object.

``diagnose`` compares its finger poses, and those of baselines without a network, with the recorded ones.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Request
from hoidata.clips.clip import FPS, SIDES, Clip, Side
from hoidata.geometry.rotations import rotmat_to_rot6d
from hoidata.hands import HandPair
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import surface_index
from hoidata.sensors import sense
from hoidata.sensors.mano_hand import mano_hands
from hoidata.settings import build_config
from models.common.checkpoints import Checkpoint, load_checkpoint
from models.common.family import Family, Figures, Skipped, Sources, motion_clip
from models.manipnet.control import Control, control_of, finger_rotmats_of, trajectories_of
from models.manipnet.features import (
    FeatureSettings,
    mirrored_to_right,
    object_from_wrist,
    sizes,
    std_floors,
    trajectory_features,
)
from models.manipnet.network import ManipNet
from models.manipnet.rollout import Predictor, RolloutTask, Rule, roll_out
from models.manipnet.training import MANIPNET

NEAREST_COUNT = 10
BATCH_SIZE = 256  # of the search for the nearest frames
DIAGNOSED_CLIPS = 60  # test clips, evenly spread
MAX_TRAINING_FRAMES = 60_000  # of the retrieval baselines, evenly spread; 1,336 numbers each


class RecordedHand(NamedTuple):
    """An active hand of a recorded clip."""

    side: Side
    hand: TrackedHand
    control: Control
    fingers: np.ndarray  # (frame, 15, 3, 3) recorded finger rotations
    tracked: np.ndarray  # indices of the tracked frames

    def inputs(self, settings: FeatureSettings) -> np.ndarray:
        """(frame, 336 + 1000) float32: trajectories, and the ambient sensor of the hand in its neutral pose."""
        time_s, surface = self.tracked / FPS, surface_index(self.control.model)
        trajectory = trajectory_features(self.control, self.side, self.hand, time_s, settings)
        transforms, hinge_rad = object_from_wrist(self.control, self.side, time_s, settings)
        neutral = self.hand.state(np.tile(self.hand.rest_rotmats, (len(time_s), 1, 1, 1)))
        ambient = sense(self.hand, neutral, transforms, hinge_rad, surface, settings.sensors).ambient
        return np.concatenate([trajectory, ambient], axis=1, dtype=np.float32)


def recorded_hands(sample: ClipSample, pair: HandPair) -> list[RecordedHand]:
    """The active hands of a clip that are tracked in some frame."""
    hands = mano_hands(pair, sample.betas, sample.template_m)
    control = control_of(trajectories_of(sample), sample.object_model)
    tracked = [np.flatnonzero(valid) for valid in sample.valid]
    return [
        RecordedHand(side, hands[side], control, finger_rotmats_of(sample.hands[index]), tracked[index])
        for index, side in enumerate(SIDES)
        if sample.active_hands[index] and len(tracked[index])
    ]


def diagnose(sources: Sources) -> Figures:
    """Mean joint errors of the network and of baselines without one on at most ``DIAGNOSED_CLIPS`` test clips, mm."""
    sampler = FingerSampler.load(sources)
    train, test = sources.clips("train"), sources.clips("test")
    training_hands = thinned([recorded for sample in train for recorded in recorded_hands(sample, sources.hands)])
    chosen = test[:: max(1, -(-len(test) // DIAGNOSED_CLIPS))]
    test_hands = [(sample, recorded) for sample in chosen for recorded in recorded_hands(sample, sources.hands)]
    if not training_hands or not test_hands:
        return {}
    baselines = _baselines(training_hands, sampler.predictor.settings)
    errors: dict[str, list[np.ndarray]] = {}
    predictions: dict[str, Mapping[Side, np.ndarray]] = {}
    for sample, recorded in test_hands:
        if sample.clip_id not in predictions:
            predictions = {sample.clip_id: sampler.predict_clip(sample)}
        methods = {"joint_error_mm": predictions[sample.clip_id][recorded.side]} | baselines(recorded)
        for name, fingers in methods.items():
            error_m = joint_errors_m(recorded.hand, fingers[recorded.tracked], recorded.fingers[recorded.tracked])
            errors.setdefault(name, []).append(error_m.mean(axis=1))
    means = {name: round(1000 * float(np.concatenate(error_m).mean()), 3) for name, error_m in errors.items()}
    return {"manipnet": means}


def thinned(hands: list[RecordedHand]) -> list[RecordedHand]:
    """The hands with every n-th tracked frame, so that all together have about ``MAX_TRAINING_FRAMES`` or fewer."""
    step = max(1, -(-sum(len(hand.tracked) for hand in hands) // MAX_TRAINING_FRAMES))
    return [hand._replace(tracked=hand.tracked[::step]) for hand in hands]


def _baselines(
    training_hands: Sequence[RecordedHand], settings: FeatureSettings
) -> Callable[[RecordedHand], dict[str, np.ndarray]]:
    """Baselines: neutral pose, mean training pose, nearest training frame, mean of the ten nearest."""
    fingers = [mirrored_to_right(recorded.hand, recorded.fingers[recorded.tracked]) for recorded in training_hands]
    inputs = [recorded.inputs(settings) for recorded in training_hands]
    training_frames = NearestFrames.of(training_hands[0].hand, settings, inputs, fingers)
    mean = mean_rotmats(np.concatenate(fingers))

    def predict(recorded: RecordedHand) -> dict[str, np.ndarray]:
        n_frames, inputs, poses = len(recorded.fingers), recorded.inputs(settings), {}
        for name, count in (("nearest_frame", 1), ("mean_of_10", NEAREST_COUNT)):
            hand_poses = np.tile(recorded.hand.rest_rotmats, (n_frames, 1, 1, 1))
            hand_poses[recorded.tracked] = mirrored_to_right(recorded.hand, training_frames.poses(inputs, count))
            poses[f"joint_error_{name}_mm"] = hand_poses
        constant_poses = {"neutral": recorded.hand.rest_rotmats, "mean_pose": mirrored_to_right(recorded.hand, mean)}
        return poses | {
            f"joint_error_{name}_mm": np.tile(pose, (n_frames, 1, 1, 1)) for name, pose in constant_poses.items()
        }

    return predict


def joint_errors_m(hand: TrackedHand, predicted: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """Errors (frame, point) of joints and tips, wrist frame; both poses: finger rotations (frame, joint - 1, 3, 3)."""
    return np.linalg.norm(hand.state(predicted).point_m - hand.state(recorded).point_m, axis=-1)[:, 1:]


def mean_rotmats(rotmats: np.ndarray) -> np.ndarray:
    """Mean of rotations (frame, joint, 3, 3) in the least-squares sense: (joint, 3, 3)."""
    means = [Rotation.from_matrix(joint_rotmats).mean().as_matrix() for joint_rotmats in np.moveaxis(rotmats, 1, 0)]
    return np.stack(means)


@dataclass(frozen=True)
class NearestFrames:
    """Training frames, searched by control inputs."""

    mean: np.ndarray  # (1336,) of the inputs
    scale: np.ndarray  # (1336,)
    scaled_inputs: np.ndarray  # (frame, 1336)
    finger_rotmats: np.ndarray  # (frame, joint - 1, 3, 3) as a right hand's

    @classmethod
    def of(
        cls, hand: TrackedHand, settings: FeatureSettings, inputs: Sequence[np.ndarray], fingers: Sequence[np.ndarray]
    ) -> "NearestFrames":
        """Build from control inputs and finger rotations (as a right hand's) of recorded hands."""
        count, all_inputs = sizes(hand, settings), np.concatenate(inputs)
        floor = std_floors(hand, settings)[0][count["pose"] : count["pose"] + all_inputs.shape[1]].astype(np.float32)
        mean, scale = all_inputs.mean(axis=0), np.maximum(all_inputs.std(axis=0), floor)
        return cls(mean, scale, (all_inputs - mean) / scale, np.concatenate(fingers))

    def nearest(self, inputs: np.ndarray, count: int) -> np.ndarray:
        """Indices (frame, count) of the training frames nearest to control inputs (frame, 1336), nearest first."""
        squares, nearest = (self.scaled_inputs**2).sum(axis=1), []
        for start in range(0, len(inputs), BATCH_SIZE):
            scaled = (inputs[start : start + BATCH_SIZE] - self.mean) / self.scale
            distances = squares - 2 * scaled @ self.scaled_inputs.T
            nearest.append(np.argsort(distances, axis=1, kind="stable")[:, :count])
        return np.concatenate(nearest)

    def poses(self, inputs: np.ndarray, count: int) -> np.ndarray:
        """(frame, joint - 1, 3, 3) mean finger rotations of the ``count`` nearest training frames."""
        chosen = self.finger_rotmats[self.nearest(inputs, count)]
        return chosen[:, 0] if count == 1 else np.stack([mean_rotmats(poses) for poses in chosen])


NO_TRAJECTORIES = "this method needs trajectories of wrists and object, and the request has none"


@dataclass(frozen=True)
class SamplingConfig:
    """The section ``sample.manipnet`` of params.yaml."""

    rule: Rule = "preset"  # of post-processing; "preset": that of the network's preset; "off": the network's prediction


@dataclass(frozen=True)
class FingerSampler:
    """The trained network with its hand model, as a sampler of clips. It is deterministic and ignores seeds."""

    checkpoint: Checkpoint
    pair: HandPair
    predictor: Predictor

    @classmethod
    def load(cls, sources: Sources) -> "FingerSampler":
        config = build_config(SamplingConfig, sources.settings.get("manipnet"), "params.yaml: sample.manipnet")
        checkpoint = load_checkpoint(sources.checkpoints / MANIPNET.name, MANIPNET)
        assert isinstance(checkpoint.network, ManipNet)
        return cls(checkpoint, sources.hands, Predictor(checkpoint.network, config.rule))

    def sample(self, requests: Sequence[Request]) -> list[Clip | Skipped]:
        features_by_clip = dict[str, tuple[torch.Tensor, torch.Tensor]]()
        for request in requests:
            if request.trajectories is not None and request.clip_id not in features_by_clip:
                features_by_clip[request.clip_id] = self._features(request)
        synthetic = bool(self.checkpoint.facts["synthetic"])
        return [
            motion_clip(request, *features_by_clip[request.clip_id], synthetic)
            if request.clip_id in features_by_clip
            else Skipped(request.motion_id, NO_TRAJECTORIES)
            for request in requests
        ]

    def _features(self, request: Request) -> tuple[torch.Tensor, torch.Tensor]:
        """Features of hands (2, F, 99) and object (F, 10): given trajectories with predicted fingers."""
        trajectories = request.trajectories
        assert trajectories is not None
        control = control_of(trajectories, request.object)
        fingers = self.fingers(control, mano_hands(self.pair, request.betas, request.template_m), request.active_hands)
        hands, n_frames = [], len(trajectories.object)
        for side in SIDES:
            wrist, pose_6d = control.wrists[side].at(control.object_motion.time_s), rotmat_to_rot6d(fingers[side])
            rows = wrist.translation, rotmat_to_rot6d(wrist.rotation), pose_6d.reshape(n_frames, -1)
            hands.append(np.concatenate(rows, axis=1))
        return torch.from_numpy(np.stack(hands)), torch.from_numpy(trajectories.object)

    def fingers(
        self, control: Control, hands: Mapping[Side, TrackedHand], active_hands: np.ndarray
    ) -> dict[Side, np.ndarray]:
        """Finger rotations (frame, 15, 3, 3) by side, from the neutral pose on; an inactive hand keeps it."""
        time_s = control.object_motion.time_s
        active: list[Side] = [side for side, is_active in zip(SIDES, active_hands, strict=True) if is_active]
        neutral: dict[Side, np.ndarray] = {side: hands[side].rest_rotmats for side in SIDES}
        tasks = [RolloutTask(hands[side], side, control, time_s, neutral[side]) for side in active]
        neutral = {side: np.tile(pose, (len(time_s), 1, 1, 1)) for side, pose in neutral.items()}
        return neutral | dict(zip(active, roll_out(self.predictor, tasks), strict=True))

    def predict_clip(self, sample: ClipSample) -> dict[Side, np.ndarray]:
        """Predict finger rotations for the trajectories of a recorded clip."""
        hands = mano_hands(self.pair, sample.betas, sample.template_m)
        return self.fingers(control_of(trajectories_of(sample), sample.object_model), hands, sample.active_hands)


FINGERS = Family(
    "manipnet",
    "ManipNet: fingers for recorded wrists and object",
    FingerSampler.load,
    networks=(MANIPNET,),
    uses=(MANIPNET.name,),
    diagnose=diagnose,
)
