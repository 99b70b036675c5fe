"""Reads and writes the JSON and Parquet files of stages. Damaged files raise an error with a remedy."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hoidata.errors import BadInput, MissingResource

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

REMEDY = "restore it with `dvc checkout`, or run the stage that writes it again"
EMPTY = "empty.json"  # the output of a stage that had nothing to do, with the reason
# Functions that return the recorded MD5 of a file, which is verified before the file is read; none by default.
_digest_sources: list[Callable[[Path], str | None]] = []


# The expected type of a JSON entry: a type, several types, or the entries of an object with their types.
Shape = type | tuple[type, ...] | Mapping[str, "Shape"]
NUMBER = (int, float)
NUMBER_OR_NONE = (int, float, type(None))


class Facts(dict[str, Any]):
    """A JSON object that hoidata wrote. A missing entry raises BadInput with the file and the key."""

    def __init__(self, path: Path, values: Mapping[str, Any], key: str = "") -> None:
        """Wrap an object and its nested objects; ``key`` is its location in the file: "" or a path such as "a.b."."""
        super().__init__(values)
        for name, value in values.items():
            if isinstance(value, dict):
                self[name] = Facts(path, value, f"{key}{name}.")
            elif isinstance(value, list) and value and isinstance(value[0], dict):
                self[name] = [Facts(path, item, f"{key}{name}.") if isinstance(item, dict) else item for item in value]
        self.path = path
        self.key = key

    def __missing__(self, name: str) -> Any:
        raise BadInput(self.path, f"an entry {self.key + name!r}", "none", REMEDY)

    def __reduce__(self) -> tuple:
        return type(self), (self.path, dict(self), self.key)

    def check(self, shape: Mapping[str, Shape]) -> "Facts":
        """Check entries, and return self. Raises BadInput for a missing entry or another type."""
        for name, expected in shape.items():
            value = self[name]
            kinds = dict if isinstance(expected, Mapping) else expected
            kinds = kinds if isinstance(kinds, tuple) else (kinds,)
            if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
                names = ", ".join(kind.__name__ for kind in kinds)
                raise BadInput(self.path, f"{names} as the entry {self.key + name!r}", repr(value)[:80], REMEDY)
            if isinstance(expected, Mapping):
                self[name].check(expected)
        return self

    def check_present(self, shape: Mapping[str, Shape]) -> "Facts":
        """As ``check``, for the entries that are present."""
        return self.check({name: expected for name, expected in shape.items() if name in self})


def verify_with(digest_of: Callable[[Path], str | None]) -> None:
    """From now on in this process, verify files by the MD5 that ``digest_of`` returns for a path (None: unknown)."""
    _digest_sources[:] = [digest_of]


def check_written(path: str | Path) -> None:
    """Raise BadInput for a file whose recorded MD5 differs."""
    for digest_of in _digest_sources:
        digest = digest_of(Path(path))
        if digest and digest != md5_file(path):
            remedy = f"{REMEDY}; `dvc commit` accepts it"
            raise BadInput(path, "the bytes its stage wrote, by dvc.lock", "others", remedy)


def md5_file(path: str | Path) -> str:
    """The MD5 that DVC records for a file."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "md5").hexdigest()


def read_json(path: str | Path, shape: Mapping[str, Shape] | None = None) -> Facts:
    """Read the JSON object in a file. Raises BadInput for anything else, and for entries that do not fit ``shape``."""
    values = _read(path, dict)
    return Facts(Path(path), values).check(shape or {})


def read_json_rows(path: str | Path, shape: Mapping[str, Shape]) -> list[Facts]:
    """Read a JSON list of objects. Raises BadInput as ``read_json`` does."""
    items = _read(path, list)
    if not all(isinstance(item, dict) for item in items):
        raise BadInput(path, "a JSON list of objects", repr(items)[:80], REMEDY)
    return [Facts(Path(path), item, f"{number}.").check(shape) for number, item in enumerate(items)]


def empty_reason(folder: str | Path) -> str | None:
    """The reason why a stage's output folder is empty; None if it is not."""
    note = Path(folder) / EMPTY
    return str(read_json(note)["reason"]) if note.is_file() else None


def require_output(folder: str | Path, stage: str, file: str = "info.json") -> None:
    """Raise MissingResource if a stage's output is empty (with the reason) or ``file`` is missing."""
    if reason := empty_reason(folder):
        raise MissingResource(f"{folder} is empty: {reason}")
    if not (Path(folder) / file).exists():
        raise MissingResource(f"{folder} is not there: run the stage '{stage}' of this dataset first")


def _read(path: str | Path, kind: type) -> Any:
    words = "a JSON object" if kind is dict else "a JSON list"
    try:
        check_written(path)
        values = json.loads(Path(path).read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(path, words, str(error)[:300], REMEDY) from error
    if not isinstance(values, kind):
        raise BadInput(path, words, type(values).__name__, REMEDY)
    return values


def read_table(path: str | Path, columns: Sequence[str] | None = None) -> "pd.DataFrame":
    """Read a Parquet table, or some of its columns. Raises BadInput for anything else."""
    import pyarrow.parquet as pq

    try:
        check_written(path)
        return pq.read_table(path, columns=columns, memory_map=True, use_threads=False).to_pandas()
    except (OSError, ValueError, KeyError) as error:  # pyarrow's errors are among these
        raise BadInput(path, "a Parquet table", (str(error).splitlines() or [""])[0][:300], REMEDY) from error


def write_table(path: str | Path, rows: Sequence[dict[str, Any]], schema: "pa.Schema") -> None:
    """Write rows as one Parquet file, zstd-compressed. A missing key is null; raises ArrowInvalid for a wrong type.

    Equal rows give equal bytes (of one pyarrow version).
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.Table.from_pylist(list(rows), schema), path, compression="zstd")
