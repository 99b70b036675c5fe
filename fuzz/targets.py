"""The fuzzing target of each parser of external files, with small valid files as seeds."""

import contextlib
import gzip
import io
import json
import os
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from fnmatch import fnmatch
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from fuzz.engine import MAX_INPUT_BYTES, Target
from hoidata.clips.clip import SourceFile
from hoidata.datasets import checks
from hoidata.datasets.arctic import adapter as arctic
from hoidata.datasets.base import RawTree
from hoidata.datasets.h2o import files as h2o
from hoidata.datasets.hoi4d import files as hoi4d
from hoidata.datasets.hot3d import files as hot3d
from hoidata.datasets.manipnet import adapter as manipnet
from hoidata.datasets.manipnet import hand as own_hand
from hoidata.datasets.oakink2 import files as oakink2
from hoidata.errors import BadInput
from hoidata.files import array_pieces, arrays, npy_header, numpy_files, pickle_check, restricted_pickle, torch_pickle
from hoidata.hands import load_embedded_hands, mano, model
from hoidata.object_paths import keyframes, trajectory_files
from hoidata.objects import glb, mesh, ply, stl, urdf, user_mesh
from hoidata.store import mapped, store
from pipelines import params
from pipelines.lineage import manifests
from pipelines.stages import base
from pipelines.stages.adapters import ConvertSettings
from tests.builders.objects import hinged_box

ABSENT = b"absent"  # this content means: the file does not exist
BVH = (
    b"HIERARCHY\nROOT Hand\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation\n"
    b"JOINT Finger\n{\nOFFSET 1 0.5 0\nCHANNELS 3 Yrotation Xrotation Zrotation\nEnd Site\n{\nOFFSET 1 0 0\n}\n}\n}\n"
    b"MOTION\nFrames: 2\nFrame Time: 0.008333\n0 0 0 1 2 3 4 5 6\n1 0 0 1 2 3 4 5 -6.5\n"
)
OBJ = (
    b"v 0 0 0\nv 1.5 0 0 0.5 0.5 0.5\nv 0 1e0 0\nv 0 0 -1\nvn 0 0 1\ng part\nf 1 2 3\nf 1/1/1 2/1/1 4/1/1\nf -1 -2 -3\n"
)
PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 3\n"
    b"property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n4 0 1 2 3\n"
)
URDF = (
    b'<robot name="r"><link name="a"><visual><geometry><box size="1 1 1"/></geometry></visual></link><link name="b">'
    b'<visual><origin xyz="0 0 1" rpy="0 0 1"/><geometry><cylinder radius="0.2" length="1"/></geometry></visual></link>'
    b'<joint name="j" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>'
    b'<limit lower="-1" upper="1"/></joint></robot>'
)
SEGMENTS = b"id path action_label start_act end_act start_frame end_frame\n1 subject1/h1/0 8 56 92 0 640\n"
TREE = b'[{"id": 0, "children": [{"id": 1, "objs": ["new-0"]}, {"id": 2, "objs": ["new-1"]}]}]'
KEYFRAMES = b"time_s,x_cm,z_mm,rx_deg,hinge_rad\n0,0,0,0,0\n1,5,150,20,0.5\n2,5,0,0,0\n"
TOML = b'[roots]\ngrab = "/data/grab"\nh2o = "x"\n\n[other]\na = [1, 2.5, true, 1979-05-27]\n'
PARAMS = b"profile: own\nconvert: {margin_frames: 3}\nsplit: {h2o: text2hoi}\n"


def seed_files(*files: bytes) -> Callable[[], list[bytes]]:
    return lambda: [*files, ABSENT]


@cache
def _raw(dataset: str) -> dict[str, bytes]:
    """Raw files of two recordings, written by the adapter's test builder."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        import_module(f"tests.builders.{dataset}").write_two(root)
        return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def raw(dataset: str, *patterns: str, lines: int | None = None) -> Callable[[], list[bytes]]:
    """Seeds: the smallest raw file that matches each pattern; ``lines``: only its first lines."""

    def seeds() -> list[bytes]:
        fitting = [[data for name, data in _raw(dataset).items() if fnmatch(name, pattern)] for pattern in patterns]
        smallest = [min(files, key=len) for files in fitting]
        return smallest if lines is None else [b"".join(data.splitlines(keepends=True)[:lines]) for data in smallest]

    return seeds


def pickled(value: object, protocol: int = 2) -> bytes:
    """Pickle with the module names of NumPy 1, as in released files; protocols over 3 keep those of NumPy 2."""
    data = pickle.dumps(value, protocol)
    return data if protocol > 3 else data.replace(b"numpy._core", b"numpy.core")


def archive(save: Callable, **values: Any) -> bytes:
    stream = io.BytesIO()
    save(stream, **values)
    return stream.getvalue()


def boxed(value: object) -> np.ndarray:
    array = np.empty((), dtype=object)
    array[()] = value
    return array


def parse(function: Callable, *names: Any) -> Callable[[bytes, Path], Any]:
    """A parser of bytes and the file's name."""
    return lambda data, _: function(data, *names)


