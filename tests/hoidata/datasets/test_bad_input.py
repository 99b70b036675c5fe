"""The table of bad input: every way a file can be spoilt, for every dataset.

Each row spoils one file of one sequence of two. That sequence must be left out with an error that names the file, what
was expected, what came and what to do; nothing may be run; the other sequence must give the same bytes as before.
``python tests/hoidata/datasets/test_bad_input.py`` prints the rows as a Markdown table.
"""

import gzip
import hashlib
import importlib.util
import io
import os
import pickle
import shutil
import sys
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import hoidata.files
from hoidata.clips.quarantine import Quarantined
from hoidata.conversion.convert import convert_dataset
from hoidata.datasets import get_adapter
from hoidata.hands import load_embedded_hands
from hoidata.store.store import open_store

Spoil = Callable[[Path], None]
CANARY = Path("canary")


@cache
def sibling(name: str) -> ModuleType:
    """Another file of this folder as a module: its literal recordings."""
    spec = importlib.util.spec_from_file_location(f"bad_input_{name}", Path(__file__).with_name(f"{name}.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class Row:
    """spoilt: the file the error must name; spoil: given the raw root; says: words of the error."""

    problem: str
    dataset: str
    spoilt: str
    spoil: Spoil
    says: str


# ---------------------------------------------------------------------------------- ways to spoil any file


def at(path: str, change: Callable[[bytes], bytes]) -> Spoil:
    """Replaces a file, never through a hard link."""

    def spoil(root: Path) -> None:
        data = change((root / path).read_bytes())
        (root / path).unlink()
        (root / path).write_bytes(data)

    return spoil


def cut_in_half(data: bytes) -> bytes:
    return data[: len(data) // 2]


def emptied(_: bytes) -> bytes:
    return b""


def removed(path: str) -> Spoil:
    return lambda root: (root / path).unlink()


def linked_outside(path: str) -> Spoil:
    def spoil(root: Path) -> None:
        outside = root.parent / "outside"
        shutil.copy(root / path, outside)
        (root / path).unlink()
        (root / path).symlink_to(outside)

    return spoil


class Command:
    """Pickles as a call that would leave a file behind."""

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {CANARY.resolve()}",)


def malicious(value: object) -> bytes:
    return pickle.dumps(value, 3)


def npy_of(value: object) -> bytes:
    stream = io.BytesIO()
    np.save(stream, value)  # type: ignore[arg-type]
    return stream.getvalue()


def huge_npy(_: bytes) -> bytes:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 7), }\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(64)


def in_gzip(change: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    return lambda data: gzip.compress(change(gzip.decompress(data)), 1, mtime=0)


def replaced(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        assert old in data
        return data.replace(old, new, 1)

    return change


FLAT_OBJ = b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"
NO_FACE_OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
HUGE_PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\nproperty float y\n"
HUGE_PLY += b"property float z\nend_header\n" + bytes(64)
NO_FACE_PLY = HUGE_PLY.replace(b"1000000000", b"5")
FAR_CORNER_OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1000000000\n"


# ---------------------------------------------------------------------------------- H2O

H2O = "subject2/k1/3/cam4"


def write_h2o(root: Path) -> Path:
    module = sibling("test_h2o")
    module.root.__wrapped__(root)
    shutil.copytree(root / "subject2", root / "subject1")
    shutil.copytree(root / "object/chips", root / "object/milk")
    (root / "object/milk/chips.obj").rename(root / "object/milk/milk.obj")
    for name in ("action_label", "obj_pose_rt"):
        for path in (root / "subject1/k1/3/cam4" / name).iterdir():
            words = path.read_text().split()
            words[0] = {"26.0": "5.0", "7.0": "5.0"}.get(words[0], words[0])
            path.write_text(" ".join(words))
    return root


def h2o_rows() -> Iterable[tuple[str, str, Spoil, str]]:
    hand, pose, label = (f"{H2O}/{kind}/000010.txt" for kind in ("hand_pose_mano", "obj_pose_rt", "action_label"))
    camera, mesh = f"{H2O}/cam_pose/000010.txt", "object/chips/chips.obj"
    yield "truncated file", hand, at(hand, cut_in_half), "124 numbers"
    yield "empty file", camera, at(camera, emptied), "16 numbers"
    yield "malicious pickle", hand, at(hand, lambda _: malicious(Command())), "124 numbers"
    yield "NaN", pose, at(pose, replaced(b"0.45", b"nan")), "finite"
    yield "infinity", hand, at(hand, replaced(b"1.1", b"inf")), "finite"
    yield "wrong columns", hand, at(hand, lambda data: data + b" 5"), "got 125"
    yield "wrong dtype (words)", pose, at(pose, replaced(b"0.45", b"near")), "17 numbers"
    yield "missing camera file", camera, removed(camera), "nothing there"
    yield "missing object file", mesh, removed(mesh), "object's mesh"
    yield (
        "frame-count mismatch",
        f"{H2O}/hand_pose_mano/000026.txt",
        removed(f"{H2O}/hand_pose_mano/000026.txt"),
        "one file for each of 27 frames",
    )
    yield "non-UTF-8 text", label, at(label, lambda _: b"\xff\xfe2\x006\x00"), "1 numbers"
    yield "symlink out of the root", camera, linked_outside(camera), "link that leaves"
    yield "zero-face mesh", mesh, at(mesh, lambda _: NO_FACE_OBJ), "with faces"
    yield "mesh without area", mesh, at(mesh, lambda _: FLAT_OBJ), "faces with area"
    yield "absurd size (frame file)", hand, at(hand, lambda data: data + b" 0" * (1 << 20)), "at most"
    yield "absurd size (corner 10^9)", mesh, at(mesh, lambda _: FAR_CORNER_OBJ), "face corners"


# ---------------------------------------------------------------------------------- GRAB

GRAB = "grab/s3/cubelarge_offhand_1.npz"


def write_grab(root: Path) -> Path:
    module = sibling("grab_recording")
    module.write_root(root)
    data = module.sequence() | {"obj_name": "cubesmall"}
    data["object"]["object_mesh"] = data["object"]["object_mesh"].replace("large", "small")
    first = (root / GRAB).read_bytes()
    module.write_sequence(root, data)
    (root / GRAB).rename(root / "grab/s3/cubesmall_offhand_1.npz")
    (root / GRAB).write_bytes(first)
    meshes = root / "tools/object_meshes/contact_meshes"
    shutil.copy(meshes / "cubelarge.ply", meshes / "cubesmall.ply")
    return root


def grab_with(change: Callable[[dict], object]) -> Spoil:
    def spoil(root: Path) -> None:
        data = sibling("grab_recording").sequence()
        change(data)
        (root / GRAB).unlink()
        sibling("grab_recording").write_sequence(root, data)

    return spoil


def set_in(*path: str, value: object) -> Callable[[dict], None]:
    def change(data: dict) -> None:
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = value

    return change


def grab_number(block: str, value: float) -> Spoil:
    return grab_with(lambda data: data[block]["params"]["transl"].__setitem__((20, 1), value))


def zip_with(name: str, content: bytes, again: bool = False) -> Callable[[bytes], bytes]:
    """The archive with one member replaced, or there twice."""

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


def grab_rows() -> Iterable[tuple[str, str, Spoil, str]]:
    mesh = "tools/object_meshes/contact_meshes/cubelarge.ply"
    zeros = np.zeros((61, 3), np.float32)
    bomb = npy_of(np.zeros(3))[:-24].replace(b"(3,), }  ", b"(200000000,), }") + bytes(0)
    yield "truncated file", GRAB, at(GRAB, cut_in_half), "whole .npz"
    yield "empty file", GRAB, at(GRAB, emptied), "whole .npz"
    yield "malicious pickle", GRAB, grab_with(set_in("rhand", value=Command())), "not allowed"
    yield (
        "malicious pickle deep inside",
        GRAB,
        grab_with(set_in("object", "params", "transl", value=Command())),
        "not allowed",
    )
    yield "NaN", GRAB, grab_number("object", np.nan), "finite"
    yield "infinity", GRAB, grab_number("rhand", np.inf), "finite"
    yield "wrong columns", GRAB, grab_with(set_in("rhand", "params", "transl", value=np.zeros((61, 4)))), "3 columns"
    yield (
        "wrong dtype (words)",
        GRAB,
        grab_with(set_in("object", "params", "transl", value=zeros.astype("U3"))),
        "numbers",
    )
    yield "missing object file", mesh, removed(mesh), "nothing there"
    yield "frame-count mismatch", GRAB, grab_with(set_in("lhand", "params", "transl", value=zeros[:60])), "61 frames"
    yield "non-UTF-8 text", GRAB, grab_with(set_in("motion_intent", value=b"\xff\xfe")), "text"
    yield "duplicate member", GRAB, at(GRAB, zip_with("rhand.npy", npy_of(np.zeros(2)), again=True)), "once"
    yield "symlink out of the root", GRAB, linked_outside(GRAB), "link that leaves"
    yield (
        "path out of the root inside the file",
        "passwd",
        grab_with(set_in("object", "object_mesh", value="../../../../../../../../etc/passwd")),
        "link that leaves",
    )
    yield "zero-face mesh", mesh, at(mesh, lambda _: NO_FACE_PLY), "with faces"
    yield "absurd size (10^9 vertices)", mesh, at(mesh, lambda _: HUGE_PLY), "ends within"
    yield "absurd size (header)", GRAB, at(GRAB, zip_with("n_frames.npy", huge_npy(b""))), "bytes of data"
    yield "zip bomb", GRAB, at(GRAB, zip_with("n_frames.npy", bomb + bytes(1_200_000_000))), "when unpacked"


# ---------------------------------------------------------------------------------- ARCTIC

ARCTIC_HAND = "raw_seqs/s04/box_grab_01.mano.npy"
ARCTIC_OBJECT = "raw_seqs/s04/box_grab_01.object.npy"
ARCTIC_TEXT = "description/s04/box_grab_01/description.txt"


def write_arctic(root: Path) -> Path:
    module = sibling("arctic_recording")
    module.write_root(root)
    module.write_sequence(root, "mixer_use_01")
    module.write_template(root, "mixer")
    return root


def arctic_hand(change: Callable[[dict], object]) -> Spoil:
    def spoil(root: Path) -> None:
        data = {side: sibling("arctic_recording").hand_params(side) for side in ("left", "right")}
        change(data)
        at(ARCTIC_HAND, lambda _: npy_of(np.array(data, dtype=object)))(root)

    return spoil


def arctic_object(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    return at(ARCTIC_OBJECT, lambda data: npy_of(change(np.load(io.BytesIO(data)))))


def number_at(place: tuple[int, int], value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array[place] = value
        return array

    return change


def arctic_rows() -> Iterable[tuple[str, str, Spoil, str]]:
    mesh, parts = (f"meta/object_vtemplates/box/{name}" for name in ("mesh.obj", "parts.json"))
    yield "truncated file", ARCTIC_HAND, at(ARCTIC_HAND, cut_in_half), "pickle"
    yield "empty file", ARCTIC_OBJECT, at(ARCTIC_OBJECT, emptied), "NumPy file"
    yield "malicious pickle", ARCTIC_HAND, arctic_hand(set_in("left", value=Command())), "not allowed"
    yield "NaN", ARCTIC_OBJECT, arctic_object(number_at((3, 2), np.nan)), "finite"
    yield "infinity", ARCTIC_HAND, arctic_hand(lambda data: data["left"]["rot"].__setitem__((3, 2), -np.inf)), "finite"
    yield "wrong columns", ARCTIC_OBJECT, arctic_object(lambda array: array[:, :6]), "7 columns"
    yield "wrong dtype (words)", ARCTIC_OBJECT, arctic_object(lambda array: array.astype("U4")), "numbers"
    yield "missing object file", mesh, removed(mesh), "nothing there"
    yield "missing object motion", ARCTIC_OBJECT, removed(ARCTIC_OBJECT), "nothing there"
    yield "frame-count mismatch", ARCTIC_HAND, arctic_object(lambda array: array[:-1]), "69 frames"
    yield "non-UTF-8 text", ARCTIC_TEXT, at(ARCTIC_TEXT, lambda data: b"\xff\xfe" + data), "UTF-8"
    yield "duplicate ids", "box_grab_01", at(ARCTIC_TEXT, lambda data: data + b"15-44 lift, both hands\n"), "twice"
    yield "symlink out of the root", ARCTIC_HAND, linked_outside(ARCTIC_HAND), "link that leaves"
    yield "zero-face mesh", mesh, at(mesh, lambda _: NO_FACE_OBJ), "with faces"
    yield "parts of another mesh", parts, at(parts, lambda _: b"[1, 0]"), "8 zeros and ones"
    yield "nested JSON", parts, at(parts, lambda _: b"[" * 100_000), "JSON"
    yield "absurd size (header)", ARCTIC_OBJECT, at(ARCTIC_OBJECT, huge_npy), "bytes of data"


# ---------------------------------------------------------------------------------- ManipNet

MANIPNET = "sequences/tetra_large7"


def write_manipnet(root: Path) -> Path:
    module = sibling("test_manipnet")
    module.write_tree(root, *module.lift_rows())
    shutil.copytree(root / MANIPNET, root / "sequences/cube_large8")
    thing = root / "sequences/cube_large8/tetra_large.bvh.gz"
    text = gzip.decompress(thing.read_bytes()).replace(b"tetra_large", b"cube_large")
    thing.with_name("cube_large.bvh.gz").write_bytes(gzip.compress(text, mtime=0))
    thing.unlink()
    shutil.copy(root / "objects/Primitive/tetra_large.obj.gz", root / "objects/Primitive/cube_large.obj.gz")
    return root


def manipnet_rows() -> Iterable[tuple[str, str, Spoil, str]]:
    hand, thing = f"{MANIPNET}/leftHand.bvh.gz", f"{MANIPNET}/tetra_large.bvh.gz"
    mesh = "objects/Primitive/tetra_large.obj.gz"
    bomb = gzip.compress(bytes(300 << 20), 1, mtime=0)

    def last_line(data: bytes) -> bytes:
        return data[: data.rstrip().rfind(b"\n") + 1]

    yield "truncated file", hand, at(hand, cut_in_half), "gzipped text"
    yield "empty file", thing, at(thing, emptied), "line MOTION"
    yield "malicious pickle", hand, at(hand, lambda _: malicious(Command())), "gzipped text"
    yield "NaN", thing, at(thing, in_gzip(lambda data: last_line(data) + b"0 0 0 0 0 nan\n")), "finite"
    yield "infinity", thing, at(thing, in_gzip(lambda data: last_line(data) + b"0 0 0 0 0 inf\n")), "finite"
    yield "wrong columns", thing, at(thing, in_gzip(lambda data: last_line(data) + b"0 0 0\n")), "6 columns"
    yield "wrong dtype (words)", thing, at(thing, in_gzip(lambda data: last_line(data) + b"0 0 0 0 0 x\n")), "numbers"
    yield "missing object file", Path(mesh).name, removed(mesh), "nothing there"
    yield "frame-count mismatch", hand, at(hand, in_gzip(last_line)), "motion lines as announced"
    yield "non-UTF-8 text", thing, at(thing, in_gzip(lambda data: b"\xff" + data)), "gzipped text"
    yield "symlink out of the root", hand, linked_outside(hand), "link that leaves"
    yield "zero-face mesh", mesh, at(mesh, in_gzip(lambda _: NO_FACE_OBJ)), "with faces"
    yield "gzip bomb", thing, at(thing, lambda _: bomb), "of text"
    yield "absurd size (10^9 frames)", thing, at(thing, in_gzip(_billion_frames)), "1 to 1000000 frames"


def _billion_frames(data: bytes) -> bytes:
    before, _, after = data.partition(b"Frames: ")
    return before + b"Frames: 1000000000\n" + after.partition(b"\n")[2]


# ---------------------------------------------------------------------------------- TACO

TACO = "(brush, brush, bowl)/20230927_034"


def write_taco(root: Path) -> Path:
    module = sibling("test_taco")
    for seed, name in enumerate((TACO, "(put in, spoon, bowl)/20230928_001")):
        module.write_recording(root, name, seed)
    other = root / "Object_Poses/(put in, spoon, bowl)/20230928_001"
    (other / "tool_012.npy").rename(other / "tool_013.npy")
    for number in ("012", "013"):
        module.write_box(root / f"Object_Models/{number}_cm.obj", module.HALF_TOOL_M)
    module.write_box(root / "Object_Models/105_cm.obj", np.array([0.08, 0.08, 0.03]))
    return root


def taco_hand(change: Callable[[dict], object]) -> Spoil:
    def spoil(root: Path) -> None:
        path = root / f"Hand_Poses/{TACO}/right_hand.pkl"
        content = pickle.loads(path.read_bytes())  # written by this test
        change(content)
        path.unlink()
        path.write_bytes(pickle.dumps(content))

    return spoil


def taco_rows() -> Iterable[tuple[str, str, Spoil, str]]:
    import torch

    hand, tool = f"Hand_Poses/{TACO}/right_hand.pkl", f"Object_Poses/{TACO}/tool_012.npy"
    mesh = "Object_Models/012_cm.obj"
    long = torch.zeros(1).expand(10**9)
    yield "truncated file", hand, at(hand, cut_in_half), "pickle"
    yield "empty file", tool, at(tool, emptied), "NumPy file"
    yield "malicious pickle", hand, taco_hand(set_in("00003", value=Command())), "not allowed"
    yield "NaN", hand, taco_hand(lambda data: data["00003"]["hand_trans"].fill_(np.nan)), "finite"
    yield "infinity", tool, at(tool, lambda data: npy_of(np.load(io.BytesIO(data)) + np.float32(np.inf))), "finite"
    yield "wrong columns", hand, taco_hand(set_in("00003", "hand_pose", value=torch.zeros(47))), "48"
    yield "wrong dtype (words)", hand, taco_hand(set_in("00003", "hand_pose", value="words")), "numbers"
    yield "missing object file", mesh, removed(mesh), "nothing there"
    yield "frame-count mismatch", TACO, at(tool, lambda data: npy_of(np.load(io.BytesIO(data))[:-1])), "frames"
    yield "symlink out of the root", hand, linked_outside(hand), "link that leaves"
    yield "zero-face mesh", mesh, at(mesh, lambda _: NO_FACE_OBJ), "with faces"
    yield "absurd size (tensor of 10^9)", hand, taco_hand(set_in("00003", "hand_pose", value=long)), "larger than"
    yield "absurd size (header)", tool, at(tool, huge_npy), "bytes of data"


# ---------------------------------------------------------------------------------- the table

WRITERS = {"h2o": write_h2o, "grab": write_grab, "arctic": write_arctic, "manipnet": write_manipnet, "taco": write_taco}
SPOILT_SEQUENCES = {
    "h2o": "h2o/subject2/k1/3",
    "grab": "grab/s3/cubelarge_offhand_1",
    "arctic": "arctic/s04/box_grab_01",
    "manipnet": "manipnet/tetra_large7",
    "taco": f"taco/{TACO}",
}
SOURCES = {"h2o": h2o_rows, "grab": grab_rows, "arctic": arctic_rows, "manipnet": manipnet_rows, "taco": taco_rows}


def table() -> list[Row]:
    return [Row(problem, name, *rest) for name, rows in SOURCES.items() for problem, *rest in rows()]  # type: ignore


ROWS = table()


def as_markdown(rows: Iterable[Row]) -> str:
    """One line per problem, one column per dataset: the words of the error, or a dash where it cannot occur."""
    cells: dict[str, dict[str, str]] = {}
    for row in rows:
        cells.setdefault(row.problem, {})[row.dataset] = f"{Path(row.spoilt).name}: {row.says}"
    lines = [f"| problem | {' | '.join(SOURCES)} |", f"|---|{'---|' * len(SOURCES)}"]
    lines += [
        f"| {problem} | {' | '.join(found.get(name, '-') for name in SOURCES)} |" for problem, found in cells.items()
    ]
    return "\n".join(lines)


def fingerprint(value: Any) -> str:
    """A digest of all that a clip holds."""
    digest = hashlib.sha256()

    def visit(item: Any) -> None:
        if is_dataclass(item) and not isinstance(item, type):
            for part in fields(item):
                visit(getattr(item, part.name))
        elif isinstance(item, dict):
            for key in sorted(item):
                visit(item[key])
        elif isinstance(item, list | tuple):
            for part in item:
                visit(part)
        elif isinstance(item, np.ndarray):
            digest.update(item.dtype.str.encode() + repr(item.shape).encode() + item.tobytes())
        else:
            digest.update(repr(item).encode())

    visit(value)
    return digest.hexdigest()


def converted(dataset: str, root: Path, out: Path) -> tuple[dict[str, str], tuple[Quarantined, ...]]:
    """Fingerprint of each clip by id, and what was left out."""
    summary = convert_dataset(get_adapter(dataset), root, load_embedded_hands(), out, progress=False)
    store = open_store(out)
    clips = {clip_id: store.clip(clip_id) for clip_id in store.ids}
    if dataset == "manipnet":  # its clips list all hands of the one subject as sources, the spoilt one too
        clips = {clip_id: replace(clip, sources=()) for clip_id, clip in clips.items()}
    return {clip_id: fingerprint(clip) for clip_id, clip in clips.items()}, summary.left_out


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, dict[str, str]]]:
    """A dataset's tree of two sequences, and its clips."""

    @cache
    def make(dataset: str) -> tuple[Path, dict[str, str]]:
        folder = tmp_path_factory.mktemp(dataset)
        (folder / "raw").mkdir()
        root = WRITERS[dataset](folder / "raw")
        whole, left_out = converted(dataset, root, folder / "whole")
        spoilt = SPOILT_SEQUENCES[dataset]
        assert not [item for item in left_out if item.source_key.startswith(spoilt)]
        assert any(clip_id.startswith(spoilt) for clip_id in whole)
        assert any(not clip_id.startswith(spoilt) for clip_id in whole)
        return root, whole

    return make


def marked(row: Row) -> Any:
    is_slow = row.dataset == "manipnet" or row.problem == "zip bomb"
    name = f"{row.dataset}: {row.problem}"
    return pytest.param(row, id=name, marks=pytest.mark.slow if is_slow else ())


@pytest.mark.parametrize("row", [marked(row) for row in ROWS])
def test_a_spoilt_file_costs_its_sequence_and_nothing_else(
    row: Row, intact: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, whole = intact(row.dataset)
    root = tmp_path / "raw"
    shutil.copytree(source, root, copy_function=os.link)
    monkeypatch.chdir(tmp_path)
    row.spoil(root)
    clips, left_out = converted(row.dataset, root, tmp_path / "store")
    assert not CANARY.exists()
    spoilt = SPOILT_SEQUENCES[row.dataset]
    found = [item for item in left_out if item.source_key.startswith(spoilt)]
    assert found, f"not left out: {left_out}"
    text = f"{found[0].where}: expected {found[0].expected}, got {found[0].got}; {found[0].remedy}"
    assert row.spoilt in found[0].where, text
    assert row.says in text
    assert "defect of hoidata" not in text
    assert all((found[0].expected, found[0].got, found[0].remedy))
    assert clips == {clip_id: digest for clip_id, digest in whole.items() if not clip_id.startswith(spoilt)}


def test_the_table_has_every_row_the_issue_names() -> None:
    problems = {row.problem.partition(" (")[0] for row in ROWS}
    assert problems >= {
        "truncated file", "empty file", "malicious pickle", "NaN", "infinity", "wrong columns", "wrong dtype",
        "missing camera file", "missing object file", "frame-count mismatch", "non-UTF-8 text", "duplicate ids",
        "symlink out of the root", "zero-face mesh", "absurd size",
    }  # fmt: skip


def test_the_readme_prints_this_table() -> None:
    assert as_markdown(ROWS) in Path(hoidata.files.__file__).with_name("README.md").read_text()


if __name__ == "__main__":
    print(as_markdown(ROWS))
