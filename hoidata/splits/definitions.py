"""Named splits, kept as data: rules in the folder of the dataset they split, ``splits/<name>.json``.

Where a split is from and its version stand there too; for one that several datasets have, in ``definitions/`` here,
with the rule where that is the same. A split of ``OF_ANY_DATASET`` needs no file in the dataset's folder.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import orjson

from hoidata.dataset_folders import dataset_facts, dataset_folder
from hoidata.errors import BadInput
from hoidata.settings import build_config
from hoidata.splits.leaks import PROMISES, Promise
from hoidata.splits.rules import KINDS, SplitRule

FOLDER = Path(__file__).with_name("definitions")
OF_ANY_DATASET = ("composition", "drawn-object", "drawn-per-object")
OWN = "params.yaml"
OWN_SOURCE = "a rule of this project's params.yaml"
RULE_KEYS = tuple(field.name for field in fields(SplitRule))
# What a rule keeps apart when it does not say: clips of one sequence stay together unless they are cut in time.
USUAL_PROMISES: dict[str, tuple[Promise, ...]] = {
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
    """One dataset's part of a named split. version counts changes of the definition; source says whose split it is.

    if_chosen: the stage writes it only where it is chosen, so that it changes nothing for whoever does not want it.
    """

    name: str
    version: int
    source: str
    rule: SplitRule
    promises: tuple[Promise, ...]
    if_chosen: bool = False

    def as_json(self) -> dict[str, Any]:
        facts = {"name": self.name, "version": self.version, "source": self.source}
        return facts | {"rule": self.rule.as_json(), "promises": list(self.promises)}


def definitions_for(dataset: str) -> dict[str, Definition]:
    """The named splits a dataset has, by name: those of its folder and those of any dataset."""
    folder = dataset_folder(dataset)
    own = [] if folder is None else (folder / "splits").glob("*.json")
    paths = {path.stem: path for path in (*(FOLDER / f"{name}.json" for name in OF_ANY_DATASET), *own)}
    return {name: _read(paths[name]) for name in sorted(paths)}


def choose(dataset: str, wanted: str | Mapping[str, Any] | None) -> Definition:
    """The split of a dataset: what params.yaml chooses, else what its facts do.

    wanted: a name, a rule of the user's own (a mapping, see ``SplitRule``), or None where params.yaml says nothing.
    Raises BadInput that lists the known names, or the known keys of a rule.
    """
    where, known = f"params.yaml: split.{dataset}", definitions_for(dataset)
    facts = dataset_facts(dataset)
    wanted = facts.split or None if facts and wanted is None else wanted
    if isinstance(wanted, Mapping):
        return _own(where, dataset, wanted)
    if wanted not in known:
        got = "nothing" if wanted is None else repr(wanted)
        remedy = "correct it, or write a rule: {by: subject, train: rest, validation: [s9], test: [s10]}"
        raise BadInput(where, f"one of: {', '.join(known)}", got, remedy)
    return known[wanted]


def _own(where: str, dataset: str, values: Mapping[str, Any]) -> Definition:
    rule, promises = _rule_and_promises(where, values)
    motion_files = published(dataset).motion_files
    if not motion_files and "file" in values.get("promises", ()):
        remedy = f"take it out: which raw files of {dataset} hold motion is not known here"
        raise BadInput(f"{where}.promises", "promises that can be checked", "file", remedy)
    checked: list[Promise] = [promise for promise in promises if promise != "file" or motion_files]
    return Definition(OWN, 0, OWN_SOURCE, rule, tuple(checked))


def _rule_and_promises(where: str, values: Mapping[str, Any]) -> tuple[SplitRule, tuple[Promise, ...]]:
    unknown = sorted(map(str, values.keys() - {*RULE_KEYS, "promises"}))
    if unknown or "by" not in values:
        got = ", ".join(unknown) or "no `by`"
        raise BadInput(
            where, f"keys among: {', '.join(RULE_KEYS)}, promises; by: {', '.join(KINDS)}", got, "correct it"
        )
    try:
        rule = SplitRule(**{key: value for key, value in values.items() if key != "promises"})
    except TypeError as error:
        raise BadInput(where, "shares and least_clips as numbers", str(error), "correct it") from error
    promises = values.get("promises", USUAL_PROMISES[rule.by])
    if not isinstance(promises, list | tuple) or not set(promises) <= set(PROMISES):
        raise BadInput(f"{where}.promises", f"a list of: {', '.join(PROMISES)}", repr(promises), "correct it")
    return rule, tuple(promises)


@lru_cache
def _read(path: Path) -> Definition:
    """One dataset's rule of a named split."""
    general = FOLDER / path.name
    try:
        values = (orjson.loads(general.read_bytes()) if general.is_file() else {}) | orjson.loads(path.read_bytes())
    except (orjson.JSONDecodeError, TypeError) as error:
        raise BadInput(path, "a JSON object", str(error), "correct it") from error
    origin, if_chosen = {key: values.pop(key, None) for key in ("version", "source")}, values.pop("if_chosen", False)
    if not all(origin.values()):
        raise BadInput(path, "the split's version and source", f"{origin}", "state them there")
    rule, promises = _rule_and_promises(str(path), values)
    return Definition(path.stem, origin["version"], origin["source"], rule, promises, bool(if_chosen))


@dataclass(frozen=True)
class Published:
    """What ``published.json`` states; what it leaves out is not known.

    source: where the lists are from, or why there is none. sequences: all names. without_ground_truth: beginnings of
    withheld ones.

    motion_files: patterns of the raw files that hold motion; other raw files (meshes, templates) serve many sequences.
    segments, frames: per sequence, where the source tells.
    """

    source: str
    sequences: tuple[str, ...] = ()
    without_ground_truth: tuple[str, ...] = ()
    motion_files: tuple[str, ...] = ()
    segments: tuple[int, ...] = ()
    frames: tuple[int, ...] = ()

    @property
    def usable(self) -> tuple[str, ...]:
        """The sequences whose ground truth is published."""
        return tuple(name for name in self.sequences if not name.startswith(self.without_ground_truth))


@lru_cache
def published(dataset: str) -> Published:
    """What is known of a dataset; nothing (an empty ``source``) of one without a list."""
    folder = dataset_folder(dataset)
    path = None if folder is None else folder / "published.json"
    if path is None or not path.is_file():
        return Published("")
    try:
        values = orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError as error:
        raise BadInput(path, "a JSON object", str(error), "correct it") from error
    found = build_config(Published, values, str(path))
    if empty := sorted(key for key, value in values.items() if value == []):
        remedy = "leave it out, and say in its source why there is none"
        raise BadInput(f"{path}: {empty[0]}", "a list of one entry or more", "an empty one", remedy)
    return found
