"""``.npy`` and ``.npz`` files of others, read without ``allow_pickle``; objects go through ``restricted_load``."""

import io
import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from hoidata.errors import BadInput
from hoidata.files.restricted_pickle import ARRAYS, MAX_BYTES, restricted_load

_MAX_MEMBERS = 256
_FORMAT = "a NumPy file"


def load_npy(path: str | Path) -> np.ndarray:
    """A plain ``.npy`` array; BadInput if it is missing, truncated or holds Python objects."""
    value = _load(path, allow_objects=False)
    assert isinstance(value, np.ndarray)
    return value


def load_npy_object(path: str | Path) -> Any:
    """A ``.npy`` file that may hold Python objects: the object when 0-d (ARCTIC's ``.mano.npy``), else the array."""
    return _item(_load(path, allow_objects=True))


def load_npz_objects(path: str | Path, members: Collection[str] | None = None) -> dict[str, Any]:
    """All members of an ``.npz`` (or only those named), 0-d ones as their item: GRAB's sequence files.

    BadInput if a named member is absent, on more than 256 members, or on more than 2 GiB when unpacked.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            chosen = _chosen_members(path, archive, members)
            return {
                name: _item(_read(io.BytesIO(archive.read(info)), f"{path}: {name}", allow_objects=True))
                for name, info in chosen.items()
            }
    except BadInput:
        raise
    except Exception as error:  # OSError, BadZipFile, zlib.error and the like have no common base
        raise BadInput(path, "a whole .npz file", f"{type(error).__name__}: {error}") from None


def _chosen_members(
    path: str | Path, archive: zipfile.ZipFile, members: Collection[str] | None
) -> dict[str, zipfile.ZipInfo]:
    infos = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    if len(infos) > _MAX_MEMBERS:
        raise BadInput(path, f"at most {_MAX_MEMBERS} members", str(len(infos)))
    if members is not None:
        absent = sorted(set(members) - set(infos))
        if absent:
            raise BadInput(path, f"members {sorted(members)}", f"a file without {absent}")
        infos = {name: info for name, info in infos.items() if name in members}
    size = sum(info.file_size for info in infos.values())
    if size > MAX_BYTES:
        raise BadInput(path, f"at most {MAX_BYTES} bytes when unpacked", str(size))
    return infos


def _load(path: str | Path, allow_objects: bool) -> np.ndarray:
    try:
        with open(path, "rb") as stream:
            return _read(stream, path, allow_objects)
    except OSError as error:
        raise BadInput(path, _FORMAT, f"{type(error).__name__}: {error.strerror}") from None


def _read(stream: BinaryIO, where: str | Path, allow_objects: bool) -> np.ndarray:
    try:
        shape, dtype = _read_header(stream)
    except (ValueError, EOFError, SyntaxError, TypeError) as error:
        raise BadInput(where, _FORMAT, f"{type(error).__name__}: {error}") from None
    if not dtype.hasobject:
        return _read_plain(stream, where, shape, dtype)
    if not allow_objects:
        raise BadInput(where, "an array of numbers", "Python objects")
    value = restricted_load(stream, ARRAYS, where=where)
    if not isinstance(value, np.ndarray):
        raise BadInput(where, "a pickled array", type(value).__name__)
    return value


def _read_header(stream: BinaryIO) -> tuple[tuple[int, ...], np.dtype]:
    version = npy.read_magic(stream)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(stream)
    return shape, dtype


def _read_plain(stream: BinaryIO, where: str | Path, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    # Compared before reading, or a header could make NumPy allocate any amount.
    start, end = stream.tell(), stream.seek(0, io.SEEK_END)
    wanted = math.prod(shape) * dtype.itemsize
    if end - start < wanted:
        raise BadInput(where, f"{wanted} bytes of data for shape {shape}", f"{end - start} bytes")
    stream.seek(0)
    try:
        return npy.read_array(stream, allow_pickle=False)
    except (ValueError, EOFError, OSError, MemoryError) as error:
        raise BadInput(where, "a whole array", f"{type(error).__name__}: {error}") from None


def _item(value: np.ndarray) -> Any:
    return value.item() if value.ndim == 0 else value
