"""The Transformer encoder that denoiser and refiner share, over tokens of (agent, frames).

Text2HOI supplement, Table S8: self-attention and GELU feed-forward blocks with residuals, post-norm in the paper.
``norm_first`` puts the norms in front, which trains without warm-up; ``frames_per_token`` lets one token carry several
neighbouring frames of an agent (the paper: 1), which shortens the sequence where compute is scarce.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.attention import SDPBackend, sdpa_kernel

from hoidata.devices import send
from hoidata.errors import BadInput

NARROW = 4  # times narrower than the tokens
FUSED_FIRST: list[SDPBackend] = [SDPBackend.EFFICIENT_ATTENTION, SDPBackend.FLASH_ATTENTION, SDPBackend.MATH]


@dataclass(frozen=True)
class TransformerConfig:
    """Sizes of the encoder; the defaults are the paper's. modulated: a condition acts in every block (of pre-norm)."""

    width: int = 512
    layers: int = 8
    heads: int = 4
    feed_forward: int = 1024
    dropout: float = 0.1
    norm_first: bool = False
    frames_per_token: int = 1
    modulated: bool = False


class Modulation(nn.Module):
    """What a condition does to one half of a block: scale and shift of what it reads, scale of what it adds.

    Peebles and Xie 2023 (adaLN). Through a narrow layer, and starting with none, as without it.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        last = nn.Linear(width // NARROW, 3 * width)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(nn.SiLU(), nn.Linear(width, width // NARROW), nn.SiLU(), last)

    def forward(self, condition: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Factor, shift and factor (batch, 1, width) of a condition (batch, 1, width)."""
        scale, shift, share = self.layers(condition).chunk(3, -1)
        return 1 + scale, shift, 1 + share


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
        halves = 2 if config.modulated else 0
        self.modulations = nn.ModuleList([Modulation(config.width) for _ in range(halves)])

    def forward(self, x: Tensor, attention_mask: Tensor, condition: Tensor | None = None) -> Tensor:
        """x: (batch, token, width). attention_mask: (batch, token) bool, the tokens that may be attended to.

        condition: (batch, 1, width), which modulated blocks need and others do not look at.
        """
        if self.modulations:
            (scale, shift, share), (feed_scale, feed_shift, feed_share) = (own(condition) for own in self.modulations)
            attended = self.attend(self.norm_attention(x) * scale + shift, attention_mask)
            x = x + share * self.drop(attended)
            return x + feed_share * self.drop(self.feed_forward(self.norm_feed_forward(x) * feed_scale + feed_shift))
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
        # On CPUs plain matrix products train faster: the fused kernel's backward pass alone takes half a step.
        kernels = [SDPBackend.MATH] if x.device.type == "cpu" and torch.is_grad_enabled() else FUSED_FIRST
        with sdpa_kernel(kernels):
            mixed = functional.scaled_dot_product_attention(
                query, key, value, attention_mask[:, None, None], dropout_p=dropout
            )
        return self.out_proj(mixed.transpose(1, 2).reshape(batch, tokens, width))


class Encoder(nn.Module):
    """A stack of blocks; pre-norm stacks end with a norm. has_condition: the network gives one to every block."""

    def __init__(self, config: TransformerConfig, has_condition: bool = False) -> None:
        super().__init__()
        if config.modulated and not config.norm_first:
            raise BadInput("transformer", "norm_first: true with modulated: true", "norm_first: false", "set both")
        if config.modulated and not has_condition:
            wanted = "modulated: false in a network that has no condition for every block"
            raise BadInput("transformer", wanted, "modulated: true", "set it for Text2HOI's diffusion network only")
        self.blocks = nn.ModuleList([Block(config) for _ in range(config.layers)])
        self.last_norm = nn.LayerNorm(config.width) if config.norm_first else nn.Identity()

    def forward(self, x: Tensor, attention_mask: Tensor, condition: Tensor | None = None) -> Tensor:
        """(batch, token, width) to the same; the other arguments as in :class:`Block`."""
        x, attention_mask, back = packed(x, attention_mask)
        for block in self.blocks:
            x = block(x, attention_mask, condition)
        x = self.last_norm(x)
        return x if back is None else x.gather(1, back[..., None].expand(-1, -1, x.shape[-1]))


def packed(x: Tensor, attention_mask: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Tokens without those that nobody in the batch attends to, their mask, and where each token went (B, token).

    The order of tokens is free: positions are codes in them. A token that is left out comes back as some other.
    Only on CPUs: a GPU would have to wait for the number of tokens, and has room for all.
    """
    longest = int(attention_mask.sum(1).max()) if x.device.type == "cpu" else x.shape[1]
    if longest == x.shape[1]:
        return x, attention_mask, None
    order = attention_mask.int().argsort(dim=1, descending=True, stable=True)
    back = order.argsort(dim=1).clamp_max(longest - 1)
    kept = order[:, :longest]
    return x.gather(1, kept[..., None].expand(-1, -1, x.shape[-1])), attention_mask.gather(1, kept), back


def sinusoid(positions: Tensor, width: int) -> Tensor:
    """Sine and cosine codes (..., width) of positions (...,) (Vaswani et al. 2017, Sec. 3.5)."""
    half = width // 2
    rates = torch.exp(torch.arange(half, device=positions.device) * (-math.log(10_000.0) / half))
    angles = positions[..., None].float() * rates
    return torch.cat((angles.sin(), angles.cos()), -1)


# Text2HOI gives each agent one row of the frames' own table, far apart from each other: left, right, object.
AGENT_POSITIONS = (1, 1666, 3333)


def agent_codes(width: int, device: torch.device) -> Tensor:
    """(3, width) agent-wise position codes: left hand, right hand, object."""
    return sinusoid(send(torch.tensor(AGENT_POSITIONS), device), width)


def to_tokens(x: Tensor, frames_per_token: int) -> Tensor:
    """Frames (..., F, D) to tokens (..., ceil(F / k), k D), padded with zeros at the end."""
    spare = -x.shape[-2] % frames_per_token
    padded = functional.pad(x, (0, 0, 0, spare))
    return padded.reshape(*x.shape[:-2], -1, frames_per_token * x.shape[-1])


def to_frames(tokens: Tensor, n_frames: int, frames_per_token: int) -> Tensor:
    """The inverse of :func:`to_tokens`, cut to ``n_frames``."""
    return tokens.reshape(*tokens.shape[:-2], -1, tokens.shape[-1] // frames_per_token)[..., :n_frames, :]


def attention_mask_of(frames: Tensor, frames_per_token: int) -> Tensor:
    """(..., token) True where a token holds at least one frame of ``frames`` (..., F) bool."""
    return to_tokens(frames[..., None].float(), frames_per_token).amax(-1) > 0
