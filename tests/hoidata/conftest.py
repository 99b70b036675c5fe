"""A small store that uses every feature of the schema, for tests of writing, reading and checking."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hoidata.clips import BodyTrack, CameraTrack, Clip, SourceContact, SourceFile
from hoidata.clips.quarantine import Quarantined
from hoidata.datasets import RawTree
from hoidata.hands import load_embedded_hands
from hoidata.store.info import generated_info
from hoidata.store.store import write_store

LEFT_OUT = Quarantined("test/s9/bad_1", "bad_1.npz", expected="7 columns", got="6", remedy="download it again")


@pytest.fixture(scope="session")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of the store that is written once and copied for each test."""
    return tmp_path_factory.mktemp("stored") / "clips"


@pytest.fixture
def clips(make_clip):
    """Three clips: rigid and articulated objects, invalid frames, betas per frame, a personal template, no label.

    Some have a second object, a camera, a body, contact labels or an empty list of contacts.
    """
    plain = replace(
        make_clip(seed=1, clip_id="test/s1/a", gravity=None),
        gravity_note="estimated from nothing",
        hands_from="keypoints",
        fit_error_m=0.0042,
        source_contact=contact(0, 30),
    )
    hinged = make_clip(40, "both", articulated=True, seed=2, clip_id="test/s2/b", verb=None)
    left = hinged.hands["left"]
    rng = np.random.default_rng(5)
    valid = left.valid.copy()
    valid[3:6] = False
    odd_left = replace(left, valid=valid, betas=rng.normal(size=(40, 10)).astype(np.float32))
    template = load_embedded_hands().right.template_m.astype(np.float32) * np.float32(1.1)
    odd_right = replace(hinged.hands["right"], template_m=template)
    odd = replace(
        hinged,
        hands={"left": odd_left, "right": odd_right},
        other_objects=(plain.object.take(slice(0, 30)), hinged.object),
        labelled_hand="left",
        source_frames=np.arange(7, 167, 4, dtype=np.int32),
        source_from_world=np.diag([10.0, -10.0, 10.0, 1.0]),
        sources=(SourceFile("s2/b.npz", 12, "ab" * 32), SourceFile("mesh.obj", 3, "cd" * 32)),
        source_fps=120.0,
    )
    moved = replace(hinged.object, translation_m=hinged.object.translation_m + np.float32(0.5))
    longer = replace(odd, other_objects=(hinged.object, moved))
    longer = replace(
        longer,
        camera=camera(40, np.array([600.0, 600, 320, 240, 640, 480])),
        body=body(40, True),
        gravity_note="fitted",
    )
    last = make_clip(20, "left", seed=3, clip_id="test/s1/c")
    return [plain, longer, replace(last, camera=camera(20), body=body(20, False), source_contact=contact(57, 20))]


def camera(n_frames: int, intrinsics: np.ndarray | None = None) -> CameraTrack:
    rng = np.random.default_rng(n_frames)
    rotvec, position = rng.normal(size=(2, n_frames, 3)).astype(np.float32)
    source_frames = np.arange(n_frames, dtype=np.int32) * 2
    return CameraTrack("cam4", rotvec, position, source_frames, intrinsics=intrinsics)


def body(n_frames: int, expression: bool) -> BodyTrack:
    rng = np.random.default_rng(n_frames)
    arrays = [rng.normal(size=(n_frames, columns)).astype(np.float32) for columns in (3, 3, 63, 9, 10)]
    return BodyTrack(*arrays[:4], expression=arrays[4] if expression else None)


def contact(count: int, n_frames: int) -> SourceContact:
    rng = np.random.default_rng(count)
    rows = np.unique(np.stack((rng.integers(0, n_frames, count), rng.integers(0, 8, count)), axis=1), axis=0)
    frame, vertex = rows.T.astype(np.int32)
    return SourceContact(frame, vertex, rng.integers(21, 56, len(rows)).astype(np.uint8))


@pytest.fixture
def left_out() -> Quarantined:
    return LEFT_OUT


@pytest.fixture
def folder(stored: Path, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    if not stored.exists():
        clips = request.getfixturevalue("clips")
        write_store(stored, [clips[0], LEFT_OUT, *clips[1:]], generated_info("test"))
    shutil.copytree(stored, tmp_path / "clips")
    return tmp_path / "clips"


@pytest.fixture
def hands():
    return load_embedded_hands()


@pytest.fixture
def load_clips(load_all) -> Callable:
    """As ``load_all``, without the quarantined intervals."""
    return lambda adapter, root: [item for item in load_all(adapter, root) if isinstance(item, Clip)]


@pytest.fixture
def load_all() -> Callable:
    """All clips and quarantined intervals of all sequences below a root, as loaded by the adapter."""

    def load(adapter, root: Path) -> list:
        keys = adapter.sequences(root)
        return [item for key in keys for item in adapter.load(RawTree(root), key, load_embedded_hands())]

    return load
