"""Outcome of one rule of the conformance check."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

SHOWN = 3


@dataclass(frozen=True)
class Finding:
    """A rule with its outcome."""

    rule: str  # as a sentence
    outcome: Literal["pass", "warn", "fail", "skip"]  # warn: suspicious, may be right; skip: not testable on this input
    detail: str = ""  # the first problems, or the reason for skipping


def finding(rule: str, problems: Sequence[str], outcome: Literal["fail", "warn"] = "fail") -> Finding:
    """Outcome "pass" without problems, else ``outcome`` with the first problems."""
    if not problems:
        return Finding(rule, "pass")
    rest = len(problems) - SHOWN
    return Finding(rule, outcome, "; ".join(problems[:SHOWN]) + (f"; and {rest} more" if rest > 0 else ""))


def skipped(rule: str, why: str) -> Finding:
    """The rule was not tried."""
    return Finding(rule, "skip", why)


def undecided(rule: str, why: str) -> Finding:
    """The input has too little data for a verdict."""
    return Finding(rule, "skip", f"not decided: {why}")
