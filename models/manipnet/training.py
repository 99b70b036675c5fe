"""Training of ManipNet on annotated clips: the shared loop draws clips, from each of which steps are drawn.

A step is the recorded pose of a frame and that of the next (Sec. 6.4), of hands of any source.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, ClipSample
from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.devices import send
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import SurfaceIndex, surface_index
from hoidata.sensors import sensor_size
from models.common.family import Losses, Network, Setup
from models.manipnet.control import Control, between, control_of, finger_rotmats_of, hands_of, trajectories_of
from models.manipnet.features import FeatureSettings, floors, hand_inputs, outputs, sizes
from models.manipnet.inverse_kinematics import turns_from_rest
from models.manipnet.lookups import as_right
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


@dataclass(frozen=True)
class LossConfig:
    """rows: steps drawn from each clip of a batch. astray: share of them from poses that were not recorded, from which
    they lead back; 0: as the paper trains.
    """

    rows: int = 16
    astray: float = 0.5


def clip_examples(
    sample: ClipSample, pair: HandPair, settings: FeatureSettings, pool: np.ndarray | None = None
) -> list[Examples]:
    """The steps of every active hand of a whole clip; with a pool (pose, 15, 3, 3) as a right hand's, from poses that
    are partly others.
    """
    hands = hands_of(pair, sample.betas, sample.template_m)
    control, surface = control_of(trajectories_of(sample), sample.object_model), surface_index(sample.object_model)
    time_s, made = np.arange(sample.length) / FPS, []
    for row, side in enumerate(SIDES):
        if not seen_twice(sample)[row]:
            continue
        hand, fingers = hands[side], finger_rotmats_of(sample.hands[row])
        seed = int.from_bytes(sha256(f"{sample.clip_id} {side}".encode()).digest()[:7])
        given = None if pool is None else other_poses(fingers, as_right(hand, pool), seed)
        own = (control, side, hand, fingers, time_s, sample.valid[row], surface, settings, given)
        made.append(hand_examples(*own))
    return made


def seen_twice(sample: ClipSample) -> np.ndarray:
    """(2,) bool: the hand takes part and is tracked in two frames in a row."""
    return sample.active_hands & (sample.valid[:, :-1] & sample.valid[:, 1:]).any(axis=1)


def pose_pool(samples: Sequence[ClipSample], pair: HandPair) -> np.ndarray:
    """(pose, 15, 3, 3) finger rotations of all tracked active hands, as a right hand's, and the neutral pose."""
    poses = [hands_of(pair, samples[0].betas, samples[0].template_m)["right"].rest_rotmats[None]]
    for sample in samples:
        hands = hands_of(pair, sample.betas, sample.template_m)
        for row in np.flatnonzero(sample.active_hands):
            own = finger_rotmats_of(sample.hands[row, sample.valid[row]])
            poses.append(as_right(hands[SIDES[row]], own))
    return np.concatenate(poses)


class FingersObjective:
    """Squared error of the next pose and distances, from recorded poses and from poses beside them."""

    frames = entries = 0

    def __init__(self, setup: Setup) -> None:
        pair, self.loss, self.device = setup.corpus.annotated.store.hand_pair(), setup.loss, setup.device
        settings = replace(setup.network.features, step_s=1 / FPS)
        train = setup.corpus.train
        whole = [train.whole(clip_id) for clip_id in train.ids]
        pools = (None, pose_pool(whole, pair)) if self.loss.astray else (None,)
        # By clip, for each hand: its steps from recorded poses, and those from others.
        self.examples = {
            sample.clip_id: list(zip(*(clip_examples(sample, pair, settings, pool) for pool in pools), strict=True))
            for sample in whole
        }
        hand = hands_of(pair, whole[0].betas, whole[0].template_m)["right"]
        known = [one for clip in self.examples.values() for kinds in clip for one in kinds]
        self.network = prepared(replace(setup.network, features=settings), hand, known).to(setup.device)
        held = [one for sample in setup.corpus.held_out for one in clip_examples(sample, pair, settings)]
        if setup.corpus.held_out and not held:
            expected = "a hand that is seen in two frames in a row"
            raise BadInput("validation", expected, "none in its clips", "put other clips into the validation part")
        self.held_out = [np.concatenate([getattr(one, name) for one in held]) for name in LEARNT] if held else None

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        drawn = [pair for sample in batch.samples for pair in self._drawn(sample, generator)]
        if not drawn:  # clips in which no hand is seen twice in a row
            return {"total": self.network.decoder.bias.sum() * 0}
        inputs, made = (send(torch.from_numpy(np.stack(rows)), self.device) for rows in zip(*drawn, strict=True))
        return {"total": step_loss(self.network, inputs, made)}

    def _drawn(self, sample: ClipSample, generator: torch.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
        """So many steps of the frames of a cropped clip, any hand."""
        first, stop = sample.start, sample.start + sample.length - 1
        steps = [
            (kinds, row)
            for kinds in self.examples[sample.clip_id]
            for row in np.flatnonzero((kinds[0].frame >= first) & (kinds[0].frame < stop))
        ]
        if not steps:
            return []
        chosen = torch.randint(len(steps), (self.loss.rows,), generator=generator).tolist()
        astray = (torch.rand(self.loss.rows, generator=generator) < self.loss.astray).long().tolist()
        found = [(steps[number][0][kind], steps[number][1]) for number, kind in zip(chosen, astray, strict=True)]
        return [(one.inputs[row], one.outputs[row]) for one, row in found]

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, ManipNet)
        assert self.held_out is not None
        inputs, made = (send(torch.from_numpy(rows), self.device) for rows in self.held_out)
        return step_loss(network, inputs, made)


MANIPNET = Network("manipnet", NetworkConfig, ManipNet, lambda setup: (FingersObjective(setup), None), loss=LossConfig)
