"""HOT3D's conventions, one test each: literal numbers, explicit formulas, and the same with the flipped convention,
which must be off by more than 5 mm. The formulas use neither a builder nor hoidata's conversion of hand parameters."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Clip
from hoidata.clips.hand_parameters import hands_for
from hoidata.datasets import RawTree, SequenceKey
from hoidata.datasets.hot3d import files
from hoidata.datasets.hot3d.adapter import Hot3dAdapter
from hoidata.hands import load_embedded_hands
from tests.builders import hot3d
from tests.builders.formulas import EXACT_M, WRONG_M, agrees, chain, joints_as_stored, off_m, rest_points
from tests.hoidata.datasets.contract import SeatedPersonContract

KEY = SequenceKey("hot3d", "P0009", "P0009_02511c2f")
UID = "37787722328019"
N_FRAMES = 32
AT = 9
SIDES = ("left", "right")
POSE = {
    "left": [1.37, 0.2, 1.3, 0.69, 0.08, -0.57, 0.94, -0.23, -0.04, -0.52, 0.37, -0.11, 0.07, 0.04, -0.6],
    "right": [-0.61, -1.52, 0.98, 0.1, 0.09, -1.42, -0.45, 0.56, 0.27, -0.71, -0.33, 0.06, 0.05, -0.4, 0.7],
}
BETAS = [0.88, 0.99, -1.96, -0.98, 0.17, -1.35, -1.16, -0.87, 0.4, -1.19]
QUATERNION = {"left": [0.8, -0.4, 0.4, 0.2], "right": [0.5, 0.1, -0.7, -0.5]}  # w, x, y, z
TRANSL = {"left": [-0.02, 0.74, -0.15], "right": [0.08, 0.745, -0.195]}
STEP_M = 0.011  # along x from frame to frame
BOX_QUATERNION, BOX_M = [0.5, -0.5, 0.1, 0.7], [0.17, 0.75, -0.18]
CORNERS = [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.3]]
FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
NODE = {"translation": [0.02, -0.03, 0.01], "rotation": [0.0, 0.0, 0.6, 0.8]}  # x, y, z, w
ARIA_NS = (56752108188860, 56752108279673)


def turn_of(wxyz) -> Rotation:
    """Normalize, because the literals have few digits."""
    return Rotation.from_quat(np.roll(wxyz, -1))


def unit(wxyz) -> list[float]:
    return (np.array(wxyz) / np.linalg.norm(wxyz)).tolist()


def placed_at(position_m, frame: int) -> list[float]:
    return (np.array(position_m) + frame * np.array([STEP_M, 0.0, 0.0])).tolist()


def times(frame: int, headset: str = "Aria") -> tuple[int, ...]:
    if headset == "Quest3":
        return (43124400000000 + 100000000 * frame // 3,)
    return tuple(first + 33331000 * frame for first in ARIA_NS)


def hand(side: str, frame: int, pose=None, quaternion=None, transl=None) -> dict:
    wrist = {"t_xyz": placed_at(transl or TRANSL[side], frame), "q_wxyz": unit(quaternion or QUATERNION[side])}
    return {"pose": list(pose or POSE[side]), "wrist_xform": wrist, "betas": BETAS}


def lines(headset: str = "Aria", hands=hand) -> list[dict]:
    """At the second time of a frame the hands are 0.02 mm further."""
    actual = []
    for frame in range(N_FRAMES):
        for late, time in enumerate(times(frame, headset)):
            poses = {str(number): hands(side, frame + 0.002 * late) for number, side in enumerate(SIDES)}
            actual.append({"timestamp_ns": time, "hand_poses": poses})
    return actual


def rows(headset: str = "Aria", quaternion=BOX_QUATERNION, position_m=BOX_M) -> list[str]:
    numbers = unit(quaternion)
    return [
        ",".join([UID, str(time), *map(repr, placed_at(position_m, frame)), *map(repr, numbers)])
        for frame in range(N_FRAMES)
        for time in times(frame, headset)
    ]


def write(root: Path, headset="Aria", hands=None, objects=None, mesh=None) -> RawTree:
    folder = root / KEY.name
    for new in (folder, root / "assets"):
        new.mkdir(parents=True, exist_ok=True)
    text = "\n".join(json.dumps(line) for line in (hands or lines(headset)))
    (folder / "mano_hand_pose_trajectory.jsonl").write_text(text)
    (folder / "dynamic_objects.csv").write_text("\n".join([hot3d.OBJECT_HEAD, *(objects or rows(headset))]))
    (folder / "metadata.json").write_text(json.dumps({"headset": headset, "participant_id": "P0009"}))
    (root / "assets/instance.json").write_text(json.dumps({UID: {"instance_name": "bowl"}}))
    (root / f"assets/{UID}.glb").write_bytes(mesh or hot3d.glb(CORNERS, FACES, NODE))
    return RawTree(root)


def load(raw: RawTree, hands=None) -> Clip:
    (clip,) = Hot3dAdapter().load(raw, KEY, hands or load_embedded_hands())
    assert isinstance(clip, Clip)
    assert clip.n_frames == N_FRAMES
    return clip


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    return load(write(tmp_path_factory.mktemp("hot3d")))


def hot3d_joints(side: str, hands, model=None, **other) -> np.ndarray:
    """(16, 3) joints by HOT3D's convention: 15 components plus mean pose, rotated about J0, then translated."""
    model = model or hands[side]
    rest = rest_points(model, other.get("betas", BETAS))
    bends = other.get("bends", model.mean_pose + np.array(POSE[side]) @ model.components[:15])
    orient = turn_of(other.get("quaternion", QUATERNION[side])).as_rotvec()
    joints = chain(rest, orient, bends, placed_at(TRANSL[side], AT))
    return joints - (rest[0] if other.get("is_the_wrist") else 0)


