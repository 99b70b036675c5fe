"""Reads and writes uncompressed NPZ files without pickles; equal arrays give equal bytes."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np

from hoidata.errors import BadInput
from hoidata.files.atomic import atomic_file
from hoidata.files.numpy_files import load_npz_arrays


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays atomically, in the mapping's order. Raises ValueError for object arrays.

    The bytes depend on names and arrays only, and equal those of ``np.savez`` on Python 3.11.4 and later.
    """
    for name, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise ValueError(f"{path}: array {name!r} holds Python objects, which NPZ files here never do")
    with atomic_file(path) as partial, open(partial, "wb") as stream:
        write_npz_to(stream, arrays)


def write_npz_to(stream: IO[bytes], arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays to a seekable stream. Raises ValueError for object arrays."""
    with zipfile.ZipFile(stream, "w") as archive:
        for name, array in arrays.items():
            with archive.open(_Member(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)


class _Member(zipfile.ZipInfo):
    """A member dated 1 January 1980 with its sizes in 64 bits only; Python before 3.11.4 writes them twice."""

    def FileHeader(self, zip64: bool | None = None) -> bytes:  # noqa: N802 (zipfile's name)
        """The header before the member's data, with both 32-bit sizes all ones, as ZIP version 4.5 requires."""
        self.create_version = self.extract_version = 45
        header = super().FileHeader(zip64)
        return header[:18] + b"\xff" * 8 + header[26:]


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """Read all arrays of an NPZ file without unpickling. Raises BadInput for any other file."""
    if not Path(path).is_file():
        raise BadInput(path, "an NPZ file", "nothing", "run the stage that writes it")
    try:
        return load_npz_arrays(path)
    except BadInput as error:
        raise BadInput(error.where, "an NPZ file of plain arrays", error.got, "write it again") from error
