"""Two motions learnt by heart: what is learnt step by step stays on course when it is run."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from hoidata.clips.clip import Side
from hoidata.datasets.base import RawTree, SequenceKey
from hoidata.datasets.manipnet.adapter import read_hand_recording
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import surface_index
from hoidata.sensors.mano_hand import mano_hand
from models.common.training import TrainingConfig, learning_rate_factor
from models.manipnet.control import Control, Motion
from models.manipnet.features import FeatureSettings
from models.manipnet.lookups import as_right, joint_errors_m
from models.manipnet.network import ManipNet, NetworkConfig
from models.manipnet.rollout import Predictor, Task, roll_out
from models.manipnet.training import LEARNT, Examples, hand_examples, other_poses, prepared, step_loss
from tests.builders.manipnet import recording_control
from tests.builders.objects import box_model

ROOT = os.environ.get("HOIDATA_MANIPNET", "")
FPS, FRAMES = 30, 150
HAND = mano_hand(load_embedded_hands(), "right")
SETTINGS = FeatureSettings(step_s=1 / FPS)
BOX = box_model((0.06, 0.06, 0.1))
# No dropout, which is against knowing. After 3,000 steps the loss is small, yet in some frames a step makes an error
# larger than it was, and the worst frame was 14.5 mm off. With more steps every frame leaves less of it.
NETWORK = NetworkConfig(encoder=64, keep=1.0, features=SETTINGS)
TRAINING = TrainingConfig(15_000, 64, 2e-3, 0.0, "cosine", 20)


@dataclass(frozen=True, eq=False)
class Stretch:
    """Five seconds of one hand. fingers: (frame, joint - 1, 3, 3) at ``time_s``."""

    hand: TrackedHand
    side: Side
    control: Control
    time_s: np.ndarray
    fingers: np.ndarray


def waves(draws: np.random.Generator, size: float, *shape: int) -> np.ndarray:
    """(frame, *shape) smooth numbers up to about ``size``, a wave each."""
    time_s = np.arange(FRAMES).reshape(-1, *[1] * len(shape)) / FPS
    rate, phase = draws.uniform(0.15, 0.5, shape), draws.uniform(0, 2 * np.pi, shape)
    return size * np.sin(2 * np.pi * rate * time_s + phase)


def played(seed: int) -> Stretch:
    """A hand that plays with a box at its palm."""
    draws, time_s = np.random.default_rng(seed), np.arange(FRAMES) / FPS
    turn, place = rotvec_to_rotmat(waves(draws, 0.6, 3)), waves(draws, 0.2, 3)
    palm = HAND.wrist_from_canonical @ [0.08, 0.0, -0.05]
    thing = place + turn @ palm + waves(draws, 0.02, 3)
    still = Motion(time_s[:1], np.eye(3)[None], np.array([[1.0, 0, 0]]))
    body = Motion(time_s, rotvec_to_rotmat(waves(draws, 0.8, 3)), thing)
    control = Control({"left": still, "right": Motion(time_s, turn, place)}, body, BOX)
    return Stretch(HAND, "right", control, time_s, HAND.rest_rotmats @ rotvec_to_rotmat(waves(draws, 0.35, 15, 3)))


def recorded(name: str, first_s: int, side: Side) -> Stretch:
    """From a recording with its own hands."""
    recording = read_hand_recording(RawTree(Path(ROOT)), SequenceKey("manipnet", "manipnet", name))
    rate, step = round(recording.fps), round(recording.fps / FPS)
    frames = slice(first_s * rate, first_s * rate + FRAMES * step, step)
    assert recording.usable[frames.start : frames.stop].all()
    fingers, time_s = recording.finger_rotmats(side, frames), recording.time_s[frames]
    return Stretch(recording.tracked_hand(side), side, recording_control(recording), time_s, fingers)


def steps_of(stretches: list[Stretch]) -> list[Examples]:
    """The steps of all, from recorded poses and from others, as many of each, as delivered."""
    usable, examples = np.ones(FRAMES, bool), []
    pool = np.concatenate([as_right(one.hand, one.fingers) for one in stretches])
    for number, one in enumerate(stretches):
        surface = surface_index(one.control.model)
        for given in (None, other_poses(one.fingers, as_right(one.hand, pool), number)):
            own = (one.control, one.side, one.hand, one.fingers, one.time_s, usable, surface, SETTINGS, given)
            examples.append(hand_examples(*own))
    return examples


def fit_examples(network: ManipNet, examples: list[Examples], config: TrainingConfig, seed: int) -> list[float]:
    """Train on steps of any source in an order drawn anew for every epoch; the losses. Adam, as the paper's."""
    inputs, made = (torch.from_numpy(np.concatenate([getattr(one, name) for one in examples])) for name in LEARNT)
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    network.train()
    losses, order = [], torch.zeros(0, dtype=torch.long)
    for step in range(1, config.steps + 1):
        if len(order) < config.batch:  # the last batch that is not full is left out
            order = torch.randperm(len(inputs), generator=generator)
        rows, order = order[: config.batch], order[config.batch :]
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * learning_rate_factor(step, config)
        loss = step_loss(network, inputs[rows], made[rows])
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    network.eval()
    return losses


def learnt(stretches: list[Stretch]) -> ManipNet:
    """A network that knows them; the budget takes some 50 s of one core."""
    torch.manual_seed(0)
    examples = steps_of(stretches)
    right = stretches[0].hand if stretches[0].side == "right" else stretches[0].hand.mirrored()
    network = prepared(NETWORK, right, examples)
    losses = fit_examples(network, examples, TRAINING, 0)
    assert np.mean(losses[-20:]) < 0.001 * losses[0]
    return network


def assert_followed(network: ManipNet, stretches: list[Stretch]) -> None:
    """From their first pose on each joint is within 5 mm in each frame; of a still hand their mean leaves 20 mm."""
    tasks = [Task(one.hand, one.side, one.control, one.time_s, one.fingers[0]) for one in stretches]
    for made, one in zip(roll_out(Predictor(network, "off"), tasks), stretches, strict=True):
        joints_mm = 1000 * joint_errors_m(one.hand, made, one.fingers)
        still_mm = 1000 * joint_errors_m(one.hand, np.repeat(one.fingers[:1], FRAMES, axis=0), one.fingers)
        frames_mm = joints_mm.mean(axis=1)
        told = f"{frames_mm.mean():.2f} mm, {np.percentile(frames_mm, 99):.2f} in 99 %, {frames_mm.max():.2f} in all"
        print(f"{told}; a joint {joints_mm.max():.2f}; still {still_mm.mean(axis=1).max():.1f}")
        assert joints_mm.max() < 5
        assert still_mm.mean(axis=1).max() > 20


@pytest.mark.long
def test_two_motions_of_five_seconds_are_learnt_and_followed_within_5_mm() -> None:
    stretches = [played(0), played(1)]
    assert_followed(learnt(stretches), stretches)


@pytest.mark.long
@pytest.mark.skipif(not ROOT, reason="HOIDATA_MANIPNET is not set: the data are not part of this repository")
def test_two_recorded_stretches_of_five_seconds_are_learnt_and_followed_within_5_mm() -> None:
    stretches = [recorded("cyl_med3", 5, "right"), recorded("cube_med2", 0, "left")]
    assert_followed(learnt(stretches), stretches)
