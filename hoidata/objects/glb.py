"""Reader of the triangles in a GLB file (Khronos, "glTF 2.0 Specification", 2021): positions, corners, nodes.

Materials, textures, cameras and animations are ignored. Skins and morph targets are applied in the stored pose. The
reader opens no other file. Its time is linear in the size of the file and the number of corners in the scene. trimesh
ignores skins, morph targets, sparse and normalized accessors, mirrored nodes and required extensions.
"""

import base64
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hoidata.errors import BadInput
from hoidata.objects.mesh import Mesh, joined
from hoidata.objects.ply import MOST_TRIANGLES

_MAX_JSON_BYTES = 4 << 20
_MAX_CORNERS = 5_000_000  # decoded or in the scene; larger files may have one per byte
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
# A file may require these extensions, which are not read, because they do not change the shape.
_APPEARANCE_EXTENSIONS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_", "MSFT_texture_")
_QUANTIZATION = "KHR_mesh_quantization"  # integer positions, which this reader accepts in all accessors
_INSTANCES = "EXT_mesh_gpu_instancing"  # repeats a mesh; a reader that ignores it sees one copy
_COMPRESSION = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


class Glb(NamedTuple):
    """The triangles of a file's scene in the order of its nodes."""

    vertices: np.ndarray  # (vertex, 3) float64 metres
    faces: np.ndarray  # (face, 3)
    node: np.ndarray  # (face,) index of the face's node
    branch: np.ndarray  # (face,) index of the root node of the face's branch, below the first fork of the scene's tree
    names: list[str]  # of all nodes
    parents: list[int]  # of all nodes; -1 for roots


def parse_glb(data: bytes, path: str | Path) -> Glb:
    """Parse the triangles of a GLB file; ``path`` names the file in errors.

    Raises BadInput: the data are not a GLB file, or an unsupported extension changes the shape.
    """
    try:
        tree, binary = _chunks(data)
        _check_extensions(tree, path)
        return _Scene(tree, _buffers(tree, binary), max(len(data), _MAX_CORNERS)).triangles()
    except BadInput:
        raise
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        got = f"{type(error).__name__}: {str(error)[:200]}"
        raise BadInput(
            path, "a readable mesh in a GLB file of glTF 2.0", got, "export the mesh alone, again"
        ) from error


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON document and the binary chunk (empty if missing)."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise ValueError("no header of a GLB file")
    version, _, length, kind = struct.unpack_from("<IIII", data, 4)
    if version != 2:
        raise ValueError(f"version {version} of glTF, expected 2")
    if kind != _JSON_CHUNK or length > len(data) - 20:
        raise ValueError("no whole JSON chunk")
    if length > _MAX_JSON_BYTES:
        raise ValueError(f"{length} bytes of JSON, expected at most {_MAX_JSON_BYTES}")
    tree = json.loads(data[20 : 20 + length])
    start = 20 + length
    if len(data) < start + 8 or struct.unpack_from("<I", data, start + 4)[0] != _BINARY_CHUNK:
        return tree, b""
    return tree, data[start + 8 : start + 8 + struct.unpack_from("<I", data, start)[0]]


def _check_extensions(tree: dict[str, Any], path: str | Path) -> None:
    """Raise BadInput for required extensions that may change the shape."""
    required = [*tree.get("extensionsRequired", ()), *({_INSTANCES} & set(tree.get("extensionsUsed", ())))]
    unknown = [
        str(name)[:60]
        for name in required
        if name != _QUANTIZATION and not str(name).startswith(_APPEARANCE_EXTENSIONS)
    ]
    if not unknown:
        return
    remedy = "export it without them"
    if any(name in _COMPRESSION for name in unknown):
        remedy = "export it without compression, or decompress it: gltf-transform copy IN.glb OUT.glb"
    expected = f"no required extension of geometry but {_QUANTIZATION}"
    raise BadInput(path, expected, ", ".join(dict.fromkeys(unknown[:5])), remedy)


