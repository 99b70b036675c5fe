"""Read plain pickles that hold torch tensors (TACO's hand files) without torch and without executing anything.

``pickle.dump`` of a tensor writes a call of ``torch.storage._load_from_bytes`` on the bytes of ``torch.save`` in its
legacy format (torch/serialization.py, ``_legacy_save``): five pickles (magic number, protocol, system, the storage as
a persistent id, keys), then the number of elements (int64) and the elements. torch would open those bytes with an
unrestricted unpickler; here they are parsed by the rules below, and tensors come back as NumPy arrays.
"""

import io
import math
import pickle
import pickletools
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.errors import BadInput
from hoidata.files.pickle_check import REFUSED_OPCODES, check_opcodes
from hoidata.files.restricted_pickle import (
    Allow,
    Budget,
    CheckedArray,
    StandIn,
    checked_keys,
    read_at_most,
    restricted_load,
)

MAX_FILE_BYTES = 256 << 20
# Tensors may repeat elements (``expand``); together they may be this much larger than the file.
_REPEATED_BYTES = 64 << 20
_MAX_DIMENSIONS = 8
_MAGIC = 0x1950A86A20F9469CFC6C
_PROTOCOL = 1001
_LEGACY_PICKLES = 5
_MOST_OPCODES = 1000  # of each; torch writes 30 at most
# Little-endian. BFloat16 and quantised storages have no NumPy type and are refused.
_STORAGE_DTYPES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "|b1",
}
# torch up to 1.9 names CUDA storages as classes of torch.cuda; later ones by their location only.
STORAGE_CLASSES = {(module, name): kind for module in ("torch", "torch.cuda") for name, kind in _STORAGE_DTYPES.items()}


def load_torch_pickle(source: str | Path | bytes, where: str | Path) -> Any:
    """The object in a plain pickle of torch tensors, each tensor as an own ``numpy.ndarray`` on the CPU.

    source: the file's path or its bytes; ``where`` names it in errors. Tensors of any device, parameters and ordered
    dictionaries are read, inside dicts, lists and tuples. Raises BadInput for anything else: other globals, other
    storage types, tensors that reach outside their storage, files over 256 MiB.
    """
    try:
        stream = io.BytesIO(source) if isinstance(source, bytes) else open(source, "rb")  # noqa: SIM115
    except OSError as error:
        raise BadInput(where, "a pickle of tensors", f"{type(error).__name__}: {error.strerror}") from None
    with stream:
        data = read_at_most(stream, MAX_FILE_BYTES + 1)
    return restricted_load(data, tensor_globals(where, len(data)), where=where, max_bytes=MAX_FILE_BYTES)


def tensor_globals(where: str | Path, n_bytes: int) -> Allow:
    """The exact allow-list of one file of ``n_bytes``, which also limits how large its tensors get together."""
    budget = Budget(n_bytes + _REPEATED_BYTES)

    def load_from_bytes(data: Any) -> _Storage:
        return _load_from_bytes(where, data)

    def rebuild_tensor(*arguments: Any) -> CheckedArray:
        return _rebuild_tensor(budget, *arguments)

    return {
        ("torch._utils", "_rebuild_tensor_v2"): rebuild_tensor,
        ("torch._utils", "_rebuild_parameter"): _rebuild_parameter,
        ("torch.storage", "_load_from_bytes"): load_from_bytes,
        ("collections", "OrderedDict"): _ordered_dict,
    }


class _Storage(StandIn):
    """The elements of one storage, (element,), read-only. A pickle can only hand it on."""

    __slots__ = ("elements",)

    def __init__(self, elements: np.ndarray) -> None:
        self.elements = elements


def _rebuild_tensor(
    budget: Budget, storage: Any, offset: Any, size: Any, stride: Any, _requires_grad: Any = False, hooks: Any = None
) -> CheckedArray:
    if not isinstance(storage, _Storage) or hooks:
        raise pickle.UnpicklingError("a tensor without a storage, or with hooks")
    numbers = (offset, *size, *stride)
    if len(size) != len(stride) or len(size) > _MAX_DIMENSIONS or not all(_is_natural(number) for number in numbers):
        raise pickle.UnpicklingError(f"a tensor of size {size} and stride {stride}"[:120])
    elements = storage.elements
    last = offset + sum((length - 1) * step for length, step in zip(size, stride, strict=True))
    if 0 not in size and last >= len(elements):
        raise pickle.UnpicklingError(f"a tensor that ends at element {last} of {len(elements)}"[:120])
    budget.spend(math.prod(size) * elements.itemsize)
    if 0 in size:
        return np.zeros(size, elements.dtype).view(CheckedArray)
    strides = tuple(step * elements.itemsize for step in stride)
    view = np.lib.stride_tricks.as_strided(elements[offset:], size, strides, writeable=False)
    return view.copy().view(CheckedArray)


