"""NPZ files: stored (not compressed, so one array can be read alone), equal arrays give equal bytes, no pickles."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hoidata.errors import BadInput
from hoidata.files.atomic import atomic_file
from hoidata.files.numpy_files import load_npz_arrays


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays in the mapping's order, atomically. Object arrays are refused (ValueError).

    NumPy stamps every member 1 January 1980, so the bytes depend on names and arrays alone.
    """
    for name, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise ValueError(f"{path}: array {name!r} holds Python objects, which NPZ files here never do")
    with atomic_file(path) as partial, open(partial, "wb") as stream:
        np.savez(stream, allow_pickle=False, **{name: np.asarray(a, order="C") for name, a in arrays.items()})


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """Every array of an NPZ file, by name. Nothing is unpickled. Raises BadInput for anything else."""
    if not Path(path).is_file():
        raise BadInput(path, "an NPZ file", "nothing", "run the stage that writes it")
    try:
        return load_npz_arrays(path)
    except BadInput as error:
        raise BadInput(error.where, "an NPZ file of plain arrays", error.got, "write it again") from error
