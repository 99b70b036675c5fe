"""What meshes enclose: cavities, holes, doubled surfaces, shells; depths against formulas."""

import gzip
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from hoidata.errors import BadInput
from hoidata.objects.distance import volume_m3
from hoidata.objects.mesh import parse_obj
from hoidata.objects.model import ObjectModel
from hoidata.objects.solid import NoSolid, Solid, patched_holes, solid_of
from hoidata.objects.surface_index import SurfaceIndex
from tests.builders.objects import model_of

ROOT = os.environ.get("HOIDATA_MANIPNET", "")
OUTER_M, INNER_M, HEIGHT_M, FLOOR_M, SECTIONS = 0.04, 0.035, 0.1, 0.008, 720
AT_ONCE, NEVER = 0, 10**12


def solid_index(vertices: np.ndarray, faces: np.ndarray, grid_after: int = NEVER) -> SurfaceIndex:
    return SurfaceIndex(model_of(trimesh.Trimesh(vertices, faces, process=False)), grid_after)


def analytic_mug() -> trimesh.Trimesh:
    """A cylinder with a cylindrical cavity open to the top; so many sections that its walls are round to 0.4 um."""
    profile = [(0, 0), (OUTER_M, 0), (OUTER_M, HEIGHT_M), (INNER_M, HEIGHT_M), (INNER_M, FLOOR_M), (0, FLOOR_M)]
    return trimesh.creation.revolve(np.array(profile), sections=SECTIONS)


