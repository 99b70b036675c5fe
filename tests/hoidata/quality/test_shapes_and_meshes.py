"""Unlikely hand shapes, and meshes with holes, nothing inside, several shells, triangles without area."""

import numpy as np
import pytest
import trimesh

from hoidata.objects.model import ObjectModel
from hoidata.objects.solid import NoSolid, Solid, solid_of
from hoidata.quality.measures import distances_to_others
from hoidata.quality.meshes import part_facts, surface_facts
from tests.builders.objects import box_model, two_parts

BOX = trimesh.creation.box((0.1, 0.2, 0.3))


def is_solid(faces: np.ndarray) -> bool:
    return isinstance(solid_of(BOX.vertices, faces), Solid)


def test_clip_of_another_shape_than_its_subjects_other_clips_stands_out():
    betas = {f"clip{number}": np.full((1, 10), 0.1) for number in range(4)}
    betas["odd"] = np.full((1, 10), 0.1)
    betas["odd"][0, 3] = -1.9
    assert distances_to_others(betas) == pytest.approx({**dict.fromkeys(betas, 0.0), "odd": 2.0})


def test_clip_is_compared_with_the_others_only():
    betas = {"a": np.zeros((1, 10)), "b": np.zeros((1, 10)), "c": np.full((1, 10), 2.0)}
    assert distances_to_others(betas) == {"a": 1, "b": 1, "c": 2}


def test_betas_per_frame_count_by_their_median():
    frames = np.zeros((11, 10))
    frames[0] = 9.0
    assert distances_to_others({"a": frames, "b": np.zeros((1, 10)), "c": np.zeros((1, 10))})["a"] == 0


def test_two_clips_do_not_tell_which_of_them_is_wrong():
    assert np.isnan(list(distances_to_others({"a": np.zeros((1, 10)), "b": np.ones((1, 10))}).values())).all()
    assert distances_to_others({}) == {}


def test_box_is_solid_and_its_volume_its_own():
    facts = surface_facts(BOX.vertices, BOX.faces)
    assert facts.volume_m3 == pytest.approx(0.006)
    assert facts.hull_m3 == pytest.approx(0.006)
    assert (facts.open_edge_share, facts.shells, facts.degenerate_share) == (0, 1, 0)
    assert is_solid(BOX.faces)
    assert facts.unfilled_share == pytest.approx(0, abs=1e-9)


def test_vertices_split_along_seams_do_not_open_a_surface():
    facts = surface_facts(BOX.vertices[BOX.faces].reshape(-1, 3), np.arange(36).reshape(12, 3))
    assert facts.open_edge_share == 0
    assert facts.shells == 1


def test_missing_triangle_opens_three_edges():
    facts = surface_facts(BOX.vertices, BOX.faces[1:])
    assert facts.open_edge_share == pytest.approx(3 / 33)
    assert not is_solid(BOX.faces[1:])


def test_collapsed_triangle_is_no_edge_of_the_surface():
    faces = np.concatenate([BOX.faces[1:], [[0, 0, 1]]])
    assert surface_facts(BOX.vertices, faces).open_edge_share == pytest.approx(3 / 33)


def test_triangle_turned_round_leaves_three_pairs_of_edges_without_an_opposite():
    turned = BOX.faces.copy()
    turned[0] = turned[0, ::-1]
    assert surface_facts(BOX.vertices, turned).open_edge_share == pytest.approx(6 / 36)


def test_inside_out_and_empty_surfaces_are_told_apart_from_filled_ones():
    turned, doubled = BOX.faces[:, ::-1], np.concatenate([BOX.faces, BOX.faces[:, ::-1]])
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 1]])
    inside_out, both, flat = (
        surface_facts(*mesh) for mesh in ((BOX.vertices, turned), (BOX.vertices, doubled), triangle)
    )
    assert inside_out.unfilled_share == pytest.approx(2)
    assert is_solid(turned)
    assert both.unfilled_share == pytest.approx(1)
    assert is_solid(doubled)  # one surface, with triangles for both sides
    assert flat.unfilled_share == 1
    assert isinstance(solid_of(*triangle), NoSolid)


def test_separate_pieces_are_shells():
    far = trimesh.util.concatenate([BOX, BOX.copy().apply_translation((1, 0, 0))])
    assert surface_facts(far.vertices, far.faces).shells == 2


@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e3])
def test_collapsed_and_needle_triangles_are_degenerate_in_every_unit(scale):
    vertices = scale * np.concatenate([BOX.vertices, [[0, 0, 0], [1, 0, 0], [0.5, 1e-8, 0]]])
    faces = np.concatenate([BOX.faces, [[0, 0, 1], [8, 9, 10]]])
    assert surface_facts(vertices, faces).degenerate_share == pytest.approx(2 / 14)


def hinged() -> ObjectModel:
    """A base box and a lid that lies on it, turning about the y axis through the lid's edge."""
    base, lid = box_model((0.2, 0.2, 0.1)), box_model((0.2, 0.2, 0.02), middle_m=(0, 0, 0.06))
    return two_parts(base, lid, (0, 1, 0), (-0.1, 0, 0.05))


def test_every_part_is_a_surface_of_its_own():
    model = hinged()
    assert [facts.volume_m3 for facts in part_facts(model).values()] == pytest.approx([0.004, 0.0008])
    whole = ObjectModel("rigid", model.vertices_m, model.faces, np.zeros(16, np.uint8))
    assert [facts.shells for facts in part_facts(whole).values()] == [2]
