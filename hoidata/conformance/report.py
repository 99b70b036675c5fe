"""One rule of the conformance check and how it came out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

SHOWN = 3


@dataclass(frozen=True)
class Finding:
    """rule: what must hold, as a sentence; outcome: detail: what was seen.

    "warn": it looks wrong but may be right. "skip": it could not be tried on this input; ``detail`` says why.
    """

    rule: str
    outcome: Literal["pass", "warn", "fail", "skip"]
    detail: str = ""


def finding(rule: str, problems: Sequence[str], outcome: Literal["fail", "warn"] = "fail") -> Finding:
    """Passed when there are no problems, else ``outcome`` with the first of them."""
    if not problems:
        return Finding(rule, "pass")
    rest = len(problems) - SHOWN
    return Finding(rule, outcome, "; ".join(problems[:SHOWN]) + (f"; and {rest} more" if rest > 0 else ""))


def skipped(rule: str, why: str) -> Finding:
    return Finding(rule, "skip", why)


def undecided(rule: str, why: str) -> Finding:
    """There is too little in the input for a verdict, good or bad."""
    return Finding(rule, "skip", f"not decided: {why}")
