"""Mutations that know a format: opcodes of a pickle, fields of an NPY header, members of a zip, values of JSON.

Each takes a whole file apart, changes one part and puts it together again with lengths and checksums that fit, so that
the change reaches the code behind the container. What cannot be taken apart comes back unchanged.
"""

import ast
import gzip
import io
import json
import pickletools
import random
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence

from tests.fuzz.mutation import INTEGERS, mutate

Bytes = Callable[[random.Random, bytes], bytes]
_BROKEN = (ValueError, SyntaxError, KeyError, IndexError, EOFError, OSError, zipfile.BadZipFile, zlib.error)
_BROKEN_ZIP = (*_BROKEN, RuntimeError, NotImplementedError, struct.error, OverflowError)
_LENGTH_BYTES = {"BINBYTES": 4, "SHORT_BINBYTES": 1, "BINUNICODE": 4, "SHORT_BINUNICODE": 1, "BINBYTES8": 8}
_JSON_VALUES = (None, True, 0, -1, 1.5, 10**30, float("nan"), float("inf"), "", "x", "\ud800", [], {}, [[]], [1, 2, 3])


def pickle_mutation(pool: Sequence[bytes], inner: Bytes | None = None) -> Bytes:
    """Changes opcodes: removes, repeats, swaps, takes some from ``pool``, changes what they carry.

    inner: mutation of the bytes an opcode carries (a storage inside a tensor, for example).
    """

    def change(rng: random.Random, data: bytes) -> bytes:
        try:
            parts = _opcodes(data)
        except _BROKEN:
            return data
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            _change_opcodes(rng, parts, pool, inner)
        return b"".join(parts)

    return change


def _opcodes(data: bytes) -> list[bytes]:
    """Each opcode with its argument; what follows STOP is one more part. Frames are left out: they state lengths."""
    found = [(opcode.name, position) for opcode, _, position in pickletools.genops(data)]
    stops = [position for _, position in found[1:]] + [found[-1][1] + 1]
    parts = [data[start:stop] for (name, start), stop in zip(found, stops, strict=True) if name != "FRAME"]
    return [*parts, data[stops[-1] :]]


def _change_opcodes(rng: random.Random, parts: list[bytes], pool: Sequence[bytes], inner: Bytes | None) -> None:
    at, other = rng.randrange(len(parts)), rng.randrange(len(parts))
    match rng.randrange(7):
        case 0:
            del parts[at : at + rng.choice((1, 1, 2, 5))]
            if not parts:
                parts.append(b".")
        case 1:
            parts.insert(at, parts[other])
        case 2:
            parts[at], parts[other] = parts[other], parts[at]
        case 3:
            parts.insert(at, rng.choice(pool))
        case 4:
            parts[at] = rng.choice(pool)
        case 5:
            parts[at:at] = parts[other : other + rng.randrange(12)]
        case _:
            parts[at] = _other_argument(rng, parts[at], inner)


def _other_argument(rng: random.Random, part: bytes, inner: Bytes | None) -> bytes:
    """The same opcode with another argument; a stated length fits the new argument."""
    if len(part) < 2:
        return part
    size = {b"B": 4, b"C": 1, b"X": 4, b"\x8c": 1, b"U": 1, b"T": 4}.get(part[:1])
    if size is None:
        return part[:1] + mutate(rng, part[1:], (), (b"\n",))
    body = part[1 + size :]
    body = inner(rng, body) if inner is not None and len(body) > 16 else mutate(rng, body, (), (b"\0",))
    body = body[: (1 << 8 * size) - 1]
    return part[:1] + len(body).to_bytes(size, "little") + body


def storage_mutation(pool: Sequence[bytes]) -> Bytes:
    """Changes one of the five pickles of torch's legacy format, or the elements behind them."""
    change_pickle = pickle_mutation(pool)

    def change(rng: random.Random, data: bytes) -> bytes:
        stream, parts = io.BytesIO(data), []
        try:
            for _ in range(5):
                start = stream.tell()
                for _opcode in pickletools.genops(stream):
                    pass
                parts.append(data[start : stream.tell()])
        except _BROKEN:
            return mutate(rng, data, (), pool)
        parts.append(data[stream.tell() :])
        at = rng.randrange(6)
        parts[at] = change_pickle(rng, parts[at]) if at < 5 else mutate(rng, parts[at], (), pool)
        return b"".join(parts)

    return change


