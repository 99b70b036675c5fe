"""Leak check: subjects, objects, files or frames that are in two parts of a split although they must not be."""

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
