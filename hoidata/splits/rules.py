"""Which clips train, which validate, which test: a rule over the columns of a store's ``sequences``."""

import math
from collections import Counter, defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import pandas as pd

from hoidata.errors import BadInput
from hoidata.files import sha256_bytes

Part = Literal["train", "validation", "test"]
Kind = Literal[
    "subject",
    "object",
    "sequence",
    "prefix",
    "time",
    "rounds",
    "drawn",
    "drawn-per-object",
    "drawn-object",
    "composition",
]
PARTS: tuple[Part, ...] = get_args(Part)
KINDS: tuple[Kind, ...] = get_args(Kind)
IN_TIME = ("time", "rounds")
HELD_OUT = ("drawn-object", "composition")
DRAWN = ("drawn", "drawn-per-object")
BY_SHARE = (*IN_TIME, *DRAWN, *HELD_OUT)  # rules that list no names
REST = "rest"
# What a split without clips of a part means for what comes after it.
WITHOUT: dict[Part, str] = {
    "train": "no training clips: nothing is trained",
    "validation": "no validation clips: no threshold, seed or stopping point is chosen; the last weights are kept",
    "test": "no test clips: no motions are sampled and nothing is measured",
}
ROUND: tuple[Part, ...] = ("train", "train", "train", "validation", "test")
REMEDY = "mend params.yaml"
# What objects lie on belongs to the room: GRAB's table stands in every clip and is no reason to keep two apart.
FURNITURE = frozenset({"table"})


@dataclass(frozen=True)
class SplitRule:
    """How one dataset is split. A clip that no part covers is left out: it never trains silently.

    by "subject", "object", "sequence": the parts list names of that column. by "prefix": they list beginnings of
    sequence names (``subject3/k2/``). ``train`` is such a list, or "rest" for all clips the other two do not name.
    by "object": a clip that also shows an object of another part (but for a table) is left out.
    by "time": in every source sequence the last ``test_share`` of its clips test, the ``validation_share`` before
    them validate (rounded, at least one clip each where a sequence has three or more).
    by "rounds": in time order of every source sequence, of five successive clips three train, one validates, one tests
    (the shares are not used). For recordings whose end shows other actions than their beginning.
    by "drawn": whole source sequences in the order of the SHA-256 of their names; shares as by "time". For a dataset of
    which no list of sequences is known.
    by "drawn-per-object": the same among the sequences of every object (that of a sequence's first clip in time): each
    object tests, with its only sequence if it has no other, and validates where it has three or more.
    by "drawn-object": whole objects, of which every verb and hand type is also seen in training; shares of all clips.
    by "composition": whole compositions, each a verb, an object and a hand type that training has all three of, never
    together. A clip that shares frames with one of test (or of validation) but is of another part is left out.
    The last two raise BadInput where fewer than ``least_clips`` test, or a part has less than half its share.
    """

    by: Kind = "subject"
    train: tuple[str, ...] | Literal["rest"] = ()
    validation: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    validation_share: float = 0.15
    test_share: float = 0.15
    least_clips: int = 1

    def __post_init__(self) -> None:
        for part in PARTS:
            value = getattr(self, part)
            object.__setattr__(self, part, value if value == REST and part == "train" else _names(part, value))
        if self.by not in KINDS:
            raise BadInput("split rule: by", ", ".join(KINDS), repr(self.by), REMEDY)
        if self.by in BY_SHARE:
            self._check_shares()
        elif not self.train:
            raise BadInput("split rule: train", f"a list of names, or `{REST}` for all others", "nothing", REMEDY)
        else:
            self._check_parts_apart()

    def names(self, part: Part) -> tuple[str, ...]:
        """The names listed for a part; none for a train part that is the rest."""
        value = getattr(self, part)
        return () if value == REST else value

    def as_json(self) -> dict[str, Any]:
        """The rule as params.yaml and the definitions write it."""
        if self.by == "rounds":
            return {"by": self.by}
        if self.by in BY_SHARE:
            shares = {"validation_share": self.validation_share, "test_share": self.test_share}
            return {"by": self.by, **shares, **({"least_clips": self.least_clips} if self.by in HELD_OUT else {})}
        lists = {part: list(self.names(part)) for part in PARTS}
        return {"by": self.by, **lists, **({"train": REST} if self.train == REST else {})}

    def _check_shares(self) -> None:
        shares = (self.validation_share, self.test_share)
        if min(shares) < 0 or sum(shares) >= 1:
            raise BadInput("split rule", "shares of 0 or more that sum to less than 1", str(shares), REMEDY)
        if self.least_clips < 1:
            raise BadInput("split rule: least_clips", "1 clips or more", str(self.least_clips), REMEDY)

    def _check_parts_apart(self) -> None:
        listed = [(name, part) for part in PARTS for name in self.names(part)]
        for name, part in listed:
            for other, other_part in listed:
                covered = other.startswith(name) if self.by == "prefix" else other == name
                if part != other_part and covered:
                    raise BadInput("split rule", f"no {self.by} in two parts", f"{other} in several", REMEDY)


