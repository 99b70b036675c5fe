"""What a metric gives where it cannot be measured: the reason, in place of values."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Unmeasured:
    """No values of a motion, and why. Its length is 0, as that of an array without values.

    reason: in words; clips with the same cause have the same reason, so that reasons can be counted.
    """

    reason: str

    def __len__(self) -> int:
        return 0


Values = np.ndarray | Unmeasured
"""The values of one motion, (value,) float64, or why there are none."""

NO_INSIDE = Unmeasured("the object has no inside")
NO_GRAVITY = Unmeasured("gravity is not known")
RIGID = Unmeasured("the object has no hinge")
CHOSEN_LENGTH = Unmeasured("the family chose the length, so frames cannot be compared")


def reasons_in_words(reasons: Mapping[str, int]) -> str:
    """``the object has no inside: 257 clips``, most clips first."""
    most_first = sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    return "; ".join(f"{reason}: {count:,} clip{'s' * (count != 1)}" for reason, count in most_first)


def counted(reasons: Iterable[str]) -> dict[str, int]:
    """How many clips there are of each reason, by reason in alphabetical order."""
    return dict(sorted(Counter(reasons).items()))
