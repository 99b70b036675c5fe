"""What `hoidata hands` takes an object's motion from, and its answers to what it cannot take."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from hoidata.errors import BadInput
from hoidata.files.arrays import write_npz
from hoidata.hands import load_embedded_hands
from hoidata.object_paths import keyframed_path, parse_keyframes
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from models.bimart.hands import Standing
from pipelines.command_inputs import MeshWish, stored_object
from pipelines.hands import Asked, HandsWish, asked_motion, chosen_networks, hinge_range
from pipelines.pages.hands_page import _figures
from pipelines.pages.motion_files import mesh_arrays, motion_arrays
from tests.builders.clips import clip_of
from tests.builders.objects import hinged_box

HANDS = load_embedded_hands()
REST = "time_s 0 1"
HINGE = "0,10,2 -1,0,0"  # of the laptop below, centimetres


@pytest.fixture
def laptop(tmp_path) -> Path:
    """Two boxes that do not touch, 30 x 20 x 2 cm and its lid, centimetres, z up."""
    base, lid = trimesh.creation.box((30, 20, 2)), trimesh.creation.box((30, 20, 1))
    trimesh.util.concatenate([base, lid.apply_translation((0, 0, 1.6))]).export(tmp_path / "laptop.obj")
    return tmp_path / "laptop.obj"


def asked(**wish) -> Asked:
    return asked_motion(HandsWish(**wish), "embedded", (), HANDS)


@pytest.fixture
def keys(tmp_path) -> Callable[[str], str]:
    """Writes rows of keyframes, which spaces part, and gives the file's path."""

    def write(rows: str) -> str:
        path = tmp_path / f"{re.sub(r'[^0-9a-z]', '_', rows)}.csv"
        path.write_text("\n".join(rows.split()) + "\n")
        return str(path)

    return write


def test_a_mesh_in_centimetres_with_its_hinge_is_moved_by_keyframes(laptop, keys):
    rows = "time_s,z_cm,hinge_deg 0,0,0 1,10,0 2.5,10,60 4,10,0 5,0,0"
    found = asked(object=str(laptop), mesh=MeshWish("cm", "z", HINGE), hinge_range="0:90", keyframes=keys(rows))
    assert np.degrees(found.thing.hinge_rad.max()) == pytest.approx(60, abs=1e-4)
    assert np.ptp(found.thing.translation_m[:, 2]) == pytest.approx(0.10, abs=1e-5)
    assert [step.words for step in found.steps] == [f"keyframes {n} to {n + 1}" for n in range(1, 5)]


def test_length_tells_the_pace_and_the_way_stays(laptop, keys):
    rows = "time_s,z_cm 0,0 0.5,0 1.5,20 2.5,20"
    told = {"object": str(laptop), "keyframes": keys(rows), "mesh": MeshWish("cm", "z")}
    own, slow = asked(**told), asked(length_s=6, **told)
    assert slow.thing.n_frames == 6 * 30 + 1
    assert slow.thing.translation_m[[0, -1]] == pytest.approx(own.thing.translation_m[[0, -1]], abs=1e-6)
    assert slow.thing.translation_m[:, 2].max() < own.thing.translation_m[:, 2].max() + 1e-4
    assert slow.steps[1].end_s / own.steps[1].end_s == pytest.approx(180 / (own.thing.n_frames - 1))


def test_a_length_that_the_answer_names_is_long_enough_and_the_longest_is_taken(laptop, keys):
    rows = "time_s,z_m,rz_deg 0,0,0 5,1,0 8,1,180"
    told = {"object": str(laptop), "keyframes": keys(rows), "mesh": MeshWish("cm", "z")}
    with pytest.raises(BadInput) as error:
        asked(length_s=0.5, **told)
    seconds = float(re.findall(r"ask for ([\d.]+) s", str(error.value))[0])
    assert asked(length_s=seconds, **told).thing.n_frames == round(seconds * 30) + 1
    assert asked(length_s=120, **told).thing.n_frames == 3601
    assert asked(**{**told, "keyframes": keys("time_s 0 120")}).thing.n_frames == 3601


def test_a_range_of_a_hinge_that_is_not_there_is_noted(laptop, keys):
    notes = [
        asked(object=str(laptop), keyframes=keys(REST), mesh=MeshWish("cm", "z", hinge), hinge_range="0:90").notes
        for hinge in ("", HINGE)
    ]
    assert ["--hinge-range" in " ".join(own) for own in notes] == [True, False]


def test_datasets_that_are_not_converted_are_passed_over_and_unknown_ones_are_named(
    tmp_path, monkeypatch, make_clip, keys
):
    rest = keys(REST)
    monkeypatch.chdir(tmp_path)
    clip = make_clip(4)
    write_store(tmp_path / "data/embedded/arctic/clips", [clip], generated_info("arctic", HANDS))
    names = ("grab", "arctic")
    name = clip.object.model.name
    assert asked_motion(HandsWish(object=name, keyframes=rest), "embedded", names, HANDS).thing.model.name == name
    with pytest.raises(BadInput, match=f"one of: {name}"):
        asked_motion(HandsWish(object="bananas", keyframes=rest), "embedded", names, HANDS)
    for look_up in (
        lambda near: asked_motion(HandsWish(object=near, keyframes=rest), "embedded", names, HANDS),
        lambda near: stored_object(near, tmp_path / "data/embedded/arctic/clips", HANDS),
    ):
        with pytest.raises(BadInput, match=f"did you mean '{name}'"):
            look_up(f"{name}s")
    with pytest.raises(BadInput, match="did you mean 'arctic'"):
        asked_motion(HandsWish(object=name, keyframes=rest, model="acrtic"), "embedded", names, HANDS)
    with pytest.raises(BadInput, match=r"a dataset of params\.yaml: grab, arctic, got nothing"):
        chosen_networks("nothing", "embedded", names, HANDS)