def _names(part: str, value: Any) -> tuple[str, ...]:
    if isinstance(value, str) or not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
        raise BadInput(f"split rule: {part}", "a list of names", repr(value), REMEDY)
    return tuple(value)


def missing_parts(clips: Mapping[str, int]) -> dict[str, str]:
    """By part of a split that has no clips, what that means. clips: how many each part has."""
    return {part: words for part, words in WITHOUT.items() if not clips[part]}


def assign_split(sequences: pd.DataFrame, rule: SplitRule) -> pd.Series:
    """ "train", "validation", "test", or None for a clip left out, under the index of a store's ``sequences``.

    Uses the columns clip_id, subject, object, other_objects, sequence, first_source_frame, last_source_frame, and of
    the annotation verb and hand_type, as far as the rule needs them. Does not depend on the order of the rows. Raises
    BadInput where too few clips can be held out.
    """
    rows = sequences.reset_index(drop=True)
    if rule.by in IN_TIME:
        parts = _in_time(rows, rule)
    elif rule.by in DRAWN:
        drawn = _drawn(rows["sequence"], rule) if rule.by == "drawn" else _drawn_per_object(rows, rule)
        parts = [drawn[name] for name in rows["sequence"]]
    elif rule.by == "prefix":
        parts = [_by_prefix(name, rule) for name in rows["sequence"]]
    elif rule.by == "object":
        parts = _by_object(rows, rule)
    elif rule.by in HELD_OUT:
        parts = _held_out(rows, rule)
    else:
        part_of = _part_of(rule)
        parts = [_listed(name, part_of, rule) for name in rows[rule.by]]
    return pd.Series(parts, index=sequences.index, name="split", dtype=object)


def _part_of(rule: SplitRule) -> dict[str, Part]:
    return {name: part for part in PARTS for name in rule.names(part)}


def _listed(name: str, part_of: Mapping[str, Part], rule: SplitRule) -> Part | None:
    return part_of[name] if name in part_of else _otherwise(rule)


def _otherwise(rule: SplitRule) -> Part | None:
    return "train" if rule.train == REST else None


def _by_prefix(sequence: str, rule: SplitRule) -> Part | None:
    found: list[Part] = [part for part in PARTS if sequence.startswith(rule.names(part))]
    return found[0] if found else _otherwise(rule)


def object_name(key: str) -> str:
    """The name of an object of a store: where two meshes share a name, its key carries a digest (``mug#1a2b3c4d``)."""
    return key.partition("#")[0]


def handled_objects(keys: Iterable[str]) -> list[str]:
    """Names of further objects of a clip, without what they lie on."""
    return [name for name in map(object_name, keys) if name not in FURNITURE]


def _by_object(rows: pd.DataFrame, rule: SplitRule) -> list[Part | None]:
    part_of = _part_of(rule)
    parts: list[Part | None] = []
    for name, others in zip(rows["object"], rows["other_objects"], strict=True):
        handled = [object_name(name), *handled_objects(others)]
        found: list[Part | None] = [_listed(key, part_of, rule) for key in handled]
        parts.append(found[0] if len(set(found)) == 1 else None)
    return parts


def composition(row: Mapping[str, Any]) -> str:
    """Verb, object and hand type of a clip, as one name."""
    return " | ".join((_verb(row), object_name(row["object"]), row["hand_type"]))


def _verb(row: Mapping[str, Any]) -> str:
    return "no verb" if pd.isna(row["verb"]) else row["verb"]


def _held_out(rows: pd.DataFrame, rule: SplitRule) -> list[Part | None]:
    clips: list[dict] = rows.to_dict("records")
    shares = {"test": rule.test_share, "validation": rule.validation_share}
    objects = [object_name(clip["object"]) for clip in clips]
    seen = [[("verb", _verb(clip)), ("hand", clip["hand_type"])] for clip in clips]
    parts: list[Any]
    if rule.by == "composition":
        seen = [[*words, ("object", name)] for words, name in zip(seen, objects, strict=True)]
        names = [composition(clip) for clip in clips]
        part_of = hold_out(names, seen, shares)
        ends = [(clip["first_source_frame"], clip["last_source_frame"]) for clip in clips]
        spans = [((clip["subject"], clip["sequence"]), *span) for clip, span in zip(clips, ends, strict=True)]
        parts = without_shared_frames(spans, [part_of.get(name, "train") for name in names], (*shares, "train"))
    else:
        part_of = hold_out(objects, seen, shares)
        test, validation = (tuple(name for name, part in part_of.items() if part == wanted) for wanted in shares)
        parts = _by_object(rows, SplitRule("object", REST, validation, test))
    _check_held_out(parts, seen, rule)
    return parts