@pytest.mark.parametrize("side", SIDES)
class TestHands:
    def test_the_translation_is_added_to_the_rest_wrist(self, clip, hands, side):
        actual = joints_as_stored(clip.hands[side], hands[side], AT)
        agrees(actual, hot3d_joints(side, hands), hot3d_joints(side, hands, is_the_wrist=True))

    def test_quaternions_of_hands_have_w_first(self, clip, hands, side):
        last = hot3d_joints(side, hands, quaternion=np.roll(QUATERNION[side], 1))
        agrees(joints_as_stored(clip.hands[side], hands[side], AT), hot3d_joints(side, hands), last)

    def test_fingers_are_relative_to_the_mean_pose(self, clip, hands, side):
        absolute = hot3d_joints(side, hands, bends=np.array(POSE[side]) @ hands[side].components[:15])
        agrees(joints_as_stored(clip.hands[side], hands[side], AT), hot3d_joints(side, hands), absolute)

    def test_fifteen_components_are_weights_of_the_models_first_rows(self, clip, hands, side):
        model = hands[side]
        as_columns = hot3d_joints(side, hands, bends=model.mean_pose + model.components[:, :15] @ POSE[side])
        last_rows = hot3d_joints(side, hands, bends=model.mean_pose + np.array(POSE[side]) @ model.components[30:])
        agrees(joints_as_stored(clip.hands[side], model, AT), hot3d_joints(side, hands), as_columns, last_rows)

    def test_both_hands_have_the_shape_of_the_file(self, clip, hands, side):
        mean = hot3d_joints(side, hands, betas=np.zeros(10))
        agrees(joints_as_stored(clip.hands[side], hands[side], AT), hot3d_joints(side, hands), mean)
        assert clip.hands[side].betas.shape == (1, 10)


def test_0_is_the_left_hand_and_1_the_right(clip, hands):
    """Components of both sides are mirrored, so positions and rotations distinguish the sides, not fingers."""
    for side, other in (SIDES, SIDES[::-1]):
        swapped = hot3d_joints(other, hands, model=hands[side])
        agrees(joints_as_stored(clip.hands[side], hands[side], AT), hot3d_joints(side, hands), swapped)


def test_left_shape_directions_are_corrected(hands, tmp_path):
    """With a MANO_LEFT as released, whose x directions have the wrong sign, which the authors' loader corrects."""
    wrong = np.array(hands.left.shape_directions)
    wrong[:, 0] *= -1  # the embedded hand is already corrected
    released = replace(hands, left=replace(hands.left, shape_directions=wrong))
    chosen = hands_for(Hot3dAdapter().hand_convention, released)
    actual = joints_as_stored(load(write(tmp_path), chosen).hands["left"], chosen.left, AT)
    agrees(actual, hot3d_joints("left", hands), hot3d_joints("left", hands, model=released.left))


