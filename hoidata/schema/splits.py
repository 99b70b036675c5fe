"""Which clips train, which validate, which test: by subject, or by time where there is one subject."""

from collections import defaultdict
from dataclasses import dataclass
from typing import Literal

import pandas as pd

from hoidata.errors import BadInput

SPLITS = ("train", "validation", "test")
ROUND = ("train", "train", "train", "validation", "test")


@dataclass(frozen=True)
class SplitRule:
    """How one dataset is split.

    by "subject": clips of the subjects in ``validation`` and ``test`` go there, all others train.
    by "time": in every source sequence the last ``test_share`` of its clips test, the ``validation_share`` before
    them validate (rounded, at least one clip each where a sequence has three or more).
    by "rounds": in time order of every source sequence, of five successive clips three train, one validates, one tests
    (the shares are not used). For recordings whose end shows other actions than their beginning.
    """

    by: Literal["subject", "time", "rounds"] = "subject"
    validation: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    validation_share: float = 0.15
    test_share: float = 0.15

    def __post_init__(self) -> None:
        object.__setattr__(self, "validation", tuple(self.validation))
        object.__setattr__(self, "test", tuple(self.test))
        if self.by not in ("subject", "time", "rounds"):
            raise BadInput("split rule: by", "subject, time or rounds", repr(self.by), "mend params.yaml")
        shared = sorted(set(self.validation) & set(self.test))
        if shared:
            raise BadInput("split rule", "no subject in both validation and test", str(shared), "mend params.yaml")
        shares = (self.validation_share, self.test_share)
        if min(shares) < 0 or sum(shares) >= 1:
            raise BadInput("split rule", "shares of 0 or more that sum to less than 1", str(shares), "mend params.yaml")


def assign_split(sequences: pd.DataFrame, rule: SplitRule) -> pd.Series:
    """ "train", "validation" or "test" for every row of a store's ``sequences``, under the table's own index.

    Uses the columns clip_id, subject, sequence, first_source_frame and last_source_frame. Does not depend on the order
    of the rows. Raises BadInput when a part would share a subject, or frames, with another (``check_no_leak``).
    """
    rows = sequences.reset_index(drop=True)
    split = pd.Series("train", index=rows.index, name="split", dtype=object)
    if rule.by == "subject":
        split[rows["subject"].isin(rule.validation)] = "validation"
        split[rows["subject"].isin(rule.test)] = "test"
    else:
        ordered = rows.sort_values(["sequence", "first_source_frame", "clip_id"], kind="stable")
        for _, group in ordered.groupby("sequence"):
            split.loc[group.index] = _by_rounds(len(group)) if rule.by == "rounds" else _by_time(len(group), rule)
    check_no_leak(rows, split, rule)
    return split.set_axis(sequences.index)


def _by_time(n_clips: int, rule: SplitRule) -> list[str]:
    """Parts of the clips of one sequence, in time order."""
    least = 1 if n_clips >= 3 else 0
    test = max(least, round(rule.test_share * n_clips)) if rule.test_share else 0
    validation = max(least, round(rule.validation_share * n_clips)) if rule.validation_share else 0
    return ["train"] * (n_clips - validation - test) + ["validation"] * validation + ["test"] * test


def _by_rounds(n_clips: int) -> list[str]:
    return [ROUND[place % len(ROUND)] for place in range(n_clips)]


def check_no_leak(sequences: pd.DataFrame, split: pd.Series, rule: SplitRule) -> None:
    """Raise BadInput when parts share what the rule keeps apart: subjects, or source frames of one sequence."""
    rows = sequences.reset_index(drop=True).to_dict("records")
    parts_of: dict[str, set[str]] = defaultdict(set)
    clips_of: dict[tuple[str, str], list[tuple[int, int, str, str]]] = defaultdict(list)
    for row, part in zip(rows, split, strict=True):
        parts_of[row["subject"]].add(part)
        span = (row["first_source_frame"], row["last_source_frame"], part, row["clip_id"])
        clips_of[row["subject"], row["sequence"]].append(span)
    leaking = sorted(subject for subject, parts in parts_of.items() if len(parts) > 1)
    if rule.by == "subject" and leaking:
        raise BadInput("split", "every subject in one part", f"{leaking} in several", "mend the split rule")
    for spans in clips_of.values():
        _check_apart(sorted(spans))


def _check_apart(spans: list[tuple[int, int, str, str]]) -> None:
    """spans: (first frame, last frame, part, clip id) of one sequence, sorted."""
    last_of: dict[str, tuple[int, str]] = {}
    for first, last, part, clip_id in spans:
        for other, (other_last, other_id) in last_of.items():
            if other != part and first <= other_last:
                got = f"{other_id} ({other}) and {clip_id} ({part}) overlap"
                raise BadInput("split", "no frame in two parts", got, "split this dataset by subject")
        last_of[part] = max(last_of.get(part, (last, clip_id)), (last, clip_id))
