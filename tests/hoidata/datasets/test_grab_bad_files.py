"""GRAB: every bad file gives an error that names it, runs nothing, and costs one sequence."""

import importlib.util
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from hoidata.conversion.convert import convert_dataset
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.errors import BadInput


def load_recording() -> ModuleType:
    spec = importlib.util.spec_from_file_location("grab_recording", Path(__file__).with_name("grab_recording.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


recording = load_recording()
N_FRAMES, N_VERTICES = recording.N_FRAMES, recording.N_VERTICES


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return recording.write_root(tmp_path)


def _edit(change):
    def spoil(root: Path) -> None:
        data = recording.sequence()
        change(data)
        recording.write_sequence(root, data)

    return spoil


def _truncate(root: Path) -> None:
    path = root / "grab" / "s3" / "cubelarge_offhand_1.npz"
    path.write_bytes(path.read_bytes()[:2000])


def _set(block: str, key: str, value):
    return _edit(lambda data: data[block]["params"].__setitem__(key, value))


def _nan(data: dict) -> None:
    data["rhand"]["params"]["transl"][20, 1] = np.nan


def _contact_of(value) -> Callable:
    return _edit(lambda data: data["contact"].__setitem__("object", value))


def _fraction() -> np.ndarray:
    return np.where(np.arange(N_VERTICES) == 2, 0.5, 0.0) * np.ones((N_FRAMES, 1))


def _not_a_number() -> np.ndarray:
    return np.where(np.arange(N_VERTICES) == 2, np.nan, 22.0) * np.ones((N_FRAMES, 1))


def _mesh(lines: bytes) -> Callable:
    return lambda root: (root / "tools/object_meshes/contact_meshes/cubelarge.ply").write_bytes(lines)


def _linked_away(root: Path) -> None:
    mesh = root / "tools/object_meshes/contact_meshes/cubelarge.ply"
    outside = root.parent / f"{root.name}-outside.ply"
    mesh.rename(outside)
    mesh.symlink_to(outside)


def _posed(member: str) -> dict:
    return {name: value for name, value in recording.sequence()[member]["params"].items() if name != "fullpose"}


def _short_table() -> dict:
    table = recording.with_table()["table"]
    return table | {"params": {name: value[:60] for name, value in table["params"].items()}}


PLY = b"ply\nformat ascii 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"
NO_FACES = PLY % 3 + b"end_header\n0 0 0\n1 0 0\n0 1 0\n"
ABSURD_PLY = PLY % 900_000_000_000 + b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n"


BAD_FILES = {
    "a truncated file": (_truncate, "cubelarge_offhand_1.npz", ".npz"),
    "NaN in a pose": (_edit(_nan), "rhand.transl", "finite"),
    "a pose of 44 columns": (
        _set("lhand", "fullpose", np.zeros((N_FRAMES, 44))),
        "lhand.fullpose",
        "45 columns",
    ),
    "text for numbers": (_set("object", "transl", np.full((N_FRAMES, 3), "x")), "object.transl", "numbers"),
    "a frame too few": (_set("object", "transl", np.zeros((60, 3))), "object.transl", "61 frames"),
    "no rotation": (_edit(lambda data: data["object"]["params"].pop("global_orient")), "object", "global_orient"),
    "no contact at all": (
        _edit(lambda data: data["contact"].__setitem__("object", np.zeros((N_FRAMES, N_VERTICES), np.int8))),
        "contact.object",
        "contact in at least one frame",
    ),
    "contact of another mesh": (
        _edit(lambda data: data["contact"].__setitem__("object", np.ones((N_FRAMES, 9), np.int8))),
        "contact.object",
        "(61, 8)",
    ),
    "a frame rate of 100": (_edit(lambda data: data.__setitem__("framerate", 100.0)), "framerate", "multiple of 30"),
    "a frame rate without end": (
        _edit(lambda data: data.__setitem__("framerate", np.inf)),
        "framerate",
        "whole number",
    ),
    "a path that leaves the folder": (
        _edit(lambda data: data["object"].__setitem__("object_mesh", "../../etc/passwd.ply")),
        "passwd",
        "file",
    ),
    "an unreadable mesh": (
        lambda root: (root / "tools/object_meshes/contact_meshes/cubelarge.ply").write_bytes(b"ply\nnothing"),
        "cubelarge.ply",
        "mesh",
    ),
    "a missing object mesh": (
        lambda root: (root / "tools/object_meshes/contact_meshes/cubelarge.ply").unlink(),
        "cubelarge.ply",
        "a file",
    ),
    "an empty file": (
        lambda root: (root / "grab" / "s3" / "cubelarge_offhand_1.npz").write_bytes(b""),
        "cubelarge_offhand_1.npz",
        ".npz",
    ),
    "a mesh without faces": (_mesh(NO_FACES), "cubelarge.ply", "faces"),
    "a mesh that states an absurd size": (_mesh(ABSURD_PLY), "cubelarge.ply", "mesh"),
    "a mesh header that is no text": (_mesh(b"ply\nformat ascii \xff\xfe\n"), "cubelarge.ply", "mesh"),
    "a mesh behind a link that leaves the folder": (_linked_away, "cubelarge.ply", "inside the raw folder"),
    "a name that is bytes": (_edit(lambda data: data.__setitem__("obj_name", b"\xffmug")), "obj_name", "text"),
    "absurdly many frames": (
        _edit(lambda data: data.__setitem__("n_frames", 10**15)),
        "contact.object",
        "(1000000000000000, 8)",
    ),
    "frames of another number": (_edit(lambda data: data.__setitem__("n_frames", 60)), "contact.object", "(60, 8)"),
    "half a frame": (_edit(lambda data: data.__setitem__("n_frames", 61.5)), "n_frames", "whole number"),
    "no contact entry": (_edit(lambda data: data.pop("contact")), "cubelarge_offhand_1.npz", "contact"),
    "contact that is no dict": (_edit(lambda data: data.__setitem__("contact", [1])), "contact", "dict"),
    "contact of text": (
        _contact_of(np.full((N_FRAMES, N_VERTICES), "x")),
        "contact.object",
        "numbers",
    ),
    "contact of halves": (_contact_of(_fraction()), "contact.object", "whole numbers"),
    "contact of NaN": (_contact_of(_not_a_number()), "contact.object", "whole numbers"),
    "contact beyond all labels": (
        _contact_of(np.full((N_FRAMES, N_VERTICES), 300)),
        "contact.object",
        "up to 255",
    ),
    "components without columns": (
        _edit(
            lambda data: data["lhand"].__setitem__("params", {**_posed("lhand"), "hand_pose": np.zeros((N_FRAMES, 0))})
        ),
        "lhand.hand_pose",
        "24 columns",
    ),
    "more components than the model has": (
        _edit(lambda data: data["lhand"].__setitem__("params", {**_posed("lhand"), "hand_pose": np.zeros((61, 46))})),
        "lhand.hand_pose",
        "24 columns",
    ),
    "a table of 60 frames": (
        lambda root: (
            recording.write_table(root),
            recording.write_sequence(root, recording.with_table() | {"table": _short_table()}),
        ),
        "table",
        "61 frames",
    ),
    "a missing hand mesh": (
        lambda root: (root / "tools/subject_meshes/male/s3_rhand.ply").unlink(),
        "s3_rhand.ply",
        "a file",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_named_with_what_was_expected(root, load_all, name):
    spoil, where, expected = BAD_FILES[name]
    spoil(root)
    with pytest.raises(BadInput) as caught:
        load_all(GrabAdapter(), root)
    assert where in caught.value.where
    assert expected in caught.value.expected


class _Runs:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("member", ["contact", "lhand", "object", "table", "obj_name", "framerate"])
def test_a_file_that_would_run_something_is_refused_and_runs_nothing(root, load_all, member):
    marker = root / "ran"
    data = recording.with_table()
    data[member] = {"params": _Runs(marker), "object": _Runs(marker)}
    recording.write_sequence(root, data)
    with pytest.raises(BadInput) as caught:
        load_all(GrabAdapter(), root)
    assert "not allowed" in caught.value.got
    assert not marker.exists()


def test_one_bad_file_costs_one_sequence_and_its_place_is_named_below_the_root(root, hands, tmp_path_factory):
    shutil.copytree(root / "grab" / "s3", root / "grab" / "s4")
    path = root / "grab" / "s4" / "cubelarge_offhand_1.npz"
    path.write_bytes(path.read_bytes()[:-300])
    clips = tmp_path_factory.mktemp("store") / "clips"
    summary = convert_dataset(GrabAdapter(), root, hands, clips, progress=False)
    assert summary.clips == 1
    (row,) = summary.left_out
    assert row.source_key == "grab/s4/cubelarge_offhand_1"
    assert row.where.startswith("grab/s4/cubelarge_offhand_1.npz")
