"""IMoS for two hands and an object: its training, and motions of 15 key frames stretched to the recorded length.

IMoS starts from the first four key frames of the recorded motion. ``imos`` takes them from a retrieved training clip
instead; ``imos-true-start`` sees the recorded ones, which other methods do not.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, ClipSample, load_sample
from hoidata.batches.requests import Request, RequestBatch
from hoidata.clips.features import HAND_FEATURES, HAND_ROTATIONS_6D, OBJECT_ROTATION_6D
from hoidata.devices import send
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rot6d, rotmat_to_rotvec, rotvec_to_rotmat
from models.baselines.retrieval import by_sentence, retrieval_clips
from models.common.checkpoints import load_checkpoint
from models.common.corpus import any_form
from models.common.family import Family, Losses, Sources
from models.common.losses import masked_mean
from models.common.motion_vectors import (
    MOTION_FEATURES,
    RecordedVectors,
    VectorObjective,
    VectorSampler,
    feature_mask,
    joined,
    vector_network,
)
from models.imos.network import KEY_FRAMES, PAST, ImosConfig, ImosNetwork, divergence

KL_WEIGHT = 1e-3
RECORDED_PAST = 0.5  # probability that a key frame of the past is the recorded one; else it is the network's own
ROTATIONS = torch.cat(  # columns of 33 rotations of 6 numbers
    [
        *(torch.arange(HAND_ROTATIONS_6D.start, HAND_FEATURES) + side * HAND_FEATURES for side in range(2)),
        torch.arange(OBJECT_ROTATION_6D.start, OBJECT_ROTATION_6D.stop) + 2 * HAND_FEATURES,
    ]
)


def key_frames(lengths: Tensor) -> Tensor:
    """(B, 15) indices of evenly spaced frames of motions with (B,) frames, the first and the last included."""
    return ((lengths[:, None] - 1) * torch.arange(KEY_FRAMES, device=lengths.device) / (KEY_FRAMES - 1)).round().long()


def interpolated(keys: Tensor, n_frames: int) -> Tensor:
    """Motion (F, 208) through key frames (15, 208), in metres: rotations by slerp, everything else linearly."""
    moments = torch.linspace(0, len(keys) - 1, n_frames, dtype=torch.float64)
    before = moments.long().clamp_max(len(keys) - 2)
    fraction = (moments - before).to(keys)[:, None]
    motion = keys[before] + fraction * (keys[before + 1] - keys[before])
    rotmats = rot6d_to_rotmat(keys[:, ROTATIONS].unflatten(-1, (-1, 6)))
    # A hand that no training clip has is zero everywhere. Zeros do not define a rotation.
    rotmats = torch.where(rotmats.flatten(-2).any(-1)[..., None, None], rotmats, torch.eye(3).to(rotmats))
    steps = rotmat_to_rotvec(rotmats[:-1].transpose(-1, -2) @ rotmats[1:])
    rotations = rotmats[before] @ rotvec_to_rotmat(fraction[..., None] * steps[before])
    motion[:, ROTATIONS] = rotmat_to_rot6d(rotations).flatten(-2)
    return motion


class ImosObjective(VectorObjective):
    """Loss of one key frame per clip: L1 of the frame and of its change, and the KL divergence of both encoders.

    IMoS takes one optimiser step for each of the key frames 5 to 15 of a batch. Here every clip of a batch has one of
    them, chosen at random, so that the statistics of batch norm are those of all key frames, as in evaluation.
    """

    def terms(self, network: nn.Module, batch: ClipBatch, generator: torch.Generator) -> Losses:
        assert isinstance(network, ImosNetwork)
        target, clip = RecordedVectors.of(batch, self.normaliser), torch.arange(len(batch), device=self.device)
        chosen = clip[:, None], key_frames(batch.lengths)
        keys, mask, visible = target.motion[chosen], target.mask[chosen], target.visible[:, 0]
        noise_size = len(batch), KEY_FRAMES - PAST + 1, network.config.latent
        if not network.training:
            condition, noise = network.conditions(batch.text[:, 0], batch.betas), keys.new_zeros(noise_size)
            error = (network.roll_out(keys[:, :PAST], condition, visible, noise[:, 1:]) - keys).abs()
            return {"total": masked_mean(error[:, PAST:], mask[:, PAST:])}
        text, noise = any_form(batch, generator), send(torch.randn(noise_size, generator=generator), self.device)
        number = send(torch.randint(PAST, KEY_FRAMES, (len(batch),), generator=generator), self.device)
        is_recorded = torch.rand(KEY_FRAMES, generator=generator) < RECORDED_PAST
        reads_present = bool(torch.rand((), generator=generator) < 0.5)
        recorded = {key: keys[:, key] for key in range(PAST, KEY_FRAMES) if is_recorded[key]}
        with torch.no_grad():
            condition = network.eval().conditions(text, batch.betas)
            history = network.roll_out(keys[:, :PAST], condition, visible, noise[:, 1:], recorded)
        past = history[clip[:, None], number[:, None] + torch.arange(-PAST, 0, device=self.device)]
        # Batch norm cannot train on a single clip.
        condition = network.train(len(batch) > 1).conditions(text, batch.betas)
        of_past = network.past(torch.cat((past.flatten(1), condition), -1))
        of_present = network.present(torch.cat((keys[clip, number], condition), -1))
        mean, deviation = of_present if reads_present else of_past
        frame = network.next_frame(past, mean + deviation * noise[:, 0], condition) * visible
        network.train()
        true, weight = keys[clip, number], mask[clip, number]
        terms = {
            "pose": masked_mean((frame - true).abs(), weight),
            "step": masked_mean((frame - past[:, -1] - true + keys[clip, number - 1]).abs(), weight),
            "kl": divergence(*of_present) + divergence(*of_past),
        }
        return {"total": terms["pose"] + terms["step"] + KL_WEIGHT * terms["kl"], **terms}


@dataclass(frozen=True)
class Imos(VectorSampler):
    """IMoS as a sampler."""

    start: Callable[[Request], ClipSample]  # the clip whose first four key frames a motion starts with

    def generate(self, requests: Sequence[Request], batch: RequestBatch, generators: list[torch.Generator]) -> Tensor:
        network, normaliser = self.checkpoint.network, self.checkpoint.normaliser
        assert isinstance(network, ImosNetwork)
        assert normaliser is not None
        hands, objects = zip(*[_first_keys(self.start(request)) for request in requests], strict=True)
        visible = feature_mask(batch.hand_frames, batch.frames)[:, 0]
        start = normaliser.encode(send(torch.stack(hands), self.device), send(torch.stack(objects), self.device))
        noise = [torch.randn(KEY_FRAMES - PAST, network.config.latent, generator=one) for one in generators]
        condition = network.conditions(batch.text, batch.betas)
        keys = network.roll_out(
            joined(*start) * visible[:, None], condition, visible, send(torch.stack(noise), self.device)
        )
        motions = batch.text.new_zeros(*batch.frames.shape, MOTION_FEATURES)
        for motion, one, n_frames in zip(motions, self.decoded(keys), batch.counts, strict=True):
            motion[:n_frames] = interpolated(one, n_frames)
        return motions


def _first_keys(sample: ClipSample) -> tuple[Tensor, Tensor]:
    """Hands (2, 4, 99) and object (4, 10) of a clip's first four key frames."""
    rows = key_frames(torch.tensor([sample.length]))[0, :PAST].numpy()
    return torch.from_numpy(sample.hands[:, rows]), torch.from_numpy(sample.object[rows])


