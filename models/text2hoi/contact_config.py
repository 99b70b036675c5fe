"""Settings of the contact networks."""

from dataclasses import dataclass, field
from typing import Literal

from models.common.point_net import PointNetConfig

HAND_FLAGS = 2


@dataclass(frozen=True)
class ContactConfig:
    """Sizes; the defaults are the paper's.

    drawn_by: what a sample is drawn by: the paper's Gaussian latent, which gives one map for both hands, or anchors,
    touched points of each hand drawn one after the other (``anchored_contact``), which gives a map for each.
    """

    point_net: PointNetConfig = field(default_factory=PointNetConfig)
    decoder_widths: tuple[int, int, int] = (512, 256, 128)
    latent: int = 64
    drawn_by: Literal["latent", "anchor"] = "latent"


@dataclass(frozen=True)
class ContactLossConfig:
    """Weights of KL divergence, Dice term, and the cross-entropy of anchors, beside a map's cross-entropy.

    points: how many points of every object a step sees, drawn anew each time.
    """

    kl_weight: float = 1.0
    dice_weight: float = 1.0
    touch_weight: float = 0.1
    points: int = 1024
