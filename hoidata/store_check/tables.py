"""Checks the tables of a store against the schema: columns, types, values, and references between tables."""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from hoidata.clips.validation import UNIT_TOLERANCE
from hoidata.errors import BadInput
from hoidata.store.fields import FILES, OBJECTS, SEQUENCES, Field, StoreFile, arrow_schema

REMEDY = "restore the store from a copy, or run the conversion again"
Columns = dict[str, list[Any]]


def read_columns(folder: Path, file: StoreFile) -> tuple[Columns | None, list[BadInput]]:
    """Read a table as Python values by column; None, with problems, if it is unreadable or has wrong columns."""
    path = folder / file.path
    if not path.is_file():
        return None, [BadInput(file.path, "a Parquet table", "nothing there", REMEDY)]
    try:
        table = pq.read_table(path, use_threads=False)
    except (OSError, ValueError) as error:  # pyarrow's errors are both
        return None, [BadInput(file.path, "a Parquet table", str(error).splitlines()[0], REMEDY)]
    problems = list(_column_problems(file, table.schema, arrow_schema(file)))
    return (None if problems else table.to_pydict()), problems


def _column_problems(file: StoreFile, actual: pa.Schema, expected: pa.Schema) -> Iterator[BadInput]:
    for name in expected.names:
        if name not in actual.names:
            yield BadInput(f"{file.path}: {name}", f"a column of {expected.field(name).type}", "no such column", REMEDY)
        elif actual.field(name).type != expected.field(name).type:
            types = f"{expected.field(name).type}", f"{actual.field(name).type}"
            yield BadInput(f"{file.path}: {name}", *types, REMEDY)
    for name in actual.names:
        if name not in expected.names:
            yield BadInput(f"{file.path}: {name}", "only the columns of the schema", "a further column", REMEDY)
    if sorted(actual.names) == sorted(expected.names) and actual.names != expected.names:
        yield BadInput(file.path, f"columns in the order {expected.names}", f"{actual.names}", REMEDY)


def table_problems(name: str, file: StoreFile, columns: Columns) -> Iterator[BadInput]:
    """Check the values of one table, without references to other tables."""
    for field in file.fields:
        if field.name in columns:
            yield from _value_problems(file, field, columns[field.name])
    if name in _TABLE_RULES and is_whole(file, columns):
        yield from _TABLE_RULES[name](columns)


def is_whole(file: StoreFile, columns: Columns) -> bool:
    """Whether no required value is null, so that the further rules can be checked."""
    fields = [field for field in file.fields if field.name in columns]
    nulls = any(None in columns[field.name] for field in fields if field.required)
    return not nulls and not any(None in (value or ()) for f in fields if f.shape for value in columns[f.name])


def _value_problems(file: StoreFile, field: Field, values: list[Any]) -> Iterator[BadInput]:
    column = f"{file.path}: {field.name}"
    if field.required:
        yield from _each(column, values, lambda value: value is not None, "a value in every row")
    if field.choices:
        choices = (None, *field.choices)
        yield from _each(column, values, lambda v: v in choices, f"one of {', '.join(field.choices)}")
    if field.shape:
        yield from _each(column, values, lambda v: v is None or None not in v, "lists without gaps")
    if field.shape and isinstance(field.shape[0], int):
        length = field.shape[0]
        yield from _each(column, values, lambda v: v is None or len(v) == length, f"{length} numbers")
    if field.dtype == "float64":
        yield from _each(column, values, _is_finite, "finite numbers")


def _is_finite(value: float | list[float] | None) -> bool:
    numbers = value if isinstance(value, list) else [value]
    return all(number is None or math.isfinite(number) for number in numbers)


def _each(column: str, values: list[Any], is_valid: Callable[[Any], bool], expected: str) -> Iterator[BadInput]:
    """Report one problem for all rows of a column that violate a rule."""
    wrong = [number for number, value in enumerate(values) if not is_valid(value)]
    if wrong:
        more = f", and in {len(wrong) - 1} more rows" if len(wrong) > 1 else ""
        yield BadInput(column, expected, f"{values[wrong[0]]!r} in row {wrong[0]}{more}", REMEDY)


def _unique(column: str, values: list[Any]) -> Iterator[BadInput]:
    repeated = [value for value, count in Counter(values).items() if count > 1]
    if repeated:
        yield BadInput(column, "each value once", f"{repeated[0]!r} more than once", REMEDY)


