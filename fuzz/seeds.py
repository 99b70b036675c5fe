"""Small valid files of every format, made here: nothing binary is committed."""

import base64
import gzip
import io
import json
import pickle
import pickletools
import struct
import tarfile
import zipfile
from collections import OrderedDict
from functools import cache

import numpy as np

from fuzz.structure import npy_bytes
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import Hinge, ObjectModel

TRAJECTORY_PARTS = ("x", "y", "z", "qw", "qx", "qy", "qz")
HEADER = {"descr": "|O", "fortran_order": False, "shape": ()}


def _objects() -> list[object]:
    return [
        {"a": np.arange(4.0).reshape(2, 2), "b": [1, 2.5, "x", None, True, (1, "y")], "c": np.float32(2)},
        [np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)), b"\xff", {1, 2}, np.array(["cup", "b"])],
        {"deep": {"x": np.array([1, "x", np.arange(2)], dtype=object)}, "big": np.arange(3, dtype=">i4")},
    ]


def array_pickles() -> list[bytes]:
    return [
        pickle.dumps(value, protocol).replace(b"numpy._core", core)
        for value in _objects()
        for protocol, core in ((0, b"numpy.core"), (2, b"numpy.core"), (3, b"numpy._core"), (5, b"numpy._core"))
    ]


def _chumpy(module: bytes, name: bytes, state: bytes) -> bytes:
    """An object of a class that is not installed, as Python 2 wrote it: no arguments, then its state."""
    return b"c" + module + b"\n" + name + b"\n)\x81" + state + b"b"


def _inner(value: object) -> bytes:
    """The opcodes that build ``value``, without PROTO and STOP."""
    return pickle.dumps(value, 2)[2:-1].replace(b"numpy._core", b"numpy.core")


def mano_pickles() -> list[bytes]:
    """A chumpy array, a selection of one and a sparse matrix, in a dictionary each."""
    array = _chumpy(b"chumpy.ch", b"Ch", _inner({"x": np.arange(6.0).reshape(2, 3)}))
    chosen = b"}(U\x01a" + array + b"U\x04idxs" + _inner(np.array([0, 2, 4])) + b"U\x0fpreferred_shape" + _inner((3, 1))
    matrix = {"_shape": (3, 2), "data": np.ones(3), "indices": np.array([0, 1, 2]), "indptr": np.array([0, 2, 3])}
    return [
        b"\x80\x02}U\x01a" + array + b"s.",
        b"\x80\x02}U\x01b" + _chumpy(b"chumpy.reordering", b"Select", chosen + b"u") + b"s.",
        b"\x80\x02}U\x01c" + _chumpy(b"scipy.sparse.csc", b"csc_matrix", _inner(matrix)) + b"s.",
        b"\x80\x02}U\x01d" + _inner(np.arange(3.0)) + b"s.",
    ]


@cache
def mano_file() -> bytes:
    """A whole right hand in MANO's layout; its bulk in one-byte numbers, so that one reading is quick."""
    model = load_embedded_hands().right
    content = {
        "v_template": model.template_m.astype(np.float32),
        "shapedirs": np.zeros((778, 3, 10), np.int8),
        "posedirs": np.zeros((778, 3, 135), np.int8),
        "J_regressor": model.joint_regressor.astype(np.float32),
        "weights": model.skin_weights.astype(np.float32),
        "kintree_table": np.array([[2**32 - 1, *model.parents[1:]], range(16)], np.int64),
        "f": model.faces.astype(np.uint16),
        "hands_mean": model.mean_pose.astype(np.float32),
        "hands_components": model.components.astype(np.float32),
    }
    return pickle.dumps(content, 2).replace(b"numpy._core", b"numpy.core")


def torch_pickles() -> list[bytes]:
    """As TACO's hand files: tensors of two frames; one as saved on a GPU, one a slice, one a parameter."""
    small = {"00000": {"hand_pose": _tensor(np.arange(4.0)), "hand_trans": _tensor(np.zeros(3, np.float32))}}
    turned = {"hand_shape": _tensor(np.arange(6.0).reshape(2, 3).T)}
    own = [_Call(_from_bytes(), usual_storage(np.arange(count, dtype="f4"))) for count in (3, 300)]
    return [
        pickle.dumps([_Call(_rebuild(), storage, 0, (3,), (1,), False, OrderedDict()) for storage in own], 4),
        pickle.dumps(small, 4),
        pickle.dumps(turned, 3),
        pickle.dumps([_tensor(np.arange(8), location="cuda:0"), OrderedDict(a=1)], 3),
        pickle.dumps([_parameter(np.ones(2))], 3),
    ]


class _Call:
    def __init__(self, function: object, *arguments: object) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple:
        return self.function, self.arguments


def _rebuild() -> object:
    from torch._utils import _rebuild_tensor_v2

    return _rebuild_tensor_v2


def _from_bytes() -> object:
    from torch.storage import _load_from_bytes

    return _load_from_bytes