def _is_natural(number: Any) -> bool:
    return type(number) is int and 0 <= number < 2**48


def _rebuild_parameter(tensor: Any, _requires_grad: Any = False, hooks: Any = None) -> CheckedArray:
    if not isinstance(tensor, CheckedArray) or hooks:
        raise pickle.UnpicklingError("a parameter without a tensor, or with hooks")
    return tensor


def _ordered_dict(items: Any = ()) -> dict:
    if not isinstance(items, list | tuple):
        raise pickle.UnpicklingError(f"an ordered dictionary of a {type(items).__name__}")
    checked_keys([key for key, _ in items])
    return dict(items)


def _load_from_bytes(where: str | Path, data: Any) -> _Storage:
    """The storage in bytes written by ``torch.save(storage, _use_new_zipfile_serialization=False)``."""
    if not isinstance(data, bytes):
        raise pickle.UnpicklingError(f"a {type(data).__name__} in the place of a storage")
    (magic, protocol, system, head, keys), elements = _split(data)
    if restricted_load(magic, {}, where=where) != _MAGIC or restricted_load(protocol, {}, where=where) != _PROTOCOL:
        raise pickle.UnpicklingError("a storage that torch.save did not write")
    facts = restricted_load(system, {}, where=where)
    if not isinstance(facts, dict) or facts.get("little_endian") is not True:
        raise pickle.UnpicklingError("a storage of a big-endian machine")
    dtype, key, length = _storage_head(head)
    if restricted_load(keys, {}, where=where) != [key]:
        raise pickle.UnpicklingError("a storage without its key")
    if int.from_bytes(elements[:8], "little") != length or len(elements) != 8 + length * dtype.itemsize:
        raise pickle.UnpicklingError(f"a storage of {length} {dtype} in {len(elements)} bytes")
    return _Storage(np.frombuffer(elements, dtype, length, offset=8))


def _split(data: bytes) -> tuple[list[bytes], memoryview]:
    """The five pickles of the legacy format and what follows them."""
    stream, parts = io.BytesIO(data), []
    for _ in range(_LEGACY_PICKLES):
        start = stream.tell()
        for number, _opcode in enumerate(pickletools.genops(stream)):
            if number > _MOST_OPCODES:
                raise pickle.UnpicklingError("a storage that torch.save did not write")
        parts.append(data[start : stream.tell()])
    return parts, memoryview(data)[stream.tell() :]  # not copied: a pickle can ask for the same storage many times


def _storage_head(data: bytes) -> tuple[np.dtype, str, int]:
    """Type, key and number of elements from ``("storage", class, key, location, length, None)``."""
    check_opcodes(data, REFUSED_OPCODES - {"BINPERSID"})
    found = _HeadUnpickler(io.BytesIO(data), fix_imports=False).load()
    if not isinstance(found, _Head):
        raise pickle.UnpicklingError("something else in the place of a storage")
    return found.dtype, found.key, found.length


class _Head(StandIn):
    """What a storage's persistent id says; any location (``cuda:0``) is the CPU here."""

    __slots__ = ("dtype", "key", "length")

    def __init__(self, dtype: np.dtype, key: str, length: int) -> None:
        self.dtype, self.key, self.length = dtype, key, length


class _HeadUnpickler(pickle.Unpickler):
    """Knows the names of storage classes and nothing else; they stand for NumPy types."""

    def find_class(self, module: str, name: str) -> Any:
        try:
            kind = STORAGE_CLASSES[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is not allowed") from None
        return _StorageClass(np.dtype(kind))

    def persistent_load(self, pid: Any) -> _Head:
        word, kind, key, location, length, view = pid
        if word != "storage" or not isinstance(kind, _StorageClass) or view is not None:
            raise pickle.UnpicklingError("a persistent id that is no whole storage")
        if not (isinstance(key, str) and isinstance(location, str) and _is_natural(length)):
            raise pickle.UnpicklingError("a persistent id that is no whole storage")
        return _Head(kind.dtype, key, length)


class _StorageClass(StandIn):
    """Stands for a class such as ``torch.FloatStorage``; cannot be called or changed."""

    __slots__ = ("dtype",)

    def __init__(self, dtype: np.dtype) -> None:
        self.dtype = dtype
