"""Every parser of files from outside, each with seeds, words of its format and the functions whose lines count."""

import contextlib
import io
import os
import pickle
import random
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fuzz import seeds
from fuzz.coverage import functions_of
from fuzz.engine import Target
from fuzz.structure import (
    LONGEST,
    mutate,
    npy_mutation,
    pickle_mutation,
    storage_mutation,
    zip_mutation,
)
from hoidata.clips.clip import SourceFile
from hoidata.datasets.arctic import files as arctic_files
from hoidata.datasets.base import RawTree
from hoidata.datasets.h2o import files as h2o_files
from hoidata.datasets.hoi4d import files as hoi4d_files
from hoidata.datasets.hot3d import files as hot3d_files
from hoidata.datasets.hot3d import packed, umetrack
from hoidata.datasets.manipnet import adapter as manipnet
from hoidata.datasets.manipnet import bvh
from hoidata.datasets.oakink2 import files as oakink2_files
from hoidata.errors import BadInput
from hoidata.files import (
    array_pieces,
    arrays,
    npy_header,
    numpy_files,
    pickle_check,
    restricted_pickle,
    torch_pickle,
)
from hoidata.hands import mano, model
from hoidata.object_paths import keyframes
from hoidata.objects import glb, mesh, stl, user_mesh
from hoidata.objects import ply as ply_reader
from hoidata.store import mapped, store
from models.manipnet import trajectory_files
from pipelines import params
from pipelines.lineage import manifests
from pipelines.stages import base
from pipelines.stages.adapters import ConvertSettings

ABSENT = b"absent"  # stands for a file that is not there
GLOBALS = (
    *(b"cnumpy.core.multiarray\n_reconstruct\n", b"cnumpy._core.multiarray\nscalar\n", b"cnumpy\nndarray\n"),
    *(b"cnumpy\ndtype\n", b"cnumpy._core.numeric\n_frombuffer\n", b"c_codecs\nencode\n", b"cbuiltins\nset\n"),
    *(b"c__builtin__\nbytes\n", b"cos\nsystem\n", b"cbuiltins\neval\n", b"\x8c\x02os\x8c\x06system\x93"),
)
OPCODES = (
    *(b"N", b"\x88", b"]", b"}", b")", b"(", b"t", b"\x85", b"\x86", b"\x87", b"a", b"e", b"s", b"u", b"R", b"b"),
    *(b"0", b"1", b"2", b"\x94", b"q\x00", b"h\x00", b"h\x01", b"r\xff\xff\xff\x7f", b"j\x00\x00\x00\x00", b"."),
    *(b"K\x05", b"J\xff\xff\xff\xff", b"\x8a\x08\x00\x00\x00\x00\x00\x00\x00\x40", b"\x8a\x00", b"\x81", b"\x92"),
    *(b"G\x7f\xf8\x00\x00\x00\x00\x00\x00", b"X\x02\x00\x00\x00f8", b"U\x02O8", b"C\x04\x00\x00\x00\x00", b"\x8f"),
    *(b"\x90", b"\x91", b"Q", b"P1\n", b"\x97", b"\x98", b"I-1\n", b"L5L\n", b"S'<'\n", b"Vlatin1\n", b"\x80\x05"),
)
MANO_GLOBALS = (b"cchumpy.ch\nCh\n", b"cchumpy.reordering\nSelect\n", b"cscipy.sparse.csc\ncsc_matrix\n")
TORCH_GLOBALS = (
    *(b"ctorch._utils\n_rebuild_tensor_v2\n", b"ctorch._utils\n_rebuild_parameter\n"),
    *(b"ctorch.storage\n_load_from_bytes\n", b"ccollections\nOrderedDict\n", b"ctorch\nFloatStorage\n"),
    *(b"ctorch.cuda\nHalfStorage\n", b"ctorch\nBFloat16Storage\n"),
)
MESH_WORDS = (
    *(b"v ", b"f ", b"vn 0 0 1\n", b"1/2/3", b"//", b"-1", b"\\\n", b"end_header\n", b"element face 1000000000\n"),
    *(b"property list uchar int vertex_indices\n", b"property double x\n", b"element vertex 1000000000\n", b"ply\n"),
    *(b"format ascii 1.0\n", b"format binary_little_endian 1.0\n", b"comment TextureFile x.png\n", b"obj_info\n"),
    *(b"property list int double vertex_index\n", b"element more 2\n", b"property uchar red\n", b"nan ", b"\xff\xfe"),
)
BVH_WORDS = (b"MOTION\n", b"JOINT ", b"End Site", b"{", b"}", b"OFFSET 0 0 0", b"CHANNELS 3 ", b"Frames: ", b"ROOT ")
PICKLE = pickle_mutation((*OPCODES, *GLOBALS))
TORCH_POOL = (*OPCODES, *TORCH_GLOBALS)
ARCTIC_TEXT = "12-100 grab, right hand\n1-30 use, both hand\n\n31-45 type, left hand\n"
_SCRATCH: ContextVar[Path] = ContextVar("scratch")


