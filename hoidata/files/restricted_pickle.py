"""Read pickles and NumPy files of others without executing anything in them.

A pickle may only name the (module, name) pairs of an allow-list, and each is mapped to a function of ours that checks
its arguments; everything else is refused before it is looked up. Every problem is a ``BadInput`` that names the file.
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
# What calls in a pickle make may take twice its bytes, twice those it is stored in and this: a call can be repeated in
# a few bytes, and a compressed member may unpack to a thousand times its size.
_GROWTH = 2
_FREE_BYTES = 64 << 20
Allow = Mapping[tuple[str, str], Any]

_REMEDY = "download it again from the dataset's own site; it is not opened otherwise, because it could run code"


def restricted_load(
    source: bytes | BinaryIO,
    allow: Allow,
    encoding: str = "ASCII",
    where: str | Path = "pickle",
    max_bytes: int = MAX_BYTES,
    archive: "StoredSize | None" = None,
) -> Any:
    """Unpickle ``source`` with only the globals of ``allow``; arrays come back as plain ``numpy.ndarray``.

    allow: (module, name) -> what stands for it; ``ARRAYS`` covers arrays in containers. encoding: "latin1" for files
    written by Python 2. archive: of a pickle inside a compressed file. Raises BadInput for anything malformed,
    oversized or not allowed.
    """
    data = source if isinstance(source, bytes) else read_at_most(source, max_bytes + 1)
    if len(data) > max_bytes:
        raise BadInput(where, f"at most {max_bytes} bytes", "more", _REMEDY)
    try:
        archive = archive or StoredSize(len(data))
        check_opcodes(data, limit=archive.opcodes)
        most = _GROWTH * (len(data) + archive.n_bytes) + _FREE_BYTES
        value = _Unpickler(io.BytesIO(data), allow, encoding, Budget(most)).load()
        _written_out(value, {}, most)
        return _plain(value, {})
    except BadInput:
        raise
    except Exception as error:  # a malformed pickle can raise anything
        text = f"{type(error).__name__}: {error}"
        raise BadInput(where, "a pickle of arrays, containers, numbers and strings", text, _REMEDY) from None


def read_at_most(stream: BinaryIO, size: int) -> bytes:
    """As ``stream.read(size)``, which allocates ``size`` bytes before it looks how many there are."""
    pieces, left = [], size
    while left and (piece := stream.read(min(left, _PIECE_BYTES))):
        pieces.append(piece)
        left -= len(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


class StoredSize:
    """What the pickles in one archive may cost together, by the bytes of the archive itself."""

    def __init__(self, n_bytes: int) -> None:
        self.n_bytes = n_bytes
        self.opcodes = OpcodeLimit(n_bytes)


class Budget:
    """Bytes that may still be allocated for one file."""

    def __init__(self, n_bytes: int) -> None:
        self.left = n_bytes

    def spend(self, n_bytes: int) -> None:
        self.left -= n_bytes
        if self.left < 0:
            raise pickle.UnpicklingError("values that are together far larger than the file")


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: BinaryIO, allow: Allow, encoding: str, budget: Budget) -> None:
        super().__init__(stream, fix_imports=False, encoding=encoding)
        self._allow = allow
        self._budget = budget

    def find_class(self, module: str, name: str) -> Any:
        try:
            allowed = self._allow[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is not allowed") from None
        return _Callable(allowed, self._budget) if isinstance(allowed, FunctionType) else allowed

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("it holds a persistent id, which is not allowed")


class StandIn:
    """Something a pickle may name or pass on but not change (BUILD), and that no result holds."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError(f"it changes a {type(self).__name__}, which is not allowed")


class _Callable(StandIn):
    """An allowed function that a pickle can call and nothing else: BUILD on it could set its defaults for all files."""

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


