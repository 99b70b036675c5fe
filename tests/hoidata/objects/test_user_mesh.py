"""A person's own mesh: its unit, which way is up and its hinge are told, or found and said."""

import numpy as np
import pytest
import trimesh

from hoidata.errors import BadInput
from hoidata.objects.user_mesh import read_user_object, thinned

MUG = trimesh.creation.cylinder(radius=0.04, height=0.1, sections=48)
Y_UP = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])


def saved(mesh, path, scale=1.0, turn=None):
    mesh = mesh.copy()
    mesh.apply_scale(scale)
    if turn is not None:
        mesh.apply_transform(turn)
    mesh.export(path)
    return path


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl"])
def test_a_mesh_that_stands_on_z_is_taken_as_it_is(tmp_path, suffix):
    found = read_user_object(saved(MUG, tmp_path / f"mug{suffix}"))
    assert np.ptp(found.model.vertices_m, axis=0) == pytest.approx([0.08, 0.08, 0.1], abs=1e-6)
    assert "z is taken for up" in found.notes[0]


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_a_mesh_that_stands_on_y_is_stood_upright(tmp_path, suffix):
    found = read_user_object(saved(MUG, tmp_path / f"mug{suffix}", turn=Y_UP))
    assert np.ptp(found.model.vertices_m, axis=0) == pytest.approx([0.08, 0.08, 0.1], abs=1e-6)
    assert found.notes[0].startswith("y is")


def test_a_glass_with_a_narrow_foot_is_stood_upright(tmp_path):
    glass = trimesh.creation.revolve([[0, 0], [0.012, 0], [0.002, 0.01], [0.002, 0.08], [0.04, 0.12], [0, 0.12]])
    found = read_user_object(saved(glass, tmp_path / "glass.obj", turn=Y_UP))
    assert np.ptp(found.model.vertices_m, axis=0) == pytest.approx([0.08, 0.08, 0.12], abs=2e-3)
    assert found.notes[0].startswith("y is taken for up: so it stands on 9% of its outline")


def test_a_bowl_that_stands_on_little_is_not_laid_on_its_side(tmp_path):
    ball = trimesh.creation.icosphere(4, 0.05)
    ball.update_faces(ball.triangles_center[:, 2] < 0)
    ball.remove_unreferenced_vertices()
    found = read_user_object(saved(ball, tmp_path / "bowl.obj"))
    assert np.ptp(found.model.vertices_m, axis=0) == pytest.approx([0.1, 0.1, 0.05], abs=2e-3)
    assert found.notes[0].startswith("z is taken for up")


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_axis_told_points_up_and_nothing_is_mirrored(tmp_path, up):
    corner = trimesh.Trimesh(
        [[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    )
    path = saved(corner, tmp_path / "corner.ply")
    found = read_user_object(path, up=up).model.vertices_m
    told = corner.vertices @ (np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1))
    assert found[:, 2] == pytest.approx(told, abs=1e-6)
    assert trimesh.Trimesh(found, corner.faces).volume == pytest.approx(corner.volume, rel=1e-4)


@pytest.mark.parametrize(("scale", "says"), [(1000, "--unit mm makes it 10 cm"), (150, "--unit cm makes it 15 cm")])
def test_a_size_that_cannot_be_meant_names_the_likely_unit(tmp_path, scale, says):
    path = saved(MUG, tmp_path / "mug.stl", scale)
    with pytest.raises(BadInput, match=says):
        read_user_object(path)


def test_a_unit_that_is_told_is_used(tmp_path):
    found = read_user_object(saved(MUG, tmp_path / "mug.stl", 1000), unit="mm")
    assert np.ptp(found.model.vertices_m, axis=0) == pytest.approx([0.08, 0.08, 0.1], abs=1e-6)
    with pytest.raises(BadInput, match="m, cm, mm, dm, inch"):
        read_user_object(tmp_path / "mug.stl", unit="feet")


def test_the_second_of_two_pieces_turns_about_the_hinge(tmp_path):
    base, lid = trimesh.creation.box((200, 150, 40)), trimesh.creation.box((200, 150, 20))
    lid.apply_translation([0, 0, 31])
    path = saved(trimesh.util.concatenate([base, lid]), tmp_path / "box.obj", turn=Y_UP)
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


@pytest.mark.parametrize(("direction", "told"), [("-1,0,0", False), ("1,0,0", True), ("0,0,1", False)])
def test_a_hinge_that_turns_the_lid_into_its_box_is_told(tmp_path, direction, told):
    """Turned the other way, or aside like the lid of a tin, nothing is said."""
    base, lid = trimesh.creation.box((0.2, 0.15, 0.04)), trimesh.creation.box((0.2, 0.15, 0.02))
    lid.apply_translation([0, 0, 0.031])
    path = saved(trimesh.util.concatenate([base, lid]), tmp_path / "box.obj")
    notes = read_user_object(path, up="z", hinge=f"0,0.075,0.02 {direction}").notes
    assert any("turn its direction round" in note for note in notes) == told


@pytest.mark.parametrize("hinge", ["0,0,0", "0,0,0 0,0,0", "a,b,c 1,0,0", "0,0,0 1,0,nan"])
def test_a_hinge_that_is_none_is_refused_with_an_example(tmp_path, hinge):
    with pytest.raises(BadInput, match="--hinge"):
        read_user_object(saved(MUG, tmp_path / "mug.obj"), hinge=hinge)


def test_a_hinge_needs_two_pieces(tmp_path):
    with pytest.raises(BadInput, match="two separate pieces"):
        read_user_object(saved(MUG, tmp_path / "mug.obj"), hinge="0,0,0 1,0,0")


@pytest.mark.parametrize("suffix", [".stl", ".glb"])
def test_damaged_files_are_refused_by_name(tmp_path, suffix):
    path = saved(MUG, tmp_path / f"mug{suffix}")
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(BadInput, match=f"mug{suffix}"):
        read_user_object(path)


def test_a_glb_cannot_make_the_reader_open_another_file(tmp_path):
    (tmp_path / "secret.bin").write_bytes(b"\0" * 64)
    path = saved(MUG, tmp_path / "mug.glb")
    data = path.read_bytes().replace(b'"buffers":[{', b'"buffers":[{"uri":"secret.bin",')
    path.write_bytes(data)
    with pytest.raises(BadInput):
        read_user_object(path)


def test_a_thinned_mesh_keeps_its_outline():
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.05)
    from hoidata.objects.model import ObjectModel

    model = ObjectModel("ball", ball.vertices, ball.faces, np.zeros(len(ball.vertices), np.uint8))
    thin = thinned(model, 20_000)
    assert 2_000 < len(thin.faces) <= 20_000
    assert np.linalg.norm(thin.vertices_m, axis=1) == pytest.approx(0.05, abs=1e-6)
    assert thinned(thin, 20_000) is thin
