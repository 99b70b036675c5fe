"""HOI4D's conventions, one test each: explicit formulas, and the same with the flipped convention, which must be off by
more than 5 mm. The recordings come from a builder of the tests; the formulas use no code of hoidata."""

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
    actual = Hoi4dAdapter(**{"clips": "whole", **settings}).load(RawTree(root), key_of(name), load_embedded_hands())
    (clip,) = (item for item in actual if isinstance(item, Clip))
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
    """The mug's corners from the files of frame AT: angles, centre and camera matrix, by explicit formulas."""
    item, written = entry(root, MUG, "Watercup"), recording(MUG, 2)
    (x, y, z), centre = ([item[name][axis] for axis in "xyz"] for name in ("rotation", "center"))
    turns = [
        np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]]),
        np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]]),
        np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]]),
    ]
    rotation = np.linalg.multi_dot(turns[::-1] if how.get("extrinsic") else turns)
    vertices = [
        line.split()[1:] for line in (root / MODELS / "rigid/Mug/007.obj").read_text().splitlines() if line[0] == "v"
    ]
    rest = np.array(vertices, float)
    corners_camera = rest @ (rotation if how.get("rows") else rotation.T) + np.array(centre) * how.get("unit", 1)
    camera = np.linalg.inv(written.camera[AT]) if how.get("inverse") else written.camera[AT]
    return corners_camera @ camera[:3, :3].T + camera[:3, 3]


def test_positions_are_metres(root, clips):
    agrees(corners(clips[MUG]), mug(root), mug(root, unit=0.001))


def test_angles_rotate_about_x_then_the_rotated_y_and_z_and_act_on_columns(root, clips):
    agrees(corners(clips[MUG]), mug(root))
    for wrong in (mug(root, extrinsic=True), mug(root, rows=True)):
        assert np.linalg.norm(wrong - corners(clips[MUG]), axis=1).max() > 0.005


def test_the_camera_matrix_takes_camera_to_world_row_by_row(root, clips):
    agrees(corners(clips[MUG]), mug(root), mug(root, inverse=True))
    rotation = Rotation.from_rotvec(clips[MUG].camera.rotvec[2 * AT]).as_matrix()
    assert np.abs(rotation - recording(MUG, 2).camera[AT, :3, :3]).max() < 1e-6
    assert np.abs(rotation.T - rotation).max() > 0.05


def safe(angle: float, own_mesh: bool = True) -> np.ndarray:
    """The safe's corners in the world at AT, with its door at an angle. own_mesh: use the correct convention."""
    written = recording(SAFE, 0)
    rotation = Rotation.from_rotvec(written.axis * angle)
    parts = [written.parts[0].vertices, rotation.apply(written.parts[1].vertices - written.origin) + written.origin]
    rest = np.concatenate(parts)
    if not own_mesh:  # as if the pose of the part's mesh were that of the whole object
        pose = Rotation.from_matrix(written.pose[AT, :3, :3]) * written.box_rotations[0]
        return pose.apply(rest) + written.pose[AT, :3, 3]
    return rest @ written.pose[AT, :3, :3].T + written.pose[AT, :3, 3]


def test_a_pose_is_that_of_the_mesh_of_the_part(clips):
    angle = recording(SAFE, 0).angle[AT]
    agrees(corners(clips[SAFE]), safe(angle), safe(angle, own_mesh=False))


def test_the_hinge_rotates_by_the_right_hand_rule_about_its_axis_and_is_not_wrapped(clips):
    written = recording(SAFE, 0)
    agrees(corners(clips[SAFE]), safe(written.angle[AT]), safe(-written.angle[AT]))
    assert np.abs(clips[SAFE].object.hinge_rad[::2] - written.angle).max() < 1e-3
    assert written.angle.max() > np.pi + 0.5


