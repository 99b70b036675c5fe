"""Arrays of a stored (uncompressed) NPZ file mapped into memory: only the pages that are read are loaded."""

import zipfile
from pathlib import Path

import numpy as np
from numpy.lib import format as npy_format

from hoidata.errors import BadInput

_LOCAL_HEADER = 30  # bytes of a zip local header before name and extra field


def map_npz(path: str | Path) -> dict[str, np.ndarray]:
    """Every array of a stored NPZ as a read-only memory map, by name.

    Nothing is unpickled. Raises BadInput when the file is missing, truncated, compressed or holds Python objects.
    """
    if not Path(path).is_file():
        raise BadInput(path, "an array file of the store", "nothing there", "run the conversion again")
    try:
        with zipfile.ZipFile(path) as archive, open(path, "rb") as stream:
            return {item.filename.removesuffix(".npy"): _map_member(path, stream, item) for item in archive.infolist()}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise BadInput(path, "a stored NPZ file of plain arrays", str(error), "run the conversion again") from error


def _map_member(path: str | Path, stream, item: zipfile.ZipInfo) -> np.ndarray:
    if item.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{item.filename} is compressed")
    stream.seek(item.header_offset)
    header = stream.read(_LOCAL_HEADER)
    # The local header's own lengths count: its extra field may differ from the one in the directory.
    skipped = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little")
    stream.seek(item.header_offset + _LOCAL_HEADER + skipped)
    version = npy_format.read_magic(stream)
    read_header = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
    shape, fortran, dtype = read_header(stream)
    if dtype.hasobject:
        raise ValueError(f"{item.filename} holds Python objects")
    if 0 in shape:
        return np.zeros(shape, dtype)
    order = "F" if fortran else "C"
    return np.memmap(path, dtype=dtype, mode="r", offset=stream.tell(), shape=shape, order=order)
