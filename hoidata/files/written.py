"""JSON and Parquet files that stages write, and read back; what is damaged is told, never shown as if it were sound."""

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
EMPTY = "empty.json"  # in the folder of a stage that had nothing to do, with the reason
# Who knows the MD5 a file was written with is asked before the file is read; nobody by default.
_known_by: list[Callable[[Path], str | None]] = []


# What an entry of a JSON file has to be: a type, several, or the entries of an object with what each has to be.
Shape = type | tuple[type, ...] | Mapping[str, "Shape"]
NUMBER = (int, float)
NUMBER_OR_NONE = (int, float, type(None))


class Facts(dict[str, Any]):
    """A JSON object of ours, and the objects inside. A missing entry is a BadInput that names the file and the key.

    key: of this object in its file, with a full stop at the end; "" for the whole file.
    """

    def __init__(self, path: Path, values: Mapping[str, Any], key: str = "") -> None:
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
        """This object, after a look at the entries of ``shape``. Raises BadInput for one that is missing or another."""
        for name, wanted in shape.items():
            value = self[name]
            kinds = (dict,) if isinstance(wanted, Mapping) else wanted if isinstance(wanted, tuple) else (wanted,)
            if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
                names = ", ".join(kind.__name__ for kind in kinds)
                raise BadInput(self.path, f"{names} as the entry {self.key + name!r}", repr(value)[:80], REMEDY)
            if isinstance(wanted, Mapping):
                self[name].check(wanted)
        return self

    def check_given(self, shape: Mapping[str, Shape]) -> "Facts":
        """As ``check``, of those entries alone that are there."""
        return self.check({name: wanted for name, wanted in shape.items() if name in self})


def ask_digests_of(known: Callable[[Path], str | None]) -> None:
    """Hold files against the MD5 that ``known`` gives for a path (None: not known) from now on, in this process."""
    _known_by[:] = [known]


def check_written(path: str | Path) -> None:
    """Raise BadInput for a file whose bytes are known to be others than were written."""
    for known in _known_by:
        digest = known(Path(path))
        if digest and digest != md5_file(path):
            raise BadInput(
                path, "the bytes its stage wrote, by dvc.lock", "others", f"{REMEDY}; `dvc commit` accepts it"
            )


def md5_file(path: str | Path) -> str:
    """The MD5 by which DVC knows a file."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "md5").hexdigest()


def read_json(path: str | Path, shape: Mapping[str, Shape] | None = None) -> Facts:
    """The JSON object in a file. Raises BadInput for anything else, and for entries that are not of ``shape``."""
    values = _read(path, dict)
    return Facts(Path(path), values).check(shape or {})


def read_json_rows(path: str | Path, shape: Mapping[str, Shape]) -> list[Facts]:
    """The objects of a JSON list in a file. Raises BadInput as ``read_json`` does."""
    rows = _read(path, list)
    if not all(isinstance(row, dict) for row in rows):
        raise BadInput(path, "a JSON list of objects", repr(rows)[:80], REMEDY)
    return [Facts(Path(path), row, f"{number}.").check(shape) for number, row in enumerate(rows)]


def empty_reason(folder: str | Path) -> str | None:
    """Why a stage's output folder is empty, or None when it holds something."""
    note = Path(folder) / EMPTY
    return str(read_json(note)["reason"]) if note.is_file() else None


def require_output(folder: str | Path, stage: str, file: str = "info.json") -> None:
    """Raise MissingResource with the reason where a stage wrote nothing else, and where ``file`` is not there."""
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
    """The Parquet table in a file, or some of its columns. Raises BadInput for anything else."""
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