@contextlib.contextmanager
def scratch_folder() -> Iterator[None]:
    """A folder in memory for parsers that take a path; forked processes use it in turn."""
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="hoidata-fuzz-", dir=shared if shared.is_dir() else None) as root:
        for folder in ("meta", str(Path(manipnet.HAND_REFERENCE).parent)):
            (Path(root) / folder).mkdir()
        token = _SCRATCH.set(Path(root))
        try:
            yield
        finally:
            _SCRATCH.reset(token)


def _written(name: str, data: bytes) -> Path:
    path = _SCRATCH.get() / name
    if data == ABSENT:
        path.unlink(missing_ok=True)
    else:
        path.write_bytes(data)
    return path


def on_disk(name: str, parse: Callable[[Path], Any]) -> Callable[[bytes], Any]:
    return lambda data: parse(_written(name, data))


def all_targets() -> dict[str, Target]:
    groups = (
        _pickles(),
        _numpy_files(),
        _hand_files(),
        _meshes(),
        _texts(),
        _trajectories(),
        _hoi4d(),
        _hot3d(),
        _oakink2(),
        _object_paths(),
        _json_files(),
        _settings(),
    )
    return {target.name: target for group in groups for target in group}


UNPICKLER = [*functions_of(restricted_pickle), *functions_of(pickle_check)]


def _pickles() -> list[Target]:
    return [
        Target(
            "pickle-arrays",
            lambda: [*seeds.array_pickles(), *seeds.near_array_pickles()],
            _restricted,
            UNPICKLER,
            (*OPCODES, *GLOBALS),
            PICKLE,
        ),
        Target(
            "pickle-mano",
            seeds.mano_pickles,
            _mano_values,
            (mano._dense, mano._dense_csc),
            (*OPCODES, *GLOBALS, *MANO_GLOBALS),
            pickle_mutation((*OPCODES, *MANO_GLOBALS)),
        ),
        Target(
            "pickle-torch",
            lambda: [*seeds.torch_pickles(), *seeds.near_torch_pickles()],
            _torch,
            functions_of(torch_pickle),
            TORCH_POOL,
            pickle_mutation(TORCH_POOL, storage_mutation(TORCH_POOL)),
        ),
    ]


def _torch(data: bytes) -> Any:
    source = _written("hand.pkl", data) if len(data) % 2 else data
    return torch_pickle.load_torch_pickle(source, "hand.pkl")


def _restricted(data: bytes) -> Any:
    source = io.BytesIO(data) if len(data) % 2 else data
    return restricted_pickle.restricted_load(source, restricted_pickle.ARRAYS, max_bytes=LONGEST - 256)


def _mano_values(data: bytes) -> Any:
    content = restricted_pickle.restricted_load(data, mano._ALLOW, encoding="latin1", where="MANO_RIGHT.pkl")
    if isinstance(content, dict):
        return [mano._dense(f"MANO_RIGHT.pkl: {key}", value) for key, value in content.items()]
    return mano._dense("MANO_RIGHT.pkl", content)


