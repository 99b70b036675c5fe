"""Training of ManipNet on annotated clips: the shared loop samples clips, and this objective samples their steps.

A step is the recorded pose of a frame and that of the next (Sec. 6.4).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, ClipSample
from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.devices import send
from hoidata.errors import BadInput
from hoidata.geometry.motion import interpolate_rotations, poses_at
from hoidata.hands import HandPair
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import surface_index
from hoidata.sensors import sensor_size
from hoidata.sensors.mano_hand import mano_hands
from models.common.family import Losses, Network, Setup
from models.common.repeatable import seed_of
from models.manipnet.control import Control, control_of, finger_rotmats_of, trajectories_of
from models.manipnet.features import FeatureSettings, hand_inputs, mirrored_to_right, outputs, sizes, std_floors
from models.manipnet.inverse_kinematics import rotvecs_from_rest
from models.manipnet.network import ManipNet, NetworkConfig

MARGIN_RAD = 0.1  # joint limits are those of the training poses, extended by this


class Examples(NamedTuple):
    """Training steps of one hand, each from a frame to the next."""

    frame: np.ndarray  # (step,) the first frame, or the last frame of the clip before the step
    inputs: np.ndarray  # (step, 2350) float32
    outputs: np.ndarray  # (step, 214) float32
    rotvecs_rad: np.ndarray  # (step, joint - 1, 3) axis-angle from the neutral pose, as a right hand's


def hand_examples(
    control: Control,
    side: Side,
    hand: TrackedHand,
    finger_rotmats: np.ndarray,
    time_s: np.ndarray,
    usable: np.ndarray,
    settings: FeatureSettings,
    start_rotmats: np.ndarray | None = None,
) -> Examples:
    """Training steps of a hand with recorded ``finger_rotmats`` (frame, joint - 1, 3, 3) at ``time_s``, one step apart.

    usable: (frame,) bool; a step needs two usable frames. start_rotmats: (frame, joint - 1, 3, 3) perturbed poses to
    start from; the targets are the recorded ones. The paper trains from recorded poses only. Such a network may keep
    any pose it is given.
    """
    first = np.flatnonzero(usable[:-1] & usable[1:])
    start = finger_rotmats[first] if start_rotmats is None else start_rotmats[first]
    inputs = hand_inputs(control, side, hand, hand.state(start), time_s[first], settings)
    next_s, next_state = time_s[first + 1], hand.state(finger_rotmats[first + 1])
    object_from_wrist = control.object_motion.at(next_s).inverse() @ control.wrists[side].at(next_s)
    surface, hinge_rad = surface_index(control.model), control.hinge_at(next_s)
    distance_m = surface.nearest(object_from_wrist @ next_state.point_m, hinge_rad).distance_m
    targets = outputs(hand, next_state, distance_m, settings).astype(np.float32)
    input_rows = np.concatenate(inputs, axis=1, dtype=np.float32)
    return Examples(first, input_rows, targets, rotvecs_from_rest(hand, finger_rotmats[first]))


def joined(examples: Sequence[Examples]) -> Examples:
    """The steps of several hands, one after the other."""
    return Examples(*map(np.concatenate, zip(*examples, strict=True)))


def perturbed_poses(fingers: np.ndarray, pool: np.ndarray, seed: int) -> np.ndarray:
    """Perturb poses (frame, joint - 1, 3, 3): move each by a random fraction towards a random pose of the pool."""
    rng = np.random.default_rng(seed)
    targets = pool[rng.integers(len(pool), size=len(fingers))]
    return interpolate_rotations(fingers, targets, rng.uniform(0, 1, len(fingers)))


def sized_config(config: NetworkConfig, hand: TrackedHand) -> NetworkConfig:
    """The configuration with the input and output sizes of a hand."""
    count = sizes(hand, config.features)
    inputs = {"pose": count["pose"], "trajectory": count["trajectory"]}
    sensors, output = sensor_size(hand, config.features.sensors), count["pose"] + hand.n_points
    return replace(config, **inputs, sensors=sensors, output=output, joints=hand.n_joints)


def build_network(config: NetworkConfig, hand: TrackedHand, examples: Sequence[Examples]) -> ManipNet:
    """A network with normalisation and joint limits from training examples, and random weights."""
    network, (_, *arrays) = ManipNet(sized_config(config, hand)), joined(examples)
    inputs, targets, turns = map(torch.from_numpy, arrays)
    input_floor, output_floor = (torch.from_numpy(values).float() for values in std_floors(hand, config.features))
    network.learn_normalisation(inputs, targets, (input_floor, output_floor))
    network.low_rad.copy_(turns.amin(0) - MARGIN_RAD)
    network.high_rad.copy_(turns.amax(0) + MARGIN_RAD)
    return network


def step_loss(network: ManipNet, inputs: Tensor, targets: Tensor) -> Tensor:
    """Mean squared error of normalised outputs."""
    return (network.normalised(inputs) - (targets - network.output_mean) / network.output_scale).square().mean()


@dataclass(frozen=True)
class LossConfig:
    """Sampling of training steps."""

    steps_per_clip: int = 16  # of each clip of a batch
    perturbed_fraction: float = 0.5  # of steps that start from a perturbed pose; 0: as in the paper


def clip_examples(
    sample: ClipSample, pair: HandPair, settings: FeatureSettings, pool: np.ndarray | None = None
) -> list[Examples]:
    """Training steps of the active hands of a whole clip, from poses perturbed towards those of a pool, or recorded.

    pool: (pose, 15, 3, 3) as a right hand's; None: recorded poses.
    """
    hands = mano_hands(pair, sample.betas, sample.template_m)
    control = control_of(trajectories_of(sample), sample.object_model)
    clip_frame = np.arange(int((sample.length - 1) / (FPS * settings.step_s) + 1e-6) + 1) * settings.step_s * FPS
    frames = np.floor(clip_frame + 1e-6).astype(int), np.ceil(clip_frame - 1e-6).astype(int)
    time_s, examples = clip_frame / FPS, []
    for side_index, side in enumerate(SIDES):
        usable = sample.valid[side_index][frames[0]] & sample.valid[side_index][frames[1]]
        if not (sample.active_hands[side_index] and (usable[:-1] & usable[1:]).any()):
            continue
        hand, fingers = hands[side], poses_at(finger_rotmats_of(sample.hands[side_index]), clip_frame)
        seed = seed_of(f"{sample.clip_id} {side}")
        start_rotmats = None if pool is None else perturbed_poses(fingers, mirrored_to_right(hand, pool), seed)
        steps = hand_examples(control, side, hand, fingers, time_s, usable, settings, start_rotmats)
        examples.append(steps._replace(frame=frames[0][steps.frame]))
    return examples


def pose_pool(samples: Sequence[ClipSample], pair: HandPair) -> np.ndarray:
    """(pose, 15, 3, 3) the neutral pose and the finger rotations of all tracked active hands, as a right hand's."""
    poses = [mano_hands(pair, samples[0].betas, samples[0].template_m)["right"].rest_rotmats[None]]
    for sample in samples:
        hands = mano_hands(pair, sample.betas, sample.template_m)
        for side_index in np.flatnonzero(sample.active_hands):
            fingers = finger_rotmats_of(sample.hands[side_index, sample.valid[side_index]])
            poses.append(mirrored_to_right(hands[SIDES[side_index]], fingers))
    return np.concatenate(poses)


