"""Small files that unpack, nest or repeat to gigabytes or minutes, each as its bytes and what reads such a file."""

import io
import json
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hoidata.datasets.arctic.adapter import parse_parts
from hoidata.datasets.base import RawTree
from hoidata.datasets.checks import table
from hoidata.datasets.h2o.files import listed_segments
from hoidata.datasets.hot3d.files import MAX_TABLE_BYTES, POSE_COLUMNS, hand_poses, object_poses
from hoidata.datasets.manipnet.adapter import _read_tips
from hoidata.datasets.manipnet.hand import ROOT_CHANNELS, parse_bvh, unpack_text
from hoidata.files.checksums import read_metadata
from hoidata.files.numpy_files import load_npz_arrays, load_npz_objects
from hoidata.files.restricted_pickle import ARRAYS, restricted_load
from hoidata.files.torch_pickle import load_torch_pickle
from hoidata.object_paths.trajectory_files import read_trajectories
from hoidata.objects.mesh import LARGEST_MESH_BYTES, load_mesh, parse_obj
from hoidata.objects.user_mesh import read_user_object

MB = 1 << 20
Attack = tuple[str, Callable[[], bytes], Callable[[Path], Any]]


def gzipped(text: bytes, repeats: int) -> bytes:
    """A gzip file that unpacks to a megabyte of ``text`` over and over; a thousandth of that in size."""
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    member = packer.compress(text * (MB // len(text))) + packer.flush()
    return member * repeats


def nested_lists(width: int, depth: int) -> bytes:
    """Lists that hold the one before ``width`` times: ``width ** depth`` numbers in some hundred bytes."""
    value: Any = [0.0] * width
    for _ in range(depth - 1):
        value = [value] * width
    return pickle.dumps(value)


def repeated(value: Any, times: int) -> bytes:
    return pickle.dumps([value] * times)


def cyclic() -> bytes:
    value: list = []
    value += [value, value]
    return pickle.dumps(value)


def many_lists() -> bytes:
    return b"\x80\x04](" + b"]" * 2_900_000 + b"e."


def same_hashes(begin: bytes = b"}(", value: bytes = b"N", end: bytes = b"u.") -> bytes:
    """A dictionary of integers that share one hash: Python takes the remainder by 2^61 - 1."""
    numbers = ((2**61 - 1) * factor for factor in range(1, 30_000))
    return b"\x80\x04" + begin + b"".join(pickle.dumps(number, 2)[2:-1] + value for number in numbers) + end


def same_hashes_in_text() -> bytes:
    return b"}(" + b"".join(b"L%dL\nN" % ((2**61 - 1) * factor) for factor in range(1, 30_000)) + b"u."


def frozensets() -> bytes:
    """Sets of the same hash as keys: those of members that share theirs."""
    numbers = ((2**61 - 1) * factor for factor in range(1, 20_000))
    keys = (b"(" + pickle.dumps(number, 2)[2:-1] + b"\x91N" for number in numbers)
    return b"\x80\x04}(" + b"".join(keys) + b"u."


DTYPE = b"cnumpy\ndtype\n(X%b%bI0\nI1\ntR(I3\nX\x01\0\0\0<NNNI-1\nI-1\nI0\ntb"


def dtype(name: bytes) -> bytes:
    return DTYPE % (struct.pack("<I", len(name)), name)


def complex_keys() -> bytes:
    """The hash of a complex number is that of its real part and 1000003 times that of the other."""
    head = b"\x80\x04" + dtype(b"c16") + b"\x940cnumpy.core.multiarray\nscalar\n\x940"
    numbers = (struct.pack("<dd", -1000003.0 * number, number) for number in range(1, 30_000))
    return head + b"}(" + b"".join(b"h\x01h\x00C\x10" + number + b"\x86RN" for number in numbers) + b"u."


def object_array(items: bytes, count: int) -> bytes:
    """The opcodes of an array of objects."""
    head = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n(I0\ntC\x01b\x87R(K\x01J"
    return head + struct.pack("<i", count) + b"\x85" + dtype(b"O8") + b"I00\n](" + items + b"etb"


def one_array_often() -> bytes:
    return b"\x80\x04](" + object_array(b"N" * 60_000, 60_000) + b"\x94" + b"h\x00" * 300_000 + b"e."


def npy(content: bytes, shape: str = "()", kind: str = "|O") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content


def npz(member: bytes, times: int = 1) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for number in range(times):
            archive.writestr(f"{number}.npy", member)
    return stream.getvalue()


def opcodes_npz() -> bytes:
    return npz(npy(b"\x80\x04" + b"N0" * (30 * MB) + b"N."))


def zeros_npz() -> bytes:
    return npz(npy(bytes(100 * MB), f"({100 * MB // 8},)", "<f8"))


def lists_npz() -> bytes:
    """Sixty members, none of which is too large."""
    return npz(npy(b"\x80\x04" + object_array(b"]" * 900_000, 900_000) + b"."), 60)


def ply(faces: bytes, count: int, index: str = "uchar", order: str = "binary_little_endian") -> bytes:
    head = f"ply\nformat {order} 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {count}\nproperty list uint {index} vertex_indices\nend_header\n"
    return head.encode() + struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + faces


def one_polygon() -> bytes:
    corners = LARGEST_MESH_BYTES - 1000
    return ply(struct.pack("<I", corners) + bytes([0, 1, 2]) * (corners // 3) + b"\0" * (corners % 3), 1)


def text_ply() -> bytes:
    head = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list int char x\nelement face 9\n"
    return head + b"property char y\nend_header\n" + b"11 " * (LARGEST_MESH_BYTES // 3 - 100)


def wide_obj() -> bytes:
    return b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf " + b"1 2 3 " * (LARGEST_MESH_BYTES // 6 - 10)


def glb(tree: dict, body: bytes = b"") -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(body), 0x004E4942) + body if body else b""
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def empty_accessors() -> bytes:
    accessors = [{"componentType": 5126, "type": "VEC3", "count": 400_000_000}]
    mesh = {"primitives": [{"attributes": {"POSITION": 0}}]}
    return glb({"asset": {"version": "2.0"}, "accessors": accessors, "meshes": [mesh], "nodes": [{"mesh": 0}],
                "scenes": [{"nodes": [0]}], "scene": 0})  # fmt: skip


def many_nodes() -> bytes:
    """One mesh of 30,000 triangles, shown by 20,000 nodes."""
    body = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) * 30_000
    views = [{"buffer": 0, "byteLength": len(body), "byteOffset": 0}]
    accessors = [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 90_000}]
    mesh, count = {"primitives": [{"attributes": {"POSITION": 0}}]}, 20_000
    nodes = [{"mesh": 0} for _ in range(count)]
    return glb({"asset": {"version": "2.0"}, "buffers": [{"byteLength": len(body)}], "bufferViews": views,
                "accessors": accessors, "meshes": [mesh], "nodes": nodes, "scenes": [{"nodes": [*range(count)]}],
                "scene": 0}, body)  # fmt: skip


def long_strip() -> bytes:
    """Forty million triangles, of one byte each."""
    body = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + bytes([0, 1, 2, 1]) * (10 * MB)
    views = [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 40 * MB}]
    accessors = [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3},
                 {"bufferView": 1, "componentType": 5121, "type": "SCALAR", "count": 40 * MB}]  # fmt: skip
    mesh = {"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 5}]}
    return glb({"asset": {"version": "2.0"}, "buffers": [{"byteLength": len(body)}], "bufferViews": views,
                "accessors": accessors, "meshes": [mesh], "nodes": [{"mesh": 0}]}, body)  # fmt: skip


def header_of_lists() -> bytes:
    text = b'{"a":[' + b"[]," * 10_000_000 + b"[]]}"
    return len(text).to_bytes(8, "little") + text


def as_table(path: Path) -> Any:
    return table("a.npy", restricted_load(path.read_bytes(), ARRAYS, path=path), 3)


def as_obj(path: Path) -> Any:
    return parse_obj(unpack_text(path.read_bytes(), str(path)), path)


def as_bvh(path: Path) -> Any:
    return parse_bvh(unpack_text(path.read_bytes(), str(path)), str(path))


def zipped_rows() -> bytes:
    head = zlib.compressobj(9, zlib.DEFLATED, 31)
    text = f"HIERARCHY ROOT a {{ OFFSET 0 0 0 CHANNELS {ROOT_CHANNELS} }}\nMOTION\n".encode()
    text += b"Frames: 1000000\nFrame Time: 0.01\n"
    return head.compress(text) + head.flush() + gzipped(b"1 2 3 4 5 6 7\n\n\n", 200)


def listed(path: Path) -> Any:
    (path.parent / "label_split").mkdir()
    path.rename(path.parent / "label_split" / path.name)
    return listed_segments(RawTree(path.parent), "subject1/h1/0")


def hand_lines() -> bytes:
    line = b'{"timestamp_ns": 1, "hand_poses": {}}\n'
    return line * (MAX_TABLE_BYTES // len(line))


def object_rows() -> bytes:
    head = ",".join(POSE_COLUMNS).encode() + b"\n"
    return head + b"1,1,0,0,0,1,0,0,0\n" * (MAX_TABLE_BYTES // 18 - 10)


def as_hand_reference(path: Path) -> Any:
    (path.parent / "hand").mkdir()
    path.rename(path.parent / "hand" / path.name)
    return _read_tips(RawTree(path.parent))


ATTACKS: list[Attack] = [
    ("gzip-vertices.obj.gz", lambda: gzipped(b"v 0 0 0\n", 255), as_obj),
    ("gzip-lines.obj.gz", lambda: gzipped(b"\n", 255), as_obj),
    ("gzip-words.bvh.gz", lambda: gzipped(b"a ", 255), as_bvh),
    ("gzip-gigabytes.bvh.gz", lambda: gzipped(b"\0", 4096), as_bvh),
    ("gzip-rows.bvh.gz", zipped_rows, as_bvh),
    ("lists-of-lists.pkl", lambda: nested_lists(100, 5), as_table),
    ("lists-without-end.pkl", lambda: nested_lists(2, 60), as_table),
    ("list-of-itself.pkl", cyclic, as_table),
    ("one-text-often.pkl", lambda: repeated("x" * MB, 20_000), as_table),
    ("many-lists.pkl", many_lists, as_table),
    ("same-hashes.pkl", same_hashes, as_table),
    ("same-hashes-one-by-one.pkl", lambda: same_hashes(b"}", b"Ns", b"."), as_table),
    ("same-hashes-set.pkl", lambda: same_hashes(b"\x8f(", b"", b"\x90."), as_table),
    ("same-hashes-set-2.pkl", lambda: same_hashes(b"cbuiltins\nset\n](", b"", b"e\x85R."), as_table),
    ("same-hashes-text.pkl", same_hashes_in_text, as_table),
    ("same-hashes-torch.pkl", same_hashes, lambda path: load_torch_pickle(path, path)),
    ("frozensets.pkl", frozensets, as_table),
    ("complex-keys.pkl", complex_keys, as_table),
    ("one-array-often.pkl", one_array_often, as_table),
    ("opcodes.npz", opcodes_npz, load_npz_objects),
    ("zeros.npz", zeros_npz, load_npz_arrays),
    ("zeros-of-members.npz", lambda: npz(npy(bytes(8 * MB), f"({MB},)", "<f8"), 12), load_npz_objects),
    ("lists.npz", lists_npz, load_npz_objects),
    ("one-polygon.ply", one_polygon, load_mesh),
    ("words.ply", text_ply, load_mesh),
    ("one-polygon.obj", wide_obj, load_mesh),
    ("empty-accessors.glb", empty_accessors, read_user_object),
    ("many-nodes.glb", many_nodes, read_user_object),
    ("long-strip.glb", long_strip, read_user_object),
    ("parts.json", lambda: b"[" + b"[]," * 1_800_000 + b"[]]", lambda path: parse_parts(path.read_bytes(), "p", 9)),
    ("action_train.txt", lambda: b"\n" * (5 * MB), listed),
    ("rows.csv", lambda: b"time_s\n" + b"0\n" * (8 * MB), read_trajectories),
    ("cells.csv", lambda: b"," * (30 * MB), read_trajectories),
    ("lines.txt", lambda: b"120\n" + b"0\n" * (8 * MB), read_trajectories),
    ("hand_reference.json", lambda: b"[" + b"{}," * (4 * MB) + b"{}]", as_hand_reference),
    ("hands.jsonl", hand_lines, lambda path: hand_poses(path.read_bytes(), "h", "mano")),
    ("objects.csv", object_rows, lambda path: object_poses(path.read_bytes(), "o")),
    ("header.safetensors", header_of_lists, read_metadata),
]  # fmt: skip