def usual_storage(elements: np.ndarray) -> bytes:
    """What torch itself writes for a storage of float32."""
    import torch

    opcodes = pickletools.genops(pickle.dumps(torch.from_numpy(elements), 4))
    # It names the storage by its address: where addresses are short, the bytes of a small one are, too.
    return next(argument for opcode, argument, _ in opcodes if opcode.name in ("BINBYTES", "SHORT_BINBYTES"))


def _tensor(array: np.ndarray, location: str = "cpu") -> _Call:
    elements = np.ascontiguousarray(array) if array.flags.c_contiguous else array.T
    strides = tuple(step // array.itemsize for step in array.strides)
    return _Call(_rebuild(), _storage(elements, location), 0, array.shape, strides, False, OrderedDict())


def _parameter(array: np.ndarray) -> _Call:
    from torch._utils import _rebuild_parameter

    return _Call(_rebuild_parameter, _tensor(array), True, OrderedDict())


def _storage(elements: np.ndarray, location: str) -> _Call:
    return _Call(_from_bytes(), storage_bytes(elements, location))


def storage_bytes(elements: np.ndarray, location: str = "cpu") -> bytes:
    """What ``torch.save`` writes for a storage in its legacy format."""
    name = {"f8": "DoubleStorage", "f4": "FloatStorage", "i8": "LongStorage"}[elements.dtype.str[1:]].encode()
    place = location.encode()
    head = b"\x80\x02(X\x07\x00\x00\x00storagectorch\n" + name + b"\nX\x01\x00\x00\x007"
    head += b"X" + struct.pack("<I", len(place)) + place + b"K" + bytes((elements.size,)) + b"NtQ."
    first = (0x1950A86A20F9469CFC6C, 1001, {"protocol_version": 1001, "little_endian": True})
    pickles = b"".join(pickle.dumps(value, 2) for value in first) + head + pickle.dumps(["7"], 2)
    return pickles + struct.pack("<q", elements.size) + elements.tobytes()


def oakink2_annotations() -> list[bytes]:
    """Two frames of a hand and a part, and the same with faults."""
    hand = {"pose_coeffs": np.eye(4, dtype="f4")[[0] * 16][None], "tsl": np.zeros((1, 3)), "betas": np.zeros((1, 10))}
    both = {f"{side}__{name}": array for side in ("lh", "rh") for name, array in hand.items()}
    whole = {
        "mocap_frame_id_list": [0, 1, 4], "obj_list": ["a", "b"], "obj_transf": {"a": {0: np.eye(4), 4: np.eye(4)}},
        "raw_mano": {0: both, 4: {f"lh__{name}": array for name, array in hand.items()}},
    }  # fmt: skip
    faults = (
        *({"mocap_frame_id_list": frames} for frames in (["0"], [], [4, 1], [0, 1000])),
        *({"obj_list": ids} for ids in ([1], "a", ["../x"])),
        *(
            {"obj_transf": {"a": poses}}
            for poses in ([], {0: np.eye(3)}, {0: np.zeros((4, 4))}, {0: "words"}, {1: 0}, {0: np.eye(4) * 1e300})
        ),
        *({"raw_mano": hands} for hands in ([], {}, {0: {**both, "lh__pose_coeffs": np.zeros((1, 16, 4))}})),
    )
    return [pickle.dumps({**whole, **fault}, 4) for fault in ({}, *faults)]


def npy_files() -> list[bytes]:
    arrays = (np.arange(6.0).reshape(2, 3), np.asfortranarray(np.ones((2, 2), np.int16)), np.array("text"))
    return [_saved(array) for array in (*arrays, np.zeros((0, 3), np.float32))]


def _saved(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def npy_object_files() -> list[bytes]:
    return [*(npy_bytes(HEADER, _zero_d(value)) for value in _objects()), npy_files()[0], npy_files()[2]]


def _zero_d(value: object) -> bytes:
    array = np.empty((), dtype=object)
    array[()] = value
    return pickle.dumps(array, 3).replace(b"numpy._core", b"numpy.core")


def npz_files(compressed: bool) -> list[bytes]:
    save = np.savez_compressed if compressed else np.savez
    found = []
    for arrays in ({"a": np.arange(4.0), "b": np.array("x"), "c": np.zeros((0, 2))}, {"deep/name": np.ones((2, 2))}):
        stream = io.BytesIO()
        save(stream, allow_pickle=False, **arrays)
        found.append(stream.getvalue())
    return found


def npz_object_files() -> list[bytes]:
    """As GRAB's: strings, numbers and pickled dictionaries."""
    found = []
    for compressed in (False, True):
        stream = io.BytesIO()
        hand = np.array({"params": {"transl": np.zeros((2, 3)), "global_orient": np.ones((2, 3))}, "vtemp": "a.ply"})
        contact = np.array({"object": np.zeros((2, 4), np.int8), "body": np.zeros((2, 4100), np.int8)})
        save = np.savez_compressed if compressed else np.savez
        save(stream, obj_name="cup", n_frames=np.array(2), lhand=hand, contact=contact)
        found.append(stream.getvalue())
    return found


OBJ = b"""# comment
mtllib x.mtl
v 0 0 0
v 1.5 0 0 0.5 0.5 0.5
v 0 1e0 0
v 0 0 -1
vn 0 0 1
vt 0 0
g part
f 1 2 3
f 1/1/1 2/1/1 4/1/1
f -1 -2 -3
f 1//1 2//1 3//1 4//1
"""
_PLY_HEAD = """ply
format {} 1.0
comment made by hand
element vertex 4
property float x
property float y
property float z
property uchar red
element face 3
property list uchar int vertex_indices
end_header
"""
_CORNERS = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_FACES = ((0, 1, 2), (0, 1, 3), (0, 2, 3))


def ply_texts() -> list[bytes]:
    rows = [" ".join(map(str, (*corner, 7))) for corner in _CORNERS]
    rows += [" ".join(map(str, (len(face), *face))) for face in _FACES]
    quads = [*rows[:-1], "4 0 1 2 3"]
    return [(_PLY_HEAD.format("ascii") + "\n".join(lines) + "\n").encode() for lines in (rows, quads)]


def ply_binaries() -> list[bytes]:
    found = []
    for name, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
        for faces in (_FACES, (*_FACES[:2], (0, 1, 2, 3))):
            body = b"".join(struct.pack(f"{order}3fB", *corner, 7) for corner in _CORNERS)
            body += b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)
            found.append(_PLY_HEAD.format(name).encode() + body)
    return found


BVH = b"""HIERARCHY
ROOT Hand
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
  JOINT Finger
  {
    OFFSET 1 0.5 0
    CHANNELS 3 Yrotation Xrotation Zrotation
    End Site
    {
      OFFSET 1 0 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.008333
0 0 0 1 2 3 4 5 6
1 0 0 1 2 3 4 5 -6.5
"""


def gzipped() -> list[bytes]:
    return [gzip.compress(text, mtime=0) for text in (BVH, "é\n".encode(), b"", bytes(5000))]


def as_json(*values: object) -> list[bytes]:
    return [json.dumps(value).encode() for value in values]


def glb_files() -> list[bytes]:
    """A tetrahedron where its node puts it, with corners of two and of four bytes; one without a scene, one empty."""
    found = []
    for kind, code in (("<u2", 5123), ("<u4", 5125)):
        body = np.array(_CORNERS, "<f4").tobytes() + np.array(_FACES, kind).tobytes()
        place = {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4}
        corner = {"bufferView": 1, "componentType": code, "type": "SCALAR", "count": 9}
        tree = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "translation": [0, 1, 2], "rotation": [0, 0, 0.6, 0.8]}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
            "accessors": [place, corner],
            "bufferViews": [
                {"buffer": 0, "byteLength": 48},
                {"buffer": 0, "byteOffset": 48, "byteLength": 9 * int(kind[2])},
            ],
            "buffers": [{"byteLength": len(body)}],
        }
        found += [_glb(tree, body), _glb({**tree, "scenes": [], "nodes": []}, body)]
    huge = _glb({"accessors": [{"count": 10**9}], "meshes": [{"primitives": [{"attributes": {}}]}]}, b"")
    return [*found, huge, *_glb_of_everything(), b"glTF", b""]


