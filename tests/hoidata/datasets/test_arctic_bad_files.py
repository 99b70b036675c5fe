"""ARCTIC: every bad file gives an error that names it, runs nothing, and costs one sequence."""

import importlib.util
import io
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from hoidata.conversion.convert import convert_dataset
from hoidata.datasets.arctic.adapter import ArcticAdapter
from hoidata.errors import BadInput


def load_recording() -> ModuleType:
    spec = importlib.util.spec_from_file_location("arctic_recording", Path(__file__).with_name("arctic_recording.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


recording = load_recording()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return recording.write_root(tmp_path)


def _edit_hand(change):
    def spoil(root: Path) -> None:
        params = {side: recording.hand_params(side) for side in recording.SHAPE}
        change(params)
        np.save(root / "raw_seqs" / "s04" / "box_grab_01.mano.npy", np.array(params, dtype=object))

    return spoil


def _set_mano(content) -> Callable[[Path], None]:
    boxed = np.empty((), dtype=object)
    boxed[()] = content
    return lambda root: np.save(root / "raw_seqs" / "s04" / "box_grab_01.mano.npy", boxed)


def _set_object(array):
    return lambda root: np.save(root / "raw_seqs" / "s04" / "box_grab_01.object.npy", array)


def _nan_object() -> np.ndarray:
    array = np.column_stack((recording.ANGLE, recording.ORIENT, recording.TRANSLATION_MM))
    array[33, 2] = np.nan
    return array


def _truncate(root: Path) -> None:
    path = root / "raw_seqs" / "s04" / "box_grab_01.mano.npy"
    path.write_bytes(path.read_bytes()[:900])


def _extra(kind: str, change: Callable[[dict], object]) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        content = {"egocam.dist": recording.head, "smplx": recording.body}[kind]()
        change(content)
        recording.write_extra(root, kind, content)

    return spoil


def _text(path: str, content: bytes) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_bytes(content)

    return spoil


def _misc(content: bytes) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        recording.write_extra(root, "egocam.dist", recording.head())
        (root / "meta" / "misc.json").write_bytes(content)

    return spoil


def _absurd_object(root: Path) -> None:
    stream = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**13, 7)}
    np.lib.format.write_array_header_1_0(stream, header)
    (root / "raw_seqs" / "s04" / "box_grab_01.object.npy").write_bytes(stream.getvalue() + bytes(700))


def _linked_away(root: Path) -> None:
    path = root / "raw_seqs" / "s04" / "box_grab_01.mano.npy"
    outside = root.parent / f"{root.name}-outside.npy"
    path.rename(outside)
    path.symlink_to(outside)


