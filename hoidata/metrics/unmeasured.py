"""The reason that a metric returns in place of values if it cannot be measured."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Unmeasured:
    """A motion without values of a metric. Its length is 0, as that of an array without values."""

    reason: str  # in words; the same cause gives the same words, so that reasons can be counted

    def __len__(self) -> int:
        return 0


Values = np.ndarray | Unmeasured
"""The values of one motion, (value,) float64, or the reason for none."""

NO_INSIDE = Unmeasured("the object has no inside")
NO_GRAVITY = Unmeasured("gravity is not known")
RIGID = Unmeasured("the object has no hinge")
CHOSEN_LENGTH = Unmeasured("the family chose the length, so frames cannot be compared")


def reasons_in_words(reasons: Mapping[str, int]) -> str:
    """Reasons with clip counts, most clips first, such as ``the object has no inside: 257 clips``."""
    most_first = sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    return "; ".join(f"{reason}: {count:,} clip{'s' * (count != 1)}" for reason, count in most_first)


def counted(reasons: Iterable[str]) -> dict[str, int]:
    """The number of clips of each reason, in alphabetical order of the reasons."""
    return dict(sorted(Counter(reasons).items()))