def _glb_of_everything() -> list[bytes]:
    """A strip and a fan of normalised, sparse, skinned and morphed vertices in a mirrored node; and one fault each."""
    positions, moved = (np.array(_CORNERS) * 100).astype("|i1"), np.array(_CORNERS, "<f4")
    joints, weights = np.tile(np.array([0, 1, 0, 0], "|u1"), (4, 1)), np.tile(np.array([0.5, 0.5, 0, 0], "<f4"), (4, 1))
    arrays = (np.pad(positions, ((0, 0), (0, 1))), np.array([0, 1, 2, 3], "<u4"), moved, joints, weights)
    arrays = (*arrays, np.tile(np.eye(4, dtype="<f4").ravel(), (2, 1)), np.array([1, 3], "<u4"))
    kinds = ((5120, "VEC3"), (5125, "SCALAR"), (5126, "VEC3"), (5121, "VEC4"), (5126, "VEC4"), (5126, "MAT4"))
    views, body = [], b""
    for array in arrays:
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": array.nbytes})
        body += array.tobytes()
    views[0]["byteStride"] = 4
    accessors = [
        {"bufferView": number, "componentType": kind, "type": name, "count": len(arrays[number])}
        for number, (kind, name) in enumerate(kinds)
    ]
    accessors[0]["normalized"] = True
    places = {"bufferView": 6, "componentType": 5125}
    accessors[0]["sparse"] = {"count": 2, "indices": places, "values": {"bufferView": 0}}
    accessors.append({"componentType": 5126, "type": "VEC3", "count": 4})
    attributes = {"POSITION": 0, "JOINTS_0": 3, "WEIGHTS_0": 4}
    shapes = [{"attributes": attributes, "indices": 1, "mode": mode, "targets": [{"POSITION": 2}]} for mode in (5, 6)]
    tree = {
        "asset": {"version": "2.0"},
        "extensionsRequired": ["KHR_mesh_quantization"],
        "nodes": [
            {"mesh": 0, "scale": [-1, 1, 1], "weights": [0.5], "children": [1, 2]},
            {"mesh": 0, "skin": 0, "matrix": np.eye(4).ravel().tolist()},
            {"mesh": 1, "name": "more"},
        ],
        "meshes": [{"primitives": shapes}, {"primitives": [{"attributes": {"POSITION": 7}, "mode": 0}]}],
        "skins": [{"joints": [0, 1], "inverseBindMatrices": 5}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    inside = {"uri": "data:application/octet-stream;base64," + base64.b64encode(body).decode()}
    changes: tuple[dict, ...] = (
        *({}, {"buffers": [inside]}, {"buffers": [{"uri": "a.bin"}]}, {"scenes": [{"nodes": [1, 1]}]}),
        *({"extensionsRequired": ["KHR_draco_mesh_compression"]}, {"scenes": [{"nodes": [-1]}]}),
        *({"meshes": [{"primitives": [shapes[0] | {"attributes": own}]}] * 2} for own in ({"POSITION": 1}, {})),
        {"meshes": [{"primitives": [{"attributes": {**attributes, "JOINTS_1": 3}}]}] * 2},
        {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": own}]} for own in (1, 3)]},
    )
    whole = _glb(tree, body)
    headers = whole[:4] + b"\1" + whole[5:], whole[:12] + b"\xff" * 4 + whole[16:]
    return [*(_glb({**tree, **change}, body) for change in changes), *headers, _glb({"asset": "x" * (5 << 20)}, b"")]


def stl_files() -> list[bytes]:
    """Two solids as text and one as binary, and the same with faults."""
    facet = "facet normal 0 0 1\nouter loop\n" + "vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n" + "endloop\nendfacet\n"
    text = f"solid a\n{facet}endsolid a\nsolid b\n{facet}endsolid b\n".encode()
    rows = np.zeros(2, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["corners"] = np.eye(3)
    binary = bytes(80) + struct.pack("<I", 2) + rows.tobytes()
    return [
        text,
        text.replace(b"vertex 1 0 0\n", b"", 1),
        text[:-20],
        binary,
        binary[:-3],
        binary + b"\0",
        b"solid",
        b"",
    ]


def _glb(tree: dict, body: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text, body = text + b" " * (-len(text) % 4), body + b"\0" * (-len(body) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def hot3d_hands() -> list[bytes]:
    """Two lines of MANO's and of UmeTrack's numbers, and lines with one thing wrong."""
    wrist = {"t_xyz": [0.1, -0.2, 3], "q_wxyz": [0.5, -0.5, 0.5, 0.5]}
    mano = {"pose": [0.1] * 15, "wrist_xform": wrist, "betas": [1.5] * 10}
    umetrack = {"joint_angles": [0.1] * 22, "wrist_xform": wrist, "hand_confidence": 1.0}
    found = []
    for hand in (mano, umetrack):
        lines = [json.dumps({"timestamp_ns": time, "hand_poses": {"0": hand, "1": hand}}) for time in (5, 9)]
        found += ["\n".join(lines), "\n".join([lines[0], lines[0]])]
    turned = {**mano, "wrist_xform": {**wrist, "q_wxyz": [2, 0, 0, 0]}}
    hands: tuple[object, ...] = ({"2": mano}, {"0": 5}, {"0": {**mano, "pose": [1]}}, {"1": turned}, {})
    found += [json.dumps({"timestamp_ns": 5, "hand_poses": own}) for own in hands]
    return [*(text.encode() for text in found), b'{"timestamp_ns": 1.5, "hand_poses": {}}', b" " * 70_000, b"\n", b""]


def hot3d_tables() -> list[bytes]:
    head = "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z\n"
    row = "37787722328019,{},-0.2,7e-1,.5,0.5,0.5,-0.5,0.5\n"
    rows = (
        row.format(1) + row.format(2),
        row.format(1) * 2,
        row.format("x"),
        row.format(1)[1:],
        "a,1\n",
        "a" + row,
        "",
    )
    masks = ("1,214-1,True\n2,1201-1,False\n", "1,214-1,yes\n", "now,1,True\n")
    found = [head + text for text in rows] + ["timestamp[ns],stream_id,mask\n" + text for text in masks]
    return [*(text.encode() for text in found), row.replace("0.5", "0.9").join((head, "")).encode(), b""]


def hot3d_tars() -> list[bytes]:
    """A clip of two frames, and clips with one thing wrong."""
    place = {"translation_xyz": [0.1, -2, 3], "quaternion_wxyz": [0.5, 0.5, -0.5, 0.5]}
    mano = {"thetas": [0.5] * 15, "wrist_xform": [0.1, 0.2, 0.3, 1, 2, 3]}
    hand = {"mano_pose": mano, "umetrack_pose": {"joint_angles": [0.1] * 20, "T_world_from_wrist": place}}
    thing = {"object_name": "mug_white", "T_world_from_object": place}
    whole = {"__hand_shapes.json__": {"mano": [0.1] * 10, "umetrack": {}}}
    for frame in (0, 1):
        whole[f"{frame:06d}.hands.json"] = {"left": hand, "right": None if frame else hand}
        whole[f"{frame:06d}.objects.json"] = {"9": [thing]}
    changes: tuple[dict, ...] = (
        {},
        {"000001.hands.json": [1]},
        {"000001.hands.json": {"left": {"mano_pose": mano}}},
        {"000001.hands.json": {"left": {**hand, "mano_pose": {**mano, "thetas": [1]}}}},
        {"000001.objects.json": {"9": [thing, thing]}},
        {"000001.objects.json": [thing]},
        {"000001.objects.json": {"9": [{**thing, "object_name": "Mug"}]}},
        {"000000.objects.json": {}, "000001.objects.json": {}},
    )
    found = [_tar({**whole, **change}) for change in changes]
    return [*found, found[0][:700], b""]


def _tar(members: dict[str, object]) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        for name, value in members.items():
            text, info = json.dumps(value).encode(), tarfile.TarInfo(name)
            info.size = len(text)
            archive.addfile(info, io.BytesIO(text))
    return stream.getvalue()


def hot3d_json() -> list[bytes]:
    """Metadata, instances, and a profile whose 21 landmarks hang on bones 0 to 16."""
    profile = {
        "joint_rotation_axes": [[0, 0, 1.0]] * 22,
        "joint_rest_positions": [[90, -1.5, 20]] * 22,
        "landmark_rest_positions": [[100, 2, 3.5]] * 21,
        "landmark_rest_bone_indices": [[number % 17, 1, 2] for number in range(21)],
        "landmark_rest_bone_weights": [[0.5, 0.25, 0.25]] * 21,
    }
    wrong = ({"joint_rotation_axes": [[0, 0, 2]] * 22}, {"landmark_rest_bone_indices": [[17, 0, 0]] * 21})
    values = [{"hand_model": {**profile, **change}} for change in ({}, *wrong)]
    names = ({"1": {"instance_name": "mug_white"}}, {"1": {"instance_name": "../a"}}, [1])
    clips = (
        {"7": {"sequence_id": "P0003_c701bd11", "device": "Aria"}},
        {"7": {"sequence_id": 5}},
        {"8": {"sequence_id": 5}},
    )
    return as_json(*values, *names, *clips, {"headset": "Aria"}, {"headset": 5})


# Files that are nearly right: each leads to one refusal that chance alone seldom finds.
_RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\n"
_NDARRAY = b"cnumpy\nndarray\n"
_DTYPE_CALL = b"cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR"
_ARRAY = _RECONSTRUCT + b"(" + _NDARRAY + b"(I0\ntS'b'\ntR"
NEAR_PICKLES = (
    b"cos\nsystem\n(S'true'\ntR.",
    b"(S'true'\nios\nsystem\n.",
    b"P1\n.",
    b"\x80\x02Nr\xff\xff\xff\x7f.",
    b"\x80\x02N2.",
    b"\x80\x02})NNs.",
    b"\x80\x02})Ns.",
    b"\x80\x020.",
    b"\x80\x02q\x00.",
    b"\x80\x02tN.",
    b"\x80\x04\x8f(K\x01K\x02\x90.",
    b"\x80\x04(K\x01K\x02\x91.",
    b"\x80\x04(N)d.",
    b"cbuiltins\nset\nN}S'x'\nI1\ns\x86b.",
    b"cbuiltins\nset\n.",
    b"cbuiltins\nset\n(I5\ntR.",
    b"cbuiltins\nset\n((I1\nttR.",
    b"cbuiltins\nset\n(((I1\ntttR.",
    b"c__builtin__\nbytes\n)R.",
    b"c_codecs\nencode\n(Vabc\nVlatin1\ntR.",
    b"c_codecs\nencode\n(Vabc\nVrot13\ntR.",
    b"c_codecs\nencode\n(I1\nVlatin1\ntR.",
    _RECONSTRUCT + b"(cnumpy\ndtype\n(I0\ntS'b'\ntR.",
    _RECONSTRUCT + b"(" + _NDARRAY + b"(I9\ntS'b'\ntR.",
    b"cnumpy\ndtype\n(S'V8'\nI0\nI1\ntR.",
    b"cnumpy\ndtype\n(C\x02f8I0\nI1\ntR.",
    _DTYPE_CALL + b"(I3\nS'<'\nN(S'a'\ntN}I-1\nI-1\nI0\ntb.",
    _DTYPE_CALL + b"(I3\nS'x'\nNNNI-1\nI-1\nI0\ntb.",
    _DTYPE_CALL + b".",
    _ARRAY + b"(I1\n(I1\nt" + _DTYPE_CALL + b"I00\nS'short'\ntb.",
    _ARRAY + b"(I1\n(I-1\nt" + _DTYPE_CALL + b"I00\nS'short'\ntb.",
    _ARRAY + b"(I1\n(I1\ntNI00\nS'short'\ntb.",
    _ARRAY + b"(I1\n(I1\nt" + _DTYPE_CALL + b"I00\nNtb.",
    _ARRAY + b"(I1\n(I1\nt" + _DTYPE_CALL + b"I00\nX\x08\x00\x00\x00abcdefghtb.",
    _ARRAY + b"(I1\n(I1\ntcnumpy\ndtype\n(S'O8'\nI0\nI1\ntRI00\nS'short'\ntb.",
    _ARRAY + b"(I1\n(I1\ntcnumpy\ndtype\n(S'U1'\nI0\nI1\ntRI00\nC\x04\xff\xff\xff\x7ftb.",
    b"cnumpy.core.multiarray\nscalar\n(" + _DTYPE_CALL + b"C\x08\x00\x00\x00\x00\x00\x00\xf0?tR.",
    b"cnumpy.core.multiarray\nscalar\n(" + _DTYPE_CALL + b"C\x01\x00tR.",
    b"cnumpy.core.multiarray\nscalar\n(cnumpy\ndtype\n(S'O8'\nI0\nI1\ntRC\x01\x00tR.",
    b"cnumpy.core.multiarray\nscalar\n(cnumpy\ndtype\n(S'S0'\nI0\nI1\ntRC\x00tR.",
    b"cnumpy.core.numeric\n_frombuffer\n(C\x08\0\0\0\0\0\0\0\0" + _DTYPE_CALL + b"(I1\ntS'C'\ntR.",
    b"cnumpy.core.numeric\n_frombuffer\n(C\x08\0\0\0\0\0\0\0\0" + _DTYPE_CALL + b"(I1\ntS'K'\ntR.",
)


def near_array_pickles() -> list[bytes]:
    shared = [np.zeros(2)]
    values = ((np.zeros(2), [np.ones(1)]), [shared, shared], [{1: np.array([b"x"])}])
    return [*NEAR_PICKLES, *(pickle.dumps(value, 5) for value in values), b"\x80\x02N" + b"0N" * 9000 + b"."]


def near_torch_pickles() -> list[bytes]:
    from torch._utils import _rebuild_parameter, _rebuild_tensor_v2
    from torch.storage import _load_from_bytes

    good, four = storage_bytes(np.arange(4.0)), np.arange(4.0)
    storage = _Call(_load_from_bytes, good)

    def tensor(*arguments: object) -> bytes:
        return pickle.dumps(_Call(_rebuild_tensor_v2, *arguments), 3)

    def stored(old: bytes, new: bytes) -> bytes:
        assert old in good
        return pickle.dumps(_Call(_load_from_bytes, good.replace(old, new)), 3)

    return [
        tensor(storage, 0, (5,), (1,), False, None),
        tensor(storage, 0, (2, 2), (1,), False, None),
        tensor(storage, 0, (0, 2), (1, 1), False, None),
        tensor(storage, 0, (10**9,), (0,), False, None),
        tensor([1], 0, (1,), (1,), False, None),
        pickle.dumps(_Call(_rebuild_parameter, 5, True, None), 3),
        pickle.dumps(_Call(_load_from_bytes, "text"), 3),
        pickle.dumps(_Call(_load_from_bytes, b"short"), 3),
        pickle.dumps(storage, 3),
        pickle.dumps(OrderedDict([(1, _tensor(four))]), 2).replace(b")R", b"]\x85R"),
        b"ccollections\nOrderedDict\n(I5\ntR.",
        b"ccollections\nOrderedDict\n(((I1\nI2\ntttR.",
        stored(b"\x04\0\0\0\0\0\0\0", b"\x05\0\0\0\0\0\0\0"),
        stored(b"DoubleStorage", b"QInt32Storage"),
        stored(b"little_endianq\x02\x88", b"little_endianq\x02\x89"),
        stored(b"M\xe9\x03.", b"M\xea\x03."),
        stored(b"storagec", b"storagfc"),
        stored(b"K\x04NtQ", b"NNtQ"),
        stored(b"NtQ.", b"Nt."),
        stored(pickle.dumps(["7"], 2), pickle.dumps(["8"], 2)),
    ]


def near_npy_files() -> list[bytes]:
    whole = dict(HEADER, descr="<f8", shape=(2,))
    headers = (
        {**whole, "shape": 5},
        {**whole, "fortran_order": 1},
        {**whole, "descr": "V8"},
        {**whole, "shape": (10**12,)},
        {**whole, "shape": (0, 2**47, 2**47)},
        {**whole, "descr": "<U4"},
        [1],
        " " * 11_000,
    )
    files = [npy_bytes(header, b"\xff" * 16) for header in headers]
    return [*files, npy_bytes(whole, bytes(16), 3), b"", b"\x93NUMPY\x01\0\xff\xff{", npy_bytes(HEADER, b"I1\n.")]


def near_object_archives() -> list[bytes]:
    """A member too few, one twice, too many, too large when unpacked, more bytes than its array, a damaged sum."""
    whole = npz_object_files()[0]
    found = [npz_files(False)[0], whole[:-30] + b"\0" * 30]
    for names in (["obj_name", "obj_name"], [f"m{number}" for number in range(300)]):
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            for name in names:
                archive.NameToInfo.clear()
                archive.writestr(zipfile.ZipInfo(f"{name}.npy"), b"")
        found.append(stream.getvalue())
    at = whole.rfind(b"PK\x01\x02")
    found.append(whole[: at + 24] + b"\xff\xff\xff\xf0" + whole[at + 28 :])
    for content in (npy_files()[0] + b"more", npy_bytes(HEADER, pickle.dumps(5))):
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            for name in ("obj_name", "n_frames", "lhand"):
                archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content)
        found.append(stream.getvalue())
    return found


def near_pieces() -> list[bytes]:
    """Contact members of other kinds: arrays by columns, of protocol 5, of text, short ones, no dictionary at all."""
    big = np.zeros((3, 5000), np.int8)
    contents = [
        pickle.dumps(_zero({"object": np.asfortranarray(big), "small": np.ones((2, 2))}), 5),
        pickle.dumps(_zero({"object": big, "text": np.array([["a"]])}), 3),
        pickle.dumps(_zero({"object": big}), 3).replace(b"K\x03M\x88\x13\x86", b"K\x03M\x89\x13\x86"),
        pickle.dumps(_zero({"object": big, "flat": np.zeros(3)}), 3),
        pickle.dumps(_zero({"object": big}), 0),
        pickle.dumps(_zero({"object": big}), 2),
        pickle.dumps(_zero({"object": 5, "other": {1: 2}}), 4),
        pickle.dumps(_zero([big]), 4),
        pickle.dumps({"object": big}, 4),
        b"N" * 1000,
        b"\xfe.",
        b"\x8e\xff\xff\xff\xff\xff\xff\xff\x7f",
        b"T\xff\xff\xff\xff",
        b"S" + b"x" * 5000,
    ]
    files = [npy_bytes(HEADER, data.replace(b"numpy._core", b"numpy.core")) for data in contents[:7]]
    files += [npy_bytes(HEADER, data) for data in contents] + [npy_files()[0]]
    found = []
    for content in files:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(zipfile.ZipInfo("contact.npy"), content)
        found.append(stream.getvalue())
    return [*found, npz_files(False)[0], near_object_archives()[3]]


def _zero(value: object) -> np.ndarray:
    array = np.empty((), dtype=object)
    array[()] = value
    return array


def mano_files() -> list[bytes]:
    """A whole hand, and nine in which one thing is wrong."""
    whole = pickle.loads(mano_file().replace(b"numpy.core", b"numpy._core"))  # written above
    faces, weights, regressor = whole["f"].copy(), whole["weights"] * 1.1, whole["J_regressor"]
    faces[0, 0] = 9999
    changes: tuple[dict, ...] = (
        {"f": faces},
        {"weights": weights},
        {"kintree_table": np.zeros((2, 16), np.int64)},
        {"kintree_table": np.zeros(3)},
        {"v_template": whole["v_template"] * np.float32(-1)},
        {"v_template": whole["v_template"] * np.float32(np.nan)},
        {"J_regressor": regressor[:, :5]},
        {"hands_mean": "text"},
    )
    found = [mano_file(), pickle.dumps([1], 2), pickle.dumps({"f": 1}, 2)]
    found += [pickle.dumps({**whole, **change}, 2) for change in changes]
    return [data.replace(b"numpy._core", b"numpy.core") for data in found]


def near_meshes() -> list[bytes]:
    lines = ("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "v 0 0\n", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "f 0 1 2\n")
    flat = ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "v 0 0 0\n", "", "f 1 2 99999999999\n")
    return [line.encode() for line in (*lines, *flat)]


def near_ply(text: bool) -> list[bytes]:
    whole = (ply_texts() if text else ply_binaries())[0]
    changes = (
        (b"property float x", b"property float w"),
        (b"property float x", b"property list uchar float x"),
        (b"property float x", b"property huge x"),
        (b"element vertex 4", b"element vertex 900"),
        (b"element face 3", b"element face 900"),
        (b"element face 3", b"element vertex 3"),
        (b"element face 3", b"element edge 3"),
        (b"element vertex 4", b"element point 4"),
        (b"vertex_indices", b"corners"),
        (b"format", b"formed"),
        (b"format ascii 1.0\n", b""),
        (b"end_header", b"end"),
        (b"\n3 0 1 2", b"\n2 0 1 2"),
        (b"\n3 0 1 2", b"\n3 0 1 0.5"),
        (b"\n3 0 1 2", b"\n-3 0 1 2"),
        (b"\n3 0 1 2", b"\n3 0 1 77"),
        (b"\n3 0 1 2", b"\n3 0 1 " + b"7" * 80),
        (b"0.0 0.0 0.0 7", b"nan 0.0 0.0 7"),
        (b"1.0 0.0 0.0 7\n0.0 1.0 0.0 7", b"0 0 0 7\n0 0 0 7"),
        (b"int vertex_indices", b"float vertex_indices"),
        (b"element face 3", b"element face 0"),
    )
    return [whole.replace(old, new) for old, new in changes if old in whole] + [b"ply\nend_header\n", whole[:-3]]


def trajectory_tables() -> list[bytes]:
    """A table that is good, then one of every kind that is refused."""
    names = ["time_s", *(f"{body}_{part}" for body in ("object", "right") for part in TRAJECTORY_PARTS)]
    row = "0,0,0,1,0,0,0,0.1,0,0,1,0,0,0"
    good = [",".join(names), *(f"{number / 30:.4f},{row}" for number in range(4))]
    hinged = [good[0] + ",hinge_rad", *(line + ",0.5" for line in good[1:])]
    late = [good[0], *(f"{step},{row}" for step in (0, 33, 66, 100))]
    frames = [good[0], *(f"{step},{row}" for step in range(4))]
    falling = [good[0], *(f"{step},{row}" for step in (0, 0.1, 0.05))]
    changed = [
        *("\n".join(good).replace(old, new) for old, new in ((",1,0,0,0,0.1", ",2,0,0,0,0.1"), ("0.0333", "x"))),
        *("\n".join(good).replace(old, new) for old, new in (("0.0333", "nan"), ("right_qz", "right_q"))),
        *("\n".join(good).replace(old, new) for old, new in (("object_x", "object_y"), ("0.0333,", "0.0333,1,"))),
        *("\n".join(good).replace(old, new) for old, new in (("time_s", "time"), ("right_", "wrist_"))),
    ]
    return [
        *("\n".join(lines).encode() for lines in (good, hinged, late, frames, falling)),
        *map(str.encode, changed),
        b"\xff",
        b"",
    ]


def trajectory_texts() -> list[bytes]:
    """ManipNet's demo files: object, left wrist, right wrist."""
    row = ",".join(["0,0,0,1,0.5,1,2"] * 3)
    rows = ("120", *([row] * 4)), ("0.1", row), ("120", row + ",1", row), ("x",)
    return [*("\n".join(lines).encode() for lines in rows), b""]


def trajectory_archives() -> list[bytes]:
    time_s, still = np.arange(4) / 30, np.tile([1.0, 0, 0, 0], (4, 1))
    arrays = {"time_s": time_s, "object_position": np.zeros((4, 3)), "object_quaternion": still}
    arrays |= {"left_position": np.ones((4, 3)), "left_quaternion": still}
    others = [
        arrays | {"hinge_rad": time_s},
        {name: array for name, array in arrays.items() if name != "object_quaternion"},
        {name: array for name, array in arrays.items() if name != "time_s"},
        {name: array for name, array in arrays.items() if "left" not in name},
        arrays | {"left_position": np.ones((4, 2))},
        arrays | {"left_quaternion": 2 * still},
        arrays | {"time_s": 33 * np.arange(4)},
        arrays | {"time_s": np.zeros(4)},
    ]
    return [_archive(values) for values in (arrays, *others)]


def _archive(arrays: dict[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def hinged_object() -> ObjectModel:
    """A tetrahedron with a second one on a hinge, metres."""
    points = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    vertices = np.concatenate((points, points + np.array([0, 0, 0.11])))
    hinge = Hinge(np.array([0.0, 1, 0]), np.array([0.0, 0, 0.11]))
    return ObjectModel(
        "two", vertices, np.concatenate((faces, faces + 4)), np.repeat([0, 1], 4).astype(np.uint8), hinge
    )


def keyframe_files() -> list[bytes]:
    """Keyframes as CSV and JSON that are good, then some that are refused."""
    table = "time_s,x_cm,z_mm,rx_deg,hinge_rad\n0,0,0,0,0\n1,5,150,20,0.5\n2,5,0,0,0\n"
    turned = "time_ms,qw,qx,qy,qz,z_m\n0,1,0,0,0,0\n900,0.8,0.6,0,0,0.2\n"
    rows = [{"time_s": 0, "z_cm": 0, "hinge_deg": 0}, {"time_s": 1.5, "z_cm": 20, "hinge_deg": 45}]
    texts = [table, turned, json.dumps(rows), json.dumps({"keyframes": rows}), "", "[1]", '[{"time_s": "a"}]']
    changes = (
        ("z_mm", "z"),
        ("z_mm", "x_m"),
        ("1,5,", "0,5,"),
        ("2,5,", "9999,5,"),
        (",150,", ",nan,"),
        ("150", "9e5"),
    )
    changes += ((",20,", ",175,"), ("x_cm", "zcm"), ("1,5,", "1,5,5,"), ("time_s", "x_m"), ("0.5", "3"))
    texts += [table.replace(old, new) for old, new in changes]
    texts += [turned.replace("0.8", "2"), turned.replace("qw", "rx_deg"), turned.replace("0.2", "-0.2")]
    return [*map(str.encode, texts), b"\xff"]
