"""Reads untrusted pickles and NumPy files without executing anything in them.

A pickle may only reference the (module, name) pairs of an allow-list. Each pair maps to a function of hoidata that
checks its arguments. Any other reference is refused before it is resolved. All errors are ``BadInput`` with the file.
"""

import io
import math
import pickle
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import FunctionType
from typing import Any, BinaryIO

import numpy as np

from hoidata.errors import BadInput
from hoidata.files.npy_header import check_text, plain_dtype
from hoidata.files.pickle_check import OpcodeLimit, check_opcodes, is_large

MAX_BYTES = 2 << 30
_PIECE_BYTES = 1 << 20
# Values may take twice the pickle's bytes, plus twice the file's, plus this: a few bytes can repeat a call, and a
# compressed member may unpack to a thousand times its size.
_GROWTH = 2
_FREE_BYTES = 64 << 20
Allow = Mapping[tuple[str, str], Any]

_REMEDY = "download it again from the dataset's own site; hoidata refuses to open it, because it could run code"


def restricted_load(
    source: bytes | BinaryIO,
    allow: Allow,
    encoding: str = "ASCII",
    path: str | Path = "pickle",
    max_bytes: int = MAX_BYTES,
    archive: "StoredSize | None" = None,
) -> Any:
    """Unpickle data with only the globals of an allow-list; arrays become plain ``numpy.ndarray``. Else raise BadInput.

    Args:
        source: the pickle.
        allow: replacement of each allowed (module, name); ``ARRAYS`` allows arrays in containers.
        encoding: "latin1" for files written by Python 2.
        path: names the file in errors.
        max_bytes: limit of the pickle's size.
        archive: shared limits of all pickles in one compressed file.
    """
    data = source if isinstance(source, bytes) else read_at_most(source, max_bytes + 1)
    if len(data) > max_bytes:
        raise BadInput(path, f"at most {max_bytes} bytes", "more", _REMEDY)
    try:
        archive = archive or StoredSize(len(data))
        check_opcodes(data, limit=archive.opcodes)
        limit = _GROWTH * (len(data) + archive.n_bytes) + _FREE_BYTES
        value = _Unpickler(io.BytesIO(data), allow, encoding, Budget(limit)).load()
        _expanded_size(value, {}, limit)
        return _with_plain_arrays(value, {})
    except BadInput:
        raise
    except Exception as error:  # a malformed pickle can raise anything
        text = f"{type(error).__name__}: {error}"
        raise BadInput(path, "a pickle of arrays, containers, numbers and strings", text, _REMEDY) from None


