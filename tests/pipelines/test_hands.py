"""`hoidata hands`: the sources of an object's motion, and the messages for unusable input."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from hoidata.clips.clip import ObjectTrack
from hoidata.errors import BadInput
from hoidata.files.arrays import write_npz
from hoidata.hands import load_embedded_hands
from hoidata.object_paths import keyframed_path, parse_keyframes
from hoidata.objects.user_mesh import read_user_object
from hoidata.store.annotated import load_annotated
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from models.bimart.hands import ContactMeasures
from pipelines.cli import app
from pipelines.command_inputs import MeshOptions, ProjectData, stored_object
from pipelines.hands import HandsOptions, ObjectMotion, _untouched_fraction, chosen_networks, hinge_range, object_motion
from pipelines.pages.hands_page import _measures
from pipelines.pages.motion_files import mesh_arrays, motion_arrays, older_motion_notes
from tests.builders.clips import clip_of
from tests.builders.objects import hinged_box
from tests.builders.stores import write_annotated
from tests.builders.urdf import write_drawer, write_partnet

HANDS = load_embedded_hands()
REST = "time_s 0 1"
HINGE = "0,10,2 -1,0,0"  # of the laptop below, centimetres


@pytest.fixture
def laptop(tmp_path) -> Path:
    """Two boxes that do not touch, 30 x 20 x 2 cm and its lid, centimetres, z up."""
    base, lid = trimesh.creation.box((30, 20, 2)), trimesh.creation.box((30, 20, 1))
    trimesh.util.concatenate([base, lid.apply_translation((0, 0, 1.6))]).export(tmp_path / "laptop.obj")
    return tmp_path / "laptop.obj"


def selected(**options) -> ObjectMotion:
    return object_motion(HandsOptions(**options), ProjectData("embedded", (), HANDS))


@pytest.fixture
def keys(tmp_path) -> Callable[[str], str]:
    """A function that writes rows of keyframes, separated by spaces, and returns the file's path."""

    def write(rows: str) -> str:
        path = tmp_path / f"{re.sub(r'[^0-9a-z]', '_', rows)}.csv"
        path.write_text("\n".join(rows.split()) + "\n")
        return str(path)

    return write


def test_a_mesh_in_centimetres_with_its_hinge_is_moved_by_keyframes(laptop, keys):
    rows = "time_s,z_cm,hinge_deg 0,0,0 1,10,0 2.5,10,60 4,10,0 5,0,0"
    motion = selected(object=str(laptop), mesh=MeshOptions("cm", "z", HINGE), hinge_range="0:90", keyframes=keys(rows))
    assert np.degrees(motion.track.hinge_rad.max()) == pytest.approx(60, abs=1e-4)
    assert np.ptp(motion.track.translation_m[:, 2]) == pytest.approx(0.10, abs=1e-5)
    assert [step.words for step in motion.steps] == [f"keyframes {n} to {n + 1}" for n in range(1, 5)]


def test_length_changes_the_speed_and_keeps_the_trajectory(laptop, keys):
    rows = "time_s,z_cm 0,0 0.5,0 1.5,20 2.5,20"
    options = {"object": str(laptop), "keyframes": keys(rows), "mesh": MeshOptions("cm", "z")}
    normal, slow = selected(**options), selected(length_s=6, **options)
    assert slow.track.n_frames == 6 * 30 + 1
    assert slow.track.translation_m[[0, -1]] == pytest.approx(normal.track.translation_m[[0, -1]], abs=1e-6)
    assert slow.track.translation_m[:, 2].max() < normal.track.translation_m[:, 2].max() + 1e-4
    assert slow.steps[1].end_s / normal.steps[1].end_s == pytest.approx(180 / (normal.track.n_frames - 1))


def test_the_length_that_the_message_suggests_is_long_enough_and_the_longest_is_accepted(laptop, keys):
    rows = "time_s,z_m,rz_deg 0,0,0 5,1,0 8,1,180"
    options = {"object": str(laptop), "keyframes": keys(rows), "mesh": MeshOptions("cm", "z")}
    with pytest.raises(BadInput) as error:
        selected(length_s=0.5, **options)
    seconds = float(re.findall(r"ask for ([\d.]+) s", str(error.value))[0])
    assert selected(length_s=seconds, **options).track.n_frames == round(seconds * 30) + 1
    assert selected(length_s=120, **options).track.n_frames == 3601
    assert selected(**{**options, "keyframes": keys("time_s 0 120")}).track.n_frames == 3601