def mug_depth(places: np.ndarray) -> np.ndarray:
    """How deep a place lies in the material, by the formula of the mug's profile in (radius, height)."""
    radius, height = np.hypot(places[:, 0], places[:, 1]), places[:, 2]
    in_wall = (radius > INNER_M) & (radius < OUTER_M) & (height > 0) & (height < HEIGHT_M)
    in_floor = (radius <= INNER_M) & (height > 0) & (height < FLOOR_M)
    edges = [((0, 0), (OUTER_M, 0)), ((OUTER_M, 0), (OUTER_M, HEIGHT_M)), ((OUTER_M, HEIGHT_M), (INNER_M, HEIGHT_M))]
    edges += [((INNER_M, HEIGHT_M), (INNER_M, FLOOR_M)), ((INNER_M, FLOOR_M), (0, FLOOR_M))]
    points, distance = np.stack([radius, height], axis=1), np.full(len(places), np.inf)
    for start, stop in edges:
        edge = np.subtract(stop, start)
        along = np.clip((points - start) @ edge / (edge @ edge), 0, 1)
        distance = np.minimum(distance, np.linalg.norm(points - start - along[:, None] * edge, axis=1))
    return np.where(in_wall | in_floor, distance, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("grid_after", [AT_ONCE, NEVER], ids=["grid", "no grid"])
def test_the_cavity_of_a_mug_is_outside_and_its_wall_inside(grid_after: int) -> None:
    mug, rng = analytic_mug(), np.random.default_rng(0)
    index = solid_index(mug.vertices, mug.faces, grid_after)
    assert index.repair_note is None
    places = rng.uniform((-0.05, -0.05, -0.01), (0.05, 0.05, 0.11), (20_000, 3))
    expected = mug_depth(places)
    assert (expected > 0).sum() > 1000
    np.testing.assert_allclose(index.depth_m(places[None], None)[0], expected, atol=5e-7)
    cavity = (np.hypot(places[:, 0], places[:, 1]) < INNER_M - 1e-5) & (places[:, 2] > FLOOR_M)
    assert cavity.sum() > 2000
    np.testing.assert_array_equal(index.depth_m(places[None], None)[0][cavity], 0)


def test_lines_through_edges_and_corners_keep_their_count() -> None:
    """Points in line with edges and corners of a box, so that the line along x runs along edges and through corners."""
    box = trimesh.creation.box((0.5, 0.5, 0.5))
    steps = np.array([-0.375, -0.25, 0.0, 0.25, 0.375])
    places = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    for grid_after in (AT_ONCE, NEVER):
        depth = solid_index(box.vertices, box.faces, grid_after).depth_m(places[None], None)[0]
        np.testing.assert_allclose(depth, np.maximum(0.25 - np.abs(places).max(axis=1), 0), atol=1e-15)


def test_a_line_through_the_tips_of_an_octahedron_enters_and_leaves_it_once() -> None:
    tips = 0.25 * np.concatenate([np.eye(3), -np.eye(3)])
    hull = trimesh.Trimesh(tips, process=False).convex_hull
    places = np.array([[0.1, 0, 0], [-0.2, 0, 0], [0.3, 0, 0], [0, 0.125, 0], [0, 0.125, 0.0625], [-0.3, 0, 0]])
    for grid_after in (AT_ONCE, NEVER):
        depth = solid_index(hull.vertices, hull.faces, grid_after).depth_m(places[None], None)[0]
        expected = np.maximum(0.25 - np.abs(places).sum(axis=1), 0) / np.sqrt(3)
        np.testing.assert_allclose(depth, expected, atol=1e-15)


def test_overlapping_shells_are_one_solid_and_an_inverted_shell_is_a_cavity() -> None:
    one, two = trimesh.creation.box((0.2, 0.1, 0.1)), trimesh.creation.box((0.2, 0.1, 0.1))
    two.vertices += (0.1, 0.0201, 0.0101)
    hollow = trimesh.creation.box((0.4, 0.4, 0.4))
    inner = trimesh.creation.box((0.2, 0.2, 0.2))
    both = trimesh.util.concatenate([one, two])
    vertices = np.concatenate([hollow.vertices, inner.vertices])
    faces = np.concatenate([hollow.faces, inner.faces[:, ::-1] + len(hollow.vertices)])
    rng = np.random.default_rng(1)
    places = rng.uniform(-0.25, 0.25, (5000, 3))
    in_either = sum((np.abs(places - at) < (0.1, 0.05, 0.05)).all(axis=1) for at in ((0, 0, 0), (0.1, 0.0201, 0.0101)))
    in_hollow = (np.abs(places) < 0.2).all(axis=1) & ~(np.abs(places) < 0.1).all(axis=1)
    for grid_after in (AT_ONCE, NEVER):
        depth = solid_index(both.vertices, both.faces, grid_after).depth_m(places[None], None)[0]
        np.testing.assert_array_equal(depth > 0, in_either > 0)
        depth = solid_index(vertices, faces, grid_after).depth_m(places[None], None)[0]
        np.testing.assert_array_equal(depth > 0, in_hollow)


def test_a_small_hole_is_closed_and_reported() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    index = solid_index(sphere.vertices, sphere.faces[1:])
    assert index.repair_note == "object: 1 small hole closed"
    places = np.array([[[0, 0, 0], [0, 0, 0.06], [0, 0, 0.03]]])
    np.testing.assert_allclose(index.depth_m(places, None)[0], [0.05, 0, 0.02], atol=5e-4)
    # The patch is not part of the surface: at the hole, the nearest triangle is next to it.
    middle = sphere.vertices[sphere.faces[0]].mean(axis=0)
    assert index.distance_m(middle[None, None], None)[0, 0] > 0.001


@pytest.mark.slow
def test_a_cup_drawn_as_one_open_sheet_is_refused_with_the_reason() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    bowl = sphere.faces[sphere.triangles_center[:, 2] < 0]
    index = solid_index(sphere.vertices, bowl)
    assert not index.is_solid
    assert index.repair_note == "object has no inside: it is open"
    with pytest.raises(BadInput, match=r"encloses a solid.*it is open"):
        index.depth_m(np.zeros((1, 1, 3)), None)
    assert index.within(np.array([[[0, 0, -0.052]]]), None, 0.005)[0, 0]


def test_a_flat_mesh_is_refused() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    sides = np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])
    assert isinstance(solid_of(square, sides), NoSolid)
    assert isinstance(solid_of(square, sides[:2]), NoSolid)


def test_a_surface_drawn_once_for_each_side_becomes_the_solid_inside_it() -> None:
    """As ManipNet's mug2."""
    torus = trimesh.creation.torus(0.05, 0.02)
    for faces in (torus.faces, torus.faces[:, ::-1]):
        solid = solid_of(np.array(torus.vertices), np.concatenate([faces, faces[::-1, ::-1]]))
        assert isinstance(solid, Solid)
        assert solid.repairs.startswith(f"{len(torus.faces)} triangles that lay double left out")
        assert volume_m3(solid.vertices_m, solid.faces) == pytest.approx(torus.volume, rel=1e-12)
        assert not solid.patched


