import struct
import time

import numpy as np
import pytest

from hoidata.objects.ply import parse_ply

HEAD = """ply
format {} 1.0
comment by hand
element vertex {}
property float x
property uchar red
property double y
property int z
element face {}
property uchar flags
property list uchar {} vertex_indices
property list ushort float texcoord
end_header
"""
VERTICES = [(0.5, 7, 0.1, 0), (1.0, 7, 0.2, -3), (0.0, 7, 1e-9, 2), (0.25, 7, 5.0, 1), (0.75, 7, 0.0, 4)]
FACES = [(0, 1, 2), (2, 1, 3), (4, 0, 1, 2), (0, 1, 2, 3, 4), (3, 2, 1)]
FANS = [[0, 1, 2], [2, 1, 3], [4, 0, 1], [4, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4], [3, 2, 1]]


def text(n_vertices=5, n_faces=5) -> bytes:
    lines = [" ".join(map(str, values)) for values in VERTICES]
    lines += [" ".join(map(str, (1, len(face), *face, 2, 0.5, 0.25))) for face in FACES]
    return (HEAD.format("ascii", n_vertices, n_faces, "int") + "\n".join(lines) + "\n").encode()


def binary(order="<", n_vertices=5, n_faces=5, corner="uint") -> bytes:
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    letter = {"uint": "I", "short": "h", "uchar": "B", "float": "f"}[corner]
    body = b"".join(struct.pack(f"{order}fBdi", *values) for values in VERTICES)
    for face in FACES:
        body += struct.pack(f"{order}BB{len(face)}{letter}Hff", 1, len(face), *face, 2, 0.5, 0.25)
    return HEAD.format(name, n_vertices, n_faces, corner).encode() + body


FILES = {"text": text(), "little": binary("<"), "big": binary(">", corner="short"), "bytes": binary(corner="uchar")}


@pytest.mark.parametrize("kind", FILES)
def test_mixed_polygons_among_other_properties_are_read_as_stored_and_become_fans(kind):
    vertices, faces = parse_ply(FILES[kind])
    expected = np.array([[x, y, z] for x, _, y, z in VERTICES])
    np.testing.assert_array_equal(vertices, expected)
    assert faces.tolist() == FANS
    assert (vertices.dtype, faces.dtype) == (np.float64, np.int64)


@pytest.mark.parametrize("kind", FILES)
def test_truncated_files_are_refused(kind):
    data = FILES[kind]
    for length in range(len(data) - 12):
        with pytest.raises(ValueError, match=r"."):
            parse_ply(data[:length])


@pytest.mark.parametrize(
    "data",
    [text(n_vertices=10**9), text(n_faces=10**9), binary(n_vertices=10**9), binary(n_faces=10**10)],
    ids=["text vertices", "text faces", "vertices", "faces"],
)
def test_a_billion_declared_rows_are_refused_immediately(data):
    with pytest.raises(ValueError, match="more than 1000000 vertices or 3000000 triangles"):
        parse_ply(data)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"ply\n", b"plx\n"),
        (b"end_header", b"end_heade"),
        (b"format ascii", b"format other"),
        (b"element vertex 5", b"element vertex -5"),
        (b"element vertex", b"element point"),
        (b"element face", b"element vertex"),
        (b"property float x", b"property float w"),
        (b"property float x", b"property list uchar float x"),
        (b"property float x", b"property huge x"),
        (b"vertex_indices", b"corners"),
        (b"1 3 0 1 2", b"1 3 0 1 1.5"),
        (b"1 3 0 1 2", b"1 3 0 1 nan"),
        (b"1 3 0 1 2", b"1 2 0 1"),
        (b"1 3 0 1 2", b"1 -3 0 1 2"),
        (b"0.5 7", b"half 7"),
        (b"0.5 7", b"0." + b"5" * 100 + b" 7"),
    ],
    ids=range(16),
)
def test_headers_and_rows_that_make_no_mesh_are_refused(old, new):
    assert old in FILES["text"]
    with pytest.raises(ValueError, match=r"."):
        parse_ply(FILES["text"].replace(old, new, 1))


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_a_mesh_whose_polygons_change_at_every_row_is_read_in_less_than_a_second(kind):
    """A reader of one block of equal rows at a time takes eight seconds for these 60,000 faces."""
    lengths = np.tile([3, 4, 3, 5], 15_000)
    faces = [np.arange(length) for length in lengths]
    head = (
        "ply\nformat {} 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n"
    )
    head += "property list uchar int vertex_indices\nend_header\n"
    if kind == "text":
        body = ("0 1 2\n" * 5 + "".join(f"{len(face)} {' '.join(map(str, face))}\n" for face in faces)).encode()
    else:
        body = bytes(60) + b"".join(bytes([len(face)]) + face.astype("<i4").tobytes() for face in faces)
    data = head.format("ascii" if kind == "text" else "binary_little_endian", len(faces)).encode() + body
    start = time.process_time()
    _, triangles = parse_ply(data)
    assert time.process_time() - start < 1
    assert triangles[:7].tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4]]
    assert len(triangles) == (lengths - 2).sum()


def test_an_element_of_more_rows_than_the_file_has_is_refused_immediately():
    more = b"element more 99999999999\nproperty int a\nelement vertex"
    with pytest.raises(ValueError, match="the file ends within its element 'more'"):
        parse_ply(FILES["little"].replace(b"element vertex", more))


def test_text_after_the_faces_is_ignored():
    data = FILES["text"].replace(b"end_header", b"element more 1\nproperty int a\nend_header") + b"no number"
    assert parse_ply(data)[1].tolist() == FANS
