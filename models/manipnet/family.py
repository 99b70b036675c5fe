"""ManipNet as a family: the recorded trajectories of wrists and object, with fingers of its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.geometry.rotations import rotmat_to_rot6d
from hoidata.hands import HandPair
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.settings import build_config
from models.common.checkpoints import Checkpoint, load_checkpoint
from models.common.family import Family, Figures, LeftOut, Sources, motion_clip
from models.manipnet.control import Control
from models.manipnet.diagnostics import diagnose
from models.manipnet.network import ManipNet
from models.manipnet.rollout import Predictor, Rule, Task, roll_out
from models.manipnet.tracks import control_of, hands_of, trajectories_of
from models.manipnet.training import MANIPNET

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
