"""Overfitting to two motions: a network trained on single steps does not drift in the rollout."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from hoidata.clips.clip import Side
from hoidata.datasets.base import RawTree, SequenceKey
from hoidata.datasets.manipnet.adapter import read_hand_recording
from hoidata.geometry.motion import Motion
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.sensors.mano_hand import mano_hand
from models.common.training import TrainingConfig, learning_rate_factor
from models.manipnet.control import Control
from models.manipnet.family import joint_errors_m
from models.manipnet.features import FeatureSettings, mirrored_to_right
from models.manipnet.network import ManipNet, NetworkConfig
from models.manipnet.rollout import Predictor, RolloutTask, roll_out
from models.manipnet.training import Examples, build_network, hand_examples, joined, perturbed_poses, step_loss
from tests.builders.manipnet import recording_control
from tests.builders.objects import box_model

ROOT = os.environ.get("HOIDATA_MANIPNET", "")
FPS, FRAMES = 30, 150
HAND = mano_hand(load_embedded_hands(), "right")
SETTINGS = FeatureSettings(step_s=1 / FPS)
BOX = box_model((0.06, 0.06, 0.1))
# No dropout, to overfit. After 3,000 steps the loss is small, but the error grows in some frames and reaches 14.5 mm.
# More steps reduce it in all frames.
NETWORK = NetworkConfig(encoder=64, keep_probability=1.0, features=SETTINGS)
TRAINING = TrainingConfig(steps=15_000, batch=64, learning_rate=2e-3, weight_decay=0.0, schedule="cosine", warmup=20)


@dataclass(frozen=True, eq=False)
class Stretch:
    """Five seconds of one hand."""

    hand: TrackedHand
    side: Side
    control: Control
    time_s: np.ndarray
    fingers: np.ndarray  # (frame, joint - 1, 3, 3) at ``time_s``


def waves(rng: np.random.Generator, size: float, *shape: int) -> np.ndarray:
    """(frame, *shape) sine waves with amplitude ``size``."""
    time_s = np.arange(FRAMES).reshape(-1, *[1] * len(shape)) / FPS
    rate, phase = rng.uniform(0.15, 0.5, shape), rng.uniform(0, 2 * np.pi, shape)
    return size * np.sin(2 * np.pi * rate * time_s + phase)


def synthetic_stretch(seed: int) -> Stretch:
    """A hand that moves a box at its palm."""
    rng, time_s = np.random.default_rng(seed), np.arange(FRAMES) / FPS
    rotmats, wrist_m = rotvec_to_rotmat(waves(rng, 0.6, 3)), waves(rng, 0.2, 3)
    palm = HAND.wrist_from_canonical @ [0.08, 0.0, -0.05]
    object_m = wrist_m + rotmats @ palm + waves(rng, 0.02, 3)
    still = Motion(time_s[:1], np.eye(3)[None], np.array([[1.0, 0, 0]]))
    body = Motion(time_s, rotvec_to_rotmat(waves(rng, 0.8, 3)), object_m)
    control = Control({"left": still, "right": Motion(time_s, rotmats, wrist_m)}, body, BOX)
    fingers = HAND.rest_rotmats @ rotvec_to_rotmat(waves(rng, 0.35, 15, 3))
    return Stretch(hand=HAND, side="right", control=control, time_s=time_s, fingers=fingers)


def recorded_stretch(name: str, first_s: int, side: Side) -> Stretch:
    """A stretch of a recording, with the hands of its person."""
    recording = read_hand_recording(RawTree(Path(ROOT)), SequenceKey("manipnet", "manipnet", name))
    rate, step = round(recording.fps), round(recording.fps / FPS)
    frames = slice(first_s * rate, first_s * rate + FRAMES * step, step)
    assert recording.usable[frames.start : frames.stop].all()
    fingers, time_s = recording.finger_rotmats(side, frames), recording.time_s[frames]
    return Stretch(
        hand=recording.tracked_hand(side),
        side=side,
        control=recording_control(recording),
        time_s=time_s,
        fingers=fingers,
    )


def steps_of(stretches: list[Stretch]) -> list[Examples]:
    """Training steps of all stretches, from recorded and from perturbed poses, as many of each."""
    usable, examples = np.ones(FRAMES, bool), []
    pool = np.concatenate([mirrored_to_right(stretch.hand, stretch.fingers) for stretch in stretches])
    for number, stretch in enumerate(stretches):
        for start_poses in (None, perturbed_poses(stretch.fingers, mirrored_to_right(stretch.hand, pool), number)):
            arguments = (
                stretch.control,
                stretch.side,
                stretch.hand,
                stretch.fingers,
                stretch.time_s,
                usable,
                SETTINGS,
                start_poses,
            )
            examples.append(hand_examples(*arguments))
    return examples


def fit_examples(network: ManipNet, examples: list[Examples], config: TrainingConfig, seed: int) -> list[float]:
    """Train with Adam on steps in a new random order for each epoch; returns the losses."""
    steps = joined(examples)
    inputs, targets = torch.from_numpy(steps.inputs), torch.from_numpy(steps.outputs)
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    network.train()
    losses, order = [], torch.zeros(0, dtype=torch.long)
    for step in range(1, config.steps + 1):
        if len(order) < config.batch:  # an incomplete last batch is skipped
            order = torch.randperm(len(inputs), generator=generator)
        chosen, order = order[: config.batch], order[config.batch :]
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * learning_rate_factor(step, config)
        loss = step_loss(network, inputs[chosen], targets[chosen])
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    network.eval()
    return losses


def overfitted(stretches: list[Stretch]) -> ManipNet:
    """Overfit a network to the stretches; takes about 50 s on one core."""
    torch.manual_seed(0)
    examples = steps_of(stretches)
    right = stretches[0].hand if stretches[0].side == "right" else stretches[0].hand.mirrored()
    network = build_network(NETWORK, right, examples)
    losses = fit_examples(network, examples, TRAINING, 0)
    assert np.mean(losses[-20:]) < 0.001 * losses[0]
    return network


def assert_followed(network: ManipNet, stretches: list[Stretch]) -> None:
    """Each joint is within 5 mm in each frame of the rollout; the error of a still hand exceeds 20 mm."""
    tasks = [
        RolloutTask(
            hand=stretch.hand,
            side=stretch.side,
            control=stretch.control,
            time_s=stretch.time_s,
            start=stretch.fingers[0],
        )
        for stretch in stretches
    ]
    for predicted, stretch in zip(roll_out(Predictor(network, "off"), tasks), stretches, strict=True):
        joints_mm = 1000 * joint_errors_m(stretch.hand, predicted, stretch.fingers)
        still_mm = 1000 * joint_errors_m(stretch.hand, np.repeat(stretch.fingers[:1], FRAMES, axis=0), stretch.fingers)
        frames_mm = joints_mm.mean(axis=1)
        summary = f"{frames_mm.mean():.2f} mm, {np.percentile(frames_mm, 99):.2f} in 99 %, {frames_mm.max():.2f} in all"
        print(f"{summary}; a joint {joints_mm.max():.2f}; still {still_mm.mean(axis=1).max():.1f}")
        assert joints_mm.max() < 5
        assert still_mm.mean(axis=1).max() > 20


@pytest.mark.long
def test_two_motions_of_five_seconds_are_overfitted_within_5_mm() -> None:
    stretches = [synthetic_stretch(0), synthetic_stretch(1)]
    assert_followed(overfitted(stretches), stretches)


@pytest.mark.long
@pytest.mark.skipif(not ROOT, reason="HOIDATA_MANIPNET is not set: the data are not part of this repository")
def test_two_recorded_stretches_of_five_seconds_are_overfitted_within_5_mm() -> None:
    stretches = [recorded_stretch("cyl_med3", 5, "right"), recorded_stretch("cube_med2", 0, "left")]
    assert_followed(overfitted(stretches), stretches)
