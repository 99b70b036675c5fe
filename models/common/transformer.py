"""The Transformer encoder of denoisers and refiner, on tokens of (agent, frames).

Text2HOI supplement, Table S8: self-attention and GELU feed-forward blocks with residuals, post-norm in the paper.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.attention import SDPBackend, sdpa_kernel

from hoidata.devices import send
from hoidata.errors import BadInput

MODULATION_BOTTLENECK = 4  # times narrower than the tokens
FUSED_FIRST: list[SDPBackend] = [SDPBackend.EFFICIENT_ATTENTION, SDPBackend.FLASH_ATTENTION, SDPBackend.MATH]


@dataclass(frozen=True)
class TransformerConfig:
    """Sizes of the encoder; the defaults are the paper's."""

    width: int = 512
    layers: int = 8
    heads: int = 4
    feed_forward: int = 1024
    dropout: float = 0.1
    # LayerNorm before attention and feed-forward (pre-norm), which trains without warm-up.
    norm_first: bool = False
    # Neighbouring frames of an agent in one token; more make the sequence shorter. The paper has 1.
    frames_per_token: int = 1
    # Adaptive layer norm (adaLN): the condition scales and shifts every block. Needs ``norm_first``.
    adaptive_norm: bool = False


class Modulation(nn.Module):
    """Adaptive layer norm (Peebles and Xie 2023) of half a block: scale and shift of its input, gate of its output.

    A bottleneck layer keeps it small. It starts as the identity.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        last = nn.Linear(width // MODULATION_BOTTLENECK, 3 * width)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(nn.SiLU(), nn.Linear(width, width // MODULATION_BOTTLENECK), nn.SiLU(), last)

    def forward(self, condition: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scale, shift and gate (batch, 1, width) for a condition (batch, 1, width)."""
        scale, shift, gate = self.layers(condition).chunk(3, -1)
        return 1 + scale, shift, 1 + gate