def test_a_hinge_range_of_a_rigid_object_gives_a_note(laptop, keys):
    notes_by_hinge = [
        selected(object=str(laptop), keyframes=keys(REST), mesh=MeshOptions("cm", "z", hinge), hinge_range="0:90").notes
        for hinge in ("", HINGE)
    ]
    assert ["--hinge-range" in " ".join(motion_notes) for motion_notes in notes_by_hinge] == [True, False]


def test_datasets_that_are_not_converted_are_skipped_and_unknown_names_are_refused(
    tmp_path, monkeypatch, make_clip, keys
):
    rest = keys(REST)
    monkeypatch.chdir(tmp_path)
    clip = make_clip(4)
    write_store(tmp_path / "data/embedded/arctic/clips", [clip], generated_info("arctic", HANDS))
    project = ProjectData("embedded", ("grab", "arctic"), HANDS)
    name = clip.object.model.name
    assert object_motion(HandsOptions(object=name, keyframes=rest), project).track.model.name == name
    with pytest.raises(BadInput, match=f"one of: {name}"):
        object_motion(HandsOptions(object="bananas", keyframes=rest), project)
    for look_up in (
        lambda misspelt: object_motion(HandsOptions(object=misspelt, keyframes=rest), project),
        lambda misspelt: stored_object(misspelt, tmp_path / "data/embedded/arctic/clips", HANDS),
    ):
        with pytest.raises(BadInput, match=f"did you mean '{name}'"):
            look_up(f"{name}s")
    with pytest.raises(BadInput, match="did you mean 'arctic'"):
        object_motion(HandsOptions(object=name, keyframes=rest, model="acrtic"), project)
    with pytest.raises(BadInput, match=r"a dataset of params\.yaml: grab, arctic, got nothing"):
        chosen_networks("nothing", project)


def test_keyframes_are_read_from_a_file(laptop, tmp_path):
    (tmp_path / "keys.csv").write_text("time_s,z_cm\n0,0\n1,20\n")
    motion = selected(object=str(laptop), keyframes=str(tmp_path / "keys.csv"), mesh=MeshOptions("cm", "z"))
    assert motion.track.n_frames == 31