def on_disk(name: str, function: Callable[[Path], Any]) -> Callable[[bytes, Path], Any]:
    """A parser of a file with this name."""

    def run(data: bytes, folder: Path) -> Any:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if data == ABSENT:
            path.unlink(missing_ok=True)
        else:
            path.write_bytes(data)
        return function(path)

    return run


@cache
def all_targets() -> dict[str, Target]:
    return _pickles() | _numpy_files() | _meshes_and_tables() | _datasets() | _json_files()


def _pickles() -> dict[str, Target]:
    values = (
        {"a": np.arange(4.0).reshape(2, 2), "b": [1, 2.5, "x", None, True, (1, "y")], "c": np.float32(2)},
        [np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)), b"\xff", {1, 2}, np.array(["cup", "b"])],
        {"deep": {"x": np.array([1, "x", np.arange(2)], dtype=object)}, "big": np.arange(3, dtype=">i4")},
    )
    arrays_ = [pickled(value, protocol) for value in values for protocol in (0, 2, 5)]
    hand = {"poseCoeff": np.zeros(48, "f4"), "beta": np.zeros(10, "f4"), "trans": np.zeros(3, "f4")}
    mano_parameters = {
        "pose_coeffs": np.eye(4, dtype="f4")[[0] * 16][None],
        "tsl": np.zeros((1, 3)),
        "betas": np.zeros((1, 10)),
    }
    both = {f"{side}__{name}": array for side in ("lh", "rh") for name, array in mano_parameters.items()}
    annotation = {"mocap_frame_id_list": [0, 1, 4], "obj_list": ["a", "b"], "raw_mano": {0: both}}
    annotation["obj_transf"] = {"a": {0: np.eye(4), 4: np.eye(4)}}
    load_hand = on_disk("MANO_RIGHT.pkl", lambda path: mano._load_side(path.parent, "right"))
    load_tensors = parse(torch_pickle.load_torch_pickle, "hand.pkl")
    tensors = raw("taco", "*hand_shape.pkl", "*right_hand.pkl")
    return {
        "pickle-arrays": Target(seed_files(*arrays_), parse(_restricted), [restricted_pickle, pickle_check], "pickle"),
        "pickle-mano": Target(_chumpy_pickles, parse(_mano_values), [mano], "pickle"),
        "pickle-torch": Target(tensors, load_tensors, [torch_pickle], "pickle"),
        "mano-file": Target(_mano_file, load_hand, [mano, model], "pickle"),
        "hoi4d-hand": Target(seed_files(pickled(hand)), parse(hoi4d.hand_frame, "0.pickle"), [hoi4d], "pickle"),
        "oakink2-annotation": Target(
            seed_files(pickled(annotation, 4)), parse(oakink2.read_annotation, "a.pkl"), [oakink2], "pickle"
        ),
    }


def _restricted(data: bytes) -> Any:
    source = io.BytesIO(data) if len(data) % 2 else data
    return restricted_pickle.restricted_load(source, restricted_pickle.ARRAYS, max_bytes=MAX_INPUT_BYTES - 256)


def _mano_values(data: bytes) -> Any:
    content = restricted_pickle.restricted_load(data, mano._ALLOW, encoding="latin1", path="MANO_RIGHT.pkl")
    return [mano._dense("MANO_RIGHT.pkl", value) for value in (content if isinstance(content, dict) else {}).values()]