def corners(track) -> np.ndarray:
    return (track.world_from_object @ track.model.vertices_m)[AT]


def expected_corners(rotation=None, position_m=None, node=True, corners_m=CORNERS) -> np.ndarray:
    points = np.array(corners_m)
    if node:
        points = Rotation.from_quat(NODE["rotation"]).apply(points) + NODE["translation"]
    actual = (rotation or turn_of(BOX_QUATERNION)).apply(points) + (
        placed_at(BOX_M, AT) if position_m is None else position_m
    )
    return in_order(actual)


def in_order(points) -> np.ndarray:
    """Sort rows by x, because the order of a mesh's vertices may differ from the file's."""
    return np.array(sorted(np.asarray(points).tolist()))


def test_meshes_are_in_metres_where_their_scene_puts_them(clip):
    actual = in_order(corners(clip.object))
    millimetres = expected_corners(corners_m=np.array(CORNERS) / 1000)
    agrees(actual, expected_corners(), expected_corners(node=False), millimetres)


def test_quaternions_have_w_first_and_rotate_columns(clip):
    by_rows, last = turn_of(BOX_QUATERNION).inv(), turn_of(np.roll(BOX_QUATERNION, 1))
    agrees(in_order(corners(clip.object)), expected_corners(), expected_corners(by_rows), expected_corners(last))


def test_files_are_in_metres_and_the_profile_in_millimetres(clip):
    agrees(clip.object.translation_m[AT], placed_at(BOX_M, AT), np.array(placed_at(BOX_M, AT)) / 1000)
    joints = umetrack_joints("left")
    agrees(joints[[1, 16]], hot3d_hand("left")[[1, 16]], hot3d_hand("left")[[1, 16]] / 1000)


WRIST_M, WRIST_QUATERNION = [-0.13, 0.755, -0.131], [0.8, -0.2, 0.5, 0.1]
ANGLES = [0.1, 0.2, 0.5, 0.24, -0.1, 0.28, 0.2, 0.2, -0.2, 0.6, 0.3, 0.25, 0.16, 0.07, 0.9, 0.23, 0.08, -0.4, 0.5, 0.2]


def umetrack_joints(side: str) -> np.ndarray:
    wrist = {"t_xyz": WRIST_M, "q_wxyz": unit(WRIST_QUATERNION)}
    pose = {"wrist_xform": wrist, "joint_angles": [*ANGLES, 0.7, -0.7], "hand_confidence": 1.0}
    line = {"timestamp_ns": 1, "hand_poses": {str(SIDES.index(side)): pose}}
    (poses,) = files.hand_poses(json.dumps(line).encode(), "u.jsonl", "umetrack").values()
    profile = files.parse_profile(json.dumps(hot3d.profile()).encode(), "profile.json")
    return files.joints_m(profile, poses, side)[0]


def hot3d_hand(side: str) -> np.ndarray:
    """(21, 3) by an independent formula, bone by bone from the wrist position of the file."""
    return turn_of(WRIST_QUATERNION).apply(hot3d.umetrack_joints(side, ANGLES)) + WRIST_M


@pytest.mark.parametrize("side", SIDES)
def test_umetracks_joints_are_converted_to_hoidatas_order_and_its_right_hand_is_the_mirrored_left(side):
    """The last two angles, of the wrist, are unused; the file has no base of the thumb."""
    actual, expected = umetrack_joints(side), hot3d_hand(side)
    assert np.isnan(actual[13]).all()
    has_joint = np.arange(21) != 13
    other = hot3d_hand("left" if side == "right" else "right")
    ring_before_pinky = expected[[*range(7), 10, 11, 12, 7, 8, 9, *range(13, 21)]]
    agrees(actual[has_joint], expected[has_joint], other[has_joint], ring_before_pinky[has_joint])
    thumb_first = expected[[*range(16), 20, 16, 17, 18, 19]]
    assert off_m(actual[has_joint], thumb_first[has_joint]) > WRONG_M
    joint_added = expected + hot3d.umetrack_rest_m()[4]
    assert off_m(actual[0], WRIST_M) < EXACT_M < WRONG_M < off_m(actual[has_joint], joint_added[has_joint])