def test_the_object_motion_of_a_generated_file_keeps_mesh_and_hinge(tmp_path):
    keys = parse_keyframes(b"time_s,z_cm,hinge_deg\n0,0,0\n1,5,0\n2,5,20\n", "keys.csv")
    path = keyframed_path(hinged_box(), keys)
    clip = clip_of("generated/a/b", path.track)
    write_npz(tmp_path / "motion.npz", motion_arrays(clip, HANDS) | mesh_arrays(path.track.model))
    track = selected(motion=str(tmp_path / "motion.npz")).track
    model = path.track.model
    before = path.track.points_in_world(model.vertices_m, model.part)
    assert track.points_in_world(track.model.vertices_m, track.model.part) == pytest.approx(before, abs=1e-6)
    arrays = {name: array for name, array in mesh_arrays(model).items() if "hinge" not in name}
    write_npz(tmp_path / "old.npz", motion_arrays(clip, HANDS) | arrays)
    with pytest.raises(BadInput, match="name the object too"):
        selected(motion=str(tmp_path / "old.npz"))
    write_npz(tmp_path / "other.npz", {"a": np.zeros(3)})
    with pytest.raises(BadInput, match="hoidata generate"):
        selected(motion=str(tmp_path / "other.npz"))
    bad = motion_arrays(clip, HANDS) | mesh_arrays(model)
    write_npz(tmp_path / "bad.npz", bad | {"object_rotvec": bad["object_rotvec"][:-1]})
    with pytest.raises(BadInput, match="finite poses"):
        selected(motion=str(tmp_path / "bad.npz"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "give one of them"),
        ({"keyframes": REST, "clip": "a"}, "--keyframes and --clip"),
        ({"keyframes": REST, "object": ""}, "name it first"),
        ({"keyframes": REST, "object": "nothing.obj"}, "correct the path"),
        ({"keyframes": "time_s,hinge_deg 0,0 1,10"}, "--hinge"),
        ({"keyframes": REST, "mesh": MeshOptions("m")}, "--unit cm"),
        ({"keyframes": REST, "object": "box", "mesh": MeshOptions(scale=2.0)}, "--scale: expected a mesh file"),
        (
            {"keyframes": REST, "object": "box", "mesh": MeshOptions("cm", "y", HINGE, "lid")},
            "--unit, --up, --hinge, --moving: expected a mesh file",
        ),
        ({"clip": "a", "object": "", "mesh": MeshOptions("cm")}, "--unit: expected a mesh file"),
        ({"motion": "a.npz", "object": "", "mesh": MeshOptions(up="y")}, "--up: expected a mesh file"),
        ({"keyframes": REST, "object": "nothing.obj", "mesh": MeshOptions("cm")}, "correct the path"),
        ({"keyframes": REST, "hinge_range": "110"}, "0:110"),
        ({"keyframes": REST, "hinge_range": "10:110"}, "0:110"),
        (
            {"keyframes": "time_s,hinge_deg 0,0 2,100", "mesh": MeshOptions("cm", "z", HINGE), "hinge_range": "0:90"},
            "0 to 90 deg",
        ),
        ({"keyframes": REST, "samples": 2, "keep": 3}, "--keep: expected at most --samples 2, got 3"),
        ({"keyframes": REST, "length_s": 0.1}, "another length"),
        ({"keyframes": REST, "length_s": float("nan")}, "0.3 to 120 s, got nan"),
        ({"keyframes": REST, "length_s": float("inf")}, "0.3 to 120 s, got inf"),
        ({"keyframes": REST, "length_s": 120.1}, "0.3 to 120 s, got 120.1 s"),
        ({"keyframes": "time_s,z_m 0,0 5,1 10,0", "length_s": 0.3}, "--length: expected at most 2.5 m/s"),
        ({"keyframes": "time_s,z_m,rz_deg 0,0,0 3,0.5,0 15,0.5,720", "length_s": 0.4}, "--length: expected at most"),
        ({"motion": "none.npz"}, "no such file"),
        ({"keyframes": "none.csv"}, "correct the path"),
    ],
)
def test_unusable_input_is_refused_with_a_remedy(laptop, keys, options, message):
    if "keyframes" in options and not options["keyframes"].endswith(".csv"):
        options = {**options, "keyframes": keys(options["keyframes"])}
    defaults = (
        {"object": str(laptop), "mesh": MeshOptions("cm", "z")} if options.get("object") is None and options else {}
    )
    with pytest.raises(BadInput) as error:
        selected(**{**defaults, **options})
    assert message in str(error.value)


def test_a_hinge_range_is_read_in_degrees_and_a_slide_in_centimetres(tmp_path):
    drawer = read_user_object(write_drawer(tmp_path)).model
    assert hinge_range("-90:0", hinged_box()) == pytest.approx((-np.pi / 2, 0))
    assert hinge_range("0:15", drawer) == pytest.approx((0, 0.15))
    assert hinge_range("", drawer) is None
    with pytest.raises(BadInput, match="two slides in cm"):
        hinge_range("15", drawer)


def test_the_limits_of_a_urdf_bound_the_keyframes_and_a_partnet_folder_is_named_as_object(tmp_path, keys):
    drawer, cabinet = str(write_drawer(tmp_path / "drawer")), str(write_partnet(tmp_path / "4321"))
    motion = selected(object=drawer, keyframes=keys("time_s,slide_cm 0,0 2,15"))
    assert motion.track.hinge_rad.max() == pytest.approx(0.15)
    with pytest.raises(BadInput, match=r"a slide of 0\.0 to 20\.0 cm"):
        selected(object=drawer, keyframes=keys("time_s,slide_cm 0,0 2,25"))
    with pytest.raises(BadInput, match=r"joint_0 \(revolute\), joint_1 \(prismatic\)"):
        selected(object=cabinet, keyframes=keys("time_s,hinge_deg 0,0 2,30"))
    door = selected(object=cabinet, keyframes=keys("time_s,hinge_deg 0,0 2,30"), mesh=MeshOptions(moving="joint_0"))
    assert (door.track.model.name, door.track.model.hinge.is_prismatic) == ("4321", False)