def _chumpy_pickles() -> list[bytes]:
    """Dictionaries with a chumpy array, a selection of one, and a sparse matrix, as pickled by Python 2."""

    def instance(module: bytes, state: bytes) -> bytes:
        return b"c" + module + b"\n)\x81" + state + b"b"

    def inner(value: object) -> bytes:
        return pickled(value)[2:-1]  # without PROTO and STOP

    array = instance(b"chumpy.ch\nCh", inner({"x": np.arange(6.0).reshape(2, 3)}))
    chosen = b"}(U\x01a" + array + b"U\x04idxs" + inner(np.array([0, 2, 4])) + b"U\x0fpreferred_shape" + inner((3, 1))
    matrix = {"_shape": (3, 2), "data": np.ones(3), "indices": np.array([0, 1, 2]), "indptr": np.array([0, 2, 3])}
    select = instance(b"chumpy.reordering\nSelect", chosen + b"u")
    sparse = instance(b"scipy.sparse.csc\ncsc_matrix", inner(matrix))
    return [b"\x80\x02}U\x01a" + part + b"s." for part in (array, select, sparse, inner(np.arange(3.0)))]


def _mano_file() -> list[bytes]:
    """A right hand in MANO's layout; large arrays are int8, so that parsing is fast."""
    hand = load_embedded_hands().right
    content = {
        **{"shapedirs": np.zeros((778, 3, 10), np.int8), "posedirs": np.zeros((778, 3, 135), np.int8)},
        **{"J_regressor": hand.joint_regressor, "weights": hand.skin_weights, "v_template": hand.template_m},
        **{"hands_mean": hand.mean_pose, "hands_components": hand.components, "f": hand.faces.astype(np.uint16)},
        "kintree_table": np.array([[2**32 - 1, *hand.parents[1:]], range(16)], np.int64),
    }
    return [pickled(content)]


def _numpy_files() -> dict[str, Target]:
    hand = boxed({"params": {"transl": np.zeros((2, 3))}, "vtemp": "a.ply"})
    contact = boxed({"object": np.zeros((2, 4), np.int8), "body": np.zeros((2, 4100), np.int8)})
    grab = {"obj_name": np.array("cup"), "n_frames": np.array(2), "lhand": hand, "contact": contact}
    small = {"a": np.arange(4.0), "b": np.array("x"), "c": np.zeros((0, 2))}
    objects = seed_files(*(archive(save, **grab) for save in (np.savez, np.savez_compressed)))
    numbers = seed_files(*(archive(save, **small) for save in (np.savez, np.savez_compressed)))
    quaternions = np.tile([1.0, 0, 0, 0], (4, 1))
    object_arrays = {"time_s": np.arange(4) / 30, "object_position": np.zeros((4, 3)), "object_quaternion": quaternions}
    tracked = seed_files(archive(np.savez, **object_arrays, left_position=np.ones((4, 3)), left_quaternion=quaternions))
    plain = [archive(np.save, arr=array) for array in (np.arange(6.0).reshape(2, 3), np.array("text"))]

    def read_objects(path: Path) -> Any:
        return numpy_files.load_npz_objects(path, ("obj_name", "n_frames", "lhand"))

    def pieces(path: Path) -> None:
        for array in array_pieces.locate_arrays(path, "contact").values():
            # Four pieces only: an array with rows of no columns may have any number.
            _ = [piece.sum() for _, (_, piece) in zip(range(4), array.pieces(), strict=False)]

    def map_all(path: Path) -> None:
        _ = [array.ravel()[:10].tolist() for array in mapped.map_npz(path).values()]

    def trajectories(path: Path) -> Any:
        return trajectory_files.from_arrays(numpy_files.load_npz_arrays(path), "a.npz")

    read_any = on_disk("a.npy", numpy_files.load_npy_object)
    return {
        "npy": Target(seed_files(*plain), on_disk("a.npy", numpy_files.load_npy), [npy_header]),
        "npy-object": Target(seed_files(archive(np.save, arr=hand), *plain), read_any, [npy_header, numpy_files]),
        "npz-object": Target(objects, on_disk("a.npz", read_objects), [numpy_files], "zip"),
        "npz-pieces": Target(objects, on_disk("a.npz", pieces), [array_pieces], "zip"),
        "npz-read": Target(numbers, on_disk("a.npz", arrays.read_npz), [arrays], "zip"),
        "npz-map": Target(numbers, on_disk("a.npz", map_all), [mapped], "zip"),
        "trajectories-npz": Target(tracked, on_disk("a.npz", trajectories), [trajectory_files], "zip"),
    }


