"""HOI4D's conventions, one test each: formulas written out here, and the same with the convention the other way round,
which must be off by more than 5 mm. The recordings come from a writer of the tests; no engine of ours is used."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Clip
from hoidata.clips.hand_parameters import hands_for
from hoidata.datasets import RawTree
from hoidata.datasets.hoi4d.adapter import Hoi4dAdapter
from hoidata.hands import load_embedded_hands
from tests.builders.formulas import agrees, chain, joints_as_stored, rest_points
from tests.builders.hoi4d import (
    ANNOTATIONS,
    MISSING,
    MODELS,
    MUG,
    SAFE,
    SCISSORS,
    SHORT,
    SIDES,
    key_of,
    pickled,
    recording,
    transforms,
    write_obj,
    write_recording,
    write_two,
)
from tests.hoidata.datasets.contract import SeatedPersonContract

AT = 9  # a frame of the source: frame 18 of a clip


def load(root: Path, name: str, **settings) -> Clip:
    found = Hoi4dAdapter(**{"clips": "whole", **settings}).load(RawTree(root), key_of(name), load_embedded_hands())
    (clip,) = (item for item in found if isinstance(item, Clip))
    return clip


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_recording(write_two(tmp_path_factory.mktemp("hoi4d")), recording(MUG, 2))


@pytest.fixture(scope="module")
def clips(root) -> dict[str, Clip]:
    return {name: load(root, name) for name in (SAFE, SCISSORS, MUG)}


def corners(clip: Clip) -> np.ndarray:
    """(vertex, 3) of the object in the world at AT."""
    return clip.object.points_in_world(clip.object.model.vertices_m, clip.object.model.part)[2 * AT]


def entry(root: Path, name: str, label: str) -> dict:
    folder = root / ANNOTATIONS / name / "objpose"
    value = json.loads(next(folder / f for f in (f"{AT}.json", f"{AT:05d}.json") if (folder / f).is_file()).read_text())
    return next(item for item in value["dataList"] if item["label"] == label)


def mug(root: Path, **how) -> np.ndarray:
    """The mug's corners as the files of AT say: angles, centre and the matrix of the camera, by hand."""
    item, made = entry(root, MUG, "Watercup"), recording(MUG, 2)
    (x, y, z), centre = ([item[name][axis] for axis in "xyz"] for name in ("rotation", "center"))
    turns = [
        np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]]),
        np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]]),
        np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]]),
    ]
    turn = np.linalg.multi_dot(turns[::-1] if how.get("extrinsic") else turns)
    vertices = [
        row.split()[1:] for row in (root / MODELS / "rigid/Mug/007.obj").read_text().splitlines() if row[0] == "v"
    ]
    rest = np.array(vertices, float)
    seen = rest @ (turn if how.get("rows") else turn.T) + np.array(centre) * how.get("unit", 1)
    camera = np.linalg.inv(made.camera[AT]) if how.get("inverse") else made.camera[AT]
    return seen @ camera[:3, :3].T + camera[:3, 3]


def test_places_are_metres(root, clips):
    agrees(corners(clips[MUG]), mug(root), mug(root, unit=0.001))


def test_angles_turn_about_x_then_the_turned_y_and_z_and_act_on_columns(root, clips):
    agrees(corners(clips[MUG]), mug(root))
    for wrong in (mug(root, extrinsic=True), mug(root, rows=True)):
        assert np.linalg.norm(wrong - corners(clips[MUG]), axis=1).max() > 0.005


def test_the_camera_matrix_takes_camera_to_world_row_by_row(root, clips):
    agrees(corners(clips[MUG]), mug(root), mug(root, inverse=True))
    seen = Rotation.from_rotvec(clips[MUG].camera.rotvec[2 * AT]).as_matrix()
    assert np.abs(seen - recording(MUG, 2).camera[AT, :3, :3]).max() < 1e-6
    assert np.abs(seen.T - seen).max() > 0.05


def safe(angle: float, own_mesh: bool = True) -> np.ndarray:
    """The safe's corners in the world at AT, its door at an angle; own_mesh: as its pose is meant."""
    made = recording(SAFE, 0)
    turn = Rotation.from_rotvec(made.axis * angle)
    parts = [made.parts[0].vertices, turn.apply(made.parts[1].vertices - made.origin) + made.origin]
    rest = np.concatenate(parts)
    if not own_mesh:  # as if the pose of the part's own mesh were that of the whole object
        pose = Rotation.from_matrix(made.pose[AT, :3, :3]) * made.own[0]
        return pose.apply(rest) + made.pose[AT, :3, 3]
    return rest @ made.pose[AT, :3, :3].T + made.pose[AT, :3, 3]


def test_a_pose_is_that_of_the_parts_own_mesh(clips):
    angle = recording(SAFE, 0).angle[AT]
    agrees(corners(clips[SAFE]), safe(angle), safe(angle, own_mesh=False))


def test_the_hinge_turns_by_the_right_hand_about_its_axis_and_is_not_wrapped(clips):
    made = recording(SAFE, 0)
    agrees(corners(clips[SAFE]), safe(made.angle[AT]), safe(-made.angle[AT]))
    assert np.abs(clips[SAFE].object.hinge_rad[::2] - made.angle).max() < 1e-3
    assert made.angle.max() > np.pi + 0.5