def _numpy_files() -> list[Target]:
    words = (b"\x93NUMPY", b"'descr': '|O'", b"(1000000000, 1000000000)", b"True", b"<f8", b"()", *OPCODES[:8])
    zip_words = (
        b"PK\x03\x04",
        b"PK\x01\x02",
        b"PK\x05\x06",
        b"PK\x06\x06",
        b"PK\x06\x07",
        b".npy",
        b"\xff\xff\xff\xff",
    )
    plain = npy_mutation(mutate)
    objects = npy_mutation(PICKLE)
    reading = [numpy_files._read, *functions_of(npy_header)]
    members = [numpy_files.load_npz_objects, numpy_files._chosen_members, numpy_files._check_size]
    members += [numpy_files._read_member, numpy_files.open_archive, numpy_files._item]
    return [
        Target(
            "npy",
            lambda: [*seeds.npy_files(), *seeds.near_npy_files()],
            on_disk("a.npy", numpy_files.load_npy),
            functions_of(npy_header),
            words,
            plain,
        ),
        Target(
            "npy-object",
            lambda: [*seeds.npy_object_files(), *seeds.near_npy_files()],
            on_disk("a.npy", numpy_files.load_npy_object),
            reading,
            words,
            objects,
        ),
        Target(
            "npz-object",
            lambda: [*seeds.npz_object_files(), *seeds.near_object_archives()],
            on_disk("a.npz", lambda path: numpy_files.load_npz_objects(path, ("obj_name", "n_frames", "lhand"))),
            members,
            zip_words,
            zip_mutation(objects),
        ),
        Target(
            "npz-pieces",
            lambda: [*seeds.npz_object_files(), *seeds.near_pieces()],
            on_disk("a.npz", _pieces),
            functions_of(array_pieces),
            zip_words,
            zip_mutation(objects),
        ),
        Target(
            "npz-read",
            lambda: [*seeds.npz_files(False), *seeds.npz_files(True), *seeds.near_object_archives(), ABSENT],
            on_disk("a.npz", arrays.read_npz),
            [item for item in functions_of(arrays) if item.__name__ != "write_npz"],
            zip_words,
            zip_mutation(plain),
        ),
        Target(
            "npz-map",
            lambda: [*seeds.npz_files(False), seeds.npz_files(True)[0], seeds.npz_object_files()[0], ABSENT],
            on_disk("a.npz", _mapped),
            functions_of(mapped),
            zip_words,
            zip_mutation(plain),
        ),
    ]


def _pieces(path: Path) -> None:
    for name, array in array_pieces.locate_arrays(path, "contact").items():
        for number, (_, piece) in enumerate(array.pieces()):
            if number > 3:  # an array of rows without columns may have any number of them
                break
            _ = name, piece.sum()


def _mapped(path: Path) -> None:
    for array in mapped.map_npz(path).values():
        _ = array.ravel()[:10].tolist()


def _hand_files() -> list[Target]:
    checks = (mano._load_side, mano._find, mano._fields, mano._parents, mano._check_side)
    return [
        Target(
            "mano-file",
            seeds.mano_files,
            on_disk("MANO_RIGHT.pkl", lambda path: mano._load_side(path.parent, "right")),
            (*checks, model.checked_model, model._check_meaning),
            structure=_mano_mutation,
            longest=1 << 20,
            structured_only=True,
        )
    ]


_change_mano = pickle_mutation((*OPCODES, *GLOBALS, *MANO_GLOBALS))


def _mano_mutation(rng: random.Random, data: bytes) -> bytes:
    """Mostly other opcodes; now and then a changed place in the bulk, or a cut."""
    if rng.random() < 0.7:
        return _change_mano(rng, data)
    at = rng.randrange(len(data))
    if rng.random() < 0.3:
        return data[:at]
    start = max(0, at - 64)
    return data[:start] + mutate(rng, data[start:at], OPCODES) + data[at:]