class Block(nn.Module):
    """Self-attention, then feed-forward, each with a residual and a LayerNorm."""

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        self.heads, self.norm_first, self.dropout = config.heads, config.norm_first, config.dropout
        self.in_proj = nn.Linear(config.width, 3 * config.width)
        self.out_proj = nn.Linear(config.width, config.width)
        self.norm_attention, self.norm_feed_forward = nn.LayerNorm(config.width), nn.LayerNorm(config.width)
        self.feed_forward = nn.Sequential(
            nn.Linear(config.width, config.feed_forward),
            nn.GELU(),
            nn.Dropout(config.dropout),
            nn.Linear(config.feed_forward, config.width),
        )
        self.drop = nn.Dropout(config.dropout)
        halves = 2 if config.adaptive_norm else 0
        self.modulations = nn.ModuleList([Modulation(config.width) for _ in range(halves)])

    def forward(self, x: Tensor, attention_mask: Tensor, condition: Tensor | None = None) -> Tensor:
        """(batch, token, width) to the same.

        attention_mask: (batch, token) bool, tokens that can be attended to. condition: (batch, 1, width), read only
        with adaptive norm.
        """
        if self.modulations:
            (scale, shift, gate), (feed_scale, feed_shift, feed_gate) = (
                modulation(condition) for modulation in self.modulations
            )
            attended = self.attend(self.norm_attention(x) * scale + shift, attention_mask)
            x = x + gate * self.drop(attended)
            return x + feed_gate * self.drop(self.feed_forward(self.norm_feed_forward(x) * feed_scale + feed_shift))
        if self.norm_first:
            x = x + self.drop(self.attend(self.norm_attention(x), attention_mask))
            return x + self.drop(self.feed_forward(self.norm_feed_forward(x)))
        x = self.norm_attention(x + self.drop(self.attend(x, attention_mask)))
        return self.norm_feed_forward(x + self.drop(self.feed_forward(x)))

    def attend(self, x: Tensor, attention_mask: Tensor) -> Tensor:
        """Multi-head self-attention (Vaswani et al. 2017, eq. 1)."""
        batch, tokens, width = x.shape
        query, key, value = self.in_proj(x).reshape(batch, tokens, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        dropout = self.dropout if self.training else 0.0
        # On CPUs plain matrix products train faster: the fused kernel's backward pass takes half of a step.
        kernels = [SDPBackend.MATH] if x.device.type == "cpu" and torch.is_grad_enabled() else FUSED_FIRST
        with sdpa_kernel(kernels):
            mixed = functional.scaled_dot_product_attention(
                query, key, value, attention_mask[:, None, None], dropout_p=dropout
            )
        return self.out_proj(mixed.transpose(1, 2).reshape(batch, tokens, width))


class Encoder(nn.Module):
    """A stack of blocks; pre-norm stacks end with a norm. has_condition: whether blocks get a condition."""

    def __init__(self, config: TransformerConfig, has_condition: bool = False) -> None:
        super().__init__()
        if config.adaptive_norm and not config.norm_first:
            raise BadInput("transformer", "norm_first: true with adaptive_norm: true", "norm_first: false", "set both")
        if config.adaptive_norm and not has_condition:
            expected = "adaptive_norm: false in a network without a condition for its blocks"
            raise BadInput(
                "transformer", expected, "adaptive_norm: true", "set it for Text2HOI's diffusion network only"
            )
        self.blocks = nn.ModuleList([Block(config) for _ in range(config.layers)])
        self.last_norm = nn.LayerNorm(config.width) if config.norm_first else nn.Identity()

    def forward(self, x: Tensor, attention_mask: Tensor, condition: Tensor | None = None) -> Tensor:
        """(batch, token, width) to the same; the other arguments as in :class:`Block`."""
        x, attention_mask, restore = packed(x, attention_mask)
        for block in self.blocks:
            x = block(x, attention_mask, condition)
        x = self.last_norm(x)
        return x if restore is None else x.gather(1, restore[..., None].expand(-1, -1, x.shape[-1]))


def packed(x: Tensor, attention_mask: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Pack valid tokens at the front and cut the padding that all motions share.

    The order of tokens does not matter, because positions are encoded in them. On GPUs nothing is packed: reading the
    number of tokens would wait for the device. Returns tokens, their mask, and indices (B, token) that restore the
    order; None if nothing was packed. Restored padding has arbitrary values.
    """
    longest = int(attention_mask.sum(1).max()) if x.device.type == "cpu" else x.shape[1]
    if longest == x.shape[1]:
        return x, attention_mask, None
    order = attention_mask.int().argsort(dim=1, descending=True, stable=True)
    restore = order.argsort(dim=1).clamp_max(longest - 1)
    selected = order[:, :longest]
    return x.gather(1, selected[..., None].expand(-1, -1, x.shape[-1])), attention_mask.gather(1, selected), restore


def sinusoid(positions: Tensor, width: int) -> Tensor:
    """Sine and cosine codes (..., width) of positions (...,) (Vaswani et al. 2017, Sec. 3.5)."""
    half = width // 2
    rates = torch.exp(torch.arange(half, device=positions.device) * (-math.log(10_000.0) / half))
    angles = positions[..., None].float() * rates
    return torch.cat((angles.sin(), angles.cos()), -1)


# Text2HOI's code encodes each agent as a frame position, far from the others: left, right, object.
AGENT_POSITIONS = (1, 1666, 3333)


def agent_codes(width: int, device: torch.device) -> Tensor:
    """(3, width) agent-wise position codes: left hand, right hand, object."""
    return sinusoid(send(torch.tensor(AGENT_POSITIONS), device), width)


def to_tokens(x: Tensor, frames_per_token: int) -> Tensor:
    """Frames (..., F, D) to tokens (..., ceil(F / k), k D) of k frames, zero-padded at the end."""
    padding = -x.shape[-2] % frames_per_token
    padded = functional.pad(x, (0, 0, 0, padding))
    return padded.reshape(*x.shape[:-2], -1, frames_per_token * x.shape[-1])


def to_frames(tokens: Tensor, n_frames: int, frames_per_token: int) -> Tensor:
    """The inverse of :func:`to_tokens`, cut to ``n_frames``."""
    return tokens.reshape(*tokens.shape[:-2], -1, tokens.shape[-1] // frames_per_token)[..., :n_frames, :]


def attention_mask_of(frames: Tensor, frames_per_token: int) -> Tensor:
    """(..., token) bool: whether a token contains any of the valid ``frames`` (..., F) bool."""
    return to_tokens(frames[..., None].float(), frames_per_token).amax(-1) > 0
