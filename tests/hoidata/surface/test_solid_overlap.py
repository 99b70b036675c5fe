"""The volume two solids both fill, against formulas and exact mesh intersections."""

import igl.copyleft.cgal as cgal
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.objects.distance import volume_m3
from hoidata.objects.model import ObjectModel
from hoidata.objects.solid import patched_holes
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.surface.solid_overlap import SolidOverlap
from tests.builders.objects import box_model, model_of, two_parts

HAND = load_embedded_hands().right


def overlap_of(mesh: trimesh.Trimesh, cell_m: float = 0.001) -> SolidOverlap:
    return SolidOverlap(SurfaceIndex(model_of(mesh)), cell_m)


def tin() -> ObjectModel:
    """Two plates of 10 x 10 x 2 cm, the upper turned by an edge along y."""
    base, lid = box_model((0.1, 0.1, 0.02)), box_model((0.1, 0.1, 0.02), middle_m=(0, 0, 0.03))
    return two_parts(base, lid, (0, 1, 0), (-0.05, 0, 0.015))


def box_at(size: tuple[float, float, float], middle: tuple[float, float, float]) -> trimesh.Trimesh:
    box = trimesh.creation.box(size)
    box.vertices += middle
    return box


def test_two_boxes_share_the_product_of_their_common_sides() -> None:
    overlap = overlap_of(box_at((0.1, 0.08, 0.06), (0, 0, 0)))
    middles = [(0.03, 0.02, -0.01), (0.0731, 0, 0), (0, 0, 0), (0.11, 0, 0), (0, -0.05, 0.04)]
    other = np.stack([box_at((0.05, 0.04, 0.04), middle).vertices for middle in middles])
    faces = trimesh.creation.box().faces
    expected = []
    for middle in middles:
        half = np.array([0.025, 0.02, 0.02])
        low = np.maximum([-0.05, -0.04, -0.03], np.array(middle) - half)
        high = np.minimum([0.05, 0.04, 0.03], np.array(middle) + half)
        expected.append(np.maximum(high - low, 0).prod())
    np.testing.assert_allclose(overlap.volume_m3(other, faces, None), expected, atol=1e-12)
    assert expected[3] == 0


@pytest.mark.parametrize("cell_m", [0.0005, 0.002])
def test_the_size_of_a_cell_changes_no_volume_that_is_a_whole_number_of_cells(cell_m: float) -> None:
    overlap, inner = overlap_of(box_at((0.1, 0.08, 0.06), (0, 0, 0)), cell_m), box_at((0.05, 0.04, 0.02), (0, 0, 0))
    np.testing.assert_allclose(overlap.volume_m3(inner.vertices[None], inner.faces, None), 4e-5, atol=1e-12)


def test_volumes_in_two_parts_are_added_up() -> None:
    """A bar of 1 cm2 through both plates of 2 cm."""
    model = tin()
    bar = box_at((0.01, 0.01, 0.2), (0.02, 0, 0))
    volume_m3 = SolidOverlap(SurfaceIndex(model)).volume_m3(bar.vertices[None], bar.faces, np.zeros(1))
    np.testing.assert_allclose(volume_m3, 4e-6, atol=1e-12)


def test_two_balls_share_a_lens() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    apart = 0.05
    lens = np.pi / 12 * (4 * 0.04 + apart) * (2 * 0.04 - apart) ** 2
    moved = np.stack([ball.vertices + apart * direction for direction in np.eye(3)])
    np.testing.assert_allclose(overlap_of(ball).volume_m3(moved, ball.faces, None), lens, rtol=0.015)


def test_a_ball_in_the_cavity_of_a_mug_has_no_overlap() -> None:
    profile = [(0, 0), (0.04, 0), (0.04, 0.1), (0.035, 0.1), (0.035, 0.008), (0, 0.008)]
    mug, ball = trimesh.creation.revolve(np.array(profile)), trimesh.creation.icosphere(radius=0.02)
    overlap = overlap_of(mug)
    places = np.stack([ball.vertices + at for at in ([0, 0, 0.05], [0, 0, 0.02], [0.03, 0, 0.05])])
    volumes_m3 = overlap.volume_m3(places, ball.faces, None)
    assert volumes_m3[0] == 0
    assert volumes_m3[1] > 1e-6
    assert volumes_m3[2] > 1e-6


