"""Split rules: assign clips to train, validation and test from the columns of a store's ``sequences`` table."""

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
    "subject", "object", "sequence", "prefix", "time", "rounds", "drawn", "drawn-per-object", "drawn-object",
    "composition",
]  # fmt: skip
PARTS: tuple[Part, ...] = get_args(Part)
KINDS: tuple[Kind, ...] = get_args(Kind)
IN_TIME = ("time", "rounds")
HELD_OUT = ("drawn-object", "composition")
DRAWN = ("drawn", "drawn-per-object")
BY_SHARE = (*IN_TIME, *DRAWN, *HELD_OUT)  # rules that list no names
REST = "rest"
# The consequence of a part without clips; info.json and the page of a dataset state it.
CONSEQUENCE_OF_EMPTY_PART: dict[Part, str] = {
    "train": "no training clips: nothing is trained",
    "validation": "no validation clips: no threshold, seed or stopping point is chosen; the last weights are kept",
    "test": "no test clips: no motions are sampled and nothing is measured",
}
ROUND: tuple[Part, ...] = ("train", "train", "train", "validation", "test")
REMEDY = "correct params.yaml"
# GRAB's table is in every clip, so it does not count as an object that two parts share.
FURNITURE = frozenset({"table"})


@dataclass(frozen=True)
class SplitRule:
    """How one dataset is split. A clip that no part covers is excluded.

    Values of ``by``:

    - "subject", "object", "sequence": each part lists names of that column. With "object", a clip that also shows an
      object of another part is excluded; ``FURNITURE`` does not count.
    - "prefix": each part lists prefixes of sequence names, such as ``subject3/k2/``.
    - "time": the last clips of each source sequence are test clips, those before them validation clips. The numbers
      are rounded; a sequence of three or more clips gives each part at least one.
    - "rounds": of five successive clips of a source sequence, three are for training, one for validation, one for test.
      For recordings whose end shows other actions than their beginning. The shares are not used.
    - "drawn": whole source sequences, in the order of the SHA-256 of their names. For datasets without a published
      list of sequences.
    - "drawn-per-object": as "drawn", separately among the sequences of each object. Each object has a test sequence,
      and a validation sequence if it has three or more. A sequence belongs to the object of its first clip.
    - "drawn-object": whole objects whose verbs and hand types all occur in training.
    - "composition": whole compositions (verb, object, hand type) whose three components occur in training, but not
      together. A clip that overlaps a test clip, or a validation clip, of another composition is excluded.

    "drawn-object" and "composition" raise BadInput if fewer than ``least_clips`` clips are test clips, or if a part has
    less than half of its share.
    """

    by: Kind = "subject"
    train: tuple[str, ...] | Literal["rest"] = ()  # names, or "rest": all clips that the other two do not list
    validation: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    validation_share: float = 0.15  # fraction of the clips, or of the sequences with "drawn" and "drawn-per-object"
    test_share: float = 0.15
    least_clips: int = 1  # minimum number of test clips

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
        """Return the names listed for a part; none if the train part is "rest"."""
        value = getattr(self, part)
        return () if value == REST else value

    def as_json(self) -> dict[str, Any]:
        """Return the rule in the form of params.yaml and of the definitions."""
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
    """Return the consequence of each empty part. clips: number of clips by part."""
    return {part: consequence for part, consequence in CONSEQUENCE_OF_EMPTY_PART.items() if not clips[part]}


def assign_split(sequences: pd.DataFrame, rule: SplitRule) -> pd.Series:
    """Assign each clip to "train", "validation", "test" or None (excluded), whatever the order of the clips.

    sequences: a store's ``sequences`` table, whose index the result has. The columns clip_id, subject, object,
    other_objects, sequence, first_source_frame and last_source_frame are used, and verb and hand_type of the
    annotation. Raises BadInput if too few clips can be held out.
    """
    clips = sequences.reset_index(drop=True)
    if rule.by in IN_TIME:
        parts = _in_time(clips, rule)
    elif rule.by in DRAWN:
        part_of = _drawn(clips["sequence"], rule) if rule.by == "drawn" else _drawn_per_object(clips, rule)
        parts = [part_of[name] for name in clips["sequence"]]
    elif rule.by == "prefix":
        parts = [_by_prefix(name, rule) for name in clips["sequence"]]
    elif rule.by == "object":
        parts = _by_object(clips, rule)
    elif rule.by in HELD_OUT:
        parts = _held_out(clips, rule)
    else:
        listed = _listed_parts(rule)
        parts = [listed.get(name, _unlisted_part(rule)) for name in clips[rule.by]]
    return pd.Series(parts, index=sequences.index, name="split", dtype=object)