def _written_out(value: Any, known: dict[int, int | None], most: int) -> int:
    """Bytes a value takes with all it shares written out, as NumPy makes one array of lists of lists.

    A few hundred bytes of pickle can hold one list 2^60 times. Raises UnpicklingError above ``most`` and for values
    that hold themselves.
    """
    if isinstance(value, str | bytes | bytearray):
        return len(value)
    if id(value) not in known:  # first: to list what an array of objects holds takes as long as it is large
        items = _items(value)
        if not len(items):
            return value.nbytes if isinstance(value, np.ndarray) else 8
        known[id(value)] = None
        known[id(value)] = 8 + sum(_written_out(item, known, most) for item in items)
    size = known[id(value)]
    if size is None:
        raise pickle.UnpicklingError("a value that holds itself")
    if size > most:
        raise pickle.UnpicklingError("values that are, written out, far larger than the file")
    return size


def _items(value: Any) -> Collection[Any]:
    """What a value holds, keys of dictionaries and members of sets apart, which are small."""
    if isinstance(value, dict):
        return value.values()
    if isinstance(value, np.ndarray):
        return value.ravel().tolist() if value.dtype.hasobject else ()
    if isinstance(value, Record):
        return () if value.state is None else (value.state,)
    return value if isinstance(value, list | tuple) else ()


def _plain(value: Any, seen: dict[int, tuple[Any, Any]]) -> Any:
    """The same value with our array class replaced by ``numpy.ndarray``.

    ``seen`` maps the id of each value to (value, result), so that shared and cyclic ones are visited once.
    """
    if id(value) in seen:
        return seen[id(value)][1]
    if isinstance(value, CheckedArray):
        result = value.view(np.ndarray)
        seen[id(value)] = value, result
        if result.dtype.hasobject:
            for index, item in enumerate(list(result.flat)):
                result.flat[index] = _plain(item, seen)
        return result
    if isinstance(value, tuple):
        result = tuple(_plain(item, seen) for item in value)
        seen[id(value)] = value, result
        return result
    if isinstance(value, StandIn | _DtypeRecord):
        raise pickle.UnpicklingError(f"it holds a {type(value).__name__} by itself")
    if isinstance(value, dict | list | Record):
        seen[id(value)] = value, value
        _make_items_plain(value, seen)
    return value


def _make_items_plain(value: "dict | list | Record", seen: dict[int, tuple[Any, Any]]) -> None:
    if isinstance(value, dict):
        value.update({key: _plain(item, seen) for key, item in value.items()})
    elif isinstance(value, list):
        value[:] = [_plain(item, seen) for item in value]
    else:
        value.state = _plain(value.state, seen)


class Record:
    """Inert stand-in for a foreign class: keeps the pickled state in ``state`` and does nothing."""

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
        wanted = math.prod(shape) * (1 if kind.hasobject else kind.itemsize)
        if len(raw) != wanted:
            raise pickle.UnpicklingError(f"an array of shape {tuple(shape)} with {len(raw)} in the place of {wanted}")
        if self.budget is not None:
            self.budget.spend(len(raw) * (kind.itemsize if kind.hasobject else 1))
        super().__setstate__((1, tuple(shape), kind, bool(is_fortran), raw))  # type: ignore[arg-type]


class _DtypeRecord:
    """A dtype built from a checked string; its state may only set the byte order."""

    def __init__(self, dtype: np.dtype) -> None:
        self.dtype = dtype

    def __setstate__(self, state: tuple) -> None:
        order, structure = state[1], state[2:5]
        if order not in ("<", ">", "|", "=") or any(item is not None for item in structure):
            raise pickle.UnpicklingError("a structured dtype, which is not allowed")
        self.dtype = self.dtype.newbyteorder(order)


class _NdarrayType(StandIn):
    """Stands for ``numpy.ndarray`` where a pickle names it as the type to rebuild; cannot be called or changed."""

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
    """Array data as bytes; Python 2 strings arrive as latin1 text."""
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
    """The items, known not to be tuples and others that hashing can take for ever (see pickle_check)."""
    for item in items:
        if isinstance(item, tuple | frozenset) or (isinstance(item, int) and is_large(item)):
            raise pickle.UnpicklingError(f"a {type(item).__name__} as a key, which is not allowed")
    return items


def _numpy_globals() -> dict[tuple[str, str], Any]:
    """NumPy 1 calls its inner package ``numpy.core``, NumPy 2 ``numpy._core``; files of both are read."""
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
