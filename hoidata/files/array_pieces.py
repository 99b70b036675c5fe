"""Reads arrays inside pickled members of ``.npz`` files in pieces, for arrays larger than memory.

GRAB stores its contact labels as a pickled dict of two arrays of up to 2 GB. One pass over the pickle skips each long
byte string and replaces it by its location in the stream. The remaining pickle is small, and ``restricted_load`` reads
it with inert records for arrays. Then the bytes of one array are read in pieces, as numbers only. Nothing in the file
is executed, and no stated length is allocated.
"""

import codecs
import io
import math
import pickletools
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from hoidata.errors import BadInput
from hoidata.files.npy_header import read_npy_header
from hoidata.files.numpy_files import open_archive
from hoidata.files.restricted_pickle import ARRAYS, Record, restricted_load

MAX_MEMBERS = 256
MAX_MEMBER_BYTES = 4 << 30
_MAX_SMALL_BYTES = 1 << 16  # of a pickled dict of arrays without the data of the arrays
_LONG_BYTES = 4096
_PIECE_BYTES = 4 << 20
_OPCODES = {opcode.code: opcode for opcode in pickletools.opcodes}
# Opcodes whose argument can be the data of an array, and the format of the length before it.
_BYTE_STRINGS = {"BINBYTES": "<I", "BINBYTES8": "<Q", "BYTEARRAY8": "<Q"}
_TEXTS = {"BINUNICODE": "<I", "BINUNICODE8": "<Q"}
_LONG_STRINGS = {**_BYTE_STRINGS, **_TEXTS}
_NUMBERS = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248])")
_LOCATION = "hoidata place in the stream"  # module name of the globals that stand for locations


