import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from hoidata.objects import mesh
from hoidata.objects.mesh import load_mesh, mass_properties, parse_obj

OBJ = """# corners shared between texture seams, out of order, one repeated
v 1 0 0
v 0 0 0
v 0 1 0
v 0 0 0
v 0 0 1
vt 0 0
vt 1 1
vn 0 0 1
f 3/1/1 1/2/1 2/1/1
f 5//1 4//1 1//1
f -1 -2 -3
"""


def test_an_obj_keeps_vertex_order_and_repeated_vertices(tmp_path: Path):
    (tmp_path / "a.obj").write_text(OBJ)
    mesh = load_mesh(tmp_path / "a.obj")
    assert mesh.vertices.tolist() == [[1, 0, 0], [0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 1]]
    assert mesh.faces.tolist() == [[2, 0, 1], [4, 3, 0], [4, 3, 2]]


def test_a_polygon_becomes_a_fan(tmp_path: Path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    assert load_mesh(tmp_path / "a.obj").faces.tolist() == [[0, 1, 2], [0, 2, 3]]


WRITTEN_OTHERWISE = {
    "slashes": lambda text: re.sub(r"^f (\d+) (\d+) (\d+)$", r"f \1/7/8 \2//9 \3/4", text, flags=re.MULTILINE),
    "other records between": lambda text: text.replace("\nf ", "\n# f 1 1 1\nvn 0 0 1\nusemtl v\n\nf "),
    "spaces": lambda text: re.sub(r"^(.) (\S+) ", r"\1   \2  ", text, flags=re.MULTILINE),
    "tabs in some": lambda text: text.replace("v 0.", "v\t0.").replace("f 1", " f\t1"),
    "colours": lambda text: re.sub(r"^(v .*)$", r"\1 0.5 0.5 1", text, flags=re.MULTILINE),
    "a colour": lambda text: text.replace("\nf", " 0.5 0.5 1 0.5\nf", 1),
    "a byte order mark": lambda text: "\ufeff" + text,
    "lines that go on": lambda text: re.sub(r"^(\S+ \S+ )(\S+ )", r"\1\\\n\2\\\n", text, flags=re.MULTILINE),
    "a comment that ends like one": lambda text: text.replace("\nv ", "\n# C:\\meshes\\\nv ", 1),
    "faces first": lambda text: "\n".join(sorted(text.splitlines(), key=lambda line: line[:1] != "f")),
    "counted from the end": lambda text: re.sub(
        r"^f (\d+)", lambda row: f"f {int(row[1]) - 43}", text, flags=re.MULTILINE
    ),
}


@pytest.mark.parametrize("variant", WRITTEN_OTHERWISE)
def test_variants_of_an_obj_file_give_the_same_mesh(tmp_path: Path, variant):
    ball = trimesh.creation.icosphere(1, radius=0.7)
    rows = [*(f"v {x!r} {y!r} {z!r}" for x, y, z in ball.vertices.tolist())]
    rows += [f"f {a} {b} {c}" for a, b, c in (ball.faces + 1).tolist()]
    plain, other = tmp_path / "plain.obj", tmp_path / "other.obj"
    plain.write_text("\n".join(rows) + "\n")
    other.write_bytes(WRITTEN_OTHERWISE[variant](plain.read_text()).encode())
    read = load_mesh(plain)
    np.testing.assert_array_equal(read.vertices, ball.vertices)
    np.testing.assert_array_equal(read.faces, ball.faces)
    np.testing.assert_array_equal(load_mesh(other).vertices, read.vertices)
    np.testing.assert_array_equal(load_mesh(other).faces, read.faces)


@pytest.mark.parametrize("ending", ["\r\n", "\r"])
def test_lines_may_end_as_on_other_systems(ending: str):
    plain = parse_obj("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "plain")
    other = parse_obj(f"v 0 0 0{ending}v 1 0 0{ending}v 0 1 0{ending}f 1 2 3", "other")
    assert [array.tolist() for array in other] == [array.tolist() for array in plain]


@pytest.mark.parametrize("corner", [0, 2**31, 2**63, "3.0", "x"])
def test_a_wrong_line_is_named_however_many_right_ones_there_are(tmp_path: Path, corner):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 3\n" * 50 + f"f 1 2 {corner}\n")
    with pytest.raises(BadInput, match=r"a\.obj:54"):
        load_mesh(tmp_path / "a.obj")


@pytest.mark.parametrize("limit", ["MOST_VERTICES", "MOST_TRIANGLES"])
def test_a_mesh_of_too_many_vertices_or_triangles_is_refused(monkeypatch: pytest.MonkeyPatch, limit: str):
    monkeypatch.setattr(mesh, limit, 3)
    with pytest.raises(BadInput, match="decimate"):
        parse_obj("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n" + "f 1 2 3\n" * 5, "a.obj")


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_an_stl_has_one_vertex_per_corner_of_the_solid(tmp_path: Path, kind: str):
    box = trimesh.creation.box((1, 2, 4))
    content = box.export(file_type=kind)
    (tmp_path / "box.stl").write_bytes(content if isinstance(content, bytes) else content.encode())
    read = load_mesh(tmp_path / "box.stl")
    assert read.vertices.shape == (8, 3)
    triangles = [np.sort(mesh.vertices[mesh.faces].reshape(-1, 9), axis=0) for mesh in (read, box)]
    np.testing.assert_allclose(triangles[0], triangles[1])
    assert mass_properties(*read).volume_m3 == pytest.approx(8)


BAD = {
    "zero.obj": ("v 0 0 0\nv 1 0 0\nf 0 1 2\nv 0 1 0\n", "numbers"),
    "empty.obj": ("", "vertices"),
    "no_faces.obj": ("v 0 0 0\nv 1 0 0\n", "faces"),
    "words.obj": ("v 0 zero 0\nf 1 1 1\n", "numbers"),
    "short.obj": ("v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "3 coordinates"),
    "short_and_long.obj": ("v 0 0\nv 1 0 0 1\nv 0 1 0\nf 1 2 3\n", "3 coordinates"),
    "outside.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "0 to 2"),
    "line.obj": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "faces with area"),
    "nan.obj": ("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
    "header.ply": ("ply\nformat ascii 1.0\nelement vertex 3\n", "readable"),
    "text.ply": ("hello", "readable"),
    "mesh.step": ("solid", ".obj, .ply or .stl"),
    "corners.stl": ("solid a\nfacet\nouter loop\nvertex 0 0 0\nendloop\nendfacet\nendsolid", "readable"),
}


@pytest.mark.parametrize("name", BAD)
def test_the_error_of_a_bad_mesh_has_its_name_and_the_expected_content(tmp_path: Path, name):
    text, expected = BAD[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(BadInput) as caught:
        load_mesh(tmp_path / name)
    assert name in caught.value.where
    assert expected in caught.value.expected
    assert "\n" not in str(caught.value)


def test_a_box_in_any_pose_has_the_inertia_of_the_textbook():
    a, b, c = 0.1, 0.2, 0.3
    rotation = Rotation.from_rotvec((0.3, -0.5, 0.9)).as_matrix()
    box = trimesh.creation.box((a, b, c))
    facts = mass_properties(box.vertices @ rotation.T + (0.4, -0.2, 1.0), box.faces)
    expected = rotation @ np.diag([b * b + c * c, a * a + c * c, a * a + b * b]) @ rotation.T / 12
    assert facts.volume_m3 == pytest.approx(a * b * c)
    np.testing.assert_allclose(facts.centre_m, (0.4, -0.2, 1.0), atol=1e-12)
    np.testing.assert_allclose(facts.inertia_kg_m2, expected, atol=1e-12)
    assert facts.source == "solid"


def test_an_inverted_mesh_has_the_same_mass_properties():
    ball = trimesh.creation.icosphere(radius=0.05)
    facts = mass_properties(ball.vertices, ball.faces[:, ::-1])
    assert facts.volume_m3 == pytest.approx(ball.volume)
    assert np.linalg.eigvalsh(facts.inertia_kg_m2).min() > 0


def test_the_hull_replaces_an_open_mesh_and_is_reported():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    facts = mass_properties(box.vertices, box.faces[2:])
    assert facts.source == "convex hull"
    assert facts.volume_m3 == pytest.approx(0.001)


def test_the_hull_replaces_two_shells_that_enclose_almost_nothing():
    outer, inner = trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.box((0.09999, 0.09999, 0.09999))
    vertices = np.concatenate([outer.vertices, inner.vertices])
    facts = mass_properties(vertices, np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]))
    assert facts.source == "convex hull"
    assert facts.volume_m3 == pytest.approx(0.001)


def test_a_thin_solid_across_its_box_is_one():
    rod = trimesh.creation.cylinder(0.0005, 0.5, sections=6)
    rod.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), (1, 1, 1)))
    assert rod.volume < 1e-3 * np.prod(np.ptp(rod.vertices, axis=0))
    facts = mass_properties(rod.vertices, rod.faces)
    assert facts.source == "solid"
    assert facts.volume_m3 == pytest.approx(rod.volume)


def test_a_single_triangle_has_no_volume_and_no_inertia():
    corners = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.3, 0]])
    properties = mass_properties(corners, np.array([[0, 1, 2]]))
    assert (properties.volume_m3, properties.source) == (0, "convex hull")
    np.testing.assert_allclose(properties.centre_m, (0.1, 0.1, 0))
    assert not properties.inertia_kg_m2.any()