def _meshes() -> list[Target]:
    quick = (mesh._plain_triangles, mesh._numbers_of, mesh._position_index)
    slow = (mesh._any_polygons, mesh._whole_lines, mesh._obj_index, mesh._Names)
    obj = (mesh._read_obj, mesh.load_named_mesh, mesh._parse_named_obj, *quick, *slow, mesh.checked_mesh)
    text = [mesh._read_ply, *functions_of(ply_reader)]
    binary = [item for item in text if item not in (ply_reader._numbers, ply_reader._as_numbers)]
    return [
        Target(
            "obj", lambda: [seeds.OBJ, *seeds.near_meshes(), ABSENT], on_disk("a.obj", mesh.load_mesh), obj, MESH_WORDS
        ),
        Target(
            "ply-ascii",
            lambda: [*seeds.ply_texts(), *seeds.near_ply(True)],
            on_disk("a.ply", mesh.load_mesh),
            text,
            MESH_WORDS,
        ),
        Target(
            "ply-binary",
            lambda: [*seeds.ply_binaries(), *seeds.near_ply(False)],
            on_disk("a.ply", mesh.load_mesh),
            binary,
            MESH_WORDS,
        ),
        Target(
            "glb",
            lambda: [*seeds.glb_files(), ABSENT],
            on_disk("a.glb", user_mesh.read_mesh_file),
            (user_mesh.read_mesh_file, user_mesh._read, user_mesh._of_glb, user_mesh._joined, *functions_of(glb)),
            (
                b'"count": 9',
                b"5126",
                b"5125",
                b"VEC3",
                b'"mesh": 0',
                b'"nodes": [0]',
                b"null",
                b"JSON",
                b"BIN\0",
                b"-1",
            ),
        ),
        Target(
            "stl",
            lambda: [*seeds.stl_files(), ABSENT],
            on_disk("a.stl", user_mesh.read_mesh_file),
            (user_mesh._read, user_mesh._of_stl, user_mesh._joined, *functions_of(stl)),
            (b"solid", b"endsolid", b"facet", b"endfacet", b"vertex 0 0 1\n", b"nan", b"\xff", b"\0"),
        ),
    ]


def _texts() -> list[Target]:
    return [
        Target(
            "bvh",
            lambda: [seeds.BVH],
            lambda data: bvh.parse_bvh(data.decode("utf-8", "replace"), "a.bvh"),
            (bvh.parse_bvh, bvh._SkeletonReader, bvh._parse_motion_head, bvh._parse_rows),
            BVH_WORDS,
        ),
        Target(
            "gzip-text",
            seeds.gzipped,
            lambda data: bvh.unpack_text(data, "a.bvh.gz", 4096),
            (bvh.unpack_text,),
            (b"\x1f\x8b\x08", b"\0", b"\xff"),
        ),
        Target(
            "h2o-rows",
            lambda: [b"1 2.5 -3e-2\n4", b"-0 1 2", b"1.0  2 3\r\n", b"0.5 1 nan"],
            lambda data: h2o_files.parse_rows([b"1 2 3\n", data], 3, "cam_pose", ["000000.txt", "000001.txt"]),
            (h2o_files.parse_rows, h2o_files._parse_as_json, h2o_files._parse_line),
            (b" ", b"\n", b"e", b"-", b"_", b"],[", b"Infinity", b"\xd9\xa3"),
        ),
        Target(
            "h2o-segments",
            lambda: list(map(str.encode, _segment_lists())),
            lambda data: h2o_files.parse_segments(data, "action_train.txt"),
            (h2o_files.parse_segments, h2o_files._segment),
            (b"subject1/h1/0", b"\n", b"id ", b"action_label", "٣".encode(), b"\xff", b"99999999999"),
        ),
        Target(
            "arctic-descriptions",
            lambda: [ARCTIC_TEXT.encode()],
            lambda data: arctic_files.parse_descriptions(data, "description.txt"),
            (arctic_files.parse_descriptions, arctic_files.parse_description),
            (b"1-2 grab, both hand\n", b"left", b"-", b"\n", "٣".encode(), b"\xff"),
        ),
    ]


def _trajectories() -> list[Target]:
    shared = (
        trajectory_files.from_arrays,
        trajectory_files._array,
        trajectory_files._check_times,
        trajectory_files._body,
    )
    words = (
        b",",
        b"\n",
        b"nan",
        b"1e400",
        b"-",
        b'"',
        b"time_s",
        b"object_qw",
        b"left_x",
        b"hinge_rad",
        b"\xff",
        b"\0",
    )
    rows = (trajectory_files._numbers, *shared)
    return [
        Target(
            "trajectories-csv",
            seeds.trajectory_tables,
            lambda data: trajectory_files.parse_csv(data, "a.csv"),
            (trajectory_files.parse_csv, *rows),
            words,
        ),
        Target(
            "trajectories-manipnet",
            seeds.trajectory_texts,
            lambda data: trajectory_files.parse_manipnet(data, "a.txt"),
            (trajectory_files.parse_manipnet, trajectory_files._numbers),
            words,
        ),
        Target(
            "trajectories-npz",
            seeds.trajectory_archives,
            on_disk("a.npz", lambda path: trajectory_files.from_arrays(numpy_files.load_npz_arrays(path), "a.npz")),
            shared,
            (b"PK\x03\x04", b".npy", b"(1, 3)", b"<f8", b"|O"),
            zip_mutation(npy_mutation(mutate)),
        ),
    ]