DESCRIPTION, PARTS_FILE = "description/s04/box_grab_01/description.txt", "meta/object_vtemplates/box/parts.json"
MESH = "meta/object_vtemplates/box/mesh.obj"
BAD_FILES = {
    "a truncated file": (_truncate, "mano.npy", ""),
    "a missing object file": (
        lambda root: (root / "raw_seqs/s04/box_grab_01.object.npy").unlink(),
        "object.npy",
        "a file",
    ),
    "a missing hand file": (
        lambda root: (root / "raw_seqs/s04/box_grab_01.mano.npy").unlink(),
        "mano.npy",
        "a file",
    ),
    "an empty file": (_text("raw_seqs/s04/box_grab_01.mano.npy", b""), "mano.npy", "NumPy file"),
    "an array that states an absurd size": (_absurd_object, "object.npy", "bytes of data"),
    "a link that leaves the folder": (_linked_away, "mano.npy", "inside the raw folder"),
    "hands that are a list": (_set_mano([1, 2]), "mano.npy", "dictionary"),
    "hands of another number of frames": (
        _edit_hand(lambda params: params["left"].update(trans=np.zeros((69, 3)))),
        "left.trans",
        "70 frames",
    ),
    "betas of another number of frames": (
        _edit_hand(lambda params: params["left"].update(shape=np.zeros((5, 10)))),
        "left.shape",
        "70 rows",
    ),
    "a range described twice": (
        _text(DESCRIPTION, b"1-40 open, left hand\n1-40 close, left hand\n"),
        "arctic/s04/box_grab_01",
        "one line per range and hand",
    ),
    "a description that is no text": (_text(DESCRIPTION, b"1-40 \xff\xfe open, left hand\n"), DESCRIPTION, "UTF-8"),
    "a description beyond all bounds": (_text(DESCRIPTION, b"\n" * (17 << 20)), DESCRIPTION, "at most"),
    "parts that are no JSON": (_text(PARTS_FILE, b"[1, 1,"), "parts.json", "a JSON list"),
    "parts that are no list": (_text(PARTS_FILE, b'{"0": 1}'), "parts.json", "8 zeros and ones"),
    "a part 2": (_text(PARTS_FILE, b"[1, 1, 1, 1, 0, 0, 0, 2]"), "parts.json", "8 zeros and ones"),
    "a missing mesh": (lambda root: (root / MESH).unlink(), "mesh.obj", "a file"),
    "a mesh that is no text": (_text(MESH, b"\xff\xfe\x00v"), "mesh.obj", "vertices"),
    "a corner beyond all vertices": (
        _text(MESH, b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 900\n"),
        "mesh.obj",
        "corners",
    ),
    "a camera of 69 frames": (
        _extra("egocam.dist", lambda head: head.update(T_k_cam_np=head["T_k_cam_np"][:69])),
        "T_k_cam_np",
        "70 frames",
    ),
    "a camera without rotation": (_extra("egocam.dist", lambda head: head.pop("R_k_cam_np")), "egocam", "R_k_cam_np"),
    "a camera that mirrors": (
        _extra("egocam.dist", lambda head: head.update(R_k_cam_np=head["R_k_cam_np"] * (1, 1, -1))),
        "R_k_cam_np",
        "rotations",
    ),
    "a camera that grows": (
        _extra("egocam.dist", lambda head: head.update(R_k_cam_np=head["R_k_cam_np"] * 1.01)),
        "R_k_cam_np",
        "rotations",
    ),
    "a camera of other matrices": (
        _extra("egocam.dist", lambda head: head.update(R_k_cam_np=np.zeros((70, 4, 4)))),
        "R_k_cam_np",
        "3 x 3",
    ),
    "a camera of text": (
        _extra("egocam.dist", lambda head: head.update(R_k_cam_np=np.full((70, 3, 3), "x"))),
        "R_k_cam_np",
        "numbers",
    ),
    "intrinsics of two rows": (
        _extra("egocam.dist", lambda head: head.update(intrinsics=np.ones((2, 3)))),
        "intrinsics",
        "3 rows",
    ),
    "offsets that are no JSON": (_misc(b"{"), "misc.json", "JSON object"),
    "offsets in a list": (_misc(b"[1]"), "misc.json", "JSON object"),
    "a subject without offset": (_misc(b'{"s04": {"gender": "male"}}'), "misc.json: s04", "ioi_offset"),
    "an offset of half a frame": (_misc(b'{"s04": {"ioi_offset": 0.5}}'), "ioi_offset", "whole number"),
    "a missing hand": (_edit_hand(lambda params: params.pop("left")), "mano.npy", "left"),
    "a frame too many": (_set_object(np.zeros((71, 7))), "mano.npy", "71 frames"),
    "six columns": (_set_object(np.zeros((70, 6))), "object.npy", "7 columns"),
    "NaN in a pose": (_set_object(_nan_object()), "object.npy", "finite"),
    "text for numbers": (_set_object(np.full((70, 7), "a")), "object.npy", "numbers"),
    "nine betas": (_edit_hand(lambda params: params["right"].update(shape=np.zeros(9))), "right.shape", "10 columns"),
    "no description": (lambda root: (root / "description/s04/box_grab_01/description.txt").unlink(), "description", ""),
    "parts of another mesh": (
        lambda root: (root / "meta/object_vtemplates/box/parts.json").write_text("[0, 1]"),
        "parts.json",
        "8 zeros and ones",
    ),
    "a mesh without faces": (
        lambda root: (root / "meta/object_vtemplates/box/mesh.obj").write_text("v 0 0 0\n"),
        "mesh.obj",
        "faces",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_named_with_what_was_expected(root, load_all, name):
    spoil, where, expected = BAD_FILES[name]
    spoil(root)
    with pytest.raises(BadInput) as caught:
        load_all(ArcticAdapter(), root)
    assert where in caught.value.where
    assert expected in caught.value.expected


@pytest.mark.parametrize("change", ["body of 69 frames", "no body", "no jaw"])
def test_a_bad_body_is_named_when_bodies_are_asked_for_and_does_not_matter_otherwise(root, load_all, change):
    if change != "no body":
        content = recording.body()
        if change == "no jaw":
            del content["jaw_pose"]
        else:
            content["transl"] = content["transl"][:69]
        recording.write_extra(root, "smplx", content)
    assert load_all(ArcticAdapter(), root)[0].body is None
    with pytest.raises(BadInput) as caught:
        load_all(ArcticAdapter(body=True), root)
    assert "smplx.npy" in caught.value.where


class _Runs:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("kind", ["mano", "object", "egocam.dist", "smplx"])
def test_a_file_that_would_run_something_is_refused_and_runs_nothing(root, load_all, kind):
    recording.write_extra(root, kind, {"left": _Runs(root / "ran"), "transl": _Runs(root / "ran")})
    with pytest.raises(BadInput) as caught:
        load_all(ArcticAdapter(body=True), root)
    assert "not allowed" in caught.value.got
    assert not (root / "ran").exists()


def test_one_bad_file_costs_one_sequence_and_the_others_convert(root, hands, tmp_path_factory):
    recording.write_sequence(root, "box_use_02")
    path = root / "raw_seqs" / "s04" / "box_use_02.mano.npy"
    path.write_bytes(path.read_bytes()[:-9])
    clips = tmp_path_factory.mktemp("store") / "clips"
    summary = convert_dataset(ArcticAdapter(), root, hands, clips, progress=False)
    assert summary.clips == 4
    assert [row.source_key for row in summary.left_out] == ["arctic/s04/box_use_02"]
    assert summary.left_out[0].where.startswith("raw_seqs/s04/box_use_02.mano.npy")
