"""MDM (Tevet et al., Human Motion Diffusion Model, ICLR 2023) for two hands and an object.

A Transformer denoises one token per frame with all features of hands and object. One token in front has sentence and
timestep. Only the size of the motion vector differs from MDM, as in Table 1 of Text2HOI. A motion has the length of the
recorded clip. Attention skips the frames beyond it, which MDM does by option.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from hoidata.batches.dataset import MAX_FRAMES, ClipBatch
from hoidata.batches.requests import Request, RequestBatch
from hoidata.devices import send
from hoidata.settings import build_config
from models.common.checkpoints import load_checkpoint
from models.common.corpus import any_form
from models.common.family import Family, Losses, Sources
from models.common.features import TEXT_FEATURES, scaled_text
from models.common.losses import masked_mean
from models.common.motion_vectors import (
    MOTION_FEATURES,
    RecordedVectors,
    VectorObjective,
    VectorSampler,
    feature_mask,
    vector_network,
)
from models.common.sampling import TRAIN_STEPS, SamplerConfig, add_noise, alphas_cumprod, sample
from models.common.transformer import Encoder, TransformerConfig, attention_mask_of, sinusoid, to_frames, to_tokens

TEXT_DROPOUT = 0.1  # fraction of training clips without sentence, for classifier-free guidance


@dataclass(frozen=True)
class MdmConfig:
    """Sizes of the denoiser; the defaults are MDM's."""

    transformer: TransformerConfig = field(default_factory=TransformerConfig)


class MdmNetwork(nn.Module):
    """``x0 = network(x_t, t, text, visible)`` on normalised motion vectors."""

    def __init__(self, config: MdmConfig) -> None:
        super().__init__()
        self.config = config
        width, inputs = config.transformer.width, MOTION_FEATURES * config.transformer.frames_per_token
        self.motion_in = nn.Linear(inputs, width)
        self.step_in = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.text_in = nn.Linear(TEXT_FEATURES, width)
        self.drop = nn.Dropout(config.transformer.dropout)
        self.encoder = Encoder(config.transformer)
        self.motion_out = nn.Linear(width, inputs)

    def forward(self, motion: Tensor, steps: Tensor, text: Tensor, visible: Tensor) -> Tensor:
        """Clean motions (B, F, 208), 0 where not visible.

        Args:
            motion: (B, F, 208) noised.
            steps: (B,) timesteps from 0 to 999.
            text: (B, 512) sentence features; zeros for no sentence.
            visible: (B, F, 208) bool: active hands and object, within the length of each motion.
        """
        width, per_token = self.config.transformer.width, self.config.transformer.frames_per_token
        condition = self.text_in(scaled_text(text)) + self.step_in(sinusoid(steps, width))
        tokens = torch.cat((condition[:, None], self.motion_in(to_tokens(motion * visible, per_token))), 1)
        tokens = self.drop(tokens + sinusoid(torch.arange(tokens.shape[1], device=tokens.device), width))
        mask = attention_mask_of(visible[..., -1], per_token)  # the object is in every frame
        mask = torch.cat((mask.new_ones(len(mask), 1), mask), 1)
        clean = self.motion_out(self.encoder(tokens, mask)[:, 1:])
        return to_frames(clean, motion.shape[1], per_token) * visible


class MdmObjective(VectorObjective):
    """Squared error of the denoised motion."""

    def terms(self, network: nn.Module, batch: ClipBatch, generator: torch.Generator) -> Losses:
        target = RecordedVectors.of(batch, self.normaliser)
        steps = send(torch.randint(TRAIN_STEPS, (len(batch),), generator=generator), self.device)
        noise = send(torch.randn(target.motion.shape, generator=generator), self.device)
        text = any_form(batch, generator)
        if network.training:
            text = text * send(torch.rand(len(batch), 1, generator=generator) >= TEXT_DROPOUT, self.device)
        noised = add_noise(target.motion, noise, steps, alphas_cumprod(self.device))
        error = (network(noised, steps, text, target.visible) - target.motion).square()
        return {"total": masked_mean(error, target.mask)}


@dataclass(frozen=True)
class MdmSampling:
    """How motions are sampled: section ``sample.mdm`` of params.yaml."""

    # MDM has {kind: ddpm, steps: 1000}; the default is that of Text2HOI's preset `ours`.
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    guidance: float = 2.5  # scale of classifier-free guidance; 1: none


@dataclass(frozen=True)
class Mdm(VectorSampler):
    """MDM as a sampler."""

    config: MdmSampling = MdmSampling()

    def generate(self, requests: Sequence[Request], batch: RequestBatch, generators: list[torch.Generator]) -> Tensor:
        visible = feature_mask(batch.hand_frames, batch.frames)
        n_frames = visible.shape[1]
        text, network = torch.cat((batch.text, torch.zeros_like(batch.text))), self.checkpoint.network

        def denoise(motion: Tensor, steps: Tensor) -> Tensor:
            inputs = motion.repeat(2, 1, 1), steps.repeat(2), text, visible.repeat(2, 1, 1)
            with_text, without = network(*inputs).chunk(2)
            return without + self.config.guidance * (with_text - without)

        def draw() -> Tensor:
            noise = [torch.randn(MAX_FRAMES, MOTION_FEATURES, generator=generator) for generator in generators]
            return send(torch.stack(noise)[:, :n_frames], self.device)

        return self.decoded(sample(denoise, draw(), self.config.sampler, draw))


def _load(sources: Sources) -> Mdm:
    config = build_config(MdmSampling, sources.settings.get("mdm"), "params.yaml: sample.mdm")
    return Mdm(load_checkpoint(sources.checkpoints / MDM.name, MDM, sources.device), sources.device, config)


MDM = vector_network("mdm", MdmConfig, MdmNetwork, MdmObjective)
FAMILY = Family("mdm", "MDM", _load, networks=(MDM,), uses=(MDM.name,))