def test_a_surface_that_enters_itself_counts_once() -> None:
    """Two boxes of one surface overlap each other inside a larger one."""
    one, two = box_at((0.04, 0.04, 0.04), (0, 0, 0)), box_at((0.04, 0.04, 0.04), (0.02, 0, 0))
    both = trimesh.util.concatenate([one, two])
    volume = overlap_of(box_at((0.2, 0.2, 0.2), (0, 0, 0))).volume_m3(both.vertices[None], both.faces, None)
    np.testing.assert_allclose(volume, 0.06 * 0.04 * 0.04, atol=1e-12)


def test_a_whole_hand_inside_has_the_hand_s_volume_closed_at_the_wrist() -> None:
    places = HAND.template_m - HAND.template_m.mean(axis=0)
    expected = volume_m3(*patched_holes(places, HAND.faces))
    volume = overlap_of(box_at((0.4, 0.4, 0.4), (0, 0, 0))).volume_m3(places[None], HAND.faces, None)
    # The flat embedded hand does not enter itself, so that both ways to measure agree.
    np.testing.assert_allclose(volume, expected, rtol=2e-3)
    assert 1.5e-4 < expected < 6e-4


def test_the_hand_in_a_torus_has_the_volume_of_the_exact_intersection_of_the_meshes() -> None:
    torus = trimesh.creation.torus(0.05, 0.02, major_sections=24, minor_sections=12)
    overlap = overlap_of(torus)
    places = (HAND.template_m - HAND.template_m.mean(axis=0)) @ Rotation.from_rotvec([0.5, 1, -0.7]).as_matrix()
    places += np.array([0.05, 0.01, 0.01])
    volume = overlap.volume_m3(places[None], HAND.faces, None)[0]
    middle = places[_wrist_edge()].mean(axis=0)
    closed = np.concatenate([HAND.faces, _wrist_fan()])
    exact = cgal.mesh_boolean(
        np.concatenate([places, [middle]]), closed, np.array(torus.vertices), np.array(torus.faces), "intersect"
    )
    corners = exact[0][exact[1]]
    expected = np.einsum("fx,fx->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert expected > 5e-6
    np.testing.assert_allclose(volume, expected, rtol=0.01)


def _wrist_edge() -> np.ndarray:
    return np.unique(trimesh.Trimesh(HAND.template_m, HAND.faces, process=False).outline().vertex_nodes)


def _wrist_fan() -> np.ndarray:
    """Triangles from each open edge, turned round, to the new last vertex."""
    edges = {(int(a), int(b)) for face in HAND.faces for a, b in zip(face, np.roll(face, -1), strict=True)}
    return np.array([(b, a, len(HAND.template_m)) for a, b in sorted(edges) if (b, a) not in edges])


@pytest.mark.parametrize("angle", [-1.0, 0.0, 2.0])
def test_contacts_with_the_moving_part_follow_the_hinge(angle: float) -> None:
    model, hinge = tin(), tin().hinge
    assert hinge is not None
    cube = box_at((0.01, 0.01, 0.01), (0.02, 0, 0.03))
    rotation = Rotation.from_rotvec(hinge.axis * angle).as_matrix()
    moved = (cube.vertices - hinge.origin_m) @ rotation.T + hinge.origin_m
    volume = SolidOverlap(SurfaceIndex(model)).volume_m3(moved[None], cube.faces, np.array([angle]))
    np.testing.assert_allclose(volume, 1e-6, atol=1e-12)


def test_objects_without_inside_and_lattices_too_fine_are_refused() -> None:
    open_box = trimesh.creation.box((0.1, 0.1, 0.1))
    model = ObjectModel("open", np.array(open_box.vertices), np.array(open_box.faces[2:]), np.zeros(8, np.uint8))
    with pytest.raises(BadInput, match="it is open"):
        SolidOverlap(SurfaceIndex(model))
    with pytest.raises(BadInput, match="larger cells"):
        overlap_of(open_box, cell_m=1e-5)
    with pytest.raises(BadInput, match="larger cells"):
        overlap_of(open_box, cell_m=0.0)
