"""Memory-maps the arrays of an uncompressed NPZ file and verifies their checksums."""

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
_verified: set[tuple[int, ...]] = set()  # files whose checksums this process has verified
_NPY_HEADER = 1 << 16  # maximum size in bytes of a member's dtype and shape


def map_npz(path: str | Path) -> dict[str, np.ndarray]:
    """Map an uncompressed NPZ file: read-only views of one memory map. Nothing is unpickled.

    The first call of a process reads the whole file to verify the checksums, at a few gigabytes per second. Raises
    BadInput if the file is missing, truncated, compressed or contains Python objects, or a checksum differs.
    """
    if not Path(path).is_file():
        raise BadInput(path, "an array file of the store", "nothing there", REMEDY)
    try:
        with zipfile.ZipFile(path) as archive, open(path, "rb") as stream:
            # Populate: page faults during reading cost as much as copying. The pages are shared with the file cache.
            flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
            mapped = mmap.mmap(stream.fileno(), 0, flags=flags, prot=mmap.PROT_READ)
            stat = os.fstat(stream.fileno())
            stamp = stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns
            is_verified = stamp in _verified
            items = archive.infolist()
            arrays = {item.filename.removesuffix(".npy"): _view(path, mapped, item, is_verified) for item in items}
        _verified.add(stamp)
        return arrays
    except BadInput:
        raise
    except Exception as error:  # zipfile's errors for damaged archives have no common base class
        raise BadInput(path, "a stored NPZ file of plain arrays", str(error), REMEDY) from error


def _view(path: str | Path, mapped: mmap.mmap, item: zipfile.ZipInfo, is_verified: bool) -> np.ndarray:
    """Map one member. is_verified: its checksum is verified already."""
    if item.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{item.filename} is compressed")
    header = mapped[item.header_offset : item.header_offset + _LOCAL_HEADER]
    # Use the lengths in the local header: its extra field may differ from the one in the directory.
    skipped = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little")
    start = item.header_offset + _LOCAL_HEADER + skipped
    whole = memoryview(mapped)[start : start + item.file_size]
    if len(whole) < item.file_size or not (is_verified or zlib.crc32(whole) == item.CRC):
        member = f"{path}: {item.filename.removesuffix('.npy')}"
        raise BadInput(member, "the bytes that were written", "another checksum (CRC-32)", REMEDY)
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
