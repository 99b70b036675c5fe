"""The ManipNet family: finger poses for given trajectories of wrists and object.

``diagnose`` compares its finger poses, and those of baselines without a network, with the recorded ones.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import FPS, SIDES, Clip, Side
from hoidata.geometry.rotations import rotmat_to_rot6d
from hoidata.hands import HandPair
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import surface_index
from hoidata.settings import build_config
from models.common.checkpoints import Checkpoint, load_checkpoint
from models.common.family import Family, Figures, Skipped, Sources, motion_clip
from models.manipnet.control import Control, control_of, finger_rotmats_of, hands_of, trajectories_of
from models.manipnet.features import FeatureSettings
from models.manipnet.network import ManipNet
from models.manipnet.retrieval import NearestFrames, control_inputs, joint_errors_m, mean_rotmats, mirrored_to_right
from models.manipnet.rollout import Predictor, RolloutTask, Rule, roll_out
from models.manipnet.training import MANIPNET

NEAREST_COUNT = 10
DIAGNOSED_CLIPS = 60  # test clips, evenly spread
MAX_TRAINING_FRAMES = 60_000  # of the retrieval baselines, evenly spread; 1,336 numbers each


class RecordedHand(NamedTuple):
    """An active hand of a recorded clip."""

    side: Side
    hand: TrackedHand
    control: Control
    fingers: np.ndarray  # (frame, 15, 3, 3) recorded finger rotations
    tracked: np.ndarray  # indices of the tracked frames


def recorded_hands(sample: ClipSample, pair: HandPair) -> list[RecordedHand]:
    """The active hands of a clip that are tracked in some frame."""
    hands = hands_of(pair, sample.betas, sample.template_m)
    control = control_of(trajectories_of(sample), sample.object_model)
    return [
        RecordedHand(
            side=side,
            hand=hands[side],
            control=control,
            fingers=finger_rotmats_of(sample.hands[side_index]),
            tracked=np.flatnonzero(sample.valid[side_index]),
        )
        for side_index, side in enumerate(SIDES)
        if sample.active_hands[side_index] and sample.valid[side_index].any()
    ]


def diagnose(
    sources: Sources,
    settings: FeatureSettings,
    predict_clip: Callable[[ClipSample], Mapping[Side, np.ndarray]],
) -> Figures:
    """Mean joint errors on at most ``DIAGNOSED_CLIPS`` test clips, millimetres.

    Args:
        predict_clip: returns finger rotations (frame, 15, 3, 3) by side.
    """
    training_hands = thinned(
        [recorded for sample in _samples(sources, "train") for recorded in recorded_hands(sample, sources.hands)]
    )
    test_clips = _samples(sources, "test")
    chosen = test_clips[:: max(1, -(-len(test_clips) // DIAGNOSED_CLIPS))]
    test_hands = [(sample, recorded) for sample in chosen for recorded in recorded_hands(sample, sources.hands)]
    if not training_hands or not test_hands:
        return {}
    baselines = _baselines(training_hands, settings)
    errors: dict[str, list[np.ndarray]] = {}
    predictions: dict[str, Mapping[Side, np.ndarray]] = {}
    for sample, recorded in test_hands:
        if sample.clip_id not in predictions:
            predictions = {sample.clip_id: predict_clip(sample)}
        poses_by_method = {"joint_error_mm": predictions[sample.clip_id][recorded.side]} | baselines(recorded)
        for name, fingers in poses_by_method.items():
            error_m = joint_errors_m(recorded.hand, fingers[recorded.tracked], recorded.fingers[recorded.tracked])
            errors.setdefault(name, []).append(error_m.mean(axis=1))
    means = {name: round(1000 * float(np.concatenate(error_m).mean()), 3) for name, error_m in errors.items()}
    return {"manipnet": means}


def thinned(hands: list[RecordedHand]) -> list[RecordedHand]:
    """The hands with every n-th tracked frame, so that all together have about ``MAX_TRAINING_FRAMES`` or fewer."""
    step = max(1, -(-sum(len(hand.tracked) for hand in hands) // MAX_TRAINING_FRAMES))
    return [hand._replace(tracked=hand.tracked[::step]) for hand in hands]


def _samples(sources: Sources, split: str) -> Sequence[ClipSample]:
    return list(HoiDataset(sources.annotated, split, crop="start"))


def _baselines(
    training_hands: Sequence[RecordedHand], settings: FeatureSettings
) -> Callable[[RecordedHand], dict[str, np.ndarray]]:
    """Baselines: neutral pose, mean training pose, nearest training frame, mean of the ten nearest."""
    fingers = [mirrored_to_right(recorded.hand, recorded.fingers[recorded.tracked]) for recorded in training_hands]
    training_frames = NearestFrames.of(
        training_hands[0].hand, settings, [_inputs(recorded, settings) for recorded in training_hands], fingers
    )
    mean = mean_rotmats(np.concatenate(fingers))

    def predict(recorded: RecordedHand) -> dict[str, np.ndarray]:
        n_frames = len(recorded.fingers)
        inputs = _inputs(recorded, settings)
        poses = {}
        for name, count in (("nearest_frame", 1), ("mean_of_10", NEAREST_COUNT)):
            hand_poses = np.tile(recorded.hand.rest_rotmats, (n_frames, 1, 1, 1))
            hand_poses[recorded.tracked] = mirrored_to_right(recorded.hand, training_frames.poses(inputs, count))
            poses[f"joint_error_{name}_mm"] = hand_poses
        constant_poses = {"neutral": recorded.hand.rest_rotmats, "mean_pose": mirrored_to_right(recorded.hand, mean)}
        return poses | {
            f"joint_error_{name}_mm": np.tile(pose, (n_frames, 1, 1, 1)) for name, pose in constant_poses.items()
        }

    return predict


def _inputs(recorded: RecordedHand, settings: FeatureSettings) -> np.ndarray:
    surface = surface_index(recorded.control.model)
    return control_inputs(recorded.control, recorded.side, recorded.hand, recorded.tracked / FPS, surface, settings)


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
        fingers = self.fingers(control, hands_of(self.pair, request.betas, request.template_m), request.active_hands)
        wrists = {side: control.wrists[side].at(control.object_motion.time_s) for side in SIDES}
        hands = [
            np.concatenate(
                [
                    wrists[side].translation,
                    rotmat_to_rot6d(wrists[side].rotation),
                    rotmat_to_rot6d(fingers[side]).reshape(len(trajectories.object), -1),
                ],
                axis=1,
            )
            for side in SIDES
        ]
        return torch.from_numpy(np.stack(hands)), torch.from_numpy(trajectories.object)

    def fingers(
        self, control: Control, hands: Mapping[Side, TrackedHand], active_hands: np.ndarray
    ) -> dict[Side, np.ndarray]:
        """Finger rotations (frame, 15, 3, 3) by side, from the neutral pose on; an inactive hand keeps it."""
        time_s = control.object_motion.time_s
        active: list[Side] = [side for side, is_active in zip(SIDES, active_hands, strict=True) if is_active]
        tasks = [
            RolloutTask(hand=hands[side], side=side, control=control, time_s=time_s, start=hands[side].rest_rotmats)
            for side in active
        ]
        neutral_poses: dict[Side, np.ndarray] = {
            side: np.tile(hands[side].rest_rotmats, (len(time_s), 1, 1, 1)) for side in SIDES
        }
        return neutral_poses | dict(zip(active, roll_out(self.predictor, tasks), strict=True))

    def predict_clip(self, sample: ClipSample) -> dict[Side, np.ndarray]:
        """Predict finger rotations for the trajectories of a recorded clip."""
        hands = hands_of(self.pair, sample.betas, sample.template_m)
        return self.fingers(control_of(trajectories_of(sample), sample.object_model), hands, sample.active_hands)


def _diagnose(sources: Sources) -> Figures:
    fingers = FingerSampler.load(sources)
    return diagnose(sources, fingers.predictor.settings, fingers.predict_clip)


FINGERS = Family(
    "manipnet",
    "ManipNet: fingers for recorded wrists and object",
    FingerSampler.load,
    networks=(MANIPNET,),
    uses=(MANIPNET.name,),
    diagnose=_diagnose,
)
