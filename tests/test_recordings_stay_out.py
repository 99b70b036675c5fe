"""No byte of the real recordings is in a tracked file or in the wheel; skipped without their variables."""

import gzip
import hashlib
import os
import re
import subprocess
import zipfile
from base64 import b64decode, b64encode
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hoidata.clips.clip import SIDES, Clip
from hoidata.datasets import RawTree
from hoidata.datasets.arctic.adapter import ArcticAdapter
from hoidata.datasets.manipnet.adapter import ManipNetAdapter, read_recording
from hoidata.errors import BadInput
from hoidata.files import load_npy_object
from hoidata.hands import load_mano_hands
from tests.builders.wheel import PROJECT, build_wheel

WINDOW = 64  # bytes
WINDOWS_PER_FILE, WINDOWS_PER_ARRAY, CONVERTED = 40, 25, 12
HEADER = 512  # bytes at the start of a file that may be those of its format
DISTINCT = 10  # minimum number of different bytes in a window, so that padding is not searched for
BASE64 = re.compile(rb"[A-Za-z0-9+/]{128,}")
# hand/ of ARCTIC is a stand-in made from hoidata's own hand; the others are recordings, meshes or published networks.
RECORDED = {"arctic": ("raw_seqs", "meta", "joints"), "manipnet": ("sequences", "objects", "trajectories", "weights")}


def windows_of(content: bytes, count: int, start: int = 0) -> Iterator[bytes]:
    """Up to ``count`` evenly spaced windows of some bytes, without those of few different bytes."""
    last = len(content) - WINDOW
    for position in np.linspace(start, last, count, dtype=int) if last >= start else ():
        window = content[position : position + WINDOW]
        if len(set(window)) >= DISTINCT:
            yield window


def windows_of_array(array: np.ndarray) -> Iterator[bytes]:
    """Windows of the array as float32 and as float64."""
    for dtype in (np.float32, np.float64):
        yield from windows_of(np.ascontiguousarray(array, dtype).tobytes(), WINDOWS_PER_ARRAY)


def arrays_of(value: Any) -> Iterator[np.ndarray]:
    """The arrays of numbers in nested dictionaries and lists."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from arrays_of(item)
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
        yield value


def arctic_arrays(root: Path) -> Iterator[np.ndarray]:
    """The arrays of all raw sequences, and those of some converted ones."""
    for path in sorted((root / "raw_seqs").glob("*/*.npy")):
        yield from arrays_of(load_npy_object(path))
    hands, adapter = load_mano_hands(root / "hand"), ArcticAdapter(clips="whole")
    keys = adapter.sequences(root)
    for key in keys[:: len(keys) // CONVERTED]:
        for clip in adapter.load(RawTree(root), key, hands):
            assert isinstance(clip, Clip)
            tracks = (clip.object, *(clip.hands[side] for side in SIDES))
            yield from arrays_of([*(vars(track) for track in tracks), clip.object.model.vertices_m])


def manipnet_arrays(root: Path) -> Iterator[np.ndarray]:
    """Keypoints, object poses and meshes of the readable sequences."""
    for key in ManipNetAdapter().sequences(root):
        try:
            recording = read_recording(RawTree(root), key.name)
        except BadInput:
            continue
        yield from arrays_of([vars(recording), recording.model.vertices_m])


ARRAYS = {"arctic": arctic_arrays, "manipnet": manipnet_arrays}


def raw_files(root: Path, folders: tuple[str, ...]) -> Iterator[bytes]:
    """The contents of all files in some folders, unpacked."""
    for folder in folders:
        for path in sorted(file for file in (root / folder).rglob("*") if file.is_file()):
            yield gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()


class Haystack:
    """Files, with what their archives and base64 texts unpack to."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self.contents = [item for name, content in files.items() for item in _unpacked(name, content)]

    def containing(self, windows: set[bytes]) -> set[str]:
        """The names of the files that contain a window at any offset."""
        heads = np.unique(np.frombuffer(b"".join(window[:8] for window in sorted(windows)), "<u8"))
        return {name for name, content in self.contents if _contains(content, windows, heads)}

    def equal_to(self, digests: set[str]) -> set[str]:
        """The names of the files with one of these SHA-256 digests."""
        return {name for name, content in self.contents if hashlib.sha256(content).hexdigest() in digests}