def _hoi4d() -> list[Target]:
    values = {"poseCoeff": np.zeros(48, "f4"), "beta": np.zeros(10, "f4"), "trans": np.zeros(3, "f4")}
    return [
        Target(
            "hoi4d-camera",
            lambda: [b"0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n" * 2],
            lambda data: hoi4d_files.camera_poses(data, "output.log"),
            (hoi4d_files.camera_poses,),
            (b"\n", b" ", b"0 0 1\n", b"nan", b"1e400", b"-", b"\xff", b"inf"),
        ),
        Target(
            "hoi4d-hand",
            lambda: [pickle.dumps(rows, 2) for rows in (values, {**values, "poseCoeff": np.zeros(1)}, {"beta": [1]})],
            lambda data: hoi4d_files.hand_frame(data, "0.pickle"),
            (hoi4d_files.hand_frame,),
            (*OPCODES, *GLOBALS),
            PICKLE,
        ),
        _json_target(
            "hoi4d-json",
            _hoi4d_values(),
            _hoi4d_json,
            (
                *(hoi4d_files.object_poses, hoi4d_files._part_pose, hoi4d_files._numbers, hoi4d_files.action_events),
                *(hoi4d_files._numbers_of, hoi4d_files._clock_s, hoi4d_files.hinge_joint, hoi4d_files._mesh_of),
            ),
        ),
    ]


def _oakink2() -> list[Target]:
    entry = {"primitive": "stir", "interaction_mode": "bh_main", "obj_list": ["a"], "obj_list_lh": None}
    entry |= {"obj_list_rh": ["b"]}
    keys = ("((1595, 2340), None)", "(None, (3, 9))", "((1, 2), (3, 4))", "(None, None)", "((2, 1), 1)", "x", "((" * 30)
    programs = [{key: entry} for key in keys]
    programs += [{keys[0]: {**entry, "interaction_mode": "foot"}}, {keys[0]: {**entry, "obj_list": "a"}}]
    others = [{"a": {"obj_id": "a", "obj_name": "mug"}}, {"a": {"obj_name": 1}}, {"a": ["b"], "b": ["c"]}, {"a": ["a"]}]
    texts = (
        *(oakink2_files.read_program, oakink2_files._segment, oakink2_files._ranges, oakink2_files._range),
        *(oakink2_files.read_names, oakink2_files.read_roots, oakink2_files._json),
        oakink2_files.Segment,
    )
    return [
        Target(
            "oakink2-annotation",
            seeds.oakink2_annotations,
            lambda data: oakink2_files.read_annotation(data, "a.pkl"),
            functions_of(oakink2_files, [item.__name__ for item in texts]),
            (*OPCODES, *GLOBALS),
            PICKLE,
        ),
        _json_target("oakink2-json", [*programs, *others, [1]], _oakink2_json, texts),
    ]


def _oakink2_json(data: bytes) -> None:
    """As each of the three kinds of file."""
    for parse in (oakink2_files.read_program, oakink2_files.read_names, oakink2_files.read_roots):
        with contextlib.suppress(BadInput):
            found = parse(data, "a.json")
            _ = [(own.span, own.hand, own.name) for own in found] if isinstance(found, list) else found


def _object_paths() -> list[Target]:
    thing = seeds.hinged_object()
    words = (b",", b"\n", b"nan", b"1e400", b"-", b"time_s", b"hinge_deg", b"z_cm", b"\xff", b'{"', b"[", b"null")
    return [
        Target(
            "object-keyframes",
            seeds.keyframe_files,
            lambda data: keyframes.keyframed_path(thing, keyframes.parse_keyframes(data, "keys"), (0.0, 2.0)),
            functions_of(keyframes, ("read_keyframes",)),
            words,
        ),
    ]


