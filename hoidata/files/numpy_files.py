"""Reads untrusted ``.npy`` and ``.npz`` files without ``allow_pickle``; ``restricted_load`` reads objects."""

import zipfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.errors import BadInput
from hoidata.files.npy_header import read_npy_header, read_plain_array
from hoidata.files.restricted_pickle import ARRAYS, StoredSize, restricted_load

_MAX_MEMBERS = 256
_MAX_BYTES = 1 << 30
# Compression shrinks recorded numbers to a half or a third; constants shrink to a thousandth, but are small.
_UNPACKED_PER_BYTE = 8
_FREE_BYTES = 64 << 20
_FORMAT = "a NumPy file"


def load_npy(path: str | Path) -> np.ndarray:
    """Read a plain ``.npy`` array. Raises BadInput if it is missing, truncated or has Python objects."""
    value = _load(path, allow_objects=False)
    assert isinstance(value, np.ndarray)
    return value


def load_npy_object(path: str | Path) -> Any:
    """Read a ``.npy`` file that may have Python objects: an object if 0-d (ARCTIC's ``.mano.npy``), else an array."""
    return _item(_load(path, allow_objects=True))


def load_npz_objects(path: str | Path, members: Collection[str] | None = None) -> dict[str, Any]:
    """Read members of an ``.npz`` file (all by default), 0-d arrays as their item, such as GRAB's sequence files.

    Raises BadInput if a member is absent, there are more than 256 members, or they unpack to more than 1 GiB, or to
    more than both 64 MiB and eight times the file.
    """
    with open_archive(path) as archive:
        chosen = _chosen_members(path, archive, members)
        size = StoredSize(Path(path).stat().st_size)
        return {name: _item(_read_member(path, archive, info, size)) for name, info in chosen.items()}


def load_npz_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """Read all members of an ``.npz`` file of plain arrays, which hoidata wrote, of any size.

    Raises BadInput for Python objects, or if it unpacks to more than both the file's size and the limit of
    ``load_npz_objects``.
    """
    with open_archive(path) as archive:
        infos = archive.infolist()
        _check_size(path, infos, Path(path).stat().st_size)
        return {info.filename.removesuffix(".npy"): _read_member(path, archive, info, None) for info in infos}


@contextmanager
def open_archive(path: str | Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive; any error of a damaged archive becomes a BadInput with its path."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except BadInput:
        raise
    except Exception as error:  # OSError, BadZipFile, zlib.error and the like have no common base
        raise BadInput(path, "a whole .npz file", f"{type(error).__name__}: {error}") from None


def _read_member(
    path: str | Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, stored: StoredSize | None
) -> np.ndarray:
    """Read one member. ``stored`` limits the cost of objects in the archive; None forbids objects."""
    source = f"{path}: {info.filename.removesuffix('.npy')}"
    with archive.open(info) as stream:
        array = _read(stream, source, info.file_size, stored)
        if stream.read(1):  # the end of the stream also checks the checksum
            raise BadInput(source, "nothing behind the array", "more bytes")
    return array


def _chosen_members(
    path: str | Path, archive: zipfile.ZipFile, members: Collection[str] | None
) -> dict[str, zipfile.ZipInfo]:
    infos = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    if len(infos) != len(archive.infolist()):
        raise BadInput(path, "each member once", "one of them twice")
    if len(infos) > _MAX_MEMBERS:
        raise BadInput(path, f"at most {_MAX_MEMBERS} members", str(len(infos)))
    if members is not None:
        absent = sorted(set(members) - set(infos))
        if absent:
            raise BadInput(path, f"members {sorted(members)}", f"a file without {absent}")
        infos = {name: info for name, info in infos.items() if name in members}
    _check_size(path, infos.values())
    return infos


def _check_size(path: str | Path, infos: Iterable[zipfile.ZipInfo], min_limit: int = 0) -> None:
    """Raise BadInput if members unpack to more than an archive of this size may, and more than ``min_limit`` bytes."""
    size = sum(info.file_size for info in infos)
    by_size = max(_FREE_BYTES, _UNPACKED_PER_BYTE * Path(path).stat().st_size)
    limit = max(min_limit, min(_MAX_BYTES, by_size))
    if size > limit:
        remedy = "download it again, or store it uncompressed"
        raise BadInput(path, f"at most {limit} bytes when unpacked", str(size), remedy)


def _load(path: str | Path, allow_objects: bool) -> np.ndarray:
    try:
        with open(path, "rb") as stream:
            size = Path(path).stat().st_size
            return _read(stream, path, size, StoredSize(size) if allow_objects else None)
    except OSError as error:
        raise BadInput(path, _FORMAT, f"{type(error).__name__}: {error.strerror}") from None


def _read(stream: Any, source: str | Path, size: int, stored: StoredSize | None) -> np.ndarray:
    """Read the array in a stream of ``size`` bytes. ``stored`` limits the cost of objects; None forbids objects."""
    header = read_npy_header(stream, source)
    if not header.dtype.hasobject:
        return read_plain_array(stream, header, size - stream.tell(), source)
    if stored is None:
        raise BadInput(source, "an array of numbers", "Python objects")
    value = restricted_load(stream, ARRAYS, path=source, archive=stored)
    if not isinstance(value, np.ndarray):
        raise BadInput(source, "a pickled array", type(value).__name__)
    return value


def _item(value: np.ndarray) -> Any:
    return value.item() if value.ndim == 0 else value
