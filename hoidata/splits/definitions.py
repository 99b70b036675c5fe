"""Named splits, stored as JSON in the dataset's folder (``splits/<name>.json`` with rule, source, version); leak check.

``definitions/`` next to this module has the values that several datasets share; the dataset's file overrides them.
A split of ``OF_ANY_DATASET`` needs no file in the dataset's folder. The leak check finds subjects, objects, files or
frames that are in two parts of a split although they must not be.
"""

import fnmatch
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

import orjson
import pandas as pd

from hoidata.dataset_folders import dataset_facts, dataset_folder
from hoidata.errors import BadInput
from hoidata.settings import build_config
from hoidata.splits.rules import KINDS, SplitRule, composition, handled_objects, object_name

Promise = Literal["subject", "object", "sequence", "file", "frame", "motion", "composition"]
PROMISES: tuple[Promise, ...] = get_args(Promise)
ALWAYS: tuple[Promise, ...] = ("frame", "motion")
MAX_LISTED = 20


@dataclass(frozen=True)
class Leaks:
    """What two parts of a split have in common.

    Kinds: subject; object (manipulated or only visible); sequence of the source; file (raw motion file); frame (two
    overlapping clips of one sequence); motion (clips with equal arrays, copies under different names); composition
    (verb, object and hand type together, checked only if the split promises it).
    """

    promised: tuple[Promise, ...]  # kinds that the split keeps apart
    shared: Mapping[Promise, tuple[str, ...]]  # by kind, sorted names that are in more than one part

    @property
    def broken(self) -> tuple[Promise, ...]:
        """The promised kinds that are shared nevertheless."""
        return tuple(kind for kind in self.promised if self.shared[kind])

    def as_json(self) -> dict[str, Any]:
        """Per kind: whether the split promises it, the number of shared names, and the first ``MAX_LISTED``."""
        return {
            kind: {"promised": kind in self.promised, "in_two_parts": len(names), "first": list(names[:MAX_LISTED])}
            for kind, names in self.shared.items()
        }


def find_leaks(
    sequences: pd.DataFrame,
    parts: Mapping[str, str | None],
    promises: Iterable[Promise],
    *,
    files: Sequence[str] = (),
    motion_files: Sequence[str] = (),
    digests: Mapping[str, str] | None = None,
) -> Leaks:
    """Find everything that two parts share. Excluded clips (None, or not in ``parts``) share nothing.

    Args:
        sequences: a store's ``sequences`` table, with the annotation's verb and hand_type if compositions are promised.
        parts: part by clip id.
        promises: kinds that the split keeps apart.
        files: path of each raw file, indexed by the numbers in ``source_files``.
        motion_files: patterns of the raw files with motion; other files (meshes, templates) may serve all parts.
        digests: digest of the motion by clip id.
    """
    clips = [clip for clip in sequences.to_dict("records") if parts.get(clip["clip_id"])]
    part_of = [str(parts[clip["clip_id"]]) for clip in clips]
    promises = tuple(promises)
    keys = {
        "subject": [[clip["subject"]] for clip in clips],
        "object": [[object_name(clip["object"]), *handled_objects(clip["other_objects"])] for clip in clips],
        "sequence": [[clip["sequence"]] for clip in clips],
        "file": [_motion_paths(clip, files, motion_files) for clip in clips],
    }
    if "composition" in promises:
        keys["composition"] = [[composition(clip)] for clip in clips]
    shared: dict[Promise, tuple[str, ...]] = {kind: _in_two_parts(keys[kind], part_of) for kind in keys}  # type: ignore[misc]
    shared["frame"] = _overlaps(clips, part_of)
    shared["motion"] = _copies(clips, part_of, digests or {})
    return Leaks(tuple(kind for kind in PROMISES if kind in {*promises, *ALWAYS}), shared)


def _motion_paths(clip: Mapping[str, Any], files: Sequence[str], patterns: Sequence[str]) -> list[str]:
    paths = [files[int(number)] for number in clip["source_files"]] if len(files) else []
    return [path for path in paths if any(fnmatch.fnmatch(path, pattern) for pattern in patterns)]


def _in_two_parts(keys: list[list[str]], part_of: list[str]) -> tuple[str, ...]:
    parts_of_name: dict[str, set[str]] = defaultdict(set)
    for names, part in zip(keys, part_of, strict=True):
        for name in names:
            parts_of_name[name].add(part)
    return tuple(sorted(name for name, parts in parts_of_name.items() if len(parts) > 1))


