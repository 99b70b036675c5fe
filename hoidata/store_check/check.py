"""Checking a store on disk, byte by byte as it lies there, against the field table."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hoidata.clips.validation import check_clip
from hoidata.errors import BadInput, MissingResource
from hoidata.store.fields import BODY, FRAMES, INFO, RECORDINGS, SOURCE_CONTACT, SOURCE_HANDS, STORE_FILES, TABLES
from hoidata.store.info import info_problems
from hoidata.store.store import open_store, read_info
from hoidata.store_check.arrays import mesh_problems, read_shards, recording_problems, shard_problems, template_problems
from hoidata.store_check.tables import REMEDY, Columns, is_whole, read_columns, reference_problems, table_problems


def check_store(folder: str | Path) -> list[BadInput]:
    """Everything that is wrong with the store ``folder``: file and field, expected, got, remedy; none when it is sound.

    Places are given below ``folder``. Raises MissingResource when ``folder`` is no store.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MissingResource(f"{folder} is no folder: give the folder of a store")
    try:
        info = read_info(folder)
    except BadInput as problem:
        return [BadInput(INFO.path, problem.expected, problem.got, problem.remedy)]
    problems = info_problems(info)
    tables: dict[str, Columns] = {}
    for name, file in TABLES.items():
        columns, found = read_columns(folder, file)
        problems += found
        if columns is not None:
            tables[name] = columns
            problems += table_problems(name, file, columns)
    if len(tables) < len(TABLES) or not all(is_whole(TABLES[name], columns) for name, columns in tables.items()):
        return problems  # what else is wrong cannot be told before this is mended
    problems += reference_problems(tables)
    problems += _count_problems(info, tables)
    recorded = info.get("recordings", {})
    problems += _file_problems(folder, tables["sequences"], bool(recorded))
    problems += _array_problems(folder, tables)
    problems += recording_problems(folder, info, set(tables["objects"]["object"]), len(tables["files"]["path"]))
    return problems or list(_clip_problems(folder))


def _count_problems(info: dict[str, Any], tables: dict[str, Columns]) -> Iterator[BadInput]:
    """What info.json counts against what the tables hold."""
    counts = info.get("counts")
    found = {
        "clips": len(tables["sequences"]["clip_id"]),
        "frames": sum(tables["sequences"]["n_frames"]),
        "objects": len(tables["objects"]["object"]),
        "files": len(tables["files"]["path"]),
        "quarantined": len(tables["quarantine"]["source_key"]),
    }
    for name, number in found.items():
        if isinstance(counts, dict) and counts.get(name) != number:
            yield BadInput(f"{INFO.path}: counts.{name}", f"{number}", f"{counts.get(name)}", REMEDY)


def expected_files(sequences: Columns, recorded: bool = False) -> set[str]:
    """The path of every file a store with these clips has. recorded: it has whole recordings, too."""
    shards = set(sequences["shard"]) or {0}
    with_rows = {
        **({} if recorded else {RECORDINGS.path: set(), SOURCE_HANDS.path: set()}),
        FRAMES.path: shards,
        BODY.path: _shards_where(sequences, "body_row", -1),
        SOURCE_CONTACT.path: _shards_where(sequences, "source_contact_count", 0),
    }
    paths = set()
    for file in STORE_FILES:
        numbers = with_rows.get(file.path)
        paths |= {file.path} if numbers is None else {file.path.replace("*", f"{number:05d}") for number in numbers}
    return paths


def _shards_where(sequences: Columns, column: str, above: int) -> set[int]:
    return {shard for shard, value in zip(sequences["shard"], sequences[column], strict=True) if value > above}


def _file_problems(folder: Path, sequences: Columns, recorded: bool) -> Iterator[BadInput]:
    expected = expected_files(sequences, recorded)
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
    for path in sorted(expected - found):
        yield BadInput(path, "a file", "nothing there", REMEDY)
    for path in sorted(found - expected):
        yield BadInput(path, "only the files of the schema", "a further file", "move it out of the store")


def _array_problems(folder: Path, tables: dict[str, Columns]) -> Iterator[BadInput]:
    paths = expected_files(tables["sequences"])
    for file in (FRAMES, BODY, SOURCE_CONTACT):
        shards, found = read_shards(folder, file, paths)
        yield from found
        yield from shard_problems(file, shards, tables["sequences"])
    yield from mesh_problems(folder, tables["objects"])
    yield from template_problems(folder, tables["sequences"])


def _clip_problems(folder: Path) -> Iterator[BadInput]:
    """The rules of ``Clip`` itself: plausible places and sizes, rising frames, what goes with what."""
    store = open_store(folder)
    for clip_id in store.ids:
        try:
            check_clip(store.clip(clip_id))
        except BadInput as problem:
            yield BadInput(problem.where, problem.expected, problem.got, REMEDY)