def _meshes_and_tables() -> dict[str, Target]:
    box, hinged = trimesh.creation.box(), hinged_box()
    binary_ply, ascii_stl = box.export(file_type="ply"), box.export(file_type="stl_ascii").encode()
    names = [f"{body}_{part}" for body in ("object", "right") for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    rows = [f"{number / 30:.4f},0,0,0,1,0,0,0,0.1,0,0,1,0,0,0" for number in range(4)]
    table = "\n".join([",".join(["time_s", *names]), *rows]).encode()
    listed = b'[{"time_s": 0, "z_cm": 0, "hinge_deg": 0}, {"time_s": 1.5, "z_cm": 20, "hinge_deg": 45}]'
    manipnet_rows = b"120\n" + b"\n".join([b",".join([b"0,0,0,1,0.5,1,2"] * 3)] * 4)

    def keyframed(data: bytes) -> Any:
        return keyframes.keyframed_path(hinged, keyframes.parse_keyframes(data, "keys"), (0.0, 2.0))

    def meshes(suffix: str) -> Callable[[bytes, Path], Any]:
        return on_disk(f"a.{suffix}", mesh.load_mesh if suffix in ("obj", "ply", "stl") else user_mesh.read_mesh_file)

    return {
        "obj": Target(seed_files(OBJ), meshes("obj"), [mesh]),
        "ply-ascii": Target(seed_files(PLY), meshes("ply"), [mesh, ply]),
        "ply-binary": Target(seed_files(binary_ply), meshes("ply"), [mesh, ply]),
        "glb": Target(seed_files(box.export(file_type="glb")), meshes("glb"), [user_mesh, glb]),
        "stl": Target(seed_files(ascii_stl, box.export(file_type="stl")), meshes("stl"), [mesh, stl]),
        "urdf": Target(seed_files(URDF), on_disk("a.urdf", user_mesh.read_user_object), [urdf]),
        "trajectories-csv": Target(seed_files(table), parse(trajectory_files.parse_csv, "a.csv"), [trajectory_files]),
        "trajectories-manipnet": Target(
            seed_files(manipnet_rows), parse(trajectory_files.parse_manipnet, "a.txt"), [trajectory_files]
        ),
        "object-keyframes": Target(seed_files(KEYFRAMES, listed), parse(keyframed), [keyframes]),
    }


def _datasets() -> dict[str, Target]:
    described = b"12-100 grab, right hand\n1-30 use, both hand\n\n31-45 type, left hand\n"

    def hot3d_tables(data: bytes) -> Any:
        return (hot3d.failed_times if b"mask" in data else hot3d.object_poses)(data, "a.csv")

    def h2o_rows(data: bytes) -> Any:
        return h2o.parse_rows([b"1 2 3\n", data], 3, "cam_pose", ["000000.txt", "000001.txt"])

    def bvh_text(data: bytes) -> Any:
        return own_hand.parse_bvh(data.decode("utf-8", "replace"), "a.bvh")

    return {
        "bvh": Target(seed_files(BVH), parse(bvh_text), [own_hand]),
        "gzip-text": Target(
            seed_files(gzip.compress(BVH, mtime=0)), parse(own_hand.unpack_text, "a.bvh.gz", 4096), [own_hand]
        ),
        "h2o-rows": Target(seed_files(b"1 2.5 -3e-2\n4", b"1.0  2 3\r\n"), parse(h2o_rows), [h2o]),
        "h2o-segments": Target(seed_files(SEGMENTS), parse(h2o.parse_segments, "action_train.txt"), [h2o]),
        "arctic-descriptions": Target(
            seed_files(described), parse(arctic.parse_descriptions, "description.txt"), [arctic]
        ),
        "hoi4d-camera": Target(raw("hoi4d", "*output.log", lines=10), parse(hoi4d.camera_poses, "output.log"), [hoi4d]),
        "hot3d-hands": Target(
            raw("hot3d", "*mano*.jsonl", lines=2), parse(hot3d.hand_poses, "a.jsonl", "mano"), [hot3d]
        ),
        "hot3d-tables": Target(raw("hot3d", "*objects.csv", "*mask*.csv", lines=3), parse(hot3d_tables), [hot3d]),
        "hot3d-tar": Target(_packed_clip, parse(hot3d.read_packed, "a.tar"), [hot3d]),
    }


def _packed_clip() -> list[bytes]:
    builders = import_module("tests.builders.hot3d")
    with tempfile.TemporaryDirectory() as folder:
        whole = builders.truth("Aria", "mano", 0)
        return [builders.write_clip(Path(folder), "Aria", 1, "P0001_4bf4e21a", whole).read_bytes()]


def _json_files() -> dict[str, Target]:
    capsules = [{"joint": joint, "end_local": [0.1, -0.2, 3]} for joint in manipnet.TIP_JOINTS]
    entry = asdict(SourceFile("grab/s1/a.npz", 12, "0" * 64))
    manifest = {"schema": manifests.SCHEMA, "dataset": "grab", "present": True, "source": "files", "licence": "x"}
    generated = {**manifest, "recipe": {"seed": 0}, "source": "generated"}
    info = {"schema_version": store.SCHEMA_VERSION, "dataset": "grab", "hand_model": {"digest": "x"}, "synthetic": True}
    misc = {"s01": {"ioi_offset": 644, "gender": "male"}, "s02": {"ioi_offset": 1}}
    hoi4d_seeds = raw("hoi4d", "*color.json", "*objpose/*.json", "*mobility_v2.json", "*result.json")
    hot3d_seeds = raw("hot3d", "*metadata.json", "*instance.json", "*profile.json")
    oakink2_seeds = raw("oakink2", "*program_info/*.json", "*obj_desc.json", "*part_tree.json")

    def values(*contents: object) -> Callable[[], list[bytes]]:
        return seed_files(*(json.dumps(content).encode() for content in contents))

    def registered_root(path: Path) -> Any:
        os.environ.pop(base.root_variable("grab"), None)
        with contextlib.chdir(path.parent):
            return base.registered_root("grab")

    def settings(path: Path) -> Any:
        return base.load_settings(ConvertSettings, "convert", path)

    def tips(path: Path) -> Any:
        return manipnet._read_tips(RawTree(path.parent.parent))

    read_manifest = on_disk("grab.json", manifests.read_manifest)
    open_store = on_disk("meta/info.json", lambda path: store.open_store(path.parent.parent))
    return {
        "arctic-parts": Target(values([0, 1, 0, 1]), parse(arctic.parse_parts, "parts.json", 4), [arctic]),
        "arctic-misc": Target(values(misc), parse(arctic.parse_misc, "misc.json"), [arctic]),
        "manipnet-hand-reference": Target(
            values({"capsules": capsules}), on_disk(manipnet.HAND_REFERENCE, tips), [manipnet]
        ),
        "manifest": Target(values({**manifest, "files": [entry]}, generated), read_manifest, [manifests]),
        "store-info": Target(values(info, {**info, "schema_version": "9.0.0"}), open_store, [store]),
        "hoi4d-json": Target(hoi4d_seeds, parse(_hoi4d_json), [hoi4d]),
        "oakink2-json": Target(oakink2_seeds, parse(_oakink2_json), [oakink2]),
        "hot3d-json": Target(hot3d_seeds, parse(_hot3d_json), [hot3d]),
        "hoidata-toml": Target(seed_files(TOML), on_disk("hoidata.toml", registered_root), [base]),
        "params-yaml": Target(seed_files(PARAMS), on_disk("params.yaml", settings), [base, params]),
    }


def _hoi4d_json(data: bytes) -> object:
    """Parse as the kind of file that the bytes resemble; also as a tree of parts."""
    if b"dataList" in data or b"objects" in data:
        return hoi4d.object_poses(data, "0.json")
    if b"event" in data or not data.strip():
        return hoi4d.action_events(data, "color.json")
    with contextlib.suppress(BadInput):
        hoi4d._meshes_by_id(checks.json_value("result.json", data), "result.json")
    return hoi4d.hinge_joint(data, TREE, "mobility_v2.json", "result.json")


def _oakink2_json(data: bytes) -> None:
    """Parse as each of the three kinds of file."""
    for read in (oakink2.read_program, oakink2.read_names, oakink2.read_roots):
        with contextlib.suppress(BadInput):
            parsed = read(data, "a.json")
            _ = [(item.span, item.hand, item.name) for item in parsed] if isinstance(parsed, list) else parsed


def _hot3d_json(data: bytes) -> object:
    """Parse as the kind of file that the bytes resemble; compute the joints of a profile too."""
    if b"sequence_id" in data:
        return hot3d.clip_definition(data, "clip_definitions.json", 7)
    if b"headset" in data:
        return hot3d.headset(data, "metadata.json")
    if b"hand_model" not in data:
        return hot3d.object_names(data, "instance.json")
    pose = hot3d.Poses(np.zeros(1, int), np.eye(3)[None], np.zeros((1, 3)), {"joint_angles": np.ones((1, 22))})
    return hot3d.joints_m(hot3d.parse_profile(data, "profile.json"), pose, "right")