def _hoi4d_values() -> list[Any]:
    three = {"x": 1, "y": 2.5, "z": -3}
    part = {"label": "a", "center": three, "rotation": three, "dimensions": {"length": 1, "width": 2, "height": 3}}
    events = [{"event": "cut", "startTime": 1.5, "endTime": 3}]
    marks = {"marks": [{"event": "cut", "hdTimeStart": 1, "hdTimeEnd": 9}]}
    axis = {"axis": {"origin": [0, 0, 1], "direction": [0, 1, 0]}}
    joints = zip((1, 2), (hoi4d_files.FIXED[0], hoi4d_files.REVOLUTE), strict=True)
    return [
        {"dataList": [part, {**part, "label": "b"}]},
        {"objects": [part]},
        {"info": {"duration": 20.0}, "events": events},
        {"info": {"Duration": 10}, "markResult": marks},
        {"events": events},
        [{"id": id_, "parent": -1, "joint": joint, "parts": [{"id": id_}], "jointData": axis} for id_, joint in joints],
    ]


def _hoi4d_json(data: bytes) -> object:
    """Whichever of the three kinds of file it looks like; and as a tree of parts."""
    if b"dataList" in data or b"objects" in data:
        return hoi4d_files.object_poses(data, "0.json")
    if b"event" in data or not data.strip():
        return hoi4d_files.action_events(data, "color.json")
    tree = b'[{"id": 0, "children": [{"id": 1, "objs": ["new-0"]}, {"id": 2, "objs": ["new-1"]}]}]'
    with contextlib.suppress(BadInput):
        hoi4d_files._meshes_by_id(hoi4d_files.read_json(data, "result.json"), "result.json")
    return hoi4d_files.hinge_joint(data, tree, "mobility_v2.json", "result.json")


def _hot3d() -> list[Target]:
    words = (b"NaN", b"null", b"-", b"1e999", b"[", b"]", b"{", b'"', b",", b"\n", b"\xff", b"true", b"_", b"0")
    rows = (hot3d_files._table, hot3d_files._time, hot3d_files.poses_of)
    return [
        Target(
            "hot3d-hands",
            seeds.hot3d_hands,
            lambda data: hot3d_files.hand_poses(data, "a.jsonl", "umetrack" if b"angles" in data else "mano"),
            (hot3d_files.hand_poses, hot3d_files._lines, hot3d_files.row_of, hot3d_files.poses_of),
            (*words, b'"hand_poses"', b'"q_wxyz"', b'"pose"', b'"2"'),
        ),
        Target(
            "hot3d-tables",
            seeds.hot3d_tables,
            lambda data: (hot3d_files.failed_times if b"mask" in data else hot3d_files.object_poses)(data, "a.csv"),
            (hot3d_files.object_poses, hot3d_files.failed_times, *rows),
            (*words, b"True", b"False", b"mask", "٣".encode(), b"1e400", b"object_uid"),
        ),
        Target(
            "hot3d-tar",
            seeds.hot3d_tars,
            lambda data: packed.read_packed(data, "a.tar"),
            functions_of(packed),
            (
                *words,
                b"000001.hands.json\0",
                b"__hand_shapes.json__\0",
                b'"mano_pose"',
                b'"thetas"',
                b"ustar",
                b"0000777",
            ),
        ),
        Target(
            "hot3d-json",
            seeds.hot3d_json,
            _hot3d_json,
            (
                hot3d_files.headset,
                hot3d_files.headset_of,
                hot3d_files.object_names,
                hot3d_files.checked_name,
                hot3d_files.read_json,
                *functions_of(umetrack),
            ),
            (*words, b'"headset"', b"17", b"1.5", b'"instance_name"', b'"hand_model"'),
        ),
    ]


def _hot3d_json(data: bytes) -> object:
    """Whichever of the three kinds of file it looks like; joints of a profile that was read are finite or not told."""
    if b"sequence_id" in data:
        return packed.definition(data, "clip_definitions.json", 7)
    if b"headset" in data:
        return hot3d_files.headset(data, "metadata.json")
    if b"hand_model" not in data:
        return hot3d_files.object_names(data, "instance.json")
    still = hot3d_files.Poses(np.zeros(1, int), np.eye(3)[None], np.zeros((1, 3)), {"joint_angles": np.ones((1, 22))})
    return umetrack.joints_m(umetrack.parse_profile(data, "profile.json"), still, "right")


