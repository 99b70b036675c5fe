"""Strict reader of NumPy's ``.npy`` format for untrusted files (numpy/lib/format.py, versions 1 to 3).

NumPy's reader raises a dozen kinds of errors on damaged headers, and allocates any shape that they state.
"""

import ast
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hoidata.errors import BadInput

_MAGIC = b"\x93NUMPY"
_MAX_HEADER_BYTES = 10_000
_PIECE_BYTES = 16 << 20
_MAX_DIMENSIONS = 32
_DTYPE = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248]|c8|c16|[SU]\d{1,6}|O8?)")
_PYTHON_2_LONG = re.compile(r"(?<=\d)L(?=[,)])")
_SUSPICIOUS = re.compile(r"\\|\d[A-Za-z_]")  # "1e5", "0if", "\\d": some raise a Python warning
_LARGEST_CODE_POINT = 0x10FFFF


class NpyHeader(NamedTuple):
    """The parsed header of an array."""

    shape: tuple[int, ...]
    by_columns: bool  # Fortran order
    dtype: np.dtype

    @property
    def n_bytes(self) -> int:
        """Bytes of the data after the header; meaningless for Python objects."""
        return math.prod(self.shape) * self.dtype.itemsize


def plain_dtype(text: Any) -> np.dtype:
    """The dtype for a string such as "<f8". Raises ValueError for records, dates, void and anything else."""
    if not isinstance(text, str) or not _DTYPE.fullmatch(text):
        raise ValueError(f"the type {str(text)[:40]!r}, which is not read")
    return np.dtype(text)


def check_text(data: bytes | bytearray | np.ndarray, dtype: np.dtype) -> None:
    """Raise ValueError for text (dtype U) with invalid code points, on which Python raises a SystemError."""
    if dtype.kind == "U" and len(data):
        codes = np.frombuffer(data, np.dtype(np.uint32).newbyteorder(dtype.byteorder))
        if codes.max() > _LARGEST_CODE_POINT:
            raise ValueError("text of impossible characters")


def read_npy_header(stream: Any, source: str | Path) -> NpyHeader:
    """Read the header at the start of a stream, up to the data. Raises BadInput naming ``source``."""
    start = stream.read(10)
    if len(start) < 10 or start[:6] != _MAGIC or start[6] not in (1, 2, 3):
        raise BadInput(source, "a NumPy file", f"one that starts with {start[:8]!r}")
    length_rest = b"" if start[6] == 1 else stream.read(2)
    length = int.from_bytes(start[8:] + length_rest, "little")
    text = stream.read(min(length, _MAX_HEADER_BYTES + 1))
    if not length == len(text) <= _MAX_HEADER_BYTES:
        raise BadInput(source, "a whole header of a NumPy file", f"{len(text)} of {length} bytes")
    try:
        return _parsed(text.decode("utf-8" if start[6] == 3 else "latin1"))
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        got = f"{type(error).__name__}: {error}".replace("MemoryError", "nested too deeply")
        raise BadInput(source, "the header of a NumPy file", got[:200]) from None


def _parsed(text: str) -> NpyHeader:
    text = _PYTHON_2_LONG.sub("", text.strip())
    if _SUSPICIOUS.search(text):
        raise ValueError("a number or text as no header has")
    values = ast.literal_eval(text)
    if not isinstance(values, dict) or set(values) != {"descr", "fortran_order", "shape"}:
        raise ValueError("other entries than descr, fortran_order and shape")
    shape, by_columns = values["shape"], values["fortran_order"]
    if not isinstance(shape, tuple) or len(shape) > _MAX_DIMENSIONS or not all(map(is_length, shape)):
        raise ValueError(f"the shape {str(shape)[:80]}")
    if not isinstance(by_columns, bool):
        raise ValueError(f"the order {str(by_columns)[:40]}")
    return NpyHeader(shape, by_columns, plain_dtype(values["descr"]))


def is_length(value: Any) -> bool:
    """Whether a value is an integer that can count elements."""
    return type(value) is int and 0 <= value < 2**48


def read_plain_array(stream: Any, header: NpyHeader, available: int, source: str | Path) -> np.ndarray:
    """Read the data after a header into a new array, if the ``available`` bytes suffice. Raises BadInput."""
    # NumPy allocates one character for an empty text.
    if max(header.n_bytes, 0 if header.dtype.itemsize else math.prod(header.shape)) > available:
        expected = f"{header.n_bytes} bytes of data for shape {header.shape}"
        raise BadInput(source, expected, f"{available} bytes")
    shape = header.shape[::-1] if header.by_columns else header.shape
    try:
        array = np.zeros(shape, header.dtype)
        data = array.reshape(-1).view(np.uint8) if array.nbytes else np.zeros(0, np.uint8)
        # Read in pieces, because a zip stream unpacks the whole requested size before it copies.
        for start in range(0, len(data), _PIECE_BYTES):
            piece = data[start : start + _PIECE_BYTES]
            if stream.readinto(piece.data) != len(piece):
                raise ValueError("fewer bytes than that")
        check_text(data, header.dtype)
    except ValueError as error:
        raise BadInput(source, f"{header.dtype} of shape {header.shape}", str(error)) from None
    return array.T if header.by_columns else array