def test_the_slide_of_a_motion_file_is_read_back(tmp_path, keys):
    track = selected(object=str(write_drawer(tmp_path / "d")), keyframes=keys("time_s,slide_cm 0,0 2,15")).track
    write_npz(tmp_path / "motion.npz", motion_arrays(clip_of("a/b/c", track), HANDS) | mesh_arrays(track.model))
    again = selected(motion=str(tmp_path / "motion.npz")).track
    expected_m = track.points_in_world(track.model.vertices_m, track.model.part)
    assert again.points_in_world(again.model.vertices_m, again.model.part) == pytest.approx(expected_m, abs=1e-6)


def test_a_motion_of_the_other_kind_of_joint_or_beyond_its_limits_is_refused(tmp_path, keys):
    drawer, door = str(write_drawer(tmp_path / "d")), str(write_partnet(tmp_path / "4321"))
    turn = {"object": door, "keyframes": keys("time_s,hinge_deg 0,0 2,30"), "mesh": MeshOptions(moving="joint_0")}
    for name, options in (("slide", {"object": drawer, "keyframes": keys("time_s,slide_cm 0,0 2,15")}), ("turn", turn)):
        track = selected(**options).track
        arrays = motion_arrays(clip_of("a/b/c", track), HANDS) | mesh_arrays(track.model)
        write_npz(tmp_path / f"{name}.npz", arrays)
    write_npz(tmp_path / "old.npz", {key: value for key, value in arrays.items() if "hinge_axis" not in key})
    slide, turned, old = (str(tmp_path / f"{name}.npz") for name in ("slide", "turn", "old"))
    with pytest.raises(BadInput, match=r"turn\.npz: expected a slide in metres: 'drawer' slides, got a hinge angle"):
        selected(object=drawer, motion=turned)
    with pytest.raises(BadInput, match=r"a hinge angle in radians: '4321' turns.*keyframes with a column hinge_deg"):
        selected(object=door, motion=slide, mesh=MeshOptions(moving="joint_0"))
    with pytest.raises(
        BadInput, match=r"old\.npz: expected a slide of 0\.0 to 20\.0 cm, got 52\.4 cm, from 0\.\d+ s on"
    ):
        selected(object=drawer, motion=old)  # the file does not say which kind, but leaves the limits
    with pytest.raises(BadInput, match=r"turn\.npz: expected a hinge angle of 0 to 20 deg, got 30 deg"):
        selected(motion=turned, hinge_range="0:20")
    assert selected(motion=turned, hinge_range="0:40").track.n_frames == 61
    assert selected(object=drawer, motion=slide).track.n_frames == 61


