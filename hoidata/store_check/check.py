"""Checks all files of a store against the schema."""

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
    """Return all problems of the store ``folder``, with paths relative to it; [] if the store is valid.

    Raises MissingResource if ``folder`` is not a store.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MissingResource(f"{folder} is not a folder: pass the folder of a store")
    try:
        info = read_info(folder)
    except BadInput as problem:
        return [BadInput(INFO.path, problem.expected, problem.got, problem.remedy)]
    problems = info_problems(info)
    tables: dict[str, Columns] = {}
    for name, file in TABLES.items():
        columns, column_problems = read_columns(folder, file)
        problems += column_problems
        if columns is not None:
            tables[name] = columns
            problems += table_problems(name, file, columns)
    if len(tables) < len(TABLES) or not all(is_whole(TABLES[name], columns) for name, columns in tables.items()):
        return problems  # the further checks need whole tables
    problems += reference_problems(tables)
    problems += _count_problems(info, tables)
    recordings = info.get("recordings", {})
    problems += _file_problems(folder, tables["sequences"], bool(recordings))
    problems += _array_problems(folder, tables)
    problems += recording_problems(folder, info, set(tables["objects"]["object"]), len(tables["files"]["path"]))
    return problems or list(_clip_problems(folder))


def _count_problems(info: dict[str, Any], tables: dict[str, Columns]) -> Iterator[BadInput]:
    """Compare the counts of info.json with the tables."""
    counts = info.get("counts")
    table_counts = {
        "clips": len(tables["sequences"]["clip_id"]),
        "frames": sum(tables["sequences"]["n_frames"]),
        "objects": len(tables["objects"]["object"]),
        "files": len(tables["files"]["path"]),
        "quarantined": len(tables["quarantine"]["source_key"]),
    }
    for name, count in table_counts.items():
        if isinstance(counts, dict) and counts.get(name) != count:
            yield BadInput(f"{INFO.path}: counts.{name}", f"{count}", f"{counts.get(name)}", REMEDY)


def expected_files(sequences: Columns, has_recordings: bool = False) -> set[str]:
    """Return the paths of all files of a store with these clips. recorded: it also has whole recordings."""
    shards = set(sequences["shard"]) or {0}
    with_rows = {
        **({} if has_recordings else {RECORDINGS.path: set(), SOURCE_HANDS.path: set()}),
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


def _file_problems(folder: Path, sequences: Columns, has_recordings: bool) -> Iterator[BadInput]:
    expected = expected_files(sequences, has_recordings)
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
    for path in sorted(expected - present):
        yield BadInput(path, "a file", "nothing there", REMEDY)
    for path in sorted(present - expected):
        yield BadInput(path, "only the files of the schema", "a further file", "move it out of the store")


def _array_problems(folder: Path, tables: dict[str, Columns]) -> Iterator[BadInput]:
    paths = expected_files(tables["sequences"])
    for file in (FRAMES, BODY, SOURCE_CONTACT):
        shards, problems = read_shards(folder, file, paths)
        yield from problems
        yield from shard_problems(file, shards, tables["sequences"])
    yield from mesh_problems(folder, tables["objects"])
    yield from template_problems(folder, tables["sequences"])


def _clip_problems(folder: Path) -> Iterator[BadInput]:
    """Check each clip with ``check_clip``: plausible positions and sizes, rising frames, consistent fields."""
    store = open_store(folder)
    for clip_id in store.ids:
        try:
            check_clip(store.clip(clip_id))
        except BadInput as problem:
            yield BadInput(problem.where, problem.expected, problem.got, REMEDY)
