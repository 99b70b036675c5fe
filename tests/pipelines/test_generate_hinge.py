"""A sentence that asks for a hinge, of an object that has none, is answered with what to add."""

import pytest
import trimesh

from hoidata.objects.user_mesh import read_user_object
from pipelines.generation import _no_hinge

HINGE = "0,0.05,0.021 -1,0,0"


@pytest.fixture
def box(tmp_path):
    """A box and its lid, which has a knob: three shells, two named nodes."""
    bottom, lid = trimesh.creation.box((0.1, 0.1, 0.04)), trimesh.creation.box((0.1, 0.1, 0.01))
    knob = trimesh.creation.icosphere(1, 0.01).apply_translation([0, 0, 0.06])
    lid = trimesh.util.concatenate([lid.apply_translation([0, 0, 0.03]), knob])
    path = tmp_path / "box.glb"
    trimesh.Scene({"bottom": bottom, "lid": lid}).export(path)
    return path


def notes(verb, path, hinge=""):
    return _no_hinge(verb, path, read_user_object(path, up="z", hinge=hinge).model)


@pytest.mark.parametrize("verb", ["open", "close"])
def test_a_mesh_of_two_pieces_without_a_hinge_says_so_and_names_the_option(box, verb):
    (note,) = notes(verb, box)
    assert note.startswith(
        f"{verb!r} turns a hinge, but the object has none: the mesh has two pieces ('bottom' and 'lid')"
    )
    assert '--hinge "px,py,pz dx,dy,dz"' in note


def test_pieces_without_names_are_not_named(tmp_path):
    boxes = [trimesh.creation.box((0.1, 0.1, 0.04)).apply_translation([0, 0, height]) for height in (0, 0.06)]
    trimesh.util.concatenate(boxes).export(tmp_path / "box.ply")
    assert "the mesh has two pieces; add --hinge" in notes("open", tmp_path / "box.ply")[0]


def test_a_mesh_of_one_piece_needs_another_mesh(tmp_path):
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "cube.ply")
    assert "it needs a mesh of two objects or nodes" in notes("open", tmp_path / "cube.ply")[0]


def test_a_rigid_object_of_a_dataset_needs_another_object(box):
    assert _no_hinge("open", "box", read_user_object(box, up="z").model)[0].endswith("choose one that has")


def test_nothing_is_said_of_a_mesh_with_its_hinge_or_of_a_verb_that_turns_none(box):
    assert not notes("open", box, HINGE)
    assert not notes("lift", box)
    assert not notes(None, box)
