"""Arrays too large for memory inside the pickled members of ``.npz`` files, read a piece at a time.

GRAB files its contact labels as a pickled dict of two arrays that take up to 2 GB. The pickle is walked once: every
long byte string is skipped and replaced by a name for its place in the stream, what remains is small and goes through
``restricted_load``, where arrays are inert records. Only then the bytes of one array are read, in pieces, and only as
numbers. Nothing of the file is executed, and no length it states is allocated.
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

MOST_MEMBERS = 256
MOST_MEMBER_BYTES = 4 << 30
_REST_BYTES = 1 << 16  # what a dict of arrays takes without their data
_LONG_BYTES = 4096
_PIECE_BYTES = 4 << 20
_OPCODES = {opcode.code: opcode for opcode in pickletools.opcodes}
# Opcodes whose argument can be the data of an array, and how its length is written before it.
_BYTE_STRINGS = {"BINBYTES": "<I", "BINBYTES8": "<Q", "BYTEARRAY8": "<Q"}
_TEXTS = {"BINUNICODE": "<I", "BINUNICODE8": "<Q"}
_LONG_STRINGS = {**_BYTE_STRINGS, **_TEXTS}
_NUMBERS = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248])")
_PLACE = "hoidata place in the stream"


@dataclass(frozen=True)
class StoredArray:
    """A numeric array of a pickled ``.npz`` member, checked but not read.

    where: names it in errors. data: its bytes, or their place in the unpacked member. by_columns: stored column by
    column.
    """

    where: str
    path: Path
    member: str
    shape: tuple[int, ...]
    dtype: np.dtype
    data: "bytes | _Place"
    by_columns: bool

    def pieces(self) -> Iterator[tuple[int, np.ndarray]]:
        """Rows of a 2-d array (or its columns when ``by_columns``) in order: number of the first, and the rows.

        Each piece takes about 4 MB. Raises BadInput when the archive is damaged.
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
    """The names of an archive's members. Raises BadInput when it is no archive, or has more than 256."""
    with open_archive(path) as archive:
        names = {name.removesuffix(".npy") for name in archive.namelist()}
    if len(names) > MOST_MEMBERS:
        raise BadInput(path, f"at most {MOST_MEMBERS} members", str(len(names)))
    return names


def locate_arrays(path: str | Path, member: str) -> dict[str, StoredArray]:
    """The 2-d numeric arrays of the dict that ``member`` of an ``.npz`` file holds, none of them read.

    Raises BadInput when the member is missing, is no dict, could run code, or is damaged.
    """
    where = f"{path}: {member}"
    if member not in npz_members(path):
        raise BadInput(path, f"a member {member!r}", "a file without it")
    with open_archive(path) as archive:
        if archive.getinfo(f"{member}.npy").file_size > MOST_MEMBER_BYTES:
            raise BadInput(where, f"at most {MOST_MEMBER_BYTES} bytes when unpacked", "more")
        with archive.open(f"{member}.npy") as stream:
            counted = _Counted(stream)
            header = read_npy_header(counted, where)
            if header.shape != () or not header.dtype.hasobject:
                raise BadInput(where, "a pickled dict of arrays", f"an array of shape {header.shape}, {header.dtype}")
            rest, places = _without_long_strings(counted, where)
    content = _dict_of(where, restricted_load(rest, _allowed(places), where=where))
    found = {str(name): _stored(f"{where}.{name}", Path(path), member, value) for name, value in content.items()}
    return {name: array for name, array in found.items() if array is not None}


@dataclass(frozen=True)
class _Place:
    """Where the bytes of an array lie in the unpacked member.

    is_text: as text of one character per byte, in UTF-8; so Python 3 writes bytes by protocol 2 (NumPy before 1.17).
    """

    start: int
    length: int
    is_text: bool = False

    def may_hold(self, size: int) -> bool:
        """Whether so many bytes can lie there; a byte from 128 on takes two of UTF-8."""
        return size <= self.length <= 2 * size if self.is_text else self.length == size


class _BytesOfText:
    """Reads the bytes that a text of the stream stands for. length: of the text in the stream."""

    def __init__(self, stream: Any, length: int) -> None:
        self.stream, self.left, self.bytes = stream, length, bytearray()
        self.decoder = codecs.getincrementaldecoder("utf-8")()

    def read(self, size: int) -> bytes:
        while len(self.bytes) < size and self.left:
            data = self.stream.read(min(self.left, _PIECE_BYTES))
            self.left = self.left - len(data) if data else 0
            self.bytes += self.decoder.decode(data).encode("latin1")
        data = bytes(self.bytes[:size])
        del self.bytes[:size]
        return data


class _Counted:
    """A stream that knows how far it has been read, and that gives no more than a little at a time."""

    def __init__(self, stream: Any) -> None:
        self.stream, self.place, self.given = stream, 0, 0

    def read(self, size: int = -1) -> bytes:
        self._give(size if size >= 0 else _REST_BYTES + 1)
        data = self.stream.read(size)
        self.place += len(data)
        return data

    def readline(self, size: int | None = -1) -> bytes:
        data = self.stream.readline(_REST_BYTES)
        self.place += len(data)
        self._give(len(data))
        return data

    def skip(self, size: int) -> None:
        _skip(self.stream, size)
        self.place += size

    def _give(self, size: int) -> None:
        self.given += size
        if self.given > _REST_BYTES:
            raise ValueError(f"more than {_REST_BYTES} bytes beside its arrays")