def read_at_most(stream: BinaryIO, size: int) -> bytes:
    """Read up to ``size`` bytes in pieces, because ``stream.read(size)`` allocates ``size`` bytes in advance."""
    pieces, n_left = [], size
    while n_left and (piece := stream.read(min(n_left, _PIECE_BYTES))):
        pieces.append(piece)
        n_left -= len(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


class StoredSize:
    """Shared limits of all pickles in one archive, from the archive's size."""

    def __init__(self, n_bytes: int) -> None:
        self.n_bytes = n_bytes
        self.opcodes = OpcodeLimit(n_bytes)


class Budget:
    """Bytes that may still be allocated for one file."""

    def __init__(self, n_bytes: int) -> None:
        self.n_left = n_bytes

    def spend(self, n_bytes: int) -> None:
        """Count an allocation. Raises UnpicklingError above the budget."""
        self.n_left -= n_bytes
        if self.n_left < 0:
            raise pickle.UnpicklingError("values that are together far larger than the file")


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: BinaryIO, allow: Allow, encoding: str, budget: Budget) -> None:
        super().__init__(stream, fix_imports=False, encoding=encoding)
        self._allow = allow
        self._budget = budget

    def find_class(self, module: str, name: str) -> Any:
        """Resolve a global by the allow-list."""
        try:
            allowed = self._allow[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is not allowed") from None
        return _Callable(allowed, self._budget) if isinstance(allowed, FunctionType) else allowed

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("it holds a persistent id, which is not allowed")


class StandIn:
    """A value that a pickle may reference or pass on, but not change (BUILD) or return in a result."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError(f"it changes a {type(self).__name__}, which is not allowed")


class _Callable(StandIn):
    """An allowed function that a pickle can only call, because BUILD could change its defaults for all files."""

    __slots__ = ("_budget", "_function")

    def __init__(self, function: Callable[..., Any], budget: Budget) -> None:
        self._function = function
        self._budget = budget

    def __call__(self, *arguments: Any) -> Any:
        result = self._function(*arguments)
        if isinstance(result, CheckedArray):
            result.budget = self._budget
            self._budget.spend(result.nbytes)
        elif isinstance(result, bytes | set | dict):
            self._budget.spend(sys.getsizeof(result))
        return result


def _expanded_size(value: Any, sizes: dict[int, int | None], limit: int) -> int:
    """Size of a value in bytes if shared items are copied, as NumPy does for an array of nested lists.

    A pickle of a few hundred bytes can contain one list 2^60 times. ``sizes`` caches sizes by id. Raises
    UnpicklingError if the size exceeds ``limit``, or the value contains itself.
    """
    if isinstance(value, str | bytes | bytearray):
        return len(value)
    if id(value) not in sizes:  # first, because listing the items of an object array takes linear time
        items = _items(value)
        if not len(items):
            return value.nbytes if isinstance(value, np.ndarray) else 8
        sizes[id(value)] = None
        sizes[id(value)] = 8 + sum(_expanded_size(item, sizes, limit) for item in items)
    size = sizes[id(value)]
    if size is None:
        raise pickle.UnpicklingError("a value that holds itself")
    if size > limit:
        raise pickle.UnpicklingError("values that are, written out, far larger than the file")
    return size


def _items(value: Any) -> Collection[Any]:
    """The items of a value, without keys of dictionaries and members of sets, which are small."""
    if isinstance(value, dict):
        return value.values()
    if isinstance(value, np.ndarray):
        return value.ravel().tolist() if value.dtype.hasobject else ()
    if isinstance(value, Record):
        return () if value.state is None else (value.state,)
    return value if isinstance(value, list | tuple) else ()


def _with_plain_arrays(value: Any, visited: dict[int, tuple[Any, Any]]) -> Any:
    """Replace ``CheckedArray`` by ``numpy.ndarray`` in a value.

    ``visited`` maps the id of each value to (value, result), so that shared and cyclic values are visited once.
    """
    if id(value) in visited:
        return visited[id(value)][1]
    if isinstance(value, CheckedArray):
        result = value.view(np.ndarray)
        visited[id(value)] = value, result
        if result.dtype.hasobject:
            for index, item in enumerate(list(result.flat)):
                result.flat[index] = _with_plain_arrays(item, visited)
        return result
    if isinstance(value, tuple):
        result = tuple(_with_plain_arrays(item, visited) for item in value)
        visited[id(value)] = value, result
        return result
    if isinstance(value, StandIn | _DtypeRecord):
        raise pickle.UnpicklingError(f"it holds a {type(value).__name__} by itself")
    if isinstance(value, dict | list | Record):
        visited[id(value)] = value, value
        _replace_items(value, visited)
    return value


def _replace_items(value: "dict | list | Record", visited: dict[int, tuple[Any, Any]]) -> None:
    if isinstance(value, dict):
        value.update({key: _with_plain_arrays(item, visited) for key, item in value.items()})
    elif isinstance(value, list):
        value[:] = [_with_plain_arrays(item, visited) for item in value]
    else:
        value.state = _with_plain_arrays(value.state, visited)


class Record:
    """Inert replacement of a foreign class, which only stores the pickled state."""

    state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class CheckedArray(np.ndarray):
    """An array whose pickled state is checked before NumPy sees it."""

    budget: Budget | None = None

    def __setstate__(self, state: tuple) -> None:  # type: ignore[override]
        _, shape, dtype, is_fortran, raw = state
        kind = _checked_dtype(dtype)
        if not all(isinstance(length, int) and length >= 0 for length in shape):
            raise pickle.UnpicklingError(f"an array of shape {shape}")
        if kind.hasobject and not isinstance(raw, list):
            raise pickle.UnpicklingError("an object array without a list of its items")
        if not kind.hasobject:
            raw = _as_bytes(raw)
            check_text(raw, kind)
        # NumPy trusts the length of an object array's list and reads past its end.
        length = math.prod(shape) * (1 if kind.hasobject else kind.itemsize)
        if len(raw) != length:
            raise pickle.UnpicklingError(f"an array of shape {tuple(shape)} with {len(raw)} in the place of {length}")
        if self.budget is not None:
            self.budget.spend(len(raw) * (kind.itemsize if kind.hasobject else 1))
        super().__setstate__((1, tuple(shape), kind, bool(is_fortran), raw))  # type: ignore[arg-type]


class _DtypeRecord:
    """A dtype from a checked string; BUILD may only set its byte order."""

    def __init__(self, dtype: np.dtype) -> None:
        self.dtype = dtype

    def __setstate__(self, state: tuple) -> None:
        order, structure = state[1], state[2:5]
        if order not in ("<", ">", "|", "=") or any(item is not None for item in structure):
            raise pickle.UnpicklingError("a structured dtype, which is not allowed")
        self.dtype = self.dtype.newbyteorder(order)


class _NdarrayType(StandIn):
    """Replaces ``numpy.ndarray`` as the type to rebuild; it cannot be called or changed."""

    __slots__ = ()


_NDARRAY = _NdarrayType()


def _dtype(text: Any, align: Any = False, copy: Any = False) -> _DtypeRecord:
    text = text.decode("latin1") if isinstance(text, bytes) else text
    return _DtypeRecord(plain_dtype(text))


def _checked_dtype(value: Any) -> np.dtype:
    if not isinstance(value, _DtypeRecord):
        raise pickle.UnpicklingError(f"a {type(value).__name__} in the place of a dtype")
    return value.dtype


def _as_bytes(raw: Any) -> bytes:
    """Array data as bytes; Python 2 strings are latin1 text."""
    if isinstance(raw, str):
        return raw.encode("latin1")
    if isinstance(raw, bytes | bytearray):
        return bytes(raw)
    raise pickle.UnpicklingError(f"a {type(raw).__name__} in the place of array data")


def _reconstruct(subtype: Any, shape: Any, dtype: Any) -> CheckedArray:
    if subtype is not _NDARRAY or tuple(shape) != (0,):
        raise pickle.UnpicklingError("an array subclass or a preset shape, which is not allowed")
    return np.ndarray.__new__(CheckedArray, (0,), np.int8)


def _scalar(dtype: Any, raw: Any = b"") -> Any:
    kind = _checked_dtype(dtype)
    if kind.hasobject or kind.kind == "c":  # the hash of a complex number can be chosen
        raise pickle.UnpicklingError(f"a scalar of dtype {kind}, which is not allowed")
    data = _as_bytes(raw)
    if len(data) != kind.itemsize:
        raise pickle.UnpicklingError(f"a scalar of {len(data)} bytes for dtype {kind}")
    check_text(data, kind)
    return np.frombuffer(data, kind)[0] if data else kind.type()


def _frombuffer(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    kind = _checked_dtype(dtype)
    if kind.hasobject or order not in ("C", "F"):
        raise pickle.UnpicklingError("a buffer of objects or unknown order, which is not allowed")
    data = bytearray(_as_bytes(raw))
    check_text(data, kind)
    return np.frombuffer(data, kind).reshape(shape, order=order).view(CheckedArray)


def _encode(text: Any, encoding: Any = None) -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"_codecs.encode to {encoding!r}, which is not allowed")
    return text.encode("latin1")


def _empty_bytes() -> bytes:
    """Python 3 writes empty bytes below protocol 3 as a call of ``bytes`` without arguments."""
    return b""


def _set(items: Any = ()) -> set:
    if not isinstance(items, list | tuple):
        raise pickle.UnpicklingError(f"a set of a {type(items).__name__}")
    return set(checked_keys(items))


def checked_keys(items: Sequence[Any]) -> Sequence[Any]:
    """The items, after a check that each is quick to hash (see pickle_check)."""
    for item in items:
        if isinstance(item, tuple | frozenset) or (isinstance(item, int) and is_large(item)):
            raise pickle.UnpicklingError(f"a {type(item).__name__} as a key, which is not allowed")
    return items


def _numpy_globals() -> dict[tuple[str, str], Any]:
    """Globals of arrays for NumPy 1 (``numpy.core``) and NumPy 2 (``numpy._core``)."""
    allowed: dict[tuple[str, str], Any] = {("numpy", "ndarray"): _NDARRAY, ("numpy", "dtype"): _dtype}
    for core in ("numpy.core", "numpy._core"):
        allowed[f"{core}.multiarray", "_reconstruct"] = _reconstruct
        allowed[f"{core}.multiarray", "scalar"] = _scalar
        allowed[f"{core}.numeric", "_frombuffer"] = _frombuffer
    return allowed


# Arrays, NumPy scalars, sets and Python-3 bytes, inside dicts, lists, tuples, strings and numbers.
ARRAYS: Allow = {
    **_numpy_globals(),
    ("_codecs", "encode"): _encode,
    ("__builtin__", "bytes"): _empty_bytes,
    ("__builtin__", "set"): _set,
    ("builtins", "set"): _set,
}
