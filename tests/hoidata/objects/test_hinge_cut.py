"""One closed mesh whose vertices belong to two parts: each part is closed at the cut, the seam belongs to neither."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from hoidata.objects.distance import is_closed, merged_surface, volume_m3
from hoidata.objects.mesh import load_mesh
from hoidata.objects.model import SEAM, Hinge, ObjectModel
from hoidata.objects.sampling import sample_points
from hoidata.objects.signed_distance_grid import DistanceFields
from hoidata.objects.solid import Solid, patched_holes
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.physics.capsules import Capsules, ObjectPoses, capsule_contacts
from hoidata.quality.measures import ObjectFacts, object_row

ARCTIC = os.environ.get("HOIDATA_ARCTIC", "")
ALONG_X = Hinge(np.array([1.0, 0.0, 0.0]), np.array([0.0, -0.05, 0.0]))
SIDE_M, LAYERS = 0.1, 8
LAYER_M = SIDE_M / LAYERS


def divided_cube(holes_m: float = 0.0) -> ObjectModel:
    """A closed cube of 10 cm about the origin in 8 layers along z; vertices above the middle belong to the lid."""
    box = trimesh.creation.box((SIDE_M, SIDE_M, SIDE_M))
    for _ in range(3):
        box = box.subdivide()
    part = (box.vertices[:, 2] > holes_m + 1e-9).astype(np.uint8)
    return ObjectModel("cube", np.array(box.vertices), np.array(box.faces), part=part, hinge=ALONG_X)


def split_vertices(model: ObjectModel) -> ObjectModel:
    """The same surface with separate vertices for each triangle, as in files with texture seams."""
    rows = model.faces.reshape(-1)
    part = model.part[rows]
    return replace(model, vertices_m=model.vertices_m[rows], part=part, faces=np.arange(len(rows)).reshape(-1, 3))


def test_triangles_between_two_parts_belong_to_neither() -> None:
    faces = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]])
    model = ObjectModel("strip", np.zeros((6, 3)), faces, part=np.array([0, 0, 0, 1, 1, 1], np.uint8), hinge=ALONG_X)
    assert model.face_part.tolist() == [0, SEAM, SEAM, 1]
    assert (model.seam_triangles, model.parts) == (2, [0, 1])
    assert replace(model, hinge=None).seam_triangles == 0


def test_corners_of_every_triangle_of_a_part_move_with_that_part() -> None:
    model = divided_cube()
    assert model.seam_triangles == 4 * LAYERS * 2
    for part in model.parts:
        assert set(model.part[model.faces_of(part)].reshape(-1)) == {part}


@pytest.mark.parametrize("model", [divided_cube(), split_vertices(divided_cube())], ids=["shared", "split vertices"])
def test_a_cut_of_any_size_is_closed(model: ObjectModel) -> None:
    """The cut has 16 % of a part's surface. The base ends at the middle, the lid begins a layer above it."""
    expected = {0: SIDE_M**2 * SIDE_M / 2, 1: SIDE_M**2 * (SIDE_M / 2 - LAYER_M)}
    for part, volume in expected.items():
        solid = model.solids[part]
        assert isinstance(solid, Solid)
        assert volume_m3(solid.vertices_m, solid.faces) == pytest.approx(volume)
        assert is_closed(merged_surface(*model.closed_parts[part]).faces)


def test_the_closing_triangles_affect_depths_but_not_distances() -> None:
    index = SurfaceIndex(divided_cube())
    cut, below = np.array([[[0.0, 0.0, 0.0]]]), np.array([[[0.0, 0.0, -0.01]]])
    closed = np.zeros(1)
    assert index.distance_m(cut, closed)[0, 0] == pytest.approx(SIDE_M / 2)
    assert index.depth_m(below, closed)[0, 0] == pytest.approx(0.01)
    assert index.repair_note == "part 0 of cube: cut at the hinge closed; part 1 of cube: cut at the hinge closed"


def test_inside_the_moving_part_follows_the_hinge() -> None:
    index = SurfaceIndex(divided_cube())
    local = np.array([[0.0, 0.0, 0.03]])  # in the lid, 1.75 cm above its cut
    angles = np.array([0.0, 1.0, 2.0])
    positions = ALONG_X.turn(angles) @ np.broadcast_to(local, (3, 1, 3))
    np.testing.assert_allclose(index.depth_m(positions, angles)[:, 0], 0.03 - LAYER_M, atol=1e-9)
    assert index.depth_m(local[None], np.array([2.0]))[0, 0] == 0


