"""ManipNet as a family: the recorded trajectories of wrists and object, with fingers of its own.

``diagnose`` says how near the fingers come to the recorded ones in the wrist's frame, beside poses without a network.
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
from models.common.family import Family, Figures, LeftOut, Sources, motion_clip
from models.manipnet.control import Control, control_of, finger_rotmats_of, hands_of, trajectories_of
from models.manipnet.features import FeatureSettings
from models.manipnet.lookups import Lookup, as_right, control_inputs, joint_errors_m, mean_rotmats
from models.manipnet.network import ManipNet
from models.manipnet.rollout import Predictor, Rule, Task, roll_out
from models.manipnet.training import MANIPNET

NEAREST = 10


class RecordedHand(NamedTuple):
    """An active hand of a clip. fingers: (frame, 15, 3, 3) as recorded; used: numbers of the tracked frames."""

    side: Side
    hand: TrackedHand
    control: Control
    fingers: np.ndarray
    used: np.ndarray


def recorded_hands(sample: ClipSample, pair: HandPair) -> list[RecordedHand]:
    """Every active hand of a clip that is tracked in some frame."""
    hands = hands_of(pair, sample.betas, sample.template_m)
    control = control_of(trajectories_of(sample), sample.object_model)
    return [
        RecordedHand(
            side, hands[side], control, finger_rotmats_of(sample.hands[row]), np.flatnonzero(sample.valid[row])
        )
        for row, side in enumerate(SIDES)
        if sample.active_hands[row] and sample.valid[row].any()
    ]


def diagnose(
    sources: Sources,
    settings: FeatureSettings,
    follow: Callable[[ClipSample], Mapping[Side, np.ndarray]],
) -> Figures:
    """Joint errors on test clips: the rollout of ``follow`` (by side (frame, 15, 3, 3)), and what it has to beat."""
    train = [one for sample in _samples(sources, "train") for one in recorded_hands(sample, sources.hands)]
    test = [(sample, one) for sample in _samples(sources, "test") for one in recorded_hands(sample, sources.hands)]
    if not train or not test:
        return {}
    rivals = _rivals(train, settings)
    errors: dict[str, list[np.ndarray]] = {}
    made: dict[str, Mapping[Side, np.ndarray]] = {}
    for sample, one in test:
        if sample.clip_id not in made:
            made = {sample.clip_id: follow(sample)}
        answers = {"joint_error_mm": made[sample.clip_id][one.side]} | rivals(one)
        for name, fingers in answers.items():
            found = joint_errors_m(one.hand, fingers[one.used], one.fingers[one.used])
            errors.setdefault(name, []).append(found.mean(axis=1))
    means = {name: round(1000 * float(np.concatenate(found).mean()), 3) for name, found in errors.items()}
    return {"manipnet": means}


def _samples(sources: Sources, split: str) -> Sequence[ClipSample]:
    return list(HoiDataset(sources.annotated, split, crop="start"))


def _rivals(
    train: Sequence[RecordedHand], settings: FeatureSettings
) -> Callable[[RecordedHand], dict[str, np.ndarray]]:
    """What answers without a network: neutral pose, mean training pose, nearest training frame and mean of ten."""
    fingers = [as_right(one.hand, one.fingers[one.used]) for one in train]
    lookup = Lookup.of(train[0].hand, settings, [_inputs(one, settings) for one in train], fingers)
    mean = mean_rotmats(np.concatenate(fingers))

    def answer(one: RecordedHand) -> dict[str, np.ndarray]:
        n_frames = len(one.fingers)
        inputs = _inputs(one, settings)
        found = {}
        for name, count in (("nearest_frame", 1), ("mean_of_10", NEAREST)):
            poses = np.tile(one.hand.rest_rotmats, (n_frames, 1, 1, 1))
            poses[one.used] = as_right(one.hand, lookup.poses(inputs, count))
            found[f"joint_error_{name}_mm"] = poses
        still = {"neutral": one.hand.rest_rotmats, "mean_pose": as_right(one.hand, mean)}
        return found | {f"joint_error_{name}_mm": np.tile(pose, (n_frames, 1, 1, 1)) for name, pose in still.items()}

    return answer


def _inputs(one: RecordedHand, settings: FeatureSettings) -> np.ndarray:
    surface = surface_index(one.control.model)
    return control_inputs(one.control, one.side, one.hand, one.used / FPS, surface, settings)


NO_TRAJECTORIES = "it adds fingers to the trajectories of wrists and object, and none were given"


@dataclass(frozen=True)
class SamplingConfig:
    """rule: of post-processing, "off" for what the network says."""

    rule: Rule = "ours"


@dataclass(frozen=True)
class Fingers:
    """A trained network with its hands, ready to answer. It draws nothing: motions asked for alike are the same."""

    checkpoint: Checkpoint
    pair: HandPair
    predictor: Predictor

    @classmethod
    def load(cls, sources: Sources) -> "Fingers":
        config = build_config(SamplingConfig, sources.settings.get("manipnet"), "params.yaml: sample.manipnet")
        checkpoint = load_checkpoint(sources.checkpoints / MANIPNET.name, MANIPNET)
        assert isinstance(checkpoint.network, ManipNet)
        return cls(checkpoint, sources.hands, Predictor(checkpoint.network, config.rule))

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        made = dict[str, tuple[torch.Tensor, torch.Tensor]]()
        for request in requests:
            if request.trajectories is not None and request.clip_id not in made:
                made[request.clip_id] = self._features(request)
        synthetic = bool(self.checkpoint.facts["synthetic"])
        return [
            motion_clip(request, *made[request.clip_id], synthetic)
            if request.clip_id in made
            else LeftOut(request.motion_id, NO_TRAJECTORIES)
            for request in requests
        ]

    def _features(self, request: Request) -> tuple[torch.Tensor, torch.Tensor]:
        """Hands (2, F, 99) and object (F, 10) of a request: as given, with the fingers made."""
        given = request.trajectories
        assert given is not None
        control = control_of(given, request.object)
        fingers = self.fingers(control, hands_of(self.pair, request.betas, request.template_m), request.active_hands)
        wrists = {side: control.wrists[side].at(control.thing.time_s) for side in SIDES}
        hands = [
            np.concatenate(
                [
                    wrists[side].translation,
                    rotmat_to_rot6d(wrists[side].rotation),
                    rotmat_to_rot6d(fingers[side]).reshape(len(given.object), -1),
                ],
                axis=1,
            )
            for side in SIDES
        ]
        return torch.from_numpy(np.stack(hands)), torch.from_numpy(given.object)

    def fingers(
        self, control: Control, hands: Mapping[Side, TrackedHand], active_hands: np.ndarray
    ) -> dict[Side, np.ndarray]:
        """(frame, 15, 3, 3) of each side from the neutral pose on; a hand that takes no part stays in it."""
        time_s = control.thing.time_s
        active: list[Side] = [side for side, is_active in zip(SIDES, active_hands, strict=True) if is_active]
        tasks = [Task(hands[side], side, control, time_s, hands[side].rest_rotmats) for side in active]
        still: dict[Side, np.ndarray] = {
            side: np.tile(hands[side].rest_rotmats, (len(time_s), 1, 1, 1)) for side in SIDES
        }
        return still | dict(zip(active, roll_out(self.predictor, tasks), strict=True))

    def follow(self, sample: ClipSample) -> dict[Side, np.ndarray]:
        """Fingers for the trajectories of a recorded clip."""
        hands = hands_of(self.pair, sample.betas, sample.template_m)
        return self.fingers(control_of(trajectories_of(sample), sample.object_model), hands, sample.active_hands)


def _figures(sources: Sources) -> Figures:
    fingers = Fingers.load(sources)
    return diagnose(sources, fingers.predictor.settings, fingers.follow)


FINGERS = Family(
    "manipnet",
    "ManipNet: fingers for recorded wrists and object",
    Fingers.load,
    networks=(MANIPNET,),
    uses=(MANIPNET.name,),
    diagnose=_figures,
)