def _copies(clips: list[dict[str, Any]], part_of: list[str], digests: Mapping[str, str]) -> tuple[str, ...]:
    copies: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for clip, part in zip(clips, part_of, strict=True):
        if clip["clip_id"] in digests:
            copies[digests[clip["clip_id"]]].append((clip["clip_id"], part))
    copied = [sorted(same) for same in copies.values() if len({part for _, part in same}) > 1]
    return tuple(sorted(" = ".join(clip_id for clip_id, _ in same) for same in copied))


def _overlaps(clips: list[dict[str, Any]], part_of: list[str]) -> tuple[str, ...]:
    """Pairs of clips of one sequence, in different parts, that share source frames.

    Each clip is compared with the clip of every other part that ends last among those before it.
    """
    spans: dict[tuple[str, str], list[tuple[int, int, str, str]]] = defaultdict(list)
    for clip, part in zip(clips, part_of, strict=True):
        span = (clip["first_source_frame"], clip["last_source_frame"], part, clip["clip_id"])
        spans[clip["subject"], clip["sequence"]].append(span)
    return tuple(sorted(pair for group in spans.values() for pair in _overlapping(sorted(group))))


def _overlapping(spans: list[tuple[int, int, str, str]]) -> Iterable[str]:
    """Yield overlapping pairs. spans: (first frame, last frame, part, clip id) of one sequence, sorted."""
    last_of: dict[str, tuple[int, str]] = {}
    for first, last, part, clip_id in spans:
        for other, (other_last, other_id) in last_of.items():
            if other != part and first <= other_last:
                yield f"{other_id} ({other}) and {clip_id} ({part}) overlap"
        last_of[part] = max(last_of.get(part, (last, clip_id)), (last, clip_id))


FOLDER = Path(__file__).with_name("definitions")
OF_ANY_DATASET = ("composition", "drawn-object", "drawn-per-object")
CUSTOM_NAME = "params.yaml"
CUSTOM_SOURCE = "a rule of this project's params.yaml"
RULE_KEYS = tuple(field.name for field in fields(SplitRule))
# What a rule keeps apart by default. Only rules in time put clips of one sequence into different parts.
DEFAULT_PROMISES: dict[str, tuple[Promise, ...]] = {
    "subject": ("subject", "sequence", "file"),
    "object": ("object",),
    "sequence": ("sequence", "file"),
    "prefix": ("sequence", "file"),
    "time": (),
    "rounds": (),
    "drawn": ("sequence", "file"),
    "drawn-per-object": ("sequence", "file"),
    "drawn-object": ("object",),
    "composition": ("composition",),
}


@dataclass(frozen=True)
class Definition:
    """A named split of one dataset."""

    name: str
    version: int  # counts changes of the definition
    source: str  # paper or authors of the split
    rule: SplitRule
    promises: tuple[Promise, ...]  # what no two parts have in common
    if_chosen: bool = False  # the stage writes this split only if params.yaml chooses it

    def as_json(self) -> dict[str, Any]:
        facts = {"name": self.name, "version": self.version, "source": self.source}
        return facts | {"rule": self.rule.as_json(), "promises": list(self.promises)}


def definitions_for(dataset: str) -> dict[str, Definition]:
    """Return the named splits of a dataset: those in its folder and ``OF_ANY_DATASET``, by name."""
    folder = dataset_folder(dataset)
    dataset_paths = [] if folder is None else (folder / "splits").glob("*.json")
    paths = {path.stem: path for path in (*(FOLDER / f"{name}.json" for name in OF_ANY_DATASET), *dataset_paths)}
    return {name: _read(paths[name]) for name in sorted(paths)}


def choose(dataset: str, choice: str | Mapping[str, Any] | None) -> Definition:
    """Return the split that params.yaml chooses for a dataset, by default the one that the dataset's facts name.

    choice: name of a split, a custom rule (keys as in ``SplitRule``), or None if params.yaml has no entry. Raises
    BadInput for an unknown name or key; the message lists the valid ones.
    """
    setting, definitions = f"params.yaml: split.{dataset}", definitions_for(dataset)
    facts = dataset_facts(dataset)
    choice = facts.split or None if facts and choice is None else choice
    if isinstance(choice, Mapping):
        return _custom(setting, dataset, choice)
    if choice not in definitions:
        got = "nothing" if choice is None else repr(choice)
        remedy = "correct it, or write a rule: {by: subject, train: rest, validation: [s9], test: [s10]}"
        raise BadInput(setting, f"one of: {', '.join(definitions)}", got, remedy)
    return definitions[choice]