def _buffers(tree: dict[str, Any], binary: bytes) -> list[bytes]:
    """The bytes of each buffer, from the binary chunk or base64 in the JSON. Raises ValueError for other files."""
    buffers = []
    for number, buffer in enumerate(tree.get("buffers", ())):
        uri = buffer.get("uri")
        if uri is None:
            buffers.append(binary if number == 0 else b"")
        elif uri.startswith("data:") and ";base64," in uri[:100]:
            buffers.append(base64.b64decode(uri.partition(",")[2], validate=True))
        else:
            raise ValueError(f"data in another file, {uri[:60]!r}: export one GLB file")
    return buffers


class _Scene:
    """One glTF document. ``budget`` is the number of vertices and corners that may still be decoded."""

    def __init__(self, tree: dict[str, Any], buffers: list[bytes], budget: int) -> None:
        self.tree, self.buffers, self.budget = tree, buffers, budget
        self.nodes = tree.get("nodes", [])
        self.world: dict[int, np.ndarray] = {}  # (4, 4) scene from node, of the nodes of the scene
        self.parent: dict[int, int | None] = {}
        self.meshes: dict[tuple[int, tuple], Mesh] = {}  # by number and weights of the morph targets

    def triangles(self) -> Glb:
        """The triangles of all nodes of the scene, in scene coordinates."""
        self._place_nodes()
        showing = sorted(number for number in self.world if "mesh" in self.nodes[number])
        meshes, n_triangles = list[Mesh](), 0
        for number in showing:
            node = self.nodes[number]
            points, corners = self._node_mesh(node)
            self._spend(len(points) + corners.size)
            n_triangles += len(corners)
            _check_count(n_triangles)
            if "skin" in node:
                points = self._apply_skin(node, points)
            else:
                matrix = self.world[number]
                points = _transform(points, matrix)
                if _determinant(matrix) < 0:  # the specification flips the triangles of a mirrored node
                    corners = corners[:, ::-1]
            meshes.append(Mesh(points, corners))
        names = [str(node.get("name", ""))[:60] for node in self.nodes]
        branch = self._branches(set(showing))
        nodes, branches, times = (
            np.array(numbers, dtype=np.int64)
            for numbers in (showing, [branch[number] for number in showing], [len(mesh.faces) for mesh in meshes])
        )
        parents = [-1 if (parent := self.parent.get(number)) is None else parent for number in range(len(self.nodes))]
        return Glb(*joined(meshes), nodes.repeat(times), branches.repeat(times), names, parents)

    def _spend(self, corners: int) -> None:
        self.budget -= corners
        if self.budget < 0:
            raise ValueError("more vertices and corners than a file of this size can hold")

    def _place_nodes(self) -> None:
        """Fill ``world`` and ``parent`` from the scene's roots downwards."""
        scenes = self.tree.get("scenes")
        children = {child for node in self.nodes for child in node.get("children", ())}
        roots = [number for number in range(len(self.nodes)) if number not in children]
        if scenes:
            roots = _at(scenes, self.tree.get("scene", 0)).get("nodes", [])
        pending: list[tuple[int, int | None]] = [(root, None) for root in roots]
        while pending:
            number, parent = pending.pop()
            if number in self.world:
                raise ValueError(f"node {number} in two places of the scene")
            local = _parent_from_node(_at(self.nodes, number))
            self.world[number] = local if parent is None else self.world[parent] @ local
            self.parent[number] = parent
            pending += [(child, number) for child in self.nodes[number].get("children", ())]

    def _branches(self, showing: set[int]) -> dict[int, int]:
        """The root node of each node's branch.

        Branches begin below the first node with two children that lead to meshes. If that node has a mesh itself, it is
        a separate branch.
        """
        top_down = list(self.world)  # parents come before their children
        used = set(showing)  # nodes with a mesh at them or below
        for number in reversed(top_down):
            if number in used and (parent := self.parent[number]) is not None:
                used.add(parent)
        undivided: set[int | None] = {None}
        below = [number for number in top_down if number in used and self.parent[number] is None]
        while len(below) == 1 and below[0] not in showing:
            undivided.add(below[0])
            below = [child for child in self.nodes[below[0]].get("children", ()) if child in used]
        if len(below) == 1:
            undivided.add(below[0])
        branch: dict[int, int] = {}
        for number in top_down:
            parent = self.parent[number]
            branch[number] = number if parent is None or parent in undivided else branch[parent]
        return branch

    def _node_mesh(self, node: dict[str, Any]) -> Mesh:
        """A node's mesh in the node's frame, with morph targets."""
        mesh = _at(self.tree["meshes"], node["mesh"])
        key = node["mesh"], tuple(node.get("weights", mesh.get("weights", ())))
        if key not in self.meshes:
            self.meshes[key] = joined([self._primitive(item, key[1]) for item in _triangle_primitives(mesh)])
        return self.meshes[key]

    def _primitive(self, primitive: dict[str, Any], weights: tuple) -> Mesh:
        points = self._accessor(primitive["attributes"]["POSITION"])
        if points.shape[1] != 3:
            raise ValueError(f"positions of {points.shape[1]} numbers")
        for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
            if weight and "POSITION" in target:
                points = points + float(weight) * self._accessor(target["POSITION"])
        order = np.arange(len(points)) if "indices" not in primitive else self._integers(primitive["indices"]).ravel()
        mode = primitive.get("mode", _TRIANGLES)
        _check_count(len(order) // 3 if mode == _TRIANGLES else len(order) - 2)
        faces = _triangles(order, mode)
        if len(faces) and (faces.min() < 0 or faces.max() >= len(points)):
            raise ValueError(f"corner {faces.max()} of {len(points)} vertices")
        return Mesh(points.astype(np.float64), faces)

    def _apply_skin(self, node: dict[str, Any], points: np.ndarray) -> np.ndarray:
        """Vertices deformed by the joints of a skin, which ignores the node's transform."""
        skin = _at(self.tree["skins"], node["skin"])
        scene_from_joint = np.array([self.world[joint] for joint in skin["joints"]])
        if "inverseBindMatrices" in skin:
            stored = self._accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4)
            scene_from_joint = scene_from_joint @ stored.transpose(0, 2, 1)[: len(scene_from_joint)]
        joints, weights = self._influences(_at(self.tree["meshes"], node["mesh"]))
        homogeneous = np.column_stack((points, np.ones(len(points))))
        moved = np.zeros((len(points), 3))
        for joint, weight in zip(joints.T, weights.T, strict=True):
            matrices = scene_from_joint[joint, :3]
            moved += weight[:, None] * np.einsum("vij,vj->vi", matrices, homogeneous)
        return moved

    def _influences(self, mesh: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Joints and weights, (vertex, influence), of all triangles of a mesh."""
        joints, weights = [], []
        for primitive in _triangle_primitives(mesh):
            attributes = primitive["attributes"]
            if "JOINTS_1" in attributes:
                raise ValueError("more than four joints at a vertex: apply the armature, then export again")
            joints.append(self._integers(attributes["JOINTS_0"]))
            weights.append(self._accessor(attributes["WEIGHTS_0"]))
        return np.concatenate(joints), np.concatenate(weights)

    def _integers(self, number: int) -> np.ndarray:
        """(element, component) indices; floating-point components are refused."""
        values = self._accessor(number)
        if values.dtype.kind not in "iu":
            raise ValueError("indices that are no integers")
        return values.astype(np.int64)

    def _accessor(self, number: int) -> np.ndarray:
        """(element, component) values; normalized integers are scaled to -1 or 0 to 1 (section 3.6.2)."""
        accessor = _at(self.tree["accessors"], number)
        dtype, width = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        count = accessor["count"]
        if count < 0 or accessor.get("sparse", {}).get("count", 0) > count:
            raise ValueError(f"an accessor of {count} elements")
        self._spend(count)
        if "bufferView" in accessor:
            values = self._elements(accessor["bufferView"], accessor.get("byteOffset", 0), dtype, width, count)
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            values = self._with_sparse(values.copy(), accessor["sparse"])
        if accessor.get("normalized") and dtype.kind in "iu":
            return np.maximum(values / float(np.iinfo(dtype).max), -1.0)
        return values

    def _with_sparse(self, values: np.ndarray, sparse: dict[str, Any]) -> np.ndarray:
        count, (indices, replacements) = sparse["count"], (sparse["indices"], sparse["values"])
        index_kind = np.dtype(_COMPONENTS[indices["componentType"]])
        rows = self._elements(indices["bufferView"], indices.get("byteOffset", 0), index_kind, 1, count)[:, 0]
        width = values.shape[1]
        values[rows] = self._elements(
            replacements["bufferView"], replacements.get("byteOffset", 0), values.dtype, width, count
        )
        return values

    def _elements(self, view: int, offset: int, dtype: np.dtype, width: int, count: int) -> np.ndarray:
        """(count, width) numbers of a buffer view, with its ``byteStride`` if it has one."""
        stated = _at(self.tree["bufferViews"], view)
        data = _at(self.buffers, stated["buffer"])
        size = dtype.itemsize * width
        stride = stated.get("byteStride", size)
        start = stated.get("byteOffset", 0) + offset
        end = start + (count - 1) * stride + size
        if stride < size or start < 0 or count < 0 or end > min(len(data), start - offset + stated["byteLength"]):
            raise ValueError(f"{count} vertices or corners in the {stated['byteLength']} bytes of buffer view {view}")
        return np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))


def _check_count(triangles: int) -> None:
    if triangles > MOST_TRIANGLES:
        raise ValueError(f"more than {MOST_TRIANGLES} triangles: decimate the mesh")


def _at(items: list[Any], number: int) -> Any:
    """items[number] without negative indices."""
    if number < 0:
        raise ValueError(f"the number {number}")
    return items[number]


def _triangle_primitives(mesh: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The primitives of a mesh that are triangles, strips or fans."""
    return (item for item in mesh["primitives"] if item.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN))


