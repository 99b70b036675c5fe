"""A user's mesh: unit, up axis and hinge are given, or guessed and reported."""

import numpy as np
import pytest
import trimesh

from hoidata.errors import BadInput
from hoidata.objects.user_mesh import piece_names, read_mesh_file, read_user_object, thinned

MUG = trimesh.creation.cylinder(radius=0.04, height=0.1, sections=48)
Y_UP = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])


def saved(mesh, path, scale=1.0, transform=None):
    mesh = mesh.copy()
    mesh.apply_scale(scale)
    if transform is not None:
        mesh.apply_transform(transform)
    mesh.export(path)
    return path


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl"])
def test_a_mesh_that_stands_on_z_is_unchanged(tmp_path, suffix):
    user_object = read_user_object(saved(MUG, tmp_path / f"mug{suffix}"))
    assert np.ptp(user_object.model.vertices_m, axis=0) == pytest.approx([0.08, 0.08, 0.1], abs=1e-6)
    assert user_object.notes[0].startswith("up: z (it stands on ")


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_a_mesh_that_stands_on_y_is_rotated_upright(tmp_path, suffix):
    user_object = read_user_object(saved(MUG, tmp_path / f"mug{suffix}", transform=Y_UP))
    assert np.ptp(user_object.model.vertices_m, axis=0) == pytest.approx([0.08, 0.08, 0.1], abs=1e-6)
    assert user_object.notes[0].startswith("up: y (it stands on " if suffix == ".obj" else "y is up")


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_vertices_that_no_face_uses_do_not_change_size_or_up_axis(tmp_path, suffix):
    path, stray = saved(MUG, tmp_path / f"mug{suffix}"), tmp_path / f"stray{suffix}"
    vertices = np.insert(MUG.vertices, 5, [0, 0, -1], axis=0)
    faces = MUG.faces + (MUG.faces >= 5)
    trimesh.Trimesh(vertices, faces, process=False).export(stray)
    expected, user_object = read_user_object(path), read_user_object(stray)
    assert user_object.notes == expected.notes
    np.testing.assert_array_equal(user_object.model.vertices_m, expected.model.vertices_m)
    np.testing.assert_array_equal(user_object.model.faces, expected.model.faces)


def test_vertices_that_no_face_uses_do_not_change_the_two_parts_of_a_hinge(tmp_path):
    (tmp_path / "box.obj").write_text("v 0 0 -1\n" + obj_text(start=2) + "v 0 0 -1\n")
    model = read_user_object(tmp_path / "box.obj", up="z", hinge="0,-0.1,0.04 1,0,0").model
    assert [(model.vertices_of(part)[:, 2].min(), model.vertices_of(part)[:, 2].max()) for part in (0, 1)] == TWO_PARTS


def test_a_glass_with_a_narrow_foot_is_rotated_upright(tmp_path):
    glass = trimesh.creation.revolve([[0, 0], [0.012, 0], [0.002, 0.01], [0.002, 0.08], [0.04, 0.12], [0, 0.12]])
    user_object = read_user_object(saved(glass, tmp_path / "glass.obj", transform=Y_UP))
    assert np.ptp(user_object.model.vertices_m, axis=0) == pytest.approx([0.08, 0.08, 0.12], abs=2e-3)
    assert user_object.notes[0].startswith("up: y (it stands on 9% of its outline; with z up on ")