def _custom(setting: str, dataset: str, values: Mapping[str, Any]) -> Definition:
    rule, promises = _rule_and_promises(setting, values)
    motion_files = published(dataset).motion_files
    if not motion_files and "file" in values.get("promises", ()):
        remedy = f"take it out: the files of {dataset} that contain motion are not listed in its published.json"
        raise BadInput(f"{setting}.promises", "promises that can be checked", "file", remedy)
    checked: list[Promise] = [promise for promise in promises if promise != "file" or motion_files]
    return Definition(name=CUSTOM_NAME, version=0, source=CUSTOM_SOURCE, rule=rule, promises=tuple(checked))


def _rule_and_promises(source: str, values: Mapping[str, Any]) -> tuple[SplitRule, tuple[Promise, ...]]:
    unknown = sorted(map(str, values.keys() - {*RULE_KEYS, "promises"}))
    if unknown or "by" not in values:
        expected = f"keys among: {', '.join(RULE_KEYS)}, promises; by: {', '.join(KINDS)}"
        raise BadInput(source, expected, ", ".join(unknown) or "no `by`", "correct it")
    try:
        rule = SplitRule(**{key: value for key, value in values.items() if key != "promises"})
    except TypeError as error:
        raise BadInput(source, "shares and least_clips as numbers", str(error), "correct it") from error
    promises = values.get("promises", DEFAULT_PROMISES[rule.by])
    if not isinstance(promises, list | tuple) or not set(promises) <= set(PROMISES):
        raise BadInput(f"{source}.promises", f"a list of: {', '.join(PROMISES)}", repr(promises), "correct it")
    return rule, tuple(promises)


@lru_cache
def _read(path: Path) -> Definition:
    """Read one dataset's definition of a named split."""
    general = FOLDER / path.name
    try:
        values = (orjson.loads(general.read_bytes()) if general.is_file() else {}) | orjson.loads(path.read_bytes())
    except (orjson.JSONDecodeError, TypeError) as error:
        raise BadInput(path, "a JSON object", str(error), "correct it") from error
    origin, if_chosen = {key: values.pop(key, None) for key in ("version", "source")}, values.pop("if_chosen", False)
    if not all(origin.values()):
        raise BadInput(path, "the split's version and source", f"{origin}", "state them there")
    rule, promises = _rule_and_promises(str(path), values)
    return Definition(path.stem, rule=rule, promises=promises, if_chosen=bool(if_chosen), **origin)


@dataclass(frozen=True)
class Published:
    """Contents of a dataset's ``published.json``: what its authors state. An absent list is unknown."""

    source: str  # source of the lists, or the reason why there are none
    sequences: tuple[str, ...] = ()  # all sequence names
    without_ground_truth: tuple[str, ...] = ()  # prefixes of sequences whose ground truth is withheld
    motion_files: tuple[str, ...] = ()  # patterns of raw files with motion; others (meshes) serve many sequences
    segments: tuple[int, ...] = ()  # number of segments of each sequence
    frames: tuple[int, ...] = ()  # number of frames of each sequence

    @property
    def usable(self) -> tuple[str, ...]:
        """The sequences whose ground truth is published."""
        return tuple(name for name in self.sequences if not name.startswith(self.without_ground_truth))


@lru_cache
def published(dataset: str) -> Published:
    """Read a dataset's ``published.json``; without the file the result has an empty ``source``."""
    folder = dataset_folder(dataset)
    path = None if folder is None else folder / "published.json"
    if path is None or not path.is_file():
        return Published("")
    try:
        values = orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError as error:
        raise BadInput(path, "a JSON object", str(error), "correct it") from error
    lists = build_config(Published, values, str(path))
    if empty := sorted(key for key, value in values.items() if value == []):
        remedy = "remove the key, and give the reason in `source`"
        raise BadInput(f"{path}: {empty[0]}", "a list of one entry or more", "an empty one", remedy)
    return lists
