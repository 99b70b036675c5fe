"""JSON and Parquet files that stages wrote, read back; what is damaged is told, never shown as if it were sound."""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hoidata.errors import BadInput

if TYPE_CHECKING:
    import pandas as pd

REMEDY = "restore it with `dvc checkout`, or run the stage that writes it again"
# Who knows the MD5 a file was written with is asked before the file is read; nobody by default.
_known_by: list[Callable[[Path], str | None]] = []


class Facts(dict[str, Any]):
    """A JSON object of ours. An entry that is not there is a BadInput that names the file."""

    def __init__(self, path: Path, values: dict[str, Any]) -> None:
        super().__init__(values)
        self.path = path

    def __missing__(self, key: str) -> Any:
        raise BadInput(self.path, f"an entry {key!r}", "none", REMEDY)


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


def read_json(path: str | Path) -> Facts:
    """The JSON object in a file. Raises BadInput for anything else."""
    try:
        check_written(path)
        values = json.loads(Path(path).read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(path, "a JSON object", str(error)[:300], REMEDY) from error
    if not isinstance(values, dict):
        raise BadInput(path, "a JSON object", type(values).__name__, REMEDY)
    return Facts(Path(path), values)


def read_table(path: str | Path, columns: Sequence[str] | None = None) -> "pd.DataFrame":
    """The Parquet table in a file, or some of its columns. Raises BadInput for anything else."""
    import pyarrow.parquet as pq

    try:
        check_written(path)
        return pq.read_table(path, columns=columns, memory_map=True, use_threads=False).to_pandas()
    except (OSError, ValueError, KeyError) as error:  # pyarrow's errors are among these
        raise BadInput(path, "a Parquet table", (str(error).splitlines() or [""])[0][:300], REMEDY) from error