def _unpacked(name: str, content: bytes) -> Iterator[tuple[str, bytes]]:
    yield name, content
    if zipfile.is_zipfile(BytesIO(content)):
        with zipfile.ZipFile(BytesIO(content)) as archive:
            for member in archive.namelist():
                yield from _unpacked(f"{name}/{member}", archive.read(member))
    for text in BASE64.findall(content):
        yield f"{name}/base64", b64decode(text[: len(text) // 4 * 4])


def _contains(content: bytes, windows: set[bytes], heads: np.ndarray) -> bool:
    """heads: (head,) uint64, sorted: the first 8 bytes of the windows."""
    for offset in range(min(8, max(0, len(content) - 8))):
        words = np.frombuffer(content, "<u8", (len(content) - offset) // 8, offset)
        places = np.minimum(np.searchsorted(heads, words), len(heads) - 1)
        for index in np.flatnonzero(heads[places] == words):
            position = offset + 8 * int(index)
            if content[position : position + WINDOW] in windows:
                return True
    return False


@pytest.fixture(scope="module")
def haystack(tmp_path_factory) -> Haystack:
    """The tracked files and those of the wheel."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=PROJECT, capture_output=True, text=True, check=True).stdout
    paths = [PROJECT / name for name in filter(None, listed.split("\0"))]
    files = {str(path): path.read_bytes() for path in (*paths, build_wheel(tmp_path_factory.mktemp("wheel")))}
    return Haystack(files)


@pytest.mark.slow
@pytest.mark.parametrize("dataset", ["arctic", "manipnet"])
def test_no_byte_of_the_recordings_is_in_a_tracked_file_or_in_the_wheel(haystack, dataset) -> None:
    variable = f"HOIDATA_{dataset.upper()}"
    if variable not in os.environ:
        pytest.skip(f"{variable} is not set")
    root = Path(os.environ[variable])
    windows: set[bytes] = set()
    digests: set[str] = set()
    for content in raw_files(root, RECORDED[dataset]):
        digests.add(hashlib.sha256(content).hexdigest())
        windows.update(windows_of(content, WINDOWS_PER_FILE, HEADER))
    for array in ARRAYS[dataset](root):
        windows.update(windows_of_array(array))
    assert len(windows) > 1000
    assert any(name.endswith(".whl/hoidata/__init__.py") for name, _ in haystack.contents)
    assert haystack.equal_to(digests) == set()
    assert haystack.containing(windows) == set()


def test_a_window_is_found_at_any_offset_in_an_archive_and_in_base64() -> None:
    recorded = np.random.default_rng(0).normal(size=(90, 45))
    windows = set(windows_of_array(recorded))
    archive = BytesIO()
    np.savez_compressed(archive, pose=recorded.astype(np.float32)[20:])
    planted = {
        "shifted.bin": b"abc" + recorded.tobytes(),
        "archive.npz": archive.getvalue(),
        "page.html": b"<script>" + b64encode(recorded.tobytes()) + b"</script>",
        "other.bin": np.random.default_rng(1).normal(size=(90, 45)).tobytes(),
        "short.txt": b"abc",
        "empty": b"",
    }
    matches = Haystack(planted).containing(windows)
    assert matches == {"shifted.bin", "archive.npz/pose.npy", "page.html/base64"}
    digest = hashlib.sha256(planted["other.bin"]).hexdigest()
    assert Haystack(planted).equal_to({digest}) == {"other.bin"}
