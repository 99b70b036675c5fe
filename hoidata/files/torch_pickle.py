"""Reads plain pickles of torch tensors (TACO's hand files, OakInk2's annotations) without executing anything.

``pickle.dump`` of a tensor writes a call of ``torch.storage._load_from_bytes`` on the bytes of ``torch.save`` in the
legacy format. These are five pickles (magic number, protocol, system, the storage as a persistent id, keys), the number
of elements, and the elements. torch would load them with an unrestricted unpickler. Here ``restricted_load`` reads the
outer pickle. ``torch.load(weights_only=True)`` reads the bytes, after a check that they reference only a storage and
state no length beyond the data. Tensors become NumPy arrays. A regular expression parses the common form of a small
storage, because a recording of OakInk2 has a hundred thousand storages.
"""

import io
import math
import pickle
import pickletools
import re
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.errors import BadInput
from hoidata.files.npy_header import is_length
from hoidata.files.pickle_check import REFUSED_OPCODES
from hoidata.files.restricted_pickle import (
    ARRAYS,
    Allow,
    Budget,
    CheckedArray,
    StandIn,
    checked_keys,
    read_at_most,
    restricted_load,
)

MAX_FILE_BYTES = 256 << 20
# Tensors may repeat elements (``expand``); in total they may exceed the file by this much.
_REPEATED_BYTES = 64 << 20
_MAX_DIMENSIONS = 8
_MAGIC = 0x1950A86A20F9469CFC6C
_LEAST_LENGTH = 1001  # the protocol's number, which is also in the storage of a single element
_LEGACY_PICKLES = 5
_MAX_OPCODES = 1000  # of each pickle; torch writes 30 at most
_REFUSED_IN_STORAGES = REFUSED_OPCODES - {"BINPERSID"} | {"STACK_GLOBAL", "REDUCE", "NEWOBJ", "NEWOBJ_EX", "BUILD"}
# torch up to 1.9 stores CUDA storages as classes of torch.cuda, later versions by location. BFloat16 and quantized
# storages have no NumPy type.
STORAGE_NAMES = frozenset(
    f"{module} {kind}Storage"
    for module in ("torch", "torch.cuda")
    for kind in ("Double", "Float", "Half", "Long", "Int", "Short", "Char", "Byte", "Bool")
)
# A storage that torch wrote on a little-endian machine: its kind, key, length as an opcode, key, length, elements.
_COMMON_STORAGE = re.compile(
    b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.\x80\x02}q\x00"
    rb"\(X\x10\0\0\0protocol_versionq\x01M\xe9\x03X\r\0\0\0little_endianq\x02\x88X\n\0\0\0type_sizesq\x03}q\x04"
    rb"\(X\x05\0\0\0shortq\x05K\x02X\x03\0\0\0intq\x06K\x04X\x04\0\0\0longq\x07K\x04uu\."
    rb"\x80\x02\(X\x07\0\0\0storageq\0ctorch\n(Float|Double)Storage\nq\x01X(?P<length>.)\0\0\0(?P<key>\d{1,20})q\x02"
    rb"X\x03\0\0\0cpuq\x03(?:K(.)|M(..))Ntq\x04Q\.\x80\x02\]q\0X(?P=length)\0\0\0(?P=key)q\x01a\."
    rb"(.{8})",
    re.DOTALL,
)


def load_torch_pickle(source: str | Path | bytes, path: str | Path, arrays: bool = False) -> Any:
    """Load a plain pickle of torch tensors, parameters and ordered dictionaries in dicts, lists and tuples.

    Each tensor becomes a separate ``numpy.ndarray``. arrays: allow NumPy arrays too. Raises BadInput for other globals,
    other storage types, tensors that exceed their storage, or files over 256 MiB.
    """
    try:
        stream = io.BytesIO(source) if isinstance(source, bytes) else open(source, "rb")  # noqa: SIM115
    except OSError as error:
        raise BadInput(path, "a pickle of tensors", f"{type(error).__name__}: {error.strerror}") from None
    with stream:
        data = read_at_most(stream, MAX_FILE_BYTES + 1)
    allow = {**tensor_globals(len(data)), **(ARRAYS if arrays else {})}
    return restricted_load(data, allow, path=path, max_bytes=MAX_FILE_BYTES)