def _triangles(order: np.ndarray, mode: int) -> np.ndarray:
    """(face, 3) from a primitive's vertex order (section 3.7.2.1). Raises ValueError for an incomplete triangle."""
    if mode == _TRIANGLES:
        if len(order) % 3:
            raise ValueError(f"{len(order)} corners of triangles")
        return order.reshape(-1, 3)
    number = np.arange(len(order) - 2)
    if mode == _STRIP:
        return np.stack((order[number], order[number + 1 + number % 2], order[number + 2 - number % 2]), axis=1)
    return np.stack((order[number + 1], order[number + 2], np.broadcast_to(order[:1], number.shape)), axis=1)


def _parent_from_node(node: dict[str, Any]) -> np.ndarray:
    """(4, 4) parent_from_node: the stored column-major matrix, or translation @ rotation @ scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node:
        x, y, z, w = (float(number) for number in node["rotation"])
        matrix[:3, :3] = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        )
    if "scale" in node:
        matrix[:3, :3] *= np.array(node["scale"], dtype=np.float64)
    if "translation" in node:
        matrix[:3, 3] = node["translation"]
    return matrix


def _transform(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Transform points (point, 3) by (4, 4). Without BLAS, so that equal points along a seam stay bitwise equal."""
    x, y, z = (points[:, axis, None] * matrix[:3, axis] for axis in range(3))
    return x + y + z + matrix[:3, 3]


def _determinant(matrix: np.ndarray) -> float:
    a, b, c = matrix[:3, :3].tolist()
    return a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
