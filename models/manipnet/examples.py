"""What ManipNet learns from: the recorded pose of a frame and that of the next (Sec. 6.4), of hands of any source."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hoidata.clips.clip import Side
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors import sensor_size
from models.common.training import TrainingConfig, learning_rate_factor
from models.manipnet.control import Control
from models.manipnet.features import FeatureSettings, floors, hand_inputs, outputs, sizes
from models.manipnet.inverse_kinematics import turns_from_rest
from models.manipnet.network import ManipNet, NetworkConfig

LEARNT = ("inputs", "outputs")
MARGIN_RAD = 0.1  # joints may turn by so much more than in any training clip


class Examples(NamedTuple):
    """Steps of a hand, from one frame to the next. frame: (step,) it starts in. inputs: (step, 2350), float32.

    outputs: (step, 214), float32. turns_rad: (step, joint - 1, 3) from the neutral pose, as a right hand's.
    """

    frame: np.ndarray
    inputs: np.ndarray
    outputs: np.ndarray
    turns_rad: np.ndarray


def hand_examples(
    control: Control,
    side: Side,
    hand: TrackedHand,
    finger_rotmats: np.ndarray,
    time_s: np.ndarray,
    usable: np.ndarray,
    surface: SurfaceIndex,
    settings: FeatureSettings,
    given: np.ndarray | None = None,
) -> Examples:
    """The steps of a recorded hand whose two frames are usable (frame,); its times (frame,) are a step apart.

    given: (frame, joint - 1, 3, 3) other poses to start the steps from, which lead to the recorded ones all the same:
    the paper trains from recorded poses alone, and a network may then keep any pose it is given.
    """
    first = np.flatnonzero(usable[:-1] & usable[1:])
    start = finger_rotmats[first] if given is None else given[first]
    seen = hand_inputs(control, side, hand, hand.state(start), time_s[first], surface, settings)
    placed = control.thing.at(time_s[first + 1]).inverse() @ control.wrists[side].at(time_s[first + 1])
    hinge = control.hinge_at(time_s[first + 1])
    after = hand.state(finger_rotmats[first + 1])
    distance_m = surface.nearest(placed @ after.point_m, hinge).distance_m
    made = outputs(hand, after, distance_m, settings)
    rows = np.concatenate(seen, axis=1, dtype=np.float32)
    return Examples(first, rows, made.astype(np.float32), turns_from_rest(hand, finger_rotmats[first]))


def other_poses(fingers: np.ndarray, pool: np.ndarray, seed: int) -> np.ndarray:
    """(frame, joint - 1, 3, 3) for each pose one that lies between it and another of the pool, anywhere on the way."""
    draws = np.random.default_rng(seed)
    return between(fingers, pool[draws.integers(len(pool), size=len(fingers))], draws.uniform(0, 1, len(fingers)))


def between(start: np.ndarray, stop: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Rotations (frame, joint, 3, 3) a share (frame,) of the way from the first to the second."""
    way = rotmat_to_rotvec(start.swapaxes(-1, -2) @ stop)
    return start @ rotvec_to_rotmat(share[:, None, None] * way)


def sized(config: NetworkConfig, hand: TrackedHand) -> NetworkConfig:
    """The configuration with the numbers that this hand has."""
    count = sizes(hand, config.features)
    return replace(
        config,
        pose=count["pose"],
        trajectory=count["trajectory"],
        sensors=sensor_size(hand, config.features.sensors),
        output=count["pose"] + hand.n_points,
        joints=hand.n_joints,
    )


def prepared(config: NetworkConfig, hand: TrackedHand, examples: Sequence[Examples]) -> ManipNet:
    """A network that knows its normalisation and the limits of the joints from training examples."""
    network = ManipNet(sized(config, hand))
    inputs, made = (torch.from_numpy(np.concatenate([getattr(one, name) for one in examples])) for name in LEARNT)
    least = [torch.from_numpy(values).float() for values in floors(hand, config.features)]
    network.learn_normalisation(inputs, made, (least[0], least[1]))
    turns = torch.from_numpy(np.concatenate([one.turns_rad for one in examples]))
    network.low_rad.copy_(turns.amin(0) - MARGIN_RAD)
    network.high_rad.copy_(turns.amax(0) + MARGIN_RAD)
    return network


def step_loss(network: ManipNet, inputs: Tensor, made: Tensor) -> Tensor:
    """Mean squared error of normalised outputs."""
    return (network.normalised(inputs) - (made - network.output_mean) / network.output_scale).square().mean()


def fit_examples(network: ManipNet, examples: Sequence[Examples], config: TrainingConfig, seed: int) -> list[float]:
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