def test_a_bowl_with_a_small_foot_is_not_rotated(tmp_path):
    ball = trimesh.creation.icosphere(4, 0.05)
    ball.update_faces(ball.triangles_center[:, 2] < 0)
    ball.remove_unreferenced_vertices()
    user_object = read_user_object(saved(ball, tmp_path / "bowl.obj"))
    assert np.ptp(user_object.model.vertices_m, axis=0) == pytest.approx([0.1, 0.1, 0.05], abs=2e-3)
    assert user_object.notes[0].startswith("up: z")


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_given_axis_points_up_and_nothing_is_mirrored(tmp_path, up):
    corner = trimesh.Trimesh(
        [[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    )
    path = saved(corner, tmp_path / "corner.ply")
    vertices_m = read_user_object(path, up=up).model.vertices_m
    expected_height_m = corner.vertices @ (np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1))
    assert vertices_m[:, 2] == pytest.approx(expected_height_m, abs=1e-6)
    assert trimesh.Trimesh(vertices_m, corner.faces).volume == pytest.approx(corner.volume, rel=1e-4)


@pytest.mark.parametrize(("scale", "says"), [(1000, "--unit mm makes it 10 cm"), (150, "--unit cm makes it 15 cm")])
def test_the_error_of_an_implausible_size_suggests_a_unit(tmp_path, scale, says):
    path = saved(MUG, tmp_path / "mug.stl", scale)
    with pytest.raises(BadInput, match=says):
        read_user_object(path)


def test_a_given_unit_is_used(tmp_path):
    user_object = read_user_object(saved(MUG, tmp_path / "mug.stl", 1000), unit="mm")
    assert np.ptp(user_object.model.vertices_m, axis=0) == pytest.approx([0.08, 0.08, 0.1], abs=1e-6)
    with pytest.raises(BadInput, match="m, cm, mm, dm, inch"):
        read_user_object(tmp_path / "mug.stl", unit="feet")


def test_a_factor_scales_the_mesh_about_its_origin_and_the_size_is_checked_after_it(tmp_path):
    path = saved(MUG, tmp_path / "mug.obj")
    plain, scaled = (read_user_object(path, factor=factor).model for factor in (1.0, 1.5))
    np.testing.assert_allclose(scaled.vertices_m, 1.5 * plain.vertices_m)
    np.testing.assert_allclose(plain.scaled(1.5).vertices_m, scaled.vertices_m)
    with pytest.raises(BadInput, match=r"a longest side of 0.005 to 2 m, got 3 m"):
        read_user_object(path, factor=30)


def test_the_second_of_two_pieces_rotates_about_the_hinge(tmp_path):
    base, lid = trimesh.creation.box((200, 150, 40)), trimesh.creation.box((200, 150, 20))
    lid.apply_translation([0, 0, 31])
    path = saved(trimesh.util.concatenate([base, lid]), tmp_path / "box.obj", transform=Y_UP)
    model = read_user_object(path, unit="mm", up="y", hinge="0,25,-75 2,0,0").model
    assert model.hinge is not None
    assert model.hinge.origin_m == pytest.approx([0, 0.075, 0.025], abs=1e-9)
    assert model.hinge.axis == pytest.approx([1, 0, 0])
    assert model.vertices_m[model.part == 1, 2].min() == pytest.approx(0.021)
    assert model.vertices_m[model.part == 0, 2].max() == pytest.approx(0.02)


@pytest.mark.parametrize("name", ["box.obj", "box.glb"])
def test_a_lid_may_lie_on_its_box(tmp_path, name):
    """Their corners coincide; the file has two pieces all the same."""
    base, lid = trimesh.creation.box((0.2, 0.15, 0.04)), trimesh.creation.box((0.2, 0.15, 0.02))
    lid.apply_translation([0, 0, 0.03])
    trimesh.Scene({"bottom": base, "lid": lid}).export(tmp_path / name)
    model = read_user_object(tmp_path / name, up="z", hinge="0,0.075,0.02 1,0,0").model
    assert len(model.faces) == 24
    assert model.vertices_m[model.part == 1, 2].min() == pytest.approx(0.02, abs=1e-6)
    assert model.vertices_m[model.part == 0, 2].max() == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize(("direction", "is_reported"), [("-1,0,0", False), ("1,0,0", True), ("0,0,1", False)])
def test_a_hinge_that_rotates_the_lid_into_its_box_is_reported(tmp_path, direction, is_reported):
    """Turned the other way, or aside like the lid of a tin, nothing is said."""
    base, lid = trimesh.creation.box((0.2, 0.15, 0.04)), trimesh.creation.box((0.2, 0.15, 0.02))
    lid.apply_translation([0, 0, 0.031])
    path = saved(trimesh.util.concatenate([base, lid]), tmp_path / "box.obj")
    notes = read_user_object(path, up="z", hinge=f"0,0.075,0.02 {direction}").notes
    assert any("turn its direction round" in note for note in notes) == is_reported


@pytest.mark.parametrize("hinge", ["0,0,0", "0,0,0 0,0,0", "a,b,c 1,0,0", "0,0,0 1,0,nan"])
def test_an_invalid_hinge_is_refused_with_an_example(tmp_path, hinge):
    with pytest.raises(BadInput, match="--hinge"):
        read_user_object(saved(MUG, tmp_path / "mug.obj"), hinge=hinge)


def test_a_hinge_needs_two_pieces(tmp_path):
    with pytest.raises(BadInput, match="two separate pieces"):
        read_user_object(saved(MUG, tmp_path / "mug.obj"), hinge="0,0,0 1,0,0")


@pytest.mark.parametrize(
    ("hinge", "unit", "remedy"),
    [
        ("0,7.5,2 -1,0,0", "", "in the mesh's unit (m); if it is in cm, write 0,0.075,0.02"),
        ("0,75,20 -1,0,0", "m", "if it is in mm, write 0,0.075,0.02"),
        ("0,75,20 -1,0,0", "cm", "in the mesh's unit (cm); if it is in mm, write 0,7.5,2"),
        ("0,1e9,0 -1,0,0", "", "in the mesh's unit (m)"),
        ("0,0.5,0 -1,0,0", "", ""),  # 42 cm from a mesh of 26 cm
        ("0,0.3,0 -1,0,0", "", None),
        ("9,0.075,0.02 -1,0,0", "", None),  # any point on the axis
    ],
)
def test_an_axis_far_from_the_mesh_is_refused_with_the_unit_that_fits(tmp_path, hinge, unit, remedy):
    base, lid = trimesh.creation.box((0.2, 0.15, 0.04)), trimesh.creation.box((0.2, 0.15, 0.02))
    lid.apply_translation([0, 0, 0.031])
    path = saved(trimesh.util.concatenate([base, lid]), tmp_path / "box.obj", scale=100 if unit == "cm" else 1)
    if remedy is None:
        assert read_user_object(path, unit=unit, up="z", hinge=hinge).model.is_articulated
        return
    with pytest.raises(BadInput, match=r"--hinge: expected an axis within (0\.257 m|25\.7 cm)") as error:
        read_user_object(path, unit=unit, up="z", hinge=hinge)
    assert remedy in str(error.value)


def pieces_of_boxes(*corners_m):
    """Boxes of 2 cm at these corners, in one mesh."""
    boxes = [trimesh.creation.box((0.02, 0.02, 0.02)).apply_translation(corner) for corner in corners_m]
    return trimesh.util.concatenate(boxes)


BODY = pieces_of_boxes([0, 0, 0], [0.1, 0, 0], [0, 0.1, 0])  # a tray and two feet
LID = pieces_of_boxes([0, 0, 0.05], [0, 0, 0.1])  # a plate and its knob


def obj_text(letter="o", names=("body", "lid"), faces="f {} {} {}\n", start=1):
    text = ""
    for name, piece in zip(names, (BODY, LID), strict=True):
        text += f"{letter} {name}\n" if name else ""
        text += "".join(f"v {x} {y} {z}\n" for x, y, z in piece.vertices.tolist())
        text += "".join(faces.format(*face) for face in (piece.faces + start).tolist())
        start += len(piece.vertices)
    return text


def stl_text(names=("body", "lid")):
    pieces = zip(names, (BODY, LID), strict=True)
    return "".join(trimesh.exchange.stl.export_stl_ascii(mesh).replace("solid ", f"solid {name}", 1).replace(
        "solid\n", f"solid {name}\n") for name, mesh in pieces)  # fmt: skip


def parts_of(path):
    """Least and greatest height of both parts, in the file's axes."""
    model = read_user_object(path, up="z", hinge="0,-0.1,0.04 1,0,0").model
    return [(vertices[:, 2].min().round(6), vertices[:, 2].max().round(6)) for vertices in
            (model.vertices_m[model.faces_of(part)].reshape(-1, 3) for part in (0, 1))]  # fmt: skip


TWO_PARTS = [(-0.01, 0.01), (0.04, 0.11)]
NAMED = {
    "objects.obj": obj_text,
    "objects of corners with normals.obj": lambda: obj_text(faces="f {}//1 {}//1 {}//1\n"),
    "groups.obj": lambda: obj_text("g"),
    "groups within one object.obj": lambda: "o box\n" + obj_text("g", ("body outside", "lid")),
    "one name comes twice.obj": lambda: obj_text().replace("f 5 ", "o lid\no body\nf 5 ", 1),
    "many groups in two objects.obj": lambda: obj_text(faces="g {0}\nf {0} {1} {2}\n"),
    "first without a name.obj": lambda: obj_text(names=("", "lid")),
    "solids.stl": stl_text,
}


@pytest.mark.parametrize("name", NAMED)
def test_named_pieces_are_the_two_parts_with_any_number_of_shells(tmp_path, name):
    (tmp_path / name).write_text(NAMED[name]())
    assert parts_of(tmp_path / name) == TWO_PARTS


def test_two_nodes_of_a_glb_are_the_two_parts(tmp_path):
    trimesh.Scene({"body": BODY, "lid": LID}).export(tmp_path / "box.glb")
    assert parts_of(tmp_path / "box.glb") == TWO_PARTS


def test_a_lid_of_several_nodes_under_one_node_is_a_part(tmp_path):
    scene = trimesh.Scene()
    for name, piece in (("body", BODY), ("lid", None)):
        scene.add_geometry(piece, name, name) if piece else scene.graph.update("lid", "world")
    for number, piece in enumerate(LID.split()):
        scene.add_geometry(piece, f"piece {number}", f"piece {number}", parent_node_name="lid")
    scene.export(tmp_path / "box.glb")
    assert parts_of(tmp_path / "box.glb") == TWO_PARTS


def test_the_children_of_a_node_move_with_it_at_any_depth(tmp_path):
    scene, (plate, knob) = trimesh.Scene(), LID.split()
    scene.add_geometry(BODY, "body", "body")
    scene.add_geometry(plate, "lid", "lid", parent_node_name="body")
    scene.graph.update("stem", "lid")  # a node without a mesh
    scene.add_geometry(knob, "knob", "knob", parent_node_name="stem")
    scene.export(tmp_path / "box.glb")
    user = read_user_object(tmp_path / "box.glb", up="z", hinge="0,-0.1,0.04 1,0,0", moving="lid")
    assert user.notes[0] == "'lid, knob' turns about the hinge, 'body' stays"
    assert user.model.vertices_m[user.model.part == 1, 2].max() == pytest.approx(0.11)
    knob_moves = read_user_object(tmp_path / "box.glb", up="z", hinge="0,-0.1,0.04 1,0,0", moving="stem")
    assert knob_moves.notes[0] == "'knob' turns about the hinge, 'body, lid' stays"
    with pytest.raises(BadInput, match="names of some pieces"):  # nothing would stay
        read_user_object(tmp_path / "box.glb", up="z", hinge="0,-0.1,0.04 1,0,0", moving="body")


def test_pieces_that_share_vertices_are_cut_apart_where_their_names_change(tmp_path):
    """A cover that is one surface with its back: each part gets separate vertices along the fold."""
    corners = "v 0 0 0\nv 0.1 0 0\nv 0.1 0.1 0\nv 0 0.1 0\nv 0.1 0.2 0.01\nv 0 0.2 0.01\n"
    (tmp_path / "cover.obj").write_text(corners + "g back\nf 1 2 3 4\ng front\nf 4 3 5 6\n")
    model = read_user_object(tmp_path / "cover.obj", up="z", hinge="0,0.1,0 1,0,0").model
    assert np.bincount(model.part).tolist() == [4, 4]
    assert [model.vertices_m[model.faces_of(part)][..., 1].max().round(6) for part in (0, 1)] == [0.1, 0.2]


def test_the_names_of_moving_and_fixed_piece_are_reported(tmp_path):
    (tmp_path / "box.obj").write_text(obj_text())
    notes = read_user_object(tmp_path / "box.obj", up="z", hinge="0,-0.1,0.04 1,0,0").notes
    assert "'lid' turns about the hinge, 'body' stays" in notes
    two = saved(pieces_of_boxes([0, 0, 0], [0, 0, 0.03]), tmp_path / "two.ply")
    note = "the second of two pieces without names of their own, with its centre at 0, 0, 0.03 in the file, turns"
    assert note in read_user_object(two, up="z", hinge="0,0,0.01 1,0,0").notes[0]


def test_without_names_of_two_parts_the_shells_are_counted(tmp_path):
    (tmp_path / "box.obj").write_text(obj_text(names=("box", "box")))
    with pytest.raises(BadInput, match="two separate pieces for --hinge, got 5 shells; export a base and what moves"):
        parts_of(tmp_path / "box.obj")
    (tmp_path / "box.obj").write_text(obj_text().replace("f 5 ", "o foot\nf 5 ", 1))
    with pytest.raises(BadInput, match="got 3 objects, 5 shells"):
        parts_of(tmp_path / "box.obj")


def test_the_two_pieces_of_a_mesh_are_named_and_a_mesh_of_one_or_three_has_none(tmp_path):
    (tmp_path / "box.obj").write_text(obj_text())
    assert piece_names(tmp_path / "box.obj") == ("body", "lid")
    saved(pieces_of_boxes([0, 0, 0], [0.1, 0, 0]), tmp_path / "two.ply")
    assert piece_names(tmp_path / "two.ply") == ("", "")
    for corners in ([[0, 0, 0]], [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]):
        assert piece_names(saved(pieces_of_boxes(*corners), tmp_path / "other.ply")) is None


def test_a_binary_stl_may_begin_with_the_word_of_a_text(tmp_path):
    data = bytearray(MUG.export(file_type="stl"))
    data[:80] = b"solid mug".ljust(80)
    (tmp_path / "mug.stl").write_bytes(data)
    assert len(read_mesh_file(tmp_path / "mug.stl").faces) == len(MUG.faces)


@pytest.mark.parametrize(("old", "new"), [("endsolid", "end"), ("vertex", "vertec"), ("vertex ", "vertex a")])
def test_a_text_of_an_stl_file_with_a_fault_is_refused(tmp_path, old, new):
    (tmp_path / "mug.stl").write_text(new.join(trimesh.exchange.stl.export_stl_ascii(MUG).rsplit(old, 1)))
    with pytest.raises(BadInput, match=r"mug\.stl"):
        read_mesh_file(tmp_path / "mug.stl")


def test_other_mesh_formats_are_refused_with_those_that_are_read(tmp_path):
    MUG.export(tmp_path / "mug.off")
    with pytest.raises(BadInput, match=r"expected a mesh named \.obj, \.ply, \.stl or \.glb, got \.off"):
        read_user_object(tmp_path / "mug.off")


def test_the_vertices_of_a_glb_stay_joined_along_its_seams_wherever_its_nodes_put_it(tmp_path):
    """Stored with one normal per face, so that all corners are repeated; a rotation must not separate them."""
    box = trimesh.creation.icosphere(4, 0.05)
    box.unmerge_vertices()
    transform = trimesh.transformations.rotation_matrix(0.7, [3, -1, 2], [0.1, 0.2, 0.3])
    scene = trimesh.Scene()
    scene.add_geometry(box, transform=transform)
    scene.export(tmp_path / "ball.glb")
    assert len(read_mesh_file(tmp_path / "ball.glb").vertices) == len(trimesh.creation.icosphere(4, 0.05).vertices)


@pytest.mark.parametrize("suffix", [".stl", ".glb"])
def test_damaged_files_are_refused_by_name(tmp_path, suffix):
    path = saved(MUG, tmp_path / f"mug{suffix}")
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(BadInput, match=f"mug{suffix}"):
        read_user_object(path)


def test_a_thinned_mesh_keeps_its_outline():
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.05)
    from hoidata.objects.model import ObjectModel

    model = ObjectModel("ball", ball.vertices, ball.faces, np.zeros(len(ball.vertices), np.uint8))
    thin = thinned(model, 20_000)
    assert 2_000 < len(thin.faces) <= 20_000
    assert np.linalg.norm(thin.vertices_m, axis=1) == pytest.approx(0.05, abs=1e-6)
    assert thinned(thin, 20_000) is thin
