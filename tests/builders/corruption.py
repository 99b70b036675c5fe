"""Ways to corrupt a file of a raw tree: ``at(path, change)`` and others return a function of the root."""

import gzip
import io
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

Corrupt = Callable[[Path], object]
Change = Callable[[bytes], bytes]
CANARY = Path("canary")


def at(path: str, change: Change) -> Corrupt:
    """Change the content of a file, which is created if it is missing."""

    def corrupt(root: Path) -> None:
        file = root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(change(file.read_bytes() if file.exists() else b""))

    return corrupt


def holding(path: str, content: bytes | str) -> Corrupt:
    return at(path, lambda _: content.encode() if isinstance(content, str) else content)


def removed(path: str) -> Corrupt:
    return lambda root: (root / path).unlink()


def linked_outside(path: str) -> Corrupt:
    def corrupt(root: Path) -> None:
        outside = root.parent / "outside"
        (root / path).rename(outside)
        (root / path).symlink_to(outside)

    return corrupt


def without_folder(path: str) -> Corrupt:
    return lambda root: shutil.rmtree(root / path)


def one_after_the_other(*corruptions: Corrupt) -> Corrupt:
    return lambda root: [corrupt(root) for corrupt in corruptions]


def cut_in_half(data: bytes) -> bytes:
    return data[: len(data) // 2]


def emptied(_: bytes) -> bytes:
    return b""


class Command:
    """Pickles as a call that would create a file."""

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {CANARY.resolve()}",)


def malicious(_: bytes = b"") -> bytes:
    return pickle.dumps(Command(), 3)


def npy_of(value: object) -> bytes:
    stream = io.BytesIO()
    np.save(stream, value)  # type: ignore[arg-type]
    return stream.getvalue()


def huge_npy(_: bytes) -> bytes:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 7), }\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(64)


def in_array(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change the array of an .npy file."""
    return lambda data: npy_of(change(np.load(io.BytesIO(data))))


def in_gzip(change: Change) -> Change:
    return lambda data: gzip.compress(change(gzip.decompress(data)), 1, mtime=0)


def replaced(old: bytes, new: bytes) -> Change:
    def change(data: bytes) -> bytes:
        assert old in data
        return data.replace(old, new, 1)

    return change


def with_member(name: str, content: bytes, again: bool = False) -> Change:
    """An .npz file with one member replaced or duplicated."""

    def change(data: bytes) -> bytes:
        stream = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as new:
            for info in old.infolist():
                if info.filename != name or again:
                    new.writestr(info.filename, old.read(info))
            new.NameToInfo.clear()
            new.writestr(name, content)
        return stream.getvalue()

    return change


def set_in(*path: str, value: object) -> Callable[[dict], None]:
    """A change of one entry of nested dictionaries."""

    def change(data: dict) -> None:
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = value

    return change


FLAT_OBJ = b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"
NO_FACE_OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
FAR_CORNER_OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1000000000\n"
HUGE_PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\nproperty float y\n"
HUGE_PLY += b"property float z\nend_header\n" + bytes(64)
NO_FACE_PLY = HUGE_PLY.replace(b"1000000000", b"5")