def test_keyframes_of_a_file_are_taken(laptop, tmp_path):
    (tmp_path / "keys.csv").write_text("time_s,z_cm\n0,0\n1,20\n")
    found = asked(object=str(laptop), keyframes=str(tmp_path / "keys.csv"), mesh=MeshWish("cm", "z"))
    assert found.thing.n_frames == 31


def test_the_objects_motion_of_a_generated_file_comes_back_with_mesh_and_hinge(tmp_path):
    keys = parse_keyframes(b"time_s,z_cm,hinge_deg\n0,0,0\n1,5,0\n2,5,20\n", "keys.csv")
    path = keyframed_path(hinged_box(), keys)
    clip = clip_of("generated/a/b", path.track)
    write_npz(tmp_path / "motion.npz", motion_arrays(clip, HANDS) | mesh_arrays(path.track.model))
    thing = asked(motion=str(tmp_path / "motion.npz")).thing
    model = path.track.model
    before = path.track.points_in_world(model.vertices_m, model.part)
    assert thing.points_in_world(thing.model.vertices_m, thing.model.part) == pytest.approx(before, abs=1e-6)
    arrays = {name: array for name, array in mesh_arrays(model).items() if "hinge" not in name}
    write_npz(tmp_path / "old.npz", motion_arrays(clip, HANDS) | arrays)
    with pytest.raises(BadInput, match="name the object too"):
        asked(motion=str(tmp_path / "old.npz"))
    write_npz(tmp_path / "other.npz", {"a": np.zeros(3)})
    with pytest.raises(BadInput, match="hoidata generate"):
        asked(motion=str(tmp_path / "other.npz"))
    bad = motion_arrays(clip, HANDS) | mesh_arrays(model)
    write_npz(tmp_path / "bad.npz", bad | {"object_rotvec": bad["object_rotvec"][:-1]})
    with pytest.raises(BadInput, match="finite poses"):
        asked(motion=str(tmp_path / "bad.npz"))


@pytest.mark.parametrize(
    ("wish", "words"),
    [
        ({}, "give one of them"),
        ({"keyframes": REST, "clip": "a"}, "--keyframes and --clip"),
        ({"keyframes": REST, "object": ""}, "name it first"),
        ({"keyframes": REST, "object": "nothing.obj"}, "correct the path"),
        ({"keyframes": "time_s,hinge_deg 0,0 1,10"}, "--hinge"),
        ({"keyframes": REST, "mesh": MeshWish("m")}, "--unit cm"),
        ({"keyframes": REST, "hinge_range": "110"}, "0:110"),
        ({"keyframes": REST, "hinge_range": "10:110"}, "0:110"),
        (
            {"keyframes": "time_s,hinge_deg 0,0 2,100", "mesh": MeshWish("cm", "z", HINGE), "hinge_range": "0:90"},
            "0 to 90 deg",
        ),
        ({"keyframes": REST, "length_s": 0.1}, "another length"),
        ({"keyframes": REST, "length_s": float("nan")}, "0.3 to 120 s, got nan"),
        ({"keyframes": REST, "length_s": float("inf")}, "0.3 to 120 s, got inf"),
        ({"keyframes": REST, "length_s": 120.1}, "0.3 to 120 s, got 120.1 s"),
        ({"keyframes": "time_s,z_m 0,0 5,1 10,0", "length_s": 0.3}, "--length: expected at most 2.5 m/s"),
        ({"keyframes": "time_s,z_m,rz_deg 0,0,0 3,0.5,0 15,0.5,720", "length_s": 0.4}, "--length: expected at most"),
        ({"motion": "none.npz"}, "nothing there"),
        ({"keyframes": "none.csv"}, "correct the path"),
    ],
)
def test_what_cannot_be_gets_an_answer_that_says_what_to_do(laptop, keys, wish, words):
    if "keyframes" in wish and not wish["keyframes"].endswith(".csv"):
        wish = {**wish, "keyframes": keys(wish["keyframes"])}
    told = {"object": str(laptop), "mesh": MeshWish("cm", "z")} if wish.get("object") is None and wish else {}
    with pytest.raises(BadInput) as error:
        asked(**{**told, **wish})
    assert words in str(error.value)


def test_a_range_of_angles_is_read_in_degrees():
    assert hinge_range("-90:0") == pytest.approx((-np.pi / 2, 0))


def test_an_open_mesh_is_moved_like_any_other(tmp_path, keys):
    sheet = trimesh.creation.box((0.1, 0.1, 0.1))
    sheet.update_faces(np.arange(len(sheet.faces)) > 1)
    sheet.export(tmp_path / "open.obj")
    wish = HandsWish(object=str(tmp_path / "open.obj"), keyframes=keys("time_s,z_cm 0,0 2,5"))
    assert asked_motion(replace(wish, mesh=MeshWish("m", "z")), "embedded", (), HANDS).thing.n_frames > 30


def test_depths_of_an_object_without_an_inside_are_not_measured_and_not_dropped():
    touching = {"right": np.array([True, False])}
    open_mesh, solid = (Standing(touching, depth, 1.0) for depth in (None, np.array([0.004, 0.012])))
    rows = {name: values for name, *values in _figures(open_mesh, open_mesh)}
    reason = "not measured: the object has no inside"
    assert rows["deepest vertex"] == rows["frames deeper than 1 cm"] == [reason, reason]
    rows = {name: values for name, *values in _figures(solid, solid)}
    assert (rows["deepest vertex"], rows["frames deeper than 1 cm"]) == (["12.0 mm"] * 2, ["50 %"] * 2)
