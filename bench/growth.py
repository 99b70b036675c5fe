"""Does a cost grow in a straight line with the number of clips? What a run costs however small it is stands apart."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from bench.harness import show

ALLOWED = 0.2  # of a straight line
PER_CLIPS = 1000


class Growth(NamedTuple):
    """Costs of the last three sizes. fixed: what is left of the last when its clips are taken off at ``later`` each.

    earlier, later: of a further clip, between the first two sizes and between the last two.
    """

    fixed: float
    earlier: float
    later: float

    @property
    def verdict(self) -> str:
        if not self.earlier:
            return "does not grow"
        ratio = self.later / self.earlier
        if ratio > 1 + ALLOWED:
            return f"MORE THAN LINEAR ({ratio:.2f})"
        return (
            f"linear within {ALLOWED:.0%} ({ratio:.2f})" if ratio >= 1 - ALLOWED else f"less than linear ({ratio:.2f})"
        )


def growth(clips: Sequence[int], costs: Sequence[float]) -> Growth:
    """Of the last three of corpora of so many clips and their costs."""
    (n0, n1, n2), (c0, c1, c2) = clips[-3:], costs[-3:]
    later = (c2 - c1) / (n2 - n1)
    return Growth(c2 - later * n2, (c1 - c0) / (n1 - n0), later)


def show_growth(title: str, clips: Sequence[int], lines: Mapping[str, Sequence[float]]) -> None:
    """One row per cost, by its name and unit. clips: of each size."""
    if len(clips) < 3:
        print("growth: three shares are needed to tell a fixed part from one per clip")
        return
    rows = []
    for name, costs in lines.items():
        found = growth(clips, costs)
        whole = [f"{cost:,.1f}" for cost in costs[-2:]]
        further = [f"{cost * PER_CLIPS:,.2f}" for cost in (found.earlier, found.later)]
        rows.append([name, *whole, f"{found.fixed:,.1f}", *further, found.verdict])
    n0, n1, n2 = clips[-3:]
    steps = [f"per {PER_CLIPS:,} further clips, {n0:,} to {n1:,}", f"{n1:,} to {n2:,}"]
    show(title, ["", f"{n1:,} clips", f"{n2:,} clips", "fixed part", *steps, "growth"], rows)
