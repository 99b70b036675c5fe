"""Every encoding that glTF 2.0 has for a triangle gives the same triangles; what cannot be read is named."""

import base64
import json
import struct
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from hoidata.objects.glb import parse_glb

CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]], "<f4")
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "<u2")
FLOAT, BYTE, UBYTE, SHORT, USHORT, UINT = 5126, 5120, 5121, 5122, 5123, 5125
CODES = {"<f4": FLOAT, "|i1": BYTE, "|u1": UBYTE, "<i2": SHORT, "<u2": USHORT, "<u4": UINT}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Document:
    """Builds a GLB file: each array becomes an accessor with a separate view."""

    def __init__(self) -> None:
        self.body = b""
        self.tree = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "meshes": [], "nodes": []}

    def accessor(self, array, stride=0, **more):
        array = np.atleast_2d(array) if array.ndim > 1 else array[:, None]
        view = self.view(array, stride)
        kind = {"componentType": CODES[array.dtype.str], "type": TYPES[array.shape[1]], "count": len(array)}
        self.tree["accessors"].append({"bufferView": view, **kind, **more})
        return len(self.tree["accessors"]) - 1

    def view(self, array, stride=0):
        items = [item.tobytes() for item in array]
        data = b"".join(item + b"\xee" * (stride - len(item)) for item in items) if stride else b"".join(items)
        self.body += b"\xee" * (-len(self.body) % 4)
        view = {"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data)}
        self.tree["bufferViews"].append(view | ({"byteStride": stride} if stride else {}))
        self.body += data
        return len(self.tree["bufferViews"]) - 1

    def mesh(self, *primitives, **more):
        self.tree["meshes"].append({"primitives": list(primitives), **more})
        return len(self.tree["meshes"]) - 1

    def node(self, **node):
        self.tree["nodes"].append(node)
        return len(self.tree["nodes"]) - 1

    def bytes(self, **more):
        tree = {"buffers": [{"byteLength": len(self.body)}], **self.tree, **more}
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        body = self.body + b"\0" * (-len(self.body) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def tetrahedron(document, **node):
    position, indices = document.accessor(CORNERS), document.accessor(FACES.ravel())
    return document.node(mesh=document.mesh({"attributes": {"POSITION": position}, "indices": indices}), **node)


def triangles(data):
    """(face, 3, 3) the corners of each triangle, each triangle from its smallest corner on, in sorted order."""
    glb = parse_glb(data, "a.glb")
    rows = []
    for face in glb.vertices[glb.faces].round(6).tolist():
        first = face.index(min(face))
        rows.append(face[first:] + face[:first])
    return np.array(sorted(rows))


PLAIN = np.array(sorted(face[face.index(min(face)) :] + face[: face.index(min(face))]
                        for face in CORNERS.astype(float).round(6)[FACES].tolist()))  # fmt: skip


def primitive_of(document, **attributes):
    return document.node(mesh=document.mesh({"attributes": attributes, "indices": document.accessor(FACES.ravel())}))


def normalised(kind):
    """Positions over the whole range of an integer type, and the node that scales them back, as gltfpack writes it."""

    def build(document):
        most = np.iinfo(kind).max
        stored = np.round(CORNERS / 0.3 * most).astype(kind)
        stride = -(-stored.itemsize * 3 // 4) * 4
        position = document.accessor(stored, stride, normalized=True)
        document.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
        document.tree["nodes"] = []
        primitive_of(document, POSITION=position)
        document.tree["nodes"][0]["scale"] = [0.3] * 3

    return build


def whole_numbers(document):
    """Integers that are not normalised: tenths of a metre here."""
    document.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    primitive_of(document, POSITION=document.accessor((CORNERS * 10).round().astype("<i2"), 8))
    document.tree["nodes"][0]["scale"] = [0.1] * 3


def sparse(document):
    position = document.accessor(np.zeros_like(CORNERS))
    rows = np.array([1, 2, 3], "<u2")
    document.tree["accessors"][position]["sparse"] = {
        "count": 3,
        "indices": {"bufferView": document.view(rows[:, None]), "componentType": USHORT},
        "values": {"bufferView": document.view(CORNERS[1:])},
    }
    primitive_of(document, POSITION=position)


def sparse_alone(document):
    sparse(document)
    del document.tree["accessors"][0]["bufferView"]


def strided(document):
    primitive_of(document, POSITION=document.accessor(CORNERS, 24))


def without_indices(document):
    document.node(mesh=document.mesh({"attributes": {"POSITION": document.accessor(CORNERS[FACES.ravel()])}}))


def indices_of(kind):
    def build(document):
        position, indices = document.accessor(CORNERS), document.accessor(FACES.ravel().astype(kind))
        document.node(mesh=document.mesh({"attributes": {"POSITION": position}, "indices": indices}))

    return build


def strip(document):
    """Four faces in one strip, whose odd triangles have the opposite orientation."""
    order = np.array([0, 2, 1, 3, 0, 2], "<u2")
    attributes = {"POSITION": document.accessor(CORNERS)}
    document.node(mesh=document.mesh({"attributes": attributes, "indices": document.accessor(order), "mode": 5}))


def fan(document):
    """Three faces about corner 0 as a fan, and the fourth as a triangle; a line is not part of the mesh."""
    attributes = {"POSITION": document.accessor(CORNERS)}
    around, last = (document.accessor(np.array(order, "<u2")) for order in ([0, 2, 1, 3, 2], [1, 2, 3]))
    document.node(
        mesh=document.mesh(
            {"attributes": attributes, "indices": around, "mode": 6},
            {"attributes": attributes, "indices": last},
            {"attributes": attributes, "indices": last, "mode": 1},
        )
    )


TURN = Rotation.from_euler("xyz", [20, -50, 110], degrees=True)


def under_nodes(document):
    """A node with translation, rotation and scale, and one with a matrix, which undo each other."""
    inner = tetrahedron(document, translation=[1, 2, 3], rotation=TURN.as_quat().tolist(), scale=[2, 3, 4])
    matrix = np.eye(4)
    matrix[:3, :3] = TURN.as_matrix() * [2, 3, 4]
    matrix[:3, 3] = [1, 2, 3]
    outer = document.node(children=[inner], matrix=np.linalg.inv(matrix).T.ravel().tolist())
    document.tree["scenes"] = [{"nodes": []}, {"nodes": [outer]}]
    document.tree["scene"] = 1


def mirrored(document):
    """The mesh is stored mirrored and inside out; the node's negative scale undoes both."""
    position = document.accessor((CORNERS * [-1, 1, 1]).astype("<f4"))
    indices = document.accessor(FACES[:, ::-1].ravel())
    mesh = document.mesh({"attributes": {"POSITION": position}, "indices": indices})
    document.node(mesh=mesh, scale=[-1, 1, 1])


def morphed(document):
    half = document.accessor((CORNERS / 2).astype("<f4"))
    more, far = document.accessor(CORNERS), document.accessor((CORNERS * 90).astype("<f4"))
    targets = [{"POSITION": more}, {"POSITION": far}]
    primitive = {"attributes": {"POSITION": half}, "indices": document.accessor(FACES.ravel()), "targets": targets}
    document.node(mesh=document.mesh(primitive, weights=[0.5, 0]))


def morphed_by_its_node(document):
    morphed(document)
    document.tree["meshes"][0]["weights"] = [0, 1]
    document.tree["nodes"][0]["weights"] = [0.5, 0]


def skinned(document):
    """Vertices weighted half and half to two joints, which the stored pose moves by a metre in turn."""
    position, indices = document.accessor(CORNERS + np.array([0, 0, 7], "<f4")), document.accessor(FACES.ravel())
    joints = document.accessor(np.tile(np.array([0, 1, 0, 0], "|u1"), (4, 1)))
    weights = document.accessor(np.tile(np.array([128, 127, 0, 0], "|u1"), (4, 1)), normalized=True)
    bound = np.tile(np.eye(4, dtype="<f4"), (2, 1, 1))
    bound[:, :3, 3] = [0, 0, -7]
    binds = document.accessor(np.ascontiguousarray(bound.transpose(0, 2, 1)).reshape(2, 16))
    attributes = {"POSITION": position, "JOINTS_0": joints, "WEIGHTS_0": weights}
    mesh = document.mesh({"attributes": attributes, "indices": indices})
    document.node(mesh=mesh, skin=0, translation=[50, 0, 0])
    first, second = document.node(translation=[127, 0, 0]), document.node(translation=[-128, 0, 0])
    document.tree["skins"] = [{"joints": [first, second], "inverseBindMatrices": binds}]


def in_base64(document):
    tetrahedron(document)
    uri = "data:application/octet-stream;base64," + base64.b64encode(document.body).decode()
    document.tree["buffers"] = [{"byteLength": len(document.body), "uri": uri}]
    document.body = b""


ENCODINGS = {
    "plain": tetrahedron,
    **{f"normalised {kind}": normalised(kind) for kind in ("|i1", "|u1", "<i2", "<u2")},
    "whole numbers": whole_numbers,
    **{f"indices {kind}": indices_of(kind) for kind in ("|u1", "<u2", "<u4")},
    **{build.__name__: build for build in (sparse, sparse_alone, strided, without_indices, strip, fan, under_nodes)},
    **{build.__name__: build for build in (mirrored, morphed, morphed_by_its_node, skinned, in_base64)},
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_tetrahedron_in_another_encoding_is_the_same_tetrahedron(encoding):
    document = Document()
    ENCODINGS[encoding](document)
    tolerance = 0.3 / 127 if "1" in encoding else 0.3 / 2**14  # half a step of the coarsest numbers
    np.testing.assert_allclose(triangles(document.bytes()), PLAIN, atol=tolerance if "normalised" in encoding else 2e-6)


def test_a_signed_integer_at_its_very_least_is_minus_one():
    document = Document()
    corners = np.array([[-128, 127, 0], [-127, 0, 0], [0, 0, 127]], "|i1")
    document.node(mesh=document.mesh({"attributes": {"POSITION": document.accessor(corners, 4, normalized=True)}}))
    vertices = parse_glb(document.bytes(), "a.glb").vertices
    np.testing.assert_array_equal(vertices, [[-1, 1, 0], [-1, 0, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    "name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "EXT_mesh_gpu_instancing", "ACME_curves"]
)
def test_a_required_extension_that_changes_the_shape_is_refused_by_name(name):
    document = Document()
    tetrahedron(document)
    data = document.bytes(extensionsUsed=[name], extensionsRequired=[name])
    with pytest.raises(BadInput, match=f"got {name}; export it without") as error:
        parse_glb(data, "a.glb")
    assert ("gltf-transform copy" in error.value.remedy) == ("compression" in name)


def test_instances_are_refused_even_where_the_file_does_not_require_them():
    document = Document()
    tetrahedron(document)
    with pytest.raises(BadInput, match="EXT_mesh_gpu_instancing"):
        parse_glb(document.bytes(extensionsUsed=["EXT_mesh_gpu_instancing"]), "a.glb")


@pytest.mark.parametrize("name", ["KHR_texture_transform", "KHR_materials_unlit", "EXT_texture_webp"])
def test_a_required_extension_of_colours_changes_nothing(name):
    document = Document()
    tetrahedron(document)
    np.testing.assert_allclose(triangles(document.bytes(extensionsRequired=[name])), PLAIN, atol=2e-6)


def change(path, value):
    """Sets a value deep inside the JSON document of the plain file."""

    def build(document):
        container = document.tree
        for key in path[:-1]:
            container = container[key]
        container[path[-1]] = value

    return build


FAULTS = {
    r"corner \d+ of 4 vertices": change(("accessors", 1, "count"), 15),
    "11 corners": change(("accessors", 1, "count"), 11),
    "5 vertices or corners in the 48 bytes of buffer view 0": change(("accessors", 0, "count"), 5),
    "12 vertices or corners in the 24 bytes of buffer view 1": change(("accessors", 1, "byteOffset"), 2),
    "more vertices and corners": change(("accessors", 0, "count"), 10**9),
    "an accessor of -1": change(("accessors", 0, "count"), -1),
    "the number -1": change(("nodes", 0, "mesh"), -1),
    "indices that are no integers": change(("meshes", 0, "primitives", 0, "indices"), 0),  # the positions
    "positions of 1": change(("meshes", 0, "primitives", 0, "attributes", "POSITION"), 1),
    "another file": change(("buffers",), [{"uri": "secret.bin", "byteLength": 9}]),
    "node 0 in two places": change(("scenes",), [{"nodes": [0, 0]}]),
    "KeyError": change(("accessors", 0, "componentType"), 5124),
    "TypeError": change(("nodes", 0, "mesh"), "first"),
}


@pytest.mark.parametrize("words", FAULTS)
def test_a_document_that_contradicts_itself_is_refused_in_words(words):
    document = Document()
    tetrahedron(document)
    document.body += bytes(range(4, 10))  # so that three more corners can be read behind the last one
    document.tree["bufferViews"][1]["byteLength"] += 6 if words.startswith("corner") else 0
    FAULTS[words](document)
    with pytest.raises(BadInput, match=words):
        parse_glb(document.bytes(), "a.glb")


@pytest.mark.parametrize("words", ["no header", "version 1", "no whole JSON", "bytes of JSON"])
def test_files_other_than_glb_of_gltf_2_are_refused(words):
    document = Document()
    tetrahedron(document)
    data = document.bytes(asset={"version": "2.0", "extras": "x" * (5 << 20)} if words == "bytes of JSON" else {})
    changed = {"no header": data[:19], "version 1": data[:4] + b"\1" + data[5:], "no whole JSON": data[:200]}
    with pytest.raises(BadInput, match=words):
        parse_glb(changed.get(words, data), "a.glb")


def test_faces_have_their_node_and_the_branch_of_the_tree_with_it():
    """root > model > (body, lid > knob): the tree divides below "model"."""
    document = Document()
    body, knob = tetrahedron(document, name="body"), tetrahedron(document, name="knob")
    lid = tetrahedron(document, name="lid", children=[knob])
    camera = document.node(name="camera")
    model = document.node(name="model", children=[body, lid, camera])
    document.tree["scenes"] = [{"nodes": [document.node(name="root", children=[model])]}]
    glb = parse_glb(document.bytes(), "a.glb")
    assert [glb.names[number] for number in glb.node[::4]] == ["body", "knob", "lid"]
    assert [glb.names[number] for number in glb.branch[::4]] == ["body", "lid", "lid"]


def test_a_fork_with_a_mesh_is_a_separate_branch():
    document = Document()
    plate, knob = tetrahedron(document, name="plate"), tetrahedron(document, name="knob")
    lid = document.node(name="lid", children=[plate, knob])
    document.tree["scenes"] = [{"nodes": [tetrahedron(document, name="body", children=[lid])]}]
    glb = parse_glb(document.bytes(), "a.glb")
    assert [glb.names[number] for number in glb.branch[::4]] == ["lid", "lid", "body"]


def one_triangle(document):
    return {"attributes": {"POSITION": document.accessor(CORNERS[:3])}}


def many_nodes(document):
    document.mesh(one_triangle(document))
    for number in range(20_000):
        document.node(mesh=0, translation=[number, 0, 0])


def many_primitives(document):
    document.node(mesh=document.mesh(*[one_triangle(document)] * 20_000))


def a_chain_of_nodes(document):
    document.mesh(one_triangle(document))
    for number in range(20_000):
        document.node(mesh=0, children=[number + 1])
    document.node(mesh=0)


@pytest.mark.slow
@pytest.mark.parametrize("build", [many_nodes, many_primitives, a_chain_of_nodes])
def test_twenty_thousand_nodes_or_primitives_are_read_in_less_than_two_seconds(build):
    document = Document()
    build(document)
    data = document.bytes()
    start = time.process_time()
    assert len(parse_glb(data, "a.glb").faces) >= 20_000
    assert time.process_time() - start < 2