def _retrieved_start(train: Sequence[ClipSample], request: Request) -> ClipSample:
    """The training clip with the verb, the hands and the most similar sentence of a request."""
    ranked = [train[index] for index in by_sentence(train, request)]
    verb = request.sentence.verb if request.sentence else None
    same = [one for one in ranked if one.verb == verb and np.array_equal(one.active_hands, request.active_hands)]
    return [*same, *ranked][0]


def _true_start(sources: Sources, request: Request) -> ClipSample:
    sample = load_sample(sources.annotated, request.clip_id)
    return sample if sample.length == request.n_frames else sample.crop(0, request.n_frames)


def _load(sources: Sources, start: Callable[[Request], ClipSample]) -> Imos:
    return Imos(load_checkpoint(sources.checkpoints / IMOS.name, IMOS, sources.device), sources.device, start)


IMOS = vector_network("imos", ImosConfig, ImosNetwork, ImosObjective)
FAMILY = Family(
    "imos",
    "IMoS, starts from a retrieved clip",
    lambda sources: _load(sources, partial(_retrieved_start, retrieval_clips(sources) or sources.clips("train"))),
    networks=(IMOS,),
    uses=(IMOS.name,),
)
TRUE_START = Family(
    "imos-true-start",
    "IMoS, sees 4 true frames",
    lambda sources: _load(sources, partial(_true_start, sources)),
    uses=(IMOS.name,),
)
