"""The header of NumPy's ``.npy`` format, read strictly, and plain arrays behind it without trusting its numbers.

NumPy's own reader raises errors of a dozen kinds on damaged headers and allocates whatever shape they state
(format: numpy/lib/format.py, versions 1 to 3).
"""

import ast
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hoidata.errors import BadInput

_MAGIC = b"\x93NUMPY"
_LONGEST_HEADER = 10_000
_PIECE_BYTES = 16 << 20
_MOST_DIMENSIONS = 32
_DTYPE = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248]|c8|c16|[SU]\d{1,6}|O8?)")
_PYTHON_2_LONG = re.compile(r"(?<=\d)L(?=[,)])")
_WARNED_ABOUT = re.compile(r"\\|\d[A-Za-z_]")  # "1e5", "0if", "\\d": Python reads some of them with a warning
_LARGEST_CODE_POINT = 0x10FFFF


class NpyHeader(NamedTuple):
    """What a header states. n_bytes: of the data behind it; meaningless for Python objects."""

    shape: tuple[int, ...]
    by_columns: bool
    dtype: np.dtype

    @property
    def n_bytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def plain_dtype(text: Any) -> np.dtype:
    """The type a string such as "<f8" names. Raises ValueError for records, dates, void and anything else."""
    if not isinstance(text, str) or not _DTYPE.fullmatch(text):
        raise ValueError(f"the type {str(text)[:40]!r}, which is not read")
    return np.dtype(text)


def check_text(data: bytes | bytearray | np.ndarray, dtype: np.dtype) -> None:
    """Refuse text (dtype U) of impossible characters, on which Python raises a SystemError. Raises ValueError."""
    if dtype.kind == "U" and len(data):
        codes = np.frombuffer(data, np.dtype(np.uint32).newbyteorder(dtype.byteorder))
        if codes.max() > _LARGEST_CODE_POINT:
            raise ValueError("text of impossible characters")


def read_npy_header(stream: Any, where: str | Path) -> NpyHeader:
    """The header at the start of ``stream``, which then stands at the data. Raises BadInput for anything else."""
    start = stream.read(10)
    if len(start) < 10 or start[:6] != _MAGIC or start[6] not in (1, 2, 3):
        raise BadInput(where, "a NumPy file", f"one that starts with {start[:8]!r}")
    more = b"" if start[6] == 1 else stream.read(2)
    length = int.from_bytes(start[8:] + more, "little")
    text = stream.read(min(length, _LONGEST_HEADER + 1))
    if not length == len(text) <= _LONGEST_HEADER:
        raise BadInput(where, "a whole header of a NumPy file", f"{len(text)} of {length} bytes")
    try:
        return _parsed(text.decode("utf-8" if start[6] == 3 else "latin1"))
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        got = f"{type(error).__name__}: {error}".replace("MemoryError", "nested too deeply")
        raise BadInput(where, "the header of a NumPy file", got[:200]) from None


def _parsed(text: str) -> NpyHeader:
    text = _PYTHON_2_LONG.sub("", text.strip())
    if _WARNED_ABOUT.search(text):
        raise ValueError("a number or text as no header has")
    values = ast.literal_eval(text)
    if not isinstance(values, dict) or set(values) != {"descr", "fortran_order", "shape"}:
        raise ValueError("other entries than descr, fortran_order and shape")
    shape, by_columns = values["shape"], values["fortran_order"]
    if not isinstance(shape, tuple) or len(shape) > _MOST_DIMENSIONS or not all(map(is_length, shape)):
        raise ValueError(f"the shape {str(shape)[:80]}")
    if not isinstance(by_columns, bool):
        raise ValueError(f"the order {str(by_columns)[:40]}")
    return NpyHeader(shape, by_columns, plain_dtype(values["descr"]))


def is_length(value: Any) -> bool:
    """A whole number that can count elements."""
    return type(value) is int and 0 <= value < 2**48


def read_plain_array(stream: Any, header: NpyHeader, available: int, where: str | Path) -> np.ndarray:
    """The numbers or texts behind a header, as an own array. available: bytes there are, before any is allocated."""
    # NumPy makes room for a character where a text has none.
    if max(header.n_bytes, 0 if header.dtype.itemsize else math.prod(header.shape)) > available:
        expected = f"{header.n_bytes} bytes of data for shape {header.shape}"
        raise BadInput(where, expected, f"{available} bytes")
    shape = header.shape[::-1] if header.by_columns else header.shape
    try:
        array = np.zeros(shape, header.dtype)
        data = array.reshape(-1).view(np.uint8) if array.nbytes else np.zeros(0, np.uint8)
        # In pieces: a zip file's stream unpacks all that it is asked for before it copies any.
        for start in range(0, len(data), _PIECE_BYTES):
            piece = data[start : start + _PIECE_BYTES]
            if stream.readinto(piece.data) != len(piece):
                raise ValueError("fewer bytes than that")
        check_text(data, header.dtype)
    except ValueError as error:
        raise BadInput(where, f"{header.dtype} of shape {header.shape}", str(error)) from None
    return array.T if header.by_columns else array