def tensor_globals(n_bytes: int) -> Allow:
    """The allow-list of one file of ``n_bytes``, which also limits the total size of its tensors."""
    budget = Budget(2 * n_bytes + _REPEATED_BYTES)  # storages, and the tensors on them

    def load_from_bytes(data: Any) -> _Storage:
        return _load_from_bytes(budget, data)

    def rebuild_tensor(*arguments: Any) -> CheckedArray:
        return _rebuild_tensor(budget, *arguments)

    return {
        ("torch._utils", "_rebuild_tensor_v2"): rebuild_tensor,
        ("torch._utils", "_rebuild_parameter"): _rebuild_parameter,
        ("torch.storage", "_load_from_bytes"): load_from_bytes,
        ("collections", "OrderedDict"): _ordered_dict,
    }


class _Storage(StandIn):
    """The elements of one storage, (element,), which a pickle can only pass on."""

    __slots__ = ("elements",)

    def __init__(self, elements: np.ndarray) -> None:
        self.elements = elements


def _rebuild_tensor(
    budget: Budget, storage: Any, offset: Any, size: Any, stride: Any, _requires_grad: Any = False, hooks: Any = None
) -> CheckedArray:
    if not isinstance(storage, _Storage) or hooks:
        raise pickle.UnpicklingError("a tensor without a storage, or with hooks")
    numbers = (offset, *size, *stride)
    if len(size) != len(stride) or len(size) > _MAX_DIMENSIONS or not all(map(is_length, numbers)):
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


def _rebuild_parameter(tensor: Any, _requires_grad: Any = False, hooks: Any = None) -> CheckedArray:
    if not isinstance(tensor, CheckedArray) or hooks:
        raise pickle.UnpicklingError("a parameter without a tensor, or with hooks")
    return tensor


def _ordered_dict(items: Any = ()) -> dict:
    if not isinstance(items, list | tuple):
        raise pickle.UnpicklingError(f"an ordered dictionary of a {type(items).__name__}")
    checked_keys([key for key, _ in items])
    return dict(items)


def _load_from_bytes(budget: Budget, data: Any) -> _Storage:
    """Load the storage in bytes written by ``torch.save(storage, _use_new_zipfile_serialization=False)``."""
    if not isinstance(data, bytes):
        raise pickle.UnpicklingError(f"a {type(data).__name__} in the place of a storage")
    budget.spend(len(data))  # a pickle can load the same bytes many times
    elements = _parse_common_storage(data)
    if elements is not None:
        return _Storage(elements)
    _check_storage(data)
    import torch

    storage = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    if not isinstance(storage, torch.TypedStorage):
        raise pickle.UnpicklingError(f"a {type(storage).__name__} in the place of a storage")
    return _Storage(torch.empty(0, dtype=storage.dtype).set_(storage._untyped_storage).numpy())


def _parse_common_storage(data: bytes) -> np.ndarray | None:
    """(element,) of a storage in the common form of torch; None for other bytes, which may still be a storage."""
    match = _COMMON_STORAGE.match(data)
    if match is None or match["length"][0] != len(match["key"]):
        return None
    kind, short, long, number = match[1], match[4], match[5], match[6]
    elements = data[match.end() :]
    count = int.from_bytes(short or long, "little")
    dtype = np.dtype("<f4" if kind == b"Float" else "<f8")
    if int.from_bytes(number, "little") != count or len(elements) != count * dtype.itemsize:
        return None
    return np.frombuffer(elements, dtype)


def _check_storage(data: bytes) -> None:
    """Refuse what a storage does not need. torch allocates the stated length before it checks the data."""
    stream = io.BytesIO(data)
    for _ in range(_LEGACY_PICKLES):
        for number, (opcode, argument, _place) in enumerate(pickletools.genops(stream)):
            is_large = isinstance(argument, int) and _MAGIC != argument > max(len(data), _LEAST_LENGTH)
            is_foreign = opcode.name == "GLOBAL" and argument not in STORAGE_NAMES
            if number > _MAX_OPCODES or is_large or is_foreign or opcode.name in _REFUSED_IN_STORAGES:
                raise pickle.UnpicklingError(f"a storage with {opcode.name} {argument}, which is not allowed"[:120])