class FingersObjective:
    """Squared error of the next pose and distances, from recorded and from perturbed poses."""

    frames = entries = 0

    def __init__(self, setup: Setup) -> None:
        pair, self.loss, self.device = setup.corpus.annotated.store.hand_pair(), setup.loss, setup.device
        settings, train = setup.network.features, setup.corpus.train
        clips = [train.whole(clip_id) for clip_id in train.ids]
        pools = (None, pose_pool(clips, pair)) if self.loss.perturbed_fraction else (None,)
        # By clip, for each hand: its steps from recorded poses, and those from perturbed poses.
        self.examples = {
            sample.clip_id: list(zip(*(clip_examples(sample, pair, settings, pool) for pool in pools), strict=True))
            for sample in clips
        }
        hand = mano_hands(pair, clips[0].betas, clips[0].template_m)["right"]
        examples = [example for clip in self.examples.values() for kinds in clip for example in kinds]
        self.network = build_network(setup.network, hand, examples).to(setup.device)
        validation = [example for sample in setup.corpus.held_out for example in clip_examples(sample, pair, settings)]
        if setup.corpus.held_out and not validation:
            expected = "a hand that is tracked in two consecutive frames"
            raise BadInput("validation", expected, "none in its clips", "put other clips into the validation part")
        self.held_out = joined(validation) if validation else None

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        steps = [pair for sample in batch.samples for pair in self._sampled_steps(sample, generator)]
        if not steps:  # no hand of the batch is tracked in two consecutive frames
            return {"total": self.network.decoder.bias.sum() * 0}
        inputs, targets = (send(torch.from_numpy(np.stack(rows)), self.device) for rows in zip(*steps, strict=True))
        return {"total": step_loss(self.network, inputs, targets)}

    def _sampled_steps(self, sample: ClipSample, generator: torch.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
        """Inputs and outputs of random steps in the frames of a cropped clip, of any hand."""
        first, stop = sample.start, sample.start + sample.length - 1
        steps = [
            (kinds, step)
            for kinds in self.examples[sample.clip_id]
            for step in np.flatnonzero((kinds[0].frame >= first) & (kinds[0].frame < stop))
        ]
        if not steps:
            return []
        chosen = torch.randint(len(steps), (self.loss.steps_per_clip,), generator=generator).tolist()
        random = torch.rand(self.loss.steps_per_clip, generator=generator)
        is_perturbed = (random < self.loss.perturbed_fraction).long().tolist()
        sampled = [(*steps[number], kind) for number, kind in zip(chosen, is_perturbed, strict=True)]
        return [(kinds[kind].inputs[step], kinds[kind].outputs[step]) for kinds, step, kind in sampled]

    @torch.no_grad()
    def validation(self, network: nn.Module) -> Tensor:
        assert isinstance(network, ManipNet)
        assert self.held_out is not None
        arrays = self.held_out.inputs, self.held_out.outputs
        return step_loss(network, *(send(torch.from_numpy(rows), self.device) for rows in arrays))


MANIPNET = Network(
    name="manipnet",
    config=NetworkConfig,
    build=ManipNet,
    objective=lambda setup: (FingersObjective(setup), None),
    loss=LossConfig,
)