def test_parts_are_matched_by_their_size_and_not_by_label(root, clips, tmp_path):
    """The scissors' labels sort in the reverse order of their parts; matched by label, the halves would be swapped."""
    written = recording(SCISSORS, 1)
    model = clips[SCISSORS].object.model
    assert sorted(written.labels) == list(written.labels)[::-1]
    assert np.ptp(model.vertices_m[model.part == 0], axis=0) == pytest.approx(written.parts[0].extents)
    rotation = Rotation.from_rotvec(written.axis * written.angle[AT])
    parts = [written.parts[0].vertices, rotation.apply(written.parts[1].vertices - written.origin) + written.origin]
    expected, other = (
        np.concatenate(rows) @ written.pose[AT, :3, :3].T + written.pose[AT, :3, 3] for rows in (parts, parts[::-1])
    )
    agrees(corners(clips[SCISSORS]), expected, other)


# --- hands


def hand_joints(side: str, hands, rest_wrist: bool = True, relative: bool = False, betas=None) -> np.ndarray:
    """(16, 3) joints of the mug's hands in the world at AT, from pose and trans in the camera's frame."""
    written = recording(MUG, 2)
    orient, fingers, wrist, file_betas = written.hands[side]
    rest = rest_points(hands[side], file_betas if betas is None else betas)
    rest_own = rest_points(hands[side], file_betas)
    camera = Rotation.from_matrix(written.camera[AT, :3, :3])
    trans = camera.inv().apply(wrist[AT] - written.camera[AT, :3, 3]) - rest_own[0]
    rotated = (camera.inv() * Rotation.from_rotvec(orient[AT])).as_rotvec()
    bends = fingers + hands[side].mean_pose * relative
    joints = chain(rest, rotated, bends, trans if rest_wrist else trans - rest[0])
    return camera.apply(joints) + written.camera[AT, :3, 3]


@pytest.mark.parametrize("side", SIDES)
class TestHands:
    def test_the_translation_is_added_to_the_rest_wrist(self, clips, hands, side):
        actual = joints_as_stored(clips[MUG].hands[side], hands[side], 2 * AT)
        agrees(actual, hand_joints(side, hands), hand_joints(side, hands, rest_wrist=False))

    def test_fingers_are_absolute(self, clips, hands, side):
        actual = joints_as_stored(clips[MUG].hands[side], hands[side], 2 * AT)
        agrees(actual, hand_joints(side, hands), hand_joints(side, hands, relative=True))

    def test_the_shape_is_that_of_the_file(self, clips, hands, side):
        actual = joints_as_stored(clips[MUG].hands[side], hands[side], 2 * AT)
        other = hand_joints(side, hands, betas=6 * recording(MUG, 2).hands[side][3])
        agrees(actual, hand_joints(side, hands), other)


def test_left_shape_directions_stay_as_released(hands):
    released = replace(hands, left=replace(hands.left, shape_directions=hands.right.shape_directions))
    assert hands_for(Hoi4dAdapter().hand_convention, released) is released


def test_every_second_frame_is_interpolated_and_the_clock_counts_300_frames(root, clips):
    assert clips[SAFE].source_frames.tolist() == sorted([*range(20), *range(19)])
    positions_m = recording(SAFE, 0).pose[:, :3, 3]
    agrees(clips[SAFE].object.translation_m[::2], positions_m, positions_m[::-1])
    cut = load(root, SCISSORS, clips="described")  # by a clock of ten seconds; at 15 a second it would be half
    assert (cut.source_frames[0], cut.source_frames[-1]) == (2, 19)


def test_a_hand_is_not_valid_without_a_whole_file(clips):
    valid = clips[SCISSORS].hands["right"].valid[::2]
    assert np.flatnonzero(~valid).tolist() == [MISSING, SHORT]
    assert clips[SCISSORS].hands["left"].valid.all()


def test_events_are_read_in_both_forms(root):
    assert load(root, SAFE, clips="described").verb == "open"
    assert load(root, SCISSORS, clips="described").verb == "cut"


class TestSeatedPerson(SeatedPersonContract):
    @pytest.fixture
    def look(self, tmp_path, hands):
        """Joints of both hands and three edges of a mug in the world, of a person of known pose."""

        def of(person):
            written = recording(MUG, 2, 4)
            plain = transforms(Rotation.identity(4), np.zeros((4, 3)))
            rotated = transforms(Rotation.from_rotvec(np.tile(person.object_orient, (4, 1))), np.zeros((4, 3)))
            written = replace(written, camera=plain, pose=rotated, box_rotations=(Rotation.identity(),) * 2)
            write_recording(tmp_path, written)
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