def _is_unit(vector: list[float] | None) -> bool:
    return vector is None or abs(math.hypot(*vector) - 1) <= UNIT_TOLERANCE


def _sequence_rules(columns: Columns) -> Iterator[BadInput]:
    path = SEQUENCES.path
    yield from _unique(f"{path}: clip_id", columns["clip_id"])
    yield from _each(f"{path}: clip_id", columns["clip_id"], bool, "an id that is not empty")
    yield from _each(f"{path}: gravity", columns["gravity"], _is_unit, "a vector of length 1")
    yield from _each(f"{path}: n_frames", columns["n_frames"], lambda n: n >= 1, "1 or more")
    yield from _each(f"{path}: source_fps", columns["source_fps"], lambda n: n > 0, "more than 0")
    shards = columns["shard"]
    if shards != sorted(shards) or set(shards) != set(range(len(set(shards)))):
        expected = "0, 1, 2 and so on, in the order of the rows"
        yield BadInput(f"{path}: shard", expected, f"{shards}", REMEDY)
    for side in ("left", "right"):
        pairs = list(zip(columns[f"{side}_betas_count"], columns["n_frames"], strict=True))
        expected = "(count, n_frames) with a count of 1 or n_frames"
        yield from _each(f"{path}: {side}_betas_count", pairs, lambda pair: pair[0] in (1, pair[1]), expected)


def _object_rules(columns: Columns) -> Iterator[BadInput]:
    path = OBJECTS.path
    yield from _unique(f"{path}: object", columns["object"])
    if columns["object"] != sorted(columns["object"]):
        yield BadInput(f"{path}: object", "sorted names", "another order", REMEDY)
    yield from _each(f"{path}: hinge_axis", columns["hinge_axis"], _is_unit, "a vector of length 1")
    pairs = list(zip(columns["articulated"], columns["hinge_axis"], strict=True))
    expected = "(articulated, value) with a value exactly for articulated objects"
    yield from _each(f"{path}: hinge_axis", pairs, lambda pair: pair[0] == (pair[1] is not None), expected)
    pairs = list(zip(columns["articulated"], columns["hinge_origin_m"], strict=True))
    expected = "(articulated, value) without a value for rigid objects"
    yield from _each(f"{path}: hinge_origin_m", pairs, lambda pair: pair[0] or pair[1] is None, expected)


def _file_rules(columns: Columns) -> Iterator[BadInput]:
    path = FILES.path
    yield from _unique(f"{path}: path", columns["path"])
    yield from _each(f"{path}: path", columns["path"], _is_below_the_root, "a path below the raw root")
    yield from _each(f"{path}: size", columns["size"], lambda size: size >= 0, "0 or more bytes")
    digest = re.compile("[0-9a-f]{64}")
    yield from _each(f"{path}: sha256", columns["sha256"], lambda v: bool(digest.fullmatch(v)), "64 hex digits")


def _is_below_the_root(path: str) -> bool:
    return bool(path) and not PurePosixPath(path).is_absolute() and ".." not in PurePosixPath(path).parts


_TABLE_RULES = {"sequences": _sequence_rules, "objects": _object_rules, "files": _file_rules}


def reference_problems(tables: dict[str, Columns]) -> Iterator[BadInput]:
    """Check that names and row numbers in one table exist in the table that they refer to."""
    sequences, objects, n_files = tables["sequences"], tables["objects"], len(tables["files"]["path"])
    path = SEQUENCES.path
    articulated = dict(zip(objects["object"], objects["articulated"], strict=True))
    yield from _each(f"{path}: object", sequences["object"], articulated.__contains__, f"a row of {OBJECTS.path}")
    others = sequences["other_objects"]
    yield from _each(
        f"{path}: other_objects", others, lambda names: set(names) <= set(articulated), f"rows of {OBJECTS.path}"
    )
    pairs = list(zip(sequences["object"], sequences["articulated"], strict=True))
    expected = f"(object, articulated) as in {OBJECTS.path}"
    yield from _each(f"{path}: articulated", pairs, lambda pair: articulated.get(pair[0], pair[1]) == pair[1], expected)
    files = sequences["source_files"]
    expected = f"rows of {FILES.path}, 0 to {n_files - 1}"
    yield from _each(f"{path}: source_files", files, lambda v: all(0 <= n < n_files for n in v), expected)
    used = {*sequences["object"], *(name for names in others for name in names)}
    yield from _each(f"{OBJECTS.path}: object", objects["object"], used.__contains__, "an object of a clip")
