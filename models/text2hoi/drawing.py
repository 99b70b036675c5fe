"""The best of several motions drawn for one request: whose hands carry, that does as its verb says, and as is usual."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from hoidata.batches.requests import ObjectPoints
from hoidata.clips.clip import Clip
from models.text2hoi.verb_check import VerbCheck

ENOUGH = 0.5  # of the frames looked at: holds carry in all of them or in none


@dataclass(frozen=True)
class Drawn:
    """A motion's clip. carried: share of some frames in the air in which its hands can carry the object, 1 where no
    hold asked for it. moved_as: the verb whose training clips move the object most alike, None where that is not known
    (``VerbCheck``); other_verb: whether it is not what was asked. unusual: numbers of object and hands, in words, that
    lie outside the bounds of the verb's training clips; beyond: by how much the worst of them does, in widths of its
    bounds, 0 where none does. draws: how many motions were drawn for it.
    """

    clip: Clip
    carried: float = 1.0
    moved_as: str | None = None
    other_verb: bool = False
    unusual: tuple[str, ...] = ()
    beyond: float = 0.0
    draws: int = 1

    @property
    def goodness(self) -> tuple[int, float, float]:
        """How many of two things are so, that hands carry and that the verb is the one asked for; then how little is
        unusual, at most 0 (a motion of another verb nearly always is, and is not counted twice); then the share.
        """
        count = int(self.carried >= ENOUGH) + (not self.other_verb)
        return count, 0.0 if self.other_verb else -self.beyond, self.carried

    @property
    def needs_another(self) -> bool:
        """Whether it is to be drawn again."""
        return self.goodness[:2] != (2, 0.0)


AnyDrawn = TypeVar("AnyDrawn", bound=Drawn)


def checked(check: VerbCheck, clip: Clip, points: ObjectPoints, asked: str | None) -> dict[str, Any]:
    """What ``Drawn`` says of a motion and the verb asked for; points: of the object."""
    numbers = check.numbers(clip, points)
    moved_as = check.moved_as(numbers)
    return {
        "moved_as": moved_as,
        "other_verb": check.fails(asked, moved_as),
        "unusual": check.unusual(asked, numbers),
        "beyond": check.beyond(asked, numbers),
    }


def best_drawn(count: int, draws: int, draw: Callable[[Sequence[int], int], Sequence[AnyDrawn]]) -> list[AnyDrawn]:
    """The best of at most ``draws`` motions for each of ``count`` requests; the first of equals.

    draw: from the numbers of requests and which draw it is, from 1, to one motion for each of them.
    """
    best = list(draw(range(count), 1))
    for which in range(2, draws + 1):
        weak = [number for number, own in enumerate(best) if own.needs_another]
        if not weak:
            break
        for number, own in zip(weak, draw(weak, which), strict=True):
            kept = own if own.goodness > best[number].goodness else best[number]
            best[number] = replace(kept, draws=which)
    return best