def test_two_times_of_one_aria_frame_are_one_frame_and_rows_are_joined_by_time(tmp_path, hands):
    """The first of two times counts. Rows are unordered, and one row of the object has only the second time."""
    shuffled = np.random.default_rng(0).permutation(2 * N_FRAMES)
    tables = [np.array(table, dtype=object)[shuffled].tolist() for table in (lines(), rows())]
    lost = next(index for index, row in enumerate(tables[1]) if f",{times(20)[0]}," in row)
    del tables[1][lost]
    actual = load(write(tmp_path, hands=tables[0], objects=tables[1]))
    assert actual.source_frames.tolist() == list(range(N_FRAMES))
    for side in SIDES:
        steps = np.arange(N_FRAMES)[:, None] * (STEP_M, 0, 0)
        positions_m = rest_points(hands[side], BETAS)[0] + TRANSL[side] + steps
        agrees(actual.hands[side].wrist_m, positions_m, positions_m[shuffled[shuffled < N_FRAMES]])
    positions_m = np.array(BOX_M) + np.arange(N_FRAMES)[:, None] * (STEP_M, 0, 0)
    assert off_m(actual.object.translation_m, positions_m) < EXACT_M


def test_a_hand_without_a_row_is_not_valid_there(tmp_path):
    missing = lines()
    for line in missing[2 * AT : 2 * AT + 2]:
        del line["hand_poses"]["0"]
    actual = load(write(tmp_path, hands=missing))
    assert np.flatnonzero(~actual.hands["left"].valid).tolist() == [AT]
    assert actual.hands["right"].valid.all()


@pytest.mark.parametrize(("headset", "down"), [("Aria", (0, 0, -1)), ("Quest3", (0, -1, 0))])
def test_objects_fall_along_minus_z_with_either_headset(tmp_path, hands, headset, down):
    """Quest 3's world has y up: its clips are rotated, and source_from_world restores it."""
    actual = load(write(tmp_path, headset))
    assert actual.gravity.tolist() == [0.0, 0.0, -1.0]
    np.testing.assert_allclose(actual.source_from_world[:3, :3] @ actual.gravity, down, atol=1e-12)
    back = actual.source_from_world[:3, :3]
    agrees(in_order(corners(actual.object) @ back.T), expected_corners())
    for side in SIDES:
        agrees(joints_as_stored(actual.hands[side], hands[side], AT) @ back.T, hot3d_joints(side, hands))


class TestSeatedPerson(SeatedPersonContract):
    @pytest.fixture
    def look(self, tmp_path, hands):
        """Joints of both hands and three edges in the world, of a person of known pose."""

        def of(person):
            def numbers(side, frame):
                orient, angles, transl = person.hands[side]
                model = hands[side]
                pose = np.linalg.lstsq(model.components[:15].T, angles - model.mean_pose, rcond=None)[0].tolist()
                quaternion = np.roll(Rotation.from_rotvec(orient).as_quat(), 1).tolist()
                return hand(side, frame, pose, quaternion, list(transl))

            # The hand grasps the middle of the first edge: a wrist a few centimetres off along the edge still touches.
            points = np.array([[0.3, 0.0, 0.0], [-0.3, 0.0, 0.0], [0.3, 0.08, 0.0], [0.3, 0.0, 0.05]]) * person.signs
            position_m = np.array(person.hands["right"][2]) + rest_points(hands.right)[0]
            quaternion = np.roll(Rotation.from_rotvec(person.object_orient).as_quat(), 1)
            mesh = hot3d.glb(points, FACES)
            raw = write(tmp_path, hands=lines(hands=numbers), objects=rows("Aria", quaternion, position_m), mesh=mesh)
            clip = load(raw)
            model = clip.object.model
            order = [int(np.linalg.norm(model.vertices_m - point, axis=1).argmin()) for point in points]
            box = corners(clip.object)[order]
            return {side: joints_as_stored(clip.hands[side], hands[side], AT) for side in SIDES}, box[1:4] - box[0]

        return of