def _listed_parts(rule: SplitRule) -> dict[str, Part]:
    return {name: part for part in PARTS for name in rule.names(part)}


def _unlisted_part(rule: SplitRule) -> Part | None:
    return "train" if rule.train == REST else None


def _by_prefix(sequence: str, rule: SplitRule) -> Part | None:
    matching: list[Part] = [part for part in PARTS if sequence.startswith(rule.names(part))]
    return matching[0] if matching else _unlisted_part(rule)


def object_name(key: str) -> str:
    """Return the name in an object's key: ``mug`` of ``mug#1a2b3c4d``, the key if several meshes are called mug."""
    return key.partition("#")[0]


def handled_objects(keys: Iterable[str]) -> list[str]:
    """Return the names of a clip's further objects, without ``FURNITURE``."""
    return [name for name in map(object_name, keys) if name not in FURNITURE]


def _by_object(clips: pd.DataFrame, rule: SplitRule) -> list[Part | None]:
    listed: dict[str, Part | None] = {**_listed_parts(rule)}
    parts: list[Part | None] = []
    for name, others in zip(clips["object"], clips["other_objects"], strict=True):
        handled = [object_name(name), *handled_objects(others)]
        object_parts: set[Part | None] = set()
        object_parts.update(listed.get(key, _unlisted_part(rule)) for key in handled)
        parts.append(object_parts.pop() if len(object_parts) == 1 else None)
    return parts


def composition(clip: Mapping[str, Any]) -> str:
    """Return verb, object and hand type of a clip as one name. clip: its row of ``sequences``, with annotation."""
    return " | ".join((_verb(clip), object_name(clip["object"]), clip["hand_type"]))


def _verb(clip: Mapping[str, Any]) -> str:
    return "no verb" if pd.isna(clip["verb"]) else clip["verb"]


def _held_out(sequences: pd.DataFrame, rule: SplitRule) -> list[Part | None]:
    clips: list[dict] = sequences.to_dict("records")
    shares = {"test": rule.test_share, "validation": rule.validation_share}
    objects = [object_name(clip["object"]) for clip in clips]
    components = [[("verb", _verb(clip)), ("hand", clip["hand_type"])] for clip in clips]
    parts: list[Any]
    if rule.by == "composition":
        components = [[*pair, ("object", name)] for pair, name in zip(components, objects, strict=True)]
        names = [composition(clip) for clip in clips]
        part_of = hold_out(names, components, shares)
        ends = [(clip["first_source_frame"], clip["last_source_frame"]) for clip in clips]
        spans = [((clip["subject"], clip["sequence"]), *span) for clip, span in zip(clips, ends, strict=True)]
        parts = without_shared_frames(spans, [part_of.get(name, "train") for name in names], (*shares, "train"))
    else:
        part_of = hold_out(objects, components, shares)
        test, validation = (tuple(name for name in part_of if part_of[name] == part) for part in shares)
        parts = _by_object(sequences, SplitRule("object", train=REST, validation=validation, test=test))
    _check_held_out(parts, components, rule)
    return parts


def _check_held_out(
    parts: Sequence[Part | None], components: Sequence[Sequence[tuple[str, str]]], rule: SplitRule
) -> None:
    """Raise BadInput if a part is too small or has a component that training has not, without the excluded clips."""
    remedy = "choose another split, other shares, or clips in which verbs, objects and hands are combined more often"
    least = {"test": max(rule.least_clips, rule.test_share * len(parts) / 2)} if rule.test_share else {}
    least |= {"validation": max(1, rule.validation_share * len(parts) / 2)} if rule.validation_share else {}
    for part, count in least.items() if len(parts) else ():
        if parts.count(part) < count:
            expected = f"{math.ceil(count)} clips or more that can be held out for {part}"
            raise BadInput(f"split by {rule.by}", expected, f"{parts.count(part)} of {len(parts)}", remedy)
    in_training: set[tuple[str, str]] = set()
    held_out: set[tuple[str, str]] = set()
    for part, items in zip(parts, components, strict=True):
        if part is not None:
            (in_training if part == "train" else held_out).update(items)
    if unseen := sorted(held_out - in_training):
        got = ", ".join(f"{kind} {name}" for kind, name in unseen)
        raise BadInput(f"split by {rule.by}", "no verb, object or hand that training has not", got, remedy)