def test_parts_are_told_by_their_size_and_not_by_label(root, clips, tmp_path):
    """The scissors' labels sort the other way round than their parts; the other way the halves change places."""
    made = recording(SCISSORS, 1)
    model = clips[SCISSORS].object.model
    assert sorted(made.labels) == list(made.labels)[::-1]
    assert np.ptp(model.vertices_m[model.part == 0], axis=0) == pytest.approx(made.parts[0].extents)
    turn = Rotation.from_rotvec(made.axis * made.angle[AT])
    parts = [made.parts[0].vertices, turn.apply(made.parts[1].vertices - made.origin) + made.origin]
    expected, other = (
        np.concatenate(rows) @ made.pose[AT, :3, :3].T + made.pose[AT, :3, 3] for rows in (parts, parts[::-1])
    )
    agrees(corners(clips[SCISSORS]), expected, other)


# --- hands


def hand_joints(side: str, hands, rest_wrist: bool = True, relative: bool = False, betas=None) -> np.ndarray:
    """(16, 3) joints of the mug's hands in the world at AT: bent in the camera's frame, moved by the file's trans."""
    made = recording(MUG, 2)
    orient, fingers, wrist, own = made.hands[side]
    rest = rest_points(hands[side], own if betas is None else betas)
    rest_own = rest_points(hands[side], own)
    camera = Rotation.from_matrix(made.camera[AT, :3, :3])
    trans = camera.inv().apply(wrist[AT] - made.camera[AT, :3, 3]) - rest_own[0]
    turned = (camera.inv() * Rotation.from_rotvec(orient[AT])).as_rotvec()
    bends = fingers + hands[side].mean_pose * relative
    joints = chain(rest, turned, bends, trans if rest_wrist else trans - rest[0])
    return camera.apply(joints) + made.camera[AT, :3, 3]


@pytest.mark.parametrize("side", SIDES)
class TestHands:
    def test_the_translation_is_added_to_the_rest_wrist(self, clips, hands, side):
        found = joints_as_stored(clips[MUG].hands[side], hands[side], 2 * AT)
        agrees(found, hand_joints(side, hands), hand_joints(side, hands, rest_wrist=False))

    def test_fingers_are_absolute(self, clips, hands, side):
        found = joints_as_stored(clips[MUG].hands[side], hands[side], 2 * AT)
        agrees(found, hand_joints(side, hands), hand_joints(side, hands, relative=True))

    def test_the_shape_is_that_of_the_file(self, clips, hands, side):
        found = joints_as_stored(clips[MUG].hands[side], hands[side], 2 * AT)
        other = hand_joints(side, hands, betas=6 * recording(MUG, 2).hands[side][3])
        agrees(found, hand_joints(side, hands), other)


def test_left_shape_directions_stay_as_released(hands):
    released = replace(hands, left=replace(hands.left, shape_directions=hands.right.shape_directions))
    assert hands_for(Hoi4dAdapter().hand_convention, released) is released


def test_every_second_frame_is_made_and_the_clock_is_that_of_300_frames(root, clips):
    assert clips[SAFE].source_frames.tolist() == sorted([*range(20), *range(19)])
    places = recording(SAFE, 0).pose[:, :3, 3]
    agrees(clips[SAFE].object.translation_m[::2], places, places[::-1])
    cut = load(root, SCISSORS, clips="described")  # by a clock of ten seconds; at 15 a second it would be half
    assert (cut.source_frames[0], cut.source_frames[-1]) == (2, 19)


def test_a_hand_is_not_valid_without_a_whole_file(clips):
    seen = clips[SCISSORS].hands["right"].valid[::2]
    assert np.flatnonzero(~seen).tolist() == [MISSING, SHORT]
    assert clips[SCISSORS].hands["left"].valid.all()


def test_events_are_read_in_both_forms(root):
    assert load(root, SAFE, clips="described").verb == "open"
    assert load(root, SCISSORS, clips="described").verb == "cut"


class TestSeatedPerson(SeatedPersonContract):
    @pytest.fixture
    def look(self, tmp_path, hands):
        """Joints of both hands and three edges of a mug in the world, of a person whose numbers are given."""

        def of(person):
            made = recording(MUG, 2, 4)
            plain = transforms(Rotation.identity(4), np.zeros((4, 3)))
            turned = transforms(Rotation.from_rotvec(np.tile(person.object_orient, (4, 1))), np.zeros((4, 3)))
            made = replace(made, camera=plain, pose=turned, own=(Rotation.identity(),) * 2)
            write_recording(tmp_path, made)
            corners_m = np.array([[0.2, 0, 0], [-0.2, 0, 0], [0.2, 0.08, 0], [0.2, 0, 0.05]]) * person.signs
            path = tmp_path / MODELS / "rigid/Mug/007.obj"
            mesh = type("Four", (), {"faces": np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])})
            write_obj(path, corners_m, mesh)
            for name in (tmp_path / ANNOTATIONS / MUG / "objpose").iterdir():
                value = json.loads(name.read_text())
                value["dataList"][0]["dimensions"] = {"length": 0.4, "width": 0.08, "height": 0.05}
                name.write_text(json.dumps(value))
            for side, (orient, angles, trans) in person.hands.items():
                values = {"poseCoeff": [*orient, *angles], "beta": np.zeros(10), "trans": trans}
                for frame in range(4):
                    file = tmp_path / f"handpose/refinehandpose_{side}" / MUG / f"{frame}.pickle"
                    file.write_bytes(pickled({name: np.array(value) for name, value in values.items()}))
            clip = load(tmp_path, MUG, shortest_frames=2)
            rest = clip.object.points_in_world(clip.object.model.vertices_m, clip.object.model.part)[2]
            joints = {side: joints_as_stored(clip.hands[side], hands[side], 2) for side in SIDES}
            return joints, rest[1:4] - rest[0]

        return of