@pytest.mark.parametrize(
    ("which", "said"),
    [(slice(None), "triangles turned outward"), (slice(0, None, 3), "neighbouring triangles turned alike")],
    ids=["inside out", "unevenly turned"],
)
def test_inverted_triangles_are_flipped_and_reported(which: slice, said: str) -> None:
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    faces = np.array(box.faces)
    faces[which] = faces[which, ::-1]
    solid = solid_of(np.array(box.vertices), faces)
    assert isinstance(solid, Solid)
    assert solid.repairs.startswith(said)
    assert volume_m3(solid.vertices_m, solid.faces) == pytest.approx(0.006)


@pytest.mark.parametrize(("wall_m", "is_solid"), [(1e-4, True), (1e-5, False)])
def test_a_cup_as_thin_as_paper_is_solid_and_two_sheets_a_hundredth_of_a_millimetre_apart_are_not(
    wall_m, is_solid
) -> None:
    profile = [(0, 0), (0.04, 0), (0.04, 0.1), (0.04 - wall_m, 0.1), (0.04 - wall_m, wall_m), (0, wall_m)]
    cup = trimesh.creation.revolve(np.array(profile))
    solid = solid_of(np.array(cup.vertices), np.array(cup.faces))
    assert isinstance(solid, Solid) if is_solid else solid == NoSolid("it encloses nothing")


def test_a_thin_rod_askew_is_solid_though_it_fills_less_than_a_thousandth_of_its_box() -> None:
    rod = trimesh.creation.box((0.002, 0.002, 0.4))
    rod.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), (1, 1, 1)))
    assert rod.volume < 1e-3 * rod.extents.prod() / 2
    assert isinstance(solid_of(np.array(rod.vertices), np.array(rod.faces)), Solid)


def test_a_closed_surface_with_one_side_only_is_refused() -> None:
    """The projective plane of six corners: each edge has two triangles, but they cannot all be turned alike."""
    corners = np.random.default_rng(0).normal(size=(6, 3))
    corner = "012 023 034 045 051 124 235 341 452 513"
    faces = [[int(digit) for digit in face] for face in corner.split()]
    assert solid_of(corners, np.array(faces)) == NoSolid("its triangles do not meet at their edges two by two")


def test_triangles_that_do_not_meet_two_by_two_are_refused() -> None:
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    fin = np.concatenate([box.vertices, [[0.5, 0.5, 0.5]]])
    solid = solid_of(fin, np.concatenate([box.faces, [[box.faces[0, 0], box.faces[0, 1], 8]]]))
    assert isinstance(solid, NoSolid)


def test_any_hole_can_be_closed_by_a_fan_in_every_pose() -> None:
    tube = trimesh.creation.cylinder(0.03, 0.1, sections=64)
    open_faces = tube.faces[np.abs(tube.face_normals[:, 2]) < 0.5]
    poses = np.stack([tube.vertices, 2 * tube.vertices])
    places, closed = patched_holes(poses, open_faces)
    for scale, queries in zip((1, 8), places, strict=True):
        assert volume_m3(queries, closed) == pytest.approx(scale * tube.volume, rel=1e-9)


@pytest.mark.skipif(not ROOT, reason="HOIDATA_MANIPNET is not set: the meshes are not part of this repository")
def test_manipnet_s_open_cup_and_doubled_mug_are_repaired() -> None:
    said = {}
    for name in ("cup1", "mug2", "mug1"):
        path = Path(ROOT) / f"objects/Dining/{name}.obj.gz"
        mesh = parse_obj(gzip.decompress(path.read_bytes()).decode(), path)
        model = ObjectModel(name, 0.1 * mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), np.uint8))
        said[name] = SurfaceIndex(model).repair_note
    assert said["cup1"] == "cup1: 1 small hole closed"
    assert said["mug2"] == "mug2: 3320 triangles that lay double left out"
    assert said["mug1"] is None