def npy_mutation(payload: Bytes) -> Bytes:
    """Changes shape, type, order or version of the header, or the payload."""

    def change(rng: random.Random, data: bytes) -> bytes:
        try:
            wide = data[6] > 1
            start = 12 if wide else 10
            stop = start + int.from_bytes(data[8:start], "little")
            header = ast.literal_eval(data[start:stop].decode("latin1"))
            body = data[stop:]
            if rng.random() < 0.5:
                body = payload(rng, body)
            else:
                header = _other_header(rng, dict(header))
        except (*_BROKEN, TypeError, MemoryError, RecursionError):
            return data
        return npy_bytes(header, body, rng.choice((1, 1, 1, 2, 3)))

    return change


def npy_bytes(header: object, body: bytes, version: int = 1) -> bytes:
    text = repr(header).encode("utf-8", "replace") + b"\n"
    size = len(text).to_bytes(2 if version == 1 else 4, "little") if len(text) < 65536 else b"\xff\xff"
    return b"\x93NUMPY" + bytes((version, 0)) + size + text + body


def _other_header(rng: random.Random, header: dict) -> dict:
    match rng.randrange(5):
        case 0:
            header["shape"] = tuple(rng.choice(INTEGERS) for _ in range(rng.randrange(5)))
        case 1:
            header["shape"] = tuple(rng.randrange(5) for _ in range(rng.randrange(70)))
        case 2:
            kinds = ("<f8", "<f4", "|O", "<U3", "|S2", "<M8[s]", "|V8", [("a", "<f8")], "|b1", "<c16", "f8,O", "x", 5)
            header["descr"] = rng.choice(kinds)
        case 3:
            header["fortran_order"] = rng.choice((True, 1, None, "x"))
        case _:
            key = rng.choice(("shape", "descr", "fortran_order", "more"))
            header[key] = rng.choice((None, (), (1, "2"), (True,), 1.5, "x", [3], {1: 2}))
    return header


def zip_mutation(member: Bytes) -> Bytes:
    """Changes one member, its name, its compression or its header; or adds, repeats or removes one."""

    def change(rng: random.Random, data: bytes) -> bytes:
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                items = [(info.filename, archive.read(info), info.compress_type) for info in archive.infolist()]
            return _zip_bytes(_other_items(rng, items, member))
        except _BROKEN_ZIP:
            return data

    return change


def _other_items(rng: random.Random, items: list, member: Bytes) -> list:
    if not items:
        return items
    at = rng.randrange(len(items))
    name, content, kind = items[at]
    match rng.randrange(8):
        case 0:
            del items[at]
        case 1:
            items.append(items[at])
        case 2:
            items[at] = (rng.choice(("", "x.npy", "../up.npy", "/abs.npy", name + "/", "a" * 300)), content, kind)
        case 3:
            items[at] = (name, content, rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
        case _:
            items[at] = (name, member(rng, content), kind)
    return items


def _zip_bytes(items: list) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content, kind in items:
            archive.NameToInfo.clear()  # or a repeated name would warn
            info = zipfile.ZipInfo(name or "x")  # its time is fixed
            info.compress_type = kind
            archive.writestr(info, content)
    return stream.getvalue()


def gzip_mutation(text: Bytes) -> Bytes:
    def change(rng: random.Random, data: bytes) -> bytes:
        try:
            return gzip.compress(text(rng, gzip.decompress(data)), 1, mtime=0)
        except _BROKEN:
            return data

    return change


def json_mutation(rng: random.Random, data: bytes) -> bytes:
    """Changes one value, or a key, somewhere in the tree; now and then nests it a thousand levels deep."""
    try:
        value = json.loads(data)
    except (*_BROKEN, RecursionError):
        return data
    if rng.random() < 0.02:
        depth = rng.choice((100, 1500, 5000))
        return b"[" * depth + data + b"]" * rng.choice((depth, 0))
    for _ in range(rng.choice((1, 1, 2, 3))):
        value = _other_json(rng, value)
    return json.dumps(value).encode("utf-8", "surrogatepass")


def _other_json(rng: random.Random, value: object) -> object:
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key = rng.choice(sorted(value))
        if rng.random() < 0.15:
            return {("x" if name == key else name): item for name, item in value.items()}
        if rng.random() < 0.15:
            return {name: item for name, item in value.items() if name != key}
        return {**value, key: _other_json(rng, value[key])}
    if isinstance(value, list) and value and rng.random() < 0.85:
        at = rng.randrange(len(value))
        if rng.random() < 0.3:
            return value[:at] + value[at + 1 :] if rng.random() < 0.5 else [*value, value[at]]
        return [*value[:at], _other_json(rng, value[at]), *value[at + 1 :]]
    return rng.choice(_JSON_VALUES)
