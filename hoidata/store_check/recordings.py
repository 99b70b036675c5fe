"""Whole recordings of a store and their hands, against the field table and what info.json says of them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.store.fields import INFO, RECORDINGS, SOURCE_HANDS
from hoidata.store_check.arrays import read_members
from hoidata.store_check.tables import REMEDY

_FACTS = ("subject", "fps", "frames", "object", "hand", "gravity", "source_files")


def recording_problems(folder: Path, info: dict[str, Any], objects: set[str], n_files: int) -> Iterator[BadInput]:
    """What is wrong with the recordings; nothing in a store without any. objects: keys of meshes; n_files: rows."""
    recordings, hands = info.get("recordings", {}), info.get("source_hands", {})
    if not isinstance(recordings, dict) or not isinstance(hands, dict):
        yield BadInput(f"{INFO.path}: recordings", "facts by sequence, and of hands", "something else", REMEDY)
        return
    sound = True
    for name, facts in recordings.items():
        for problem in _fact_problems(f"{INFO.path}: recordings.{name}", facts, objects, set(hands), n_files):
            sound = False
            yield problem
    if recordings and sound:
        yield from _array_problems(folder, recordings, hands)


def _fact_problems(where: str, facts: Any, objects: set[str], hands: set[str], n_files: int) -> Iterator[BadInput]:
    if not isinstance(facts, dict) or set(_FACTS) - set(facts):
        yield BadInput(where, f"an object with {', '.join(_FACTS)}", repr(facts)[:80], REMEDY)
        return
    for key, known in (("object", objects), ("hand", hands)):
        if facts[key] not in known:
            yield BadInput(f"{where}.{key}", "one the store has", f"{facts[key]}", REMEDY)
    if not all(isinstance(number, int) and 0 <= number < n_files for number in facts["source_files"]):
        yield BadInput(f"{where}.source_files", f"rows 0 to {n_files - 1}", f"{facts['source_files']}", REMEDY)


def _array_problems(folder: Path, recordings: dict[str, Any], hands: dict[str, Any]) -> Iterator[BadInput]:
    for file, names in ((RECORDINGS, recordings), (SOURCE_HANDS, hands)):
        members = {f"{name}/{field.name}": field for name in names for field in file.fields}
        arrays, problems = read_members(folder, file.path, members)
        yield from problems
        if arrays is None:
            return
        counts = {name: len(facts["joints"]) for name, facts in hands.items()}
        for member, field in members.items():
            name = member.removesuffix(f"/{field.name}")
            lengths: dict[int | str, int] = {"frame": recordings[name]["frames"]} if file is RECORDINGS else {}
            lengths["joint"] = counts[recordings[name]["hand"] if file is RECORDINGS else name]
            wanted = tuple(lengths.get(axis, axis) for axis in field.shape)
            got = arrays[member].shape
            if any(isinstance(n, int) and n != m for n, m in zip(wanted, got, strict=True)):
                yield BadInput(f"{file.path}: {member}", f"shape {wanted}", f"{got}", REMEDY)