def test_a_hinge_range_bounds_the_motion_of_a_clip(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = keyframed_path(hinged_box(), parse_keyframes(b"time_s,z_cm,hinge_deg\n0,0,0\n1,5,45\n", "keys.csv"))
    clips = [clip_of("arctic/s01/box_use_01/0000-0030", path.track)]
    write_store(tmp_path / "data/embedded/arctic/clips", clips, generated_info("arctic", HANDS))
    project = ProjectData("embedded", ("arctic",), HANDS)
    assert object_motion(HandsOptions(clip=clips[0].clip_id, hinge_range="0:50"), project).track.n_frames == 31
    with pytest.raises(
        BadInput, match=r"arctic/s01/box_use_01/0000-0030: expected a hinge angle of 0 to 20 deg, got 45"
    ):
        object_motion(HandsOptions(clip=clips[0].clip_id, hinge_range="0:20"), project)


def test_motions_for_a_clip_have_the_verb_derived_from_its_motion(tmp_path, monkeypatch, make_clip):
    monkeypatch.chdir(tmp_path)
    root = write_annotated(tmp_path / "data/embedded/toy", [make_clip(6, clip_id="toy/s1/0", verb=None)], points=64)
    motion = object_motion(HandsOptions(clip="toy/s1/0"), ProjectData("embedded", ("toy",), HANDS))
    assert motion.verb == load_annotated(root).verb("toy/s1/0")
    assert motion.verb


def test_a_refusal_says_from_where_positions_count_if_the_limits_of_a_urdf_exclude_zero(tmp_path, keys):
    drawer = write_drawer(tmp_path / "drawer")
    drawer.write_text(drawer.read_text().replace('lower="0" upper="0.2"', 'lower="0.05" upper="0.2"'))
    expected = r"a slide of 0\.0 to 15\.0 cm, counted from the URDF's limit of 5\.0 cm, where the mesh rests, got 18\.0"
    with pytest.raises(BadInput, match=expected):
        selected(object=str(drawer), keyframes=keys("time_s,slide_cm 0,0 2,18"))


def test_a_folder_without_a_urdf_is_named_so(tmp_path, keys):
    (tmp_path / "mug").mkdir()
    with pytest.raises(BadInput, match=r"mug, a folder without a \.urdf file"):
        selected(object=str(tmp_path / "mug"), keyframes=keys(REST))


def test_files_of_an_earlier_run_with_more_samples_are_named(tmp_path):
    for name in ("motion.npz", "motion.glb", "motion-1.npz", "motion-12.glb", "motion-capture.npz", "index.html"):
        (tmp_path / name).touch()
    (note,) = older_motion_notes(tmp_path, [tmp_path / "motion.npz", tmp_path / "motion.glb"])
    assert note.endswith("motions of an earlier run, which stay: motion-1.npz, motion-12.glb")
    assert not older_motion_notes(tmp_path, list(tmp_path.iterdir()))


def test_a_negative_seed_is_refused_as_in_generate():
    commands = (["hands", "mug.obj"], ["generate", "Lift a mug.", "--object", "mug.obj"])
    results = [CliRunner().invoke(app, [*command, "--out", "out", "--seed", "-1"]) for command in commands]
    assert [("--seed" in result.output, result.exit_code) for result in results] == [(True, 2)] * 2


@pytest.mark.parametrize(("distance_m", "expected"), [(0.01, 0.0), (0.05, 1.0)])
def test_a_moving_part_without_a_hand_near_it_is_found(distance_m, expected):
    """Points of the base are touched in all frames; only those of the lid count, while it moves."""
    angle_rad, part = np.array([0, 0, 0.1, 0.2, 0.2], np.float32), np.array([0, 0, 1, 1], np.uint8)
    clip = clip_of("a/b/c", ObjectTrack(hinged_box(), np.zeros((5, 3)), np.zeros((5, 3)), angle_rad))
    reached_m = np.full((2, 5, 4), np.inf)
    reached_m[0, :, :2], reached_m[1, 2:4, 3] = 0.0, distance_m
    sample = SimpleNamespace(clip=clip, reached_m=reached_m, points=SimpleNamespace(part=part))
    assert _untouched_fraction(sample) == expected


def test_an_open_mesh_is_moved_like_any_other(tmp_path, keys):
    sheet = trimesh.creation.box((0.1, 0.1, 0.1))
    sheet.update_faces(np.arange(len(sheet.faces)) > 1)
    sheet.export(tmp_path / "open.obj")
    options = HandsOptions(object=str(tmp_path / "open.obj"), keyframes=keys("time_s,z_cm 0,0 2,5"))
    assert (
        object_motion(replace(options, mesh=MeshOptions("m", "z")), ProjectData("embedded", (), HANDS)).track.n_frames
        > 30
    )


def test_penetration_of_an_object_without_an_inside_is_reported_as_not_measured():
    touching = {"right": np.array([True, False])}
    open_mesh, solid = (ContactMeasures(touching, depth, 1.0) for depth in (None, np.array([0.004, 0.012])))
    rows = {name: values for name, *values in _measures(open_mesh, open_mesh)}
    reason = "not measured: the object has no inside"
    assert rows["deepest vertex"] == rows["frames deeper than 1 cm"] == [reason, reason]
    rows = {name: values for name, *values in _measures(solid, solid)}
    assert (rows["deepest vertex"], rows["frames deeper than 1 cm"]) == (["12.0 mm"] * 2, ["50 %"] * 2)