def _without_long_strings(stream: _Counted, where: str) -> tuple[bytes, list[_Place]]:
    """The pickle with a global in the place of each long byte string, and where those strings lie."""
    rest, places = bytearray(), []
    while True:
        code = stream.read(1)
        opcode = _OPCODES.get(code.decode("latin1"))
        if opcode is None:
            raise BadInput(where, "a whole pickle", "its end" if not code else f"the unknown opcode {code!r}")
        argument = b""
        if opcode.name in _LONG_STRINGS:
            argument = _exactly(stream, struct.calcsize(_LONG_STRINGS[opcode.name]))
            (length,) = struct.unpack(_LONG_STRINGS[opcode.name], argument)
            if length > _LONG_BYTES:
                rest += f"c{_PLACE}\n{len(places)}\n".encode()
                places.append(_Place(stream.place, length, opcode.name in _TEXTS))
                stream.skip(length)
                continue
            argument += _exactly(stream, length)
        elif opcode.arg is not None:
            argument = _argument(stream, opcode.arg)
        if opcode.name != "FRAME":  # a hint of lengths that no longer hold
            rest += code + argument
        if opcode.name == "STOP":
            return bytes(rest), places


def _argument(stream: _Counted, kind: Any) -> bytes:
    """The bytes of an opcode's argument: of fixed size, up to a line's end, or with its length before it."""
    if kind.n >= 0:
        return _exactly(stream, kind.n)
    if kind.n == pickletools.UP_TO_NEWLINE:
        lines = 2 if kind.name == "stringnl_noescape_pair" else 1
        return b"".join(stream.readline() for _ in range(lines))
    sizes = {pickletools.TAKEN_FROM_ARGUMENT1: "<B", pickletools.TAKEN_FROM_ARGUMENT4: "<i"}
    sizes |= {pickletools.TAKEN_FROM_ARGUMENT4U: "<I", pickletools.TAKEN_FROM_ARGUMENT8U: "<Q"}
    before = _exactly(stream, struct.calcsize(sizes[kind.n]))
    (length,) = struct.unpack(sizes[kind.n], before)
    return before + _exactly(stream, length)


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
    """An array as its pickle describes it: version, shape, dtype, by columns, data."""


class _DtypeRecord(Record):
    """A dtype as its pickle describes it: ``text`` such as "i8", then its byte order within the state."""

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
    """Python 3's way to write bytes by protocol 2; the place of a long text stays a place."""
    if isinstance(text, _Place) and encoding in ("latin1", "latin-1"):
        return text
    return ARRAYS["_codecs", "encode"](text, encoding)


def _allowed(places: list[_Place]) -> dict[tuple[str, str], Any]:
    cores = ("numpy.core", "numpy._core")
    arrays = {(f"{core}.multiarray", name): _array_record for core in cores for name in ("_reconstruct", "scalar")}
    buffers = {(f"{core}.numeric", "_frombuffer"): _buffer_record for core in cores}
    others = {("numpy", "dtype"): _dtype_record, ("_codecs", "encode"): _encoded}
    return {**ARRAYS, **others, **arrays, **buffers, **{(_PLACE, str(at)): place for at, place in enumerate(places)}}


def _dict_of(where: str, record: Any) -> dict[Any, Any]:
    """The dict inside the record of a 0-d object array."""
    state = getattr(record, "state", None)
    items = state[4] if isinstance(state, tuple) and len(state) == 5 and state[1] == () else None
    if not isinstance(items, list) or len(items) != 1 or not isinstance(items[0], dict):
        raise BadInput(where, "a dict of arrays", type(record).__name__)
    return items[0]


def _stored(where: str, path: Path, member: str, record: Any) -> StoredArray | None:
    """What the record says, when it is a 2-d array of numbers whose data are as long as its shape says."""
    state = getattr(record, "state", None)
    if not isinstance(record, _ArrayRecord) or not isinstance(state, tuple) or len(state) != 5:
        return None
    _, shape, dtype, by_columns, raw = state
    dtype = _number_type(where, dtype)
    if not isinstance(shape, tuple) or len(shape) != 2 or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise BadInput(where, "an array of rows and columns", f"shape {shape}")
    size = math.prod(shape) * dtype.itemsize
    if isinstance(raw, _Place):
        fits, length = raw.may_hold(size), raw.length
    else:
        length = len(raw) if isinstance(raw, bytes | bytearray) else 0
        fits = length == size
    if not fits:
        raise BadInput(where, f"{size} bytes for shape {shape}", f"{length}")
    data = raw if isinstance(raw, _Place) else bytes(raw)
    return StoredArray(where, path, member, shape, dtype, data, bool(by_columns))


def _number_type(where: str, record: Any) -> np.dtype:
    text, state = getattr(record, "text", ""), getattr(record, "state", None)
    order = state[1] if isinstance(state, tuple) and len(state) > 1 else "|"
    if not _NUMBERS.fullmatch(text) or order not in ("<", ">", "|", "="):
        raise BadInput(where, "an array of numbers", f"type {text or type(record).__name__}")
    return np.dtype(text).newbyteorder(order)
