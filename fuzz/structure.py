"""Mutations that know a format: opcodes of a pickle, fields of an NPY header, members of a zip.

Each takes a whole file apart, changes one part and puts it together again with lengths and checksums that fit, so that
the change reaches the code behind the container. What cannot be taken apart comes back unchanged.
"""

import ast
import io
import pickletools
import random
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence

LONGEST = 1 << 14
NUMBERS = (
    *(b"0", b"-1", b"1", b"2", b"255", b"256", b"32768", b"65536", b"2147483647", b"2147483648", b"4294967295"),
    *(b"1000000000", b"9223372036854775807", b"9223372036854775808", b"18446744073709551616", b"1e5", b"1e308"),
    *(b"1e999", b"-1e999", b"nan", b"inf", b"-inf", b"NaN", b"1_0", b"0x10", b"1.5", b".5", b"--1"),
)
INTEGERS = (0, 1, -1, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 10**9)
Bytes = Callable[[random.Random, bytes], bytes]
_BROKEN = (ValueError, SyntaxError, KeyError, IndexError, EOFError, OSError, zipfile.BadZipFile, zlib.error)
_BROKEN_ZIP = (*_BROKEN, RuntimeError, NotImplementedError, struct.error, OverflowError)
_LENGTH_BYTES = {"BINBYTES": 4, "SHORT_BINBYTES": 1, "BINUNICODE": 4, "SHORT_BINUNICODE": 1, "BINBYTES8": 8}


def mutate(rng: random.Random, data: bytes, words: Sequence[bytes] = (b"\0",)) -> bytes:
    """``data`` inside a container with a span left out, repeated, or overwritten by a word or by one of ``NUMBERS``."""
    start = rng.randrange(len(data) + 1)
    stop = min(len(data), start + 1 + int(rng.expovariate(1 / 8)))
    new = (b"", data[start:stop] * rng.choice((2, 3, 50)), rng.choice(words), rng.choice(NUMBERS), rng.randbytes(1))
    return data[:start] + rng.choice(new) + data[stop:]


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
        return part[:1] + mutate(rng, part[1:], (b"\n",))
    body = part[1 + size :]
    body = inner(rng, body) if inner is not None and len(body) > 16 else mutate(rng, body)
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
            return mutate(rng, data, pool)
        parts.append(data[stream.tell() :])
        at = rng.randrange(6)
        parts[at] = change_pickle(rng, parts[at]) if at < 5 else mutate(rng, parts[at], pool)
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