def test_a_hole_elsewhere_stays_open() -> None:
    model = divided_cube()
    bottom = (model.vertices_m[model.faces][:, :, 2] < -SIDE_M / 2 + 1e-9).all(axis=1)
    index = SurfaceIndex(replace(model, faces=model.faces[~bottom]))
    assert not isinstance(index.solids[0], Solid)
    assert isinstance(index.solids[1], Solid)
    assert index.repair_note == "part 0 of cube has no inside: it is open; part 1 of cube: cut at the hinge closed"


def test_holes_that_share_a_vertex_are_closed_one_by_one() -> None:
    grid = divided_cube()
    middles = grid.vertices_m[grid.faces].mean(axis=1)
    top = middles[:, 2] > SIDE_M / 2 - 1e-9
    corners = ((middles[:, :2] > 0).all(axis=1) & (middles[:, :2] < LAYER_M).all(axis=1)) | (
        (middles[:, :2] < 0).all(axis=1) & (middles[:, :2] > -LAYER_M).all(axis=1)
    )
    opened = grid.faces[~(top & corners)]
    assert len(grid.faces) - len(opened) == 4  # two squares that meet at the middle of the top
    vertices, faces = patched_holes(grid.vertices_m, opened)
    assert is_closed(faces)
    assert volume_m3(vertices, faces) == pytest.approx(SIDE_M**3)


def test_sampled_points_keep_off_triangles_that_span_both_parts() -> None:
    model = divided_cube()
    points = sample_points(model, 512)
    assert points.method == "surface-fps"
    assert not (model.face_part[points.face] == SEAM).any()
    np.testing.assert_array_equal(points.part, model.part[model.faces[points.face, 0]])


def test_masses_of_parts_are_those_of_the_closed_parts() -> None:
    base, lid = divided_cube().masses
    assert [mass.source for mass in (base, lid)] == ["solid", "solid"]
    np.testing.assert_allclose(base.centre_m, (0, 0, -SIDE_M / 4), atol=1e-12)
    np.testing.assert_allclose(lid.centre_m, (0, 0, (SIDE_M / 2 + LAYER_M) / 2), atol=1e-12)


def test_mass_of_a_mesh_with_a_small_hole_is_that_of_the_repaired_solid() -> None:
    model = replace(divided_cube(), hinge=None)
    whole, holed = model.masses[0], replace(model, faces=model.faces[1:]).masses[0]
    assert holed.source == "solid"
    assert holed.volume_m3 == pytest.approx(whole.volume_m3)


def test_the_penetration_loss_takes_the_inside_of_a_closed_part_as_inside() -> None:
    fields = DistanceFields([("cube", divided_cube())], resolution=24)
    places = torch.tensor([[[[0.0, 0.0, -0.01], [0.0, 0.0, 0.03], [0.0, 0.0, 0.006]]]])
    distance, _ = fields.query(torch.tensor([0]), places, torch.zeros(1, 1))
    np.testing.assert_allclose(distance.numpy()[0, 0], (-0.01, LAYER_M - 0.03, 0.006), atol=2e-3)


def test_a_finger_inside_a_cut_part_is_in_contact_with_it() -> None:
    segment = np.array([[[-0.01, 0.0, -0.02]]]), np.array([[[0.01, 0.0, -0.02]]])
    poses = ObjectPoses(np.eye(3)[None], np.zeros((1, 3)), np.zeros(1))
    contacts = capsule_contacts(divided_cube(), poses, Capsules(*segment, np.array([0.005])))
    assert contacts.depth_m == pytest.approx([0.025], abs=1e-6)


def test_quality_counts_the_seam_and_finds_both_parts_solid() -> None:
    facts = object_row(ObjectFacts.of(divided_cube()))
    assert (facts["solid"], facts["watertight"], facts["seam_triangles"]) == (True, True, 64)
    assert facts["open_edge_share"] == 0


@pytest.mark.skipif(not ARCTIC, reason="HOIDATA_ARCTIC is not set: the meshes are not part of this repository")
def test_both_parts_of_every_arctic_object_are_solid_and_fill_the_whole_mesh() -> None:
    """What the parts enclose is what the whole mesh encloses, but for the layer of triangles between them."""
    folders = sorted((Path(ARCTIC) / "meta/object_vtemplates").iterdir())
    assert len(folders) == 11
    for folder in folders:
        mesh, is_base = load_mesh(folder / "mesh.obj"), np.array(json.loads((folder / "parts.json").read_text()), bool)
        part = (~is_base).astype(np.uint8)
        model = ObjectModel(folder.name, mesh.vertices / 1000, mesh.faces, part=part, hinge=ALONG_X)
        assert all(isinstance(solid, Solid) for solid in model.solids.values()), folder.name
        parts = sum(mass.volume_m3 for mass in model.masses)
        whole = abs(volume_m3(*merged_surface(model.vertices_m, model.faces)))
        assert parts == pytest.approx(whole, rel=0.05), folder.name
        assert 0 < model.seam_triangles < 0.04 * len(model.faces)
