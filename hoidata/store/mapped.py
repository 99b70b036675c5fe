"""Arrays of a stored (uncompressed) NPZ file mapped into memory, each held against the checksum it was written with."""

import io
import math
import mmap
import os
import zipfile
import zlib
from pathlib import Path

import numpy as np

from hoidata.errors import BadInput
from hoidata.files.npy_header import check_text, read_npy_header
from hoidata.files.written import REMEDY

_LOCAL_HEADER = 30  # bytes of a zip local header before name and extra field
_compared: set[tuple[int, ...]] = set()  # files whose checksums this process has compared
_NPY_HEADER = 1 << 16  # at most so many bytes describe the dtype and shape of a member


def map_npz(path: str | Path) -> dict[str, np.ndarray]:
    """Every array of a stored NPZ as a read-only view of one memory map, by name.

    Nothing is unpickled. The whole file is read, at some gigabytes a second, the first time a process maps it as it is.
    Raises BadInput when the file is missing, truncated, compressed, holds Python objects, or a byte of an array is
    another than was written.
    """
    if not Path(path).is_file():
        raise BadInput(path, "an array file of the store", "nothing there", REMEDY)
    try:
        with zipfile.ZipFile(path) as archive, open(path, "rb") as stream:
            # Filled at once: a fault per clip costs as much as copying it. These pages are the file's own cache.
            flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
            mapped = mmap.mmap(stream.fileno(), 0, flags=flags, prot=mmap.PROT_READ)
            stat = os.fstat(stream.fileno())
            stamp = stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns
            known = stamp in _compared
            items = archive.infolist()
            arrays = {item.filename.removesuffix(".npy"): _view(path, mapped, item, known) for item in items}
        _compared.add(stamp)
        return arrays
    except BadInput:
        raise
    except Exception as error:  # what zipfile raises on damaged archives has no common base
        raise BadInput(path, "a stored NPZ file of plain arrays", str(error), REMEDY) from error


def _view(path: str | Path, mapped: mmap.mmap, item: zipfile.ZipInfo, known: bool) -> np.ndarray:
    """One member. known: its checksum has been compared."""
    if item.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{item.filename} is compressed")
    header = mapped[item.header_offset : item.header_offset + _LOCAL_HEADER]
    # The local header's own lengths count: its extra field may differ from the one in the directory.
    skipped = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little")
    start = item.header_offset + _LOCAL_HEADER + skipped
    whole = memoryview(mapped)[start : start + item.file_size]
    if len(whole) < item.file_size or not (known or zlib.crc32(whole) == item.CRC):
        where = f"{path}: {item.filename.removesuffix('.npy')}"
        raise BadInput(where, "the bytes that were written", "another checksum (CRC-32)", REMEDY)
    stream = io.BytesIO(mapped[start : start + min(item.file_size, _NPY_HEADER)])
    shape, fortran, dtype = read_npy_header(stream, f"{path}: {item.filename}")
    if dtype.hasobject:
        raise ValueError(f"{item.filename} holds Python objects")
    count = math.prod(shape)
    if stream.tell() + count * dtype.itemsize > item.file_size:
        raise ValueError(f"{item.filename} is shorter than its shape {shape} says")
    if count == 0:
        return np.zeros(shape, dtype)
    flat = np.frombuffer(mapped, dtype, count, start + stream.tell())
    if dtype.kind == "U":
        check_text(flat.tobytes(), dtype)
    return flat.reshape(shape, order="F" if fortran else "C")