def _check_held_out(parts: Sequence[Part | None], seen: Sequence[Sequence[tuple[str, str]]], rule: SplitRule) -> None:
    """Raise BadInput where a part is too small, or holds what training does not (after clips were left out)."""
    remedy = "choose another split, other shares, or clips in which the same verbs, objects and hands cross more often"
    least = {"test": max(rule.least_clips, rule.test_share * len(parts) / 2)} if rule.test_share else {}
    least |= {"validation": max(1, rule.validation_share * len(parts) / 2)} if rule.validation_share else {}
    for part, count in least.items() if len(parts) else ():
        if parts.count(part) < count:
            what = f"{math.ceil(count)} clips or more that can be held out for {part}"
            raise BadInput(f"split by {rule.by}", what, f"{parts.count(part)} of {len(parts)}", remedy)
    trained = {item for part, row in zip(parts, seen, strict=True) if part == "train" for item in row}
    held = {item for part, row in zip(parts, seen, strict=True) if part not in ("train", None) for item in row}
    if unseen := sorted(held - trained):
        got = ", ".join(f"{kind} {name}" for kind, name in unseen)
        raise BadInput(f"split by {rule.by}", "no verb, object or hand that training has not", got, remedy)


def _in_time(rows: pd.DataFrame, rule: SplitRule) -> list[Part | None]:
    parts: list[Part | None] = [None] * len(rows)
    ordered = rows.sort_values(["sequence", "first_source_frame", "clip_id"], kind="stable")
    for _, group in ordered.groupby("sequence"):
        found = _by_rounds(len(group)) if rule.by == "rounds" else _by_share(len(group), rule)
        for row, part in zip(group.index, found, strict=True):
            parts[row] = part
    return parts


def _by_share(n_clips: int, rule: SplitRule) -> Sequence[Part]:
    """Parts of the clips of one sequence, in time order; or of sequences, in the order drawn."""
    least = 1 if n_clips >= 3 else 0
    test = max(least, round(rule.test_share * n_clips)) if rule.test_share else 0
    validation = max(least, round(rule.validation_share * n_clips)) if rule.validation_share else 0
    validation = min(validation, n_clips - test)  # both may be rounded up
    return (*["train"] * (n_clips - validation - test), *["validation"] * validation, *["test"] * test)  # type: ignore[return-value]


def _drawn(sequences: Iterable[str], rule: SplitRule) -> dict[str, Part]:
    """Part of each sequence: with every sequence that is added few others change theirs."""
    names = sorted(set(sequences), key=lambda name: sha256_bytes(name.encode()))
    return dict(zip(names, _by_share(len(names), rule), strict=True))


def _drawn_per_object(rows: pd.DataFrame, rule: SplitRule) -> dict[str, Part]:
    first = rows.sort_values(["first_source_frame", "clip_id"], kind="stable").groupby("sequence")["object"].first()
    parts: dict[str, Part] = {}
    for _, own in first.groupby(first.map(object_name)):
        drawn = _drawn(own.index, rule)
        parts |= drawn
        if rule.test_share and "test" not in drawn.values():
            parts[list(drawn)[-1]] = "test"
    return parts


def _by_rounds(n_clips: int) -> Sequence[Part]:
    return [ROUND[place % len(ROUND)] for place in range(n_clips)]


def hold_out(groups: Sequence[str], seen: Sequence[Iterable[Hashable]], shares: Mapping[str, float]) -> dict[str, str]:
    """Part by group, of the groups that do not train: all they are made of is seen in training, only never together.

    groups: of every clip. seen: of every clip, what training must have a clip of if this one is held out. shares: of
    all clips, by part. Of the groups that bring a part nearer to its share, the one comes next of whose most held out
    content least is held out then (never all of it); among equals the first by the SHA-256 of its name.
    """
    content: dict[str, Counter[Hashable]] = defaultdict(Counter)
    for group, contents in zip(groups, seen, strict=True):
        content[group].update(contents)
    size, total = Counter(groups), sum(content.values(), Counter[Hashable]())
    held, part_of = Counter[Hashable](), dict[str, str]()
    missing = {part: share * len(groups) for part, share in shares.items() if share}

    def held_then(group: str) -> float:
        return max((held[item] + count) / total[item] for item, count in content[group].items())

    order = sorted(content, key=lambda name: sha256_bytes(name.encode()))
    while missing:
        part = max(missing, key=lambda name: missing[name] / shares[name])
        fitting = [name for name in order if name not in part_of and size[name] <= 2 * missing[part]]
        best = min(fitting, key=held_then, default=None)
        if best is None or held_then(best) >= 1:
            del missing[part]
            continue
        part_of[best] = part
        held += content[best]
        missing[part] -= size[best]
    return part_of


def without_shared_frames(
    spans: Sequence[tuple[Hashable, int, int]], parts: Sequence[str | None], order: Sequence[str]
) -> list[str | None]:
    """The parts, but None for a clip that shares frames with one of a part before its own in ``order``.

    spans: of every clip its sequence, first and last source frame.
    """
    kept: dict[Hashable, list[tuple[int, int, str]]] = defaultdict(list)
    found: list[str | None] = [None] * len(spans)
    for part in order:
        for row, (sequence, first, last) in enumerate(spans):
            others = (item for item in kept[sequence] if item[2] != part)
            if parts[row] == part and not any(first <= end and start <= last for start, end, _ in others):
                found[row] = part
                kept[sequence].append((first, last, part))
    return found