def _segment_lists() -> tuple[str, str]:
    head = "id path action_label start_act end_act start_frame end_frame\n"
    row = "1 subject1/h1/0 8 56 92 0 640\n"
    return head + row + "\n" + row, head.replace("action_label ", "") + row.replace(" 8 ", " ")


def _json_files() -> list[Target]:
    capsules = [{"joint": joint, "end_local": [0.1, -0.2, 3]} for joint in manipnet.TIP_JOINTS]
    entry = asdict(SourceFile("grab/s1/a.npz", 12, "0" * 64))
    manifest = {"schema": manifests.SCHEMA, "dataset": "grab", "present": True, "source": "files", "licence": "x"}
    info = {"schema_version": store.SCHEMA_VERSION, "dataset": "grab", "hand_model": {"digest": "x"}, "synthetic": True}
    return [
        _json_target(
            "arctic-parts",
            [[0, 1, 0, 1], [True, False, 1, 0]],
            lambda data: arctic_files.parse_parts(data, "parts.json", 4),
            (arctic_files.parse_parts,),
        ),
        _json_target(
            "arctic-misc",
            [{"s01": {"ioi_offset": 644, "gender": "male"}, "s02": {"ioi_offset": 1}}],
            lambda data: arctic_files.parse_misc(data, "misc.json"),
            (arctic_files.parse_misc,),
        ),
        _json_target(
            "manipnet-hand-reference",
            [{"capsules": capsules}, {"capsules": [{**capsule, "end_local": [1, 2]} for capsule in capsules]}],
            on_disk(manipnet.HAND_REFERENCE, lambda path: manipnet._read_tips(RawTree(path.parent.parent))),
            (manipnet._read_tips,),
        ),
        _json_target(
            "manifest",
            [{**manifest, "files": [entry, entry]}, {**manifest, "recipe": {"seed": 0}, "source": "generated"}],
            on_disk("grab.json", manifests.read_manifest),
            (manifests.read_manifest, manifests.Manifest.by_path.fget),
        ),
        _json_target(
            "store-info",
            [info, {**info, "schema_version": "1.0.0"}, {**info, "schema_version": "9.0.0"}, {**info, "hand_model": 1}],
            on_disk("meta/info.json", lambda path: _store_info(path.parent.parent)),
            (store.read_info,),
        ),
    ]


def _json_target(name: str, values: Sequence[Any], run: Callable[[bytes], Any], code: Sequence[Any]) -> Target:
    words = (b"[", b"]", b"{", b'"', b",", b"null", b"NaN", b"1e999", b"-", b"\xff", b"\\ud800", b"true")
    return Target(name, lambda: [*seeds.as_json(*values), ABSENT], run, code, words)


def _store_info(folder: Path) -> None:
    store.open_store(folder)  # ends at the tables, which are not there


def _settings() -> list[Target]:
    toml = b'[roots]\ngrab = "/data/grab"\nh2o = "x"\n\n[other]\na = [1, 2.5, true, 1979-05-27]\n'
    text = yaml.safe_dump({"profile": "own", "convert": {"margin_frames": 3}, "split": {"h2o": "text2hoi"}}).encode()
    return [
        Target(
            "hoidata-toml",
            lambda: [toml],
            on_disk("hoidata.toml", _own_root),
            (base.own_root, base._registered_roots),
            (
                b"[roots]\n",
                b"=",
                b'"',
                b"'''",
                b"[[a]]\n",
                b"roots = 5\n",
                b"{",
                b"\xff",
                b"grab = 1\n",
                b"a.b.c = 1\n",
            ),
        ),
        Target(
            "params-yaml",
            lambda: [text],
            on_disk("params.yaml", _params),
            (base.load_settings, params.read_file),
            (b"convert: ", b"- ", b"!!python/object/apply:os.system ", b"&a ", b"*a", b"<<: *a\n", b"{", b"]", b"? "),
        ),
    ]


def _params(path: Path) -> Any:
    return base.load_settings(ConvertSettings, "convert", path)


def _own_root(path: Path) -> Any:
    os.environ.pop(base.root_variable("grab"), None)
    with contextlib.chdir(path.parent):
        return base.own_root("grab")