@dataclass(frozen=True)
class StoredArray:
    """A numeric array of a pickled ``.npz`` member, checked but not read."""

    source: str  # names the array in errors
    path: Path
    member: str
    shape: tuple[int, ...]
    dtype: np.dtype
    data: "bytes | _Location"  # its bytes, or their location in the unpacked member
    by_columns: bool  # stored in Fortran order

    def pieces(self) -> Iterator[tuple[int, np.ndarray]]:
        """Iterate over pieces of about 4 MB: index of the first row, and rows (columns if ``by_columns``).

        Raises BadInput for a damaged archive.
        """
        count, length = self.shape[::-1] if self.by_columns else self.shape
        step = max(1, _PIECE_BYTES // max(1, length * self.dtype.itemsize))
        with self._open() as stream:
            for first in range(0, count, step):
                rows = min(step, count - first)
                data = _exactly(stream, rows * length * self.dtype.itemsize)
                yield first, np.frombuffer(data, self.dtype).reshape(rows, length)

    @contextmanager
    def _open(self) -> "Iterator[Any]":
        if isinstance(self.data, bytes):
            yield io.BytesIO(self.data)
            return
        with open_archive(self.path) as archive, archive.open(f"{self.member}.npy") as stream:
            _skip(stream, self.data.start)
            yield _BytesOfText(stream, self.data.length) if self.data.is_text else stream


def npz_members(path: str | Path) -> set[str]:
    """Names of an archive's members. Raises BadInput if it is not an archive, or has more than 256 members."""
    with open_archive(path) as archive:
        names = {name.removesuffix(".npy") for name in archive.namelist()}
    if len(names) > MAX_MEMBERS:
        raise BadInput(path, f"at most {MAX_MEMBERS} members", str(len(names)))
    return names


def locate_arrays(path: str | Path, member: str) -> dict[str, StoredArray]:
    """Locate the 2-d numeric arrays in the pickled dict of an ``.npz`` member, without reading their data.

    Raises BadInput if the member is missing, is not a dict, could run code, or is damaged.
    """
    source = f"{path}: {member}"
    if member not in npz_members(path):
        raise BadInput(path, f"a member {member!r}", "a file without it")
    with open_archive(path) as archive:
        if archive.getinfo(f"{member}.npy").file_size > MAX_MEMBER_BYTES:
            raise BadInput(source, f"at most {MAX_MEMBER_BYTES} bytes when unpacked", "more")
        with archive.open(f"{member}.npy") as stream:
            counted = _CountingStream(stream)
            header = read_npy_header(counted, source)
            if header.shape != () or not header.dtype.hasobject:
                raise BadInput(source, "a pickled dict of arrays", f"an array of shape {header.shape}, {header.dtype}")
            small_pickle, locations = _without_long_strings(counted, source)
    content = _dict_of(source, restricted_load(small_pickle, _allowed(locations), path=source))
    items = ((str(name), _checked_array(f"{source}.{name}", Path(path), member, v)) for name, v in content.items())
    return {name: array for name, array in items if array is not None}


@dataclass(frozen=True)
class _Location:
    """Location of an array's bytes in the unpacked member."""

    start: int
    length: int
    # One UTF-8 character per byte: Python 3 writes bytes so in pickle protocol 2 (NumPy before 1.17).
    is_text: bool = False

    def may_hold(self, size: int) -> bool:
        """Whether the location can have ``size`` bytes; a byte of 128 or more takes two in UTF-8."""
        return size <= self.length <= 2 * size if self.is_text else self.length == size


class _BytesOfText:
    """Stream of the bytes that are encoded as a text of ``length`` bytes in another stream."""

    def __init__(self, stream: Any, length: int) -> None:
        self.stream, self.n_left, self.bytes = stream, length, bytearray()
        self.decoder = codecs.getincrementaldecoder("utf-8")()

    def read(self, size: int) -> bytes:
        """Read up to ``size`` decoded bytes."""
        while len(self.bytes) < size and self.n_left:
            data = self.stream.read(min(self.n_left, _PIECE_BYTES))
            self.n_left = self.n_left - len(data) if data else 0
            self.bytes += self.decoder.decode(data).encode("latin1")
        data = bytes(self.bytes[:size])
        del self.bytes[:size]
        return data


class _CountingStream:
    """A stream that counts its offset and limits the total size of its reads, without skipped bytes."""

    def __init__(self, stream: Any) -> None:
        self.stream, self.offset, self.n_read = stream, 0, 0

    def read(self, size: int = -1) -> bytes:
        """Read as a stream does, within the limit."""
        self._count(size if size >= 0 else _MAX_SMALL_BYTES + 1)
        data = self.stream.read(size)
        self.offset += len(data)
        return data

    def readline(self, size: int | None = -1) -> bytes:
        """Read one line, within the limit."""
        data = self.stream.readline(_MAX_SMALL_BYTES)
        self.offset += len(data)
        self._count(len(data))
        return data

    def skip_bytes(self, count: int) -> None:
        """Skip bytes, which do not count for the limit."""
        _skip(self.stream, count)
        self.offset += count

    def _count(self, size: int) -> None:
        self.n_read += size
        if self.n_read > _MAX_SMALL_BYTES:
            raise ValueError(f"more than {_MAX_SMALL_BYTES} bytes besides its arrays")


def _without_long_strings(stream: _CountingStream, source: str) -> tuple[bytes, list[_Location]]:
    """The pickle with each long byte string replaced by a global, and the locations of these strings."""
    small_pickle, locations = bytearray(), []
    while True:
        code = stream.read(1)
        opcode = _OPCODES.get(code.decode("latin1"))
        if opcode is None:
            raise BadInput(source, "a whole pickle", "its end" if not code else f"the unknown opcode {code!r}")
        argument = b""
        if opcode.name in _LONG_STRINGS:
            argument = _exactly(stream, struct.calcsize(_LONG_STRINGS[opcode.name]))
            (length,) = struct.unpack(_LONG_STRINGS[opcode.name], argument)
            if length > _LONG_BYTES:
                small_pickle += f"c{_LOCATION}\n{len(locations)}\n".encode()
                locations.append(_Location(stream.offset, length, opcode.name in _TEXTS))
                stream.skip_bytes(length)
                continue
            argument += _exactly(stream, length)
        elif opcode.arg is not None:
            argument = _argument(stream, opcode.arg)
        if opcode.name != "FRAME":  # frame lengths are wrong after the replacement
            small_pickle += code + argument
        if opcode.name == "STOP":
            return bytes(small_pickle), locations


def _argument(stream: _CountingStream, kind: Any) -> bytes:
    """The bytes of an opcode's argument: of fixed size, up to the end of a line, or after its length."""
    if kind.n >= 0:
        return _exactly(stream, kind.n)
    if kind.n == pickletools.UP_TO_NEWLINE:
        lines = 2 if kind.name == "stringnl_noescape_pair" else 1
        return b"".join(stream.readline() for _ in range(lines))
    sizes = {pickletools.TAKEN_FROM_ARGUMENT1: "<B", pickletools.TAKEN_FROM_ARGUMENT4: "<i"}
    sizes |= {pickletools.TAKEN_FROM_ARGUMENT4U: "<I", pickletools.TAKEN_FROM_ARGUMENT8U: "<Q"}
    stated_length = _exactly(stream, struct.calcsize(sizes[kind.n]))
    (length,) = struct.unpack(sizes[kind.n], stated_length)
    return stated_length + _exactly(stream, length)


def _exactly(stream: Any, size: int) -> bytes:
    data = stream.read(size) if size >= 0 else b""
    if len(data) != size:
        raise EOFError(f"{size} bytes expected, {len(data)} left")
    return data


def _skip(stream: BinaryIO | Any, size: int) -> None:
    while size > 0:
        data = stream.read(min(size, 1 << 20))
        if not data:
            raise EOFError(f"the file ends {size} bytes early")
        size -= len(data)


class _ArrayRecord(Record):
    """The pickled state of an array: version, shape, dtype, by_columns, data."""


class _DtypeRecord(Record):
    """The pickled state of a dtype: ``text`` such as "i8", and the byte order in the state."""

    text = ""


def _dtype_record(text: Any, *_: Any) -> _DtypeRecord:
    record = _DtypeRecord()
    record.text = text if isinstance(text, str) else ""
    return record


def _array_record(*_: Any) -> _ArrayRecord:
    return _ArrayRecord()


def _buffer_record(raw: Any, dtype: Any, shape: Any, order: Any) -> _ArrayRecord:
    record = _ArrayRecord()
    record.state = (1, shape, dtype, order == "F", raw)
    return record


def _encoded(text: Any, encoding: Any = None) -> Any:
    """Replace ``_codecs.encode``, which protocol 2 calls for bytes; the location of a long text is unchanged."""
    if isinstance(text, _Location) and encoding in ("latin1", "latin-1"):
        return text
    return ARRAYS["_codecs", "encode"](text, encoding)


def _allowed(locations: list[_Location]) -> dict[tuple[str, str], Any]:
    cores = ("numpy.core", "numpy._core")
    arrays = {(f"{core}.multiarray", name): _array_record for core in cores for name in ("_reconstruct", "scalar")}
    buffers = {(f"{core}.numeric", "_frombuffer"): _buffer_record for core in cores}
    others = {("numpy", "dtype"): _dtype_record, ("_codecs", "encode"): _encoded}
    places = {(_LOCATION, str(index)): location for index, location in enumerate(locations)}
    return {**ARRAYS, **others, **arrays, **buffers, **places}


def _dict_of(source: str, record: Any) -> dict[Any, Any]:
    """The dict inside the record of a 0-d object array."""
    state = getattr(record, "state", None)
    items = state[4] if isinstance(state, tuple) and len(state) == 5 and state[1] == () else None
    if not isinstance(items, list) or len(items) != 1 or not isinstance(items[0], dict):
        raise BadInput(source, "a dict of arrays", type(record).__name__)
    return items[0]


def _checked_array(source: str, path: Path, member: str, record: Any) -> StoredArray | None:
    """The array that a record describes, after a check of dtype, shape and length; None for other records."""
    state = getattr(record, "state", None)
    if not isinstance(record, _ArrayRecord) or not isinstance(state, tuple) or len(state) != 5:
        return None
    _, shape, dtype, by_columns, raw = state
    dtype = _number_type(source, dtype)
    if not isinstance(shape, tuple) or len(shape) != 2 or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise BadInput(source, "an array of rows and columns", f"shape {shape}")
    size = math.prod(shape) * dtype.itemsize
    if isinstance(raw, _Location):
        fits, length = raw.may_hold(size), raw.length
    else:
        length = len(raw) if isinstance(raw, bytes | bytearray) else 0
        fits = length == size
    if not fits:
        raise BadInput(source, f"{size} bytes for shape {shape}", f"{length}")
    data = raw if isinstance(raw, _Location) else bytes(raw)
    return StoredArray(source, path, member, shape, dtype=dtype, data=data, by_columns=bool(by_columns))


def _number_type(source: str, record: Any) -> np.dtype:
    text, state = getattr(record, "text", ""), getattr(record, "state", None)
    order = state[1] if isinstance(state, tuple) and len(state) > 1 else "|"
    if not _NUMBERS.fullmatch(text) or order not in ("<", ">", "|", "="):
        raise BadInput(source, "an array of numbers", f"type {text or type(record).__name__}")
    return np.dtype(text).newbyteorder(order)
