"""The leak check: what two parts of a split have in common, and whether the split promised that they have not."""

import fnmatch
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import pandas as pd

from hoidata.splits.rules import composition, handled_objects, object_name

Promise = Literal["subject", "object", "sequence", "file", "frame", "motion", "composition"]
PROMISES: tuple[Promise, ...] = get_args(Promise)
ALWAYS: tuple[Promise, ...] = ("frame", "motion")
SHOWN = 20


@dataclass(frozen=True)
class Leaks:
    """What lies in two parts, per kind, sorted; and what the split promised to keep apart.

    subject; object (manipulated, or only shown); sequence of the source; file: raw motion file; frame: two clips
    of one sequence that overlap; motion: clips of equal numbers, a copy under another name; composition: verb, object
    and hand type together, looked for only where it is promised.
    """

    promised: tuple[Promise, ...]
    shared: Mapping[Promise, tuple[str, ...]]

    @property
    def broken(self) -> tuple[Promise, ...]:
        return tuple(kind for kind in self.promised if self.shared[kind])

    def as_json(self) -> dict[str, Any]:
        """Per kind: promised or not, how many lie in two parts, and the first of them."""
        return {
            kind: {"promised": kind in self.promised, "in_two_parts": len(names), "first": list(names[:SHOWN])}
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
    """Everything two parts share. Clips that are left out (None, or not in ``parts``) share nothing.

    sequences: a store's table; with the annotation's verb and hand_type where compositions are promised.
    parts: clip id to part. files: path by number, as ``source_files`` counts them.
    motion_files: patterns of the raw files that hold motion; others (meshes, templates) may serve all parts.
    digests: clip id to a digest of its motion.
    """
    rows = [row for row in sequences.to_dict("records") if parts.get(row["clip_id"])]
    part_of = [str(parts[row["clip_id"]]) for row in rows]
    promises = tuple(promises)
    keys = {
        "subject": [[row["subject"]] for row in rows],
        "object": [[object_name(row["object"]), *handled_objects(row["other_objects"])] for row in rows],
        "sequence": [[row["sequence"]] for row in rows],
        "file": [_motion_paths(row, files, motion_files) for row in rows],
    }
    if "composition" in promises:
        keys["composition"] = [[composition(row)] for row in rows]
    shared: dict[Promise, tuple[str, ...]] = {kind: _in_two_parts(keys[kind], part_of) for kind in keys}  # type: ignore[misc]
    shared["frame"] = _overlaps(rows, part_of)
    shared["motion"] = _copies(rows, part_of, digests or {})
    return Leaks(tuple(kind for kind in PROMISES if kind in {*promises, *ALWAYS}), shared)


def _motion_paths(row: Mapping[str, Any], files: Sequence[str], patterns: Sequence[str]) -> list[str]:
    paths = [files[int(number)] for number in row["source_files"]] if len(files) else []
    return [path for path in paths if any(fnmatch.fnmatch(path, pattern) for pattern in patterns)]


def _in_two_parts(keys: list[list[str]], part_of: list[str]) -> tuple[str, ...]:
    found: dict[str, set[str]] = defaultdict(set)
    for names, part in zip(keys, part_of, strict=True):
        for name in names:
            found[name].add(part)
    return tuple(sorted(name for name, parts in found.items() if len(parts) > 1))


def _copies(rows: list[dict[str, Any]], part_of: list[str], digests: Mapping[str, str]) -> tuple[str, ...]:
    clips: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for row, part in zip(rows, part_of, strict=True):
        if row["clip_id"] in digests:
            clips[digests[row["clip_id"]]].append((row["clip_id"], part))
    copied = [sorted(same) for same in clips.values() if len({part for _, part in same}) > 1]
    return tuple(sorted(" = ".join(clip_id for clip_id, _ in same) for same in copied))


def _overlaps(rows: list[dict[str, Any]], part_of: list[str]) -> tuple[str, ...]:
    """Pairs of clips of one sequence in two parts that share source frames (each clip with the last one before it)."""
    spans: dict[tuple[str, str], list[tuple[int, int, str, str]]] = defaultdict(list)
    for row, part in zip(rows, part_of, strict=True):
        span = (row["first_source_frame"], row["last_source_frame"], part, row["clip_id"])
        spans[row["subject"], row["sequence"]].append(span)
    return tuple(sorted(pair for group in spans.values() for pair in _overlapping(sorted(group))))


def _overlapping(spans: list[tuple[int, int, str, str]]) -> Iterable[str]:
    """spans: (first frame, last frame, part, clip id) of one sequence, sorted."""
    last_of: dict[str, tuple[int, str]] = {}
    for first, last, part, clip_id in spans:
        for other, (other_last, other_id) in last_of.items():
            if other != part and first <= other_last:
                yield f"{other_id} ({other}) and {clip_id} ({part}) overlap"
        last_of[part] = max(last_of.get(part, (last, clip_id)), (last, clip_id))