def _in_time(clips: pd.DataFrame, rule: SplitRule) -> list[Part | None]:
    parts: list[Part | None] = [None] * len(clips)
    ordered = clips.sort_values(["sequence", "first_source_frame", "clip_id"], kind="stable")
    for _, group in ordered.groupby("sequence"):
        rounds: Sequence[Part] = [ROUND[number % len(ROUND)] for number in range(len(group))]
        group_parts = rounds if rule.by == "rounds" else _by_share(len(group), rule)
        for clip, part in zip(group.index, group_parts, strict=True):
            parts[clip] = part
    return parts


def _by_share(n_clips: int, rule: SplitRule) -> Sequence[Part]:
    """Parts of the clips of one sequence in time order, or of sequences in the order of their digests."""
    least = 1 if n_clips >= 3 else 0
    test = max(least, round(rule.test_share * n_clips)) if rule.test_share else 0
    validation = max(least, round(rule.validation_share * n_clips)) if rule.validation_share else 0
    validation = min(validation, n_clips - test)  # both may be rounded up
    return (*["train"] * (n_clips - validation - test), *["validation"] * validation, *["test"] * test)  # type: ignore[return-value]


def _drawn(sequences: Iterable[str], rule: SplitRule) -> dict[str, Part]:
    """Part of each sequence. Adding a sequence changes the part of few others, because digests give the order."""
    names = sorted(set(sequences), key=lambda name: sha256_bytes(name.encode()))
    return dict(zip(names, _by_share(len(names), rule), strict=True))


def _drawn_per_object(clips: pd.DataFrame, rule: SplitRule) -> dict[str, Part]:
    in_time = clips.sort_values(["first_source_frame", "clip_id"], kind="stable")
    first_object = in_time.groupby("sequence")["object"].first()
    parts: dict[str, Part] = {}
    for _, sequences in first_object.groupby(first_object.map(object_name)):
        object_parts = _drawn(sequences.index, rule)
        parts |= object_parts
        if rule.test_share and "test" not in object_parts.values():
            parts[list(object_parts)[-1]] = "test"
    return parts


def hold_out(
    groups: Sequence[str], components: Sequence[Iterable[Hashable]], fractions: Mapping[str, float]
) -> dict[str, str]:
    """Choose groups to hold out such that training has each of their components in other groups.

    Greedy: the next group is one that brings a part closer to its size. Among these it is the group whose most held-out
    component is held out the least, never completely. The SHA-256 of the name decides between equal groups.

    groups, components: of each clip. fractions: by part, the fraction of all clips that it gets. Returns the part of
    each held-out group.
    """
    counts: dict[str, Counter[Hashable]] = defaultdict(Counter)
    for group, items in zip(groups, components, strict=True):
        counts[group].update(items)
    size, total = Counter(groups), sum(counts.values(), Counter[Hashable]())
    held_out, part_of = Counter[Hashable](), dict[str, str]()
    missing = {part: fraction * len(groups) for part, fraction in fractions.items() if fraction}

    def largest_fraction_with(group: str) -> float:
        return max((held_out[item] + count) / total[item] for item, count in counts[group].items())

    order = sorted(counts, key=lambda name: sha256_bytes(name.encode()))
    while missing:
        part = max(missing, key=lambda name: missing[name] / fractions[name])
        fitting = [name for name in order if name not in part_of and size[name] <= 2 * missing[part]]
        best = min(fitting, key=largest_fraction_with, default=None)
        if best is None or largest_fraction_with(best) >= 1:
            del missing[part]
            continue
        part_of[best] = part
        held_out += counts[best]
        missing[part] -= size[best]
    return part_of


def without_shared_frames(
    spans: Sequence[tuple[Hashable, int, int]], parts: Sequence[str | None], order: Sequence[str]
) -> list[str | None]:
    """Exclude clips (None) that share frames with a clip of a part that is earlier in ``order``.

    spans: sequence, first and last source frame of each clip.
    """
    used: dict[Hashable, list[tuple[int, int, str]]] = defaultdict(list)
    disjoint: list[str | None] = [None] * len(spans)
    for part in order:
        for clip, (sequence, first, last) in enumerate(spans):
            others = (span for span in used[sequence] if span[2] != part)
            if parts[clip] == part and not any(first <= end and start <= last for start, end, _ in others):
                disjoint[clip] = part
                used[sequence].append((first, last, part))
    return disjoint
