"""TACO's conventions, one test each: literal numbers, explicit formulas, and the same with the flipped convention,
which must be off by more than 5 mm. The formulas use neither a builder nor hoidata's conversion of hand parameters."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Clip
from hoidata.clips.hand_parameters import hands_for
from hoidata.datasets import RawTree, SequenceKey
from hoidata.datasets.taco.adapter import TacoAdapter
from hoidata.hands import load_embedded_hands
from tests.builders.formulas import EXACT_M, WRONG_M, agrees, chain, joints_as_stored, off_m, rest_points
from tests.hoidata.datasets.contract import SeatedPersonContract

KEY = SequenceKey("taco", "20231105", "(stir, spoon, pan)/20231105_007")
N_FRAMES = 12
AT = 9
SIDES = ("left", "right")
WRIST_M = {"left": (0.25, -0.12, 0.85), "right": (-0.17, 0.31, 0.92)}
ORIENT = {"left": (0.6, -1.0, 0.5), "right": (-0.3, 1.2, 0.9)}
BENT = [0.1, -0.2, 0.5] + [0.0] * 6 + [0.3, 0.4, 0.7] + [0.2] * 33
SHAPE = {
    "left": [1.2, -0.9, 0.7, 0.4, -0.5, 0.6, -0.3, 0.8, -0.1, 0.2],
    "right": [-1.0, 0.8, -0.7, 1.1, 0.3, -0.6, 0.5, -0.4, 0.9, -0.2],
}
STEP_M = 0.011  # along x from frame to frame
# The spoon's head is at the right wrist; the pan rests.
SPOON_CM = [[0.0, 0.0, 0.0], [18.0, 0.5, 0.0], [17.0, 2.0, 1.0], [1.0, -1.0, 2.5]]
PAN_CM = [[0.0, 0.0, 0.0], [26.0, 0.0, 0.0], [0.0, 24.0, 0.0], [0.0, 0.0, 6.0]]
SPOON_TURN, SPOON_M = (0.7, -0.4, 1.3), (-0.17, 0.31, 0.92)
PAN_TURN, PAN_M = (-0.2, 0.9, 0.1), (0.1, 0.2, 0.7)


def matrices(rotation, shift_m, step_m: float) -> np.ndarray:
    """(frame, 4, 4) that act on columns."""
    poses = np.tile(np.eye(4), (N_FRAMES, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    poses[:, :3, 3] = shift_m + np.arange(N_FRAMES)[:, None] * (step_m, 0.0, 0.0)
    return poses


def write(root: Path) -> Path:
    """Frame keys 1 to 12, not padded, in the file in the order of text: 1, 10, 11, 12, 2 and so on."""
    hands, objects, models = root / "Hand_Poses" / KEY.name, root / "Object_Poses" / KEY.name, root / "Object_Models"
    for folder in (hands, objects, models):
        folder.mkdir(parents=True)
    for side in SIDES:
        poses = {}
        for frame in sorted(range(N_FRAMES), key=lambda number: str(number + 1)):
            moved = np.array(WRIST_M[side]) + frame * np.array([STEP_M, 0, 0])
            pose = torch.tensor([*ORIENT[side], *BENT], dtype=torch.float32)
            poses[str(frame + 1)] = {"hand_pose": pose, "hand_trans": torch.tensor(moved, dtype=torch.float32)}
        (hands / f"{side}_hand.pkl").write_bytes(pickle.dumps(poses))
        shape = {"hand_shape": torch.tensor(SHAPE[side], dtype=torch.float32)}
        (hands / f"{side}_hand_shape.pkl").write_bytes(pickle.dumps(shape))
    np.save(objects / "tool_031.npy", matrices(SPOON_TURN, SPOON_M, STEP_M))
    np.save(objects / "target_004.npy", matrices(PAN_TURN, PAN_M, 0.0))
    for name, corners in (("031", SPOON_CM), ("004", PAN_CM)):
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f 1 3 2", "f 1 2 4", "f 2 3 4", "f 3 1 4"]
        (models / f"{name}_cm.obj").write_text("\n".join(lines))
    return root


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    raw = RawTree(write(tmp_path_factory.mktemp("taco")))
    (clip,) = TacoAdapter(margin_frames=N_FRAMES).load(raw, KEY, load_embedded_hands())
    assert isinstance(clip, Clip)
    assert clip.n_frames == N_FRAMES
    return clip


def taco_joints(side: str, hands, bends=BENT, betas=None, added_to_rest: bool = False) -> np.ndarray:
    """(16, 3) joints by TACO's convention: wrist at the origin, hand rotated, then translated."""
    rest = rest_points(hands[side], SHAPE[side] if betas is None else betas)
    translation = np.array(WRIST_M[side]) + AT * np.array([STEP_M, 0, 0])
    joints = chain(rest, ORIENT[side], np.array(bends), np.zeros(3))
    return joints - (0 if added_to_rest else rest[0]) + translation


@pytest.mark.parametrize("side", SIDES)
class TestHands:
    def test_the_translation_is_the_wrist_and_not_added_to_the_rest_wrist(self, clip, hands, side):
        actual = joints_as_stored(clip.hands[side], hands[side], AT)
        agrees(actual, taco_joints(side, hands), taco_joints(side, hands, added_to_rest=True))

    def test_fingers_are_absolute(self, clip, hands, side):
        actual = joints_as_stored(clip.hands[side], hands[side], AT)
        relative = taco_joints(side, hands, bends=BENT + hands[side].mean_pose)
        agrees(actual, taco_joints(side, hands), relative)

    def test_each_side_has_a_separate_shape(self, clip, hands, side):
        actual = joints_as_stored(clip.hands[side], hands[side], AT)
        other = taco_joints(side, hands, betas=SHAPE["right" if side == "left" else "left"])
        agrees(actual, taco_joints(side, hands), other)

    def test_frame_keys_are_sorted_as_numbers(self, clip, hands, side):
        """In the file's order, and in that of text, 12 comes before 2."""
        positions_m = np.array(WRIST_M[side]) + np.arange(N_FRAMES)[:, None] * (STEP_M, 0, 0)
        as_text = positions_m[sorted(range(N_FRAMES), key=lambda number: str(number + 1))]
        agrees(clip.hands[side].wrist_m, positions_m, as_text)


def test_left_shape_directions_stay_as_released(hands):
    """With the released sign, as TACO's loader reads the file; the corrected one moves the joints."""
    released = np.array(hands.left.shape_directions)
    released[:, 0] *= -1  # undo the correction of the embedded hand
    as_released = hands_like(hands, released)
    chosen = hands_for(TacoAdapter().hand_convention, as_released)
    expected = rest_points(as_released.left, SHAPE["left"])
    corrected = rest_points(hands.left, SHAPE["left"])
    assert off_m(rest_points(chosen.left, SHAPE["left"]), expected) < EXACT_M
    assert off_m(expected, corrected) > WRONG_M


def hands_like(hands, left_directions):
    return replace(hands, left=replace(hands.left, shape_directions=left_directions))


def corners(track) -> np.ndarray:
    return (track.world_from_object @ track.model.vertices_m)[AT]


def expected_corners(corners_cm, rotation, shift_m, scale: float = 0.01) -> np.ndarray:
    return np.array(corners_cm) * scale @ Rotation.from_rotvec(rotation).as_matrix().T + shift_m


SPOON_AT = np.array(SPOON_M) + AT * np.array([STEP_M, 0, 0])


def test_meshes_are_in_centimetres_and_motion_in_metres(clip):
    actual = corners(clip.object)
    agrees(
        actual,
        expected_corners(SPOON_CM, SPOON_TURN, SPOON_AT),
        expected_corners(SPOON_CM, SPOON_TURN, SPOON_AT, scale=0.001),
        expected_corners(SPOON_CM, SPOON_TURN, SPOON_AT / 100),
    )


def test_object_matrices_act_on_columns(clip):
    transposed = expected_corners(SPOON_CM, -np.array(SPOON_TURN), SPOON_AT)
    agrees(corners(clip.object), expected_corners(SPOON_CM, SPOON_TURN, SPOON_AT), transposed)


def test_the_tool_is_the_object_and_the_target_the_other_one(clip):
    (target,) = clip.other_objects
    assert (clip.object.model.name, target.model.name, clip.object_words) == ("031", "004", "spoon")
    assert off_m(corners(target), expected_corners(PAN_CM, PAN_TURN, PAN_M)) < EXACT_M
    assert off_m(corners(clip.object), expected_corners(PAN_CM, PAN_TURN, PAN_M)) > WRONG_M


def test_frames_are_30_a_second(clip):
    np.testing.assert_array_equal(clip.source_frames, np.arange(N_FRAMES))
    speed = np.linalg.norm(clip.object.translation_m[1] - clip.object.translation_m[0]) * 30
    assert abs(speed - STEP_M * 30) < 1e-4
    assert (clip.source_fps, TacoAdapter().source_fps) == (30, 30)


def test_gravity_is_unknown_with_its_reason(clip):
    assert clip.gravity is None
    assert clip.gravity_note
    assert (TacoAdapter().frame.up_axis, TacoAdapter().frame.gravity) == (None, "unknown")


def write_seated(root: Path, person) -> RawTree:
    """The recording with other hands, and with a spoon of three straight edges at the right wrist."""
    poses, objects = root / "Hand_Poses" / KEY.name, root / "Object_Poses" / KEY.name
    for side, (orient, angles, wrist_m) in person.hands.items():
        frame = {"hand_pose": torch.tensor([*orient, *angles]), "hand_trans": torch.tensor(wrist_m)}
        (poses / f"{side}_hand.pkl").write_bytes(pickle.dumps({str(number + 1): frame for number in range(N_FRAMES)}))
    np.save(objects / "tool_031.npy", matrices(person.object_orient, person.hands["right"][2], 0.0))
    # The hand grasps the middle of the first edge: a wrist a few centimetres off along the edge still touches.
    corners_cm = np.array([[20.0, 0.0, 0.0], [-20.0, 0.0, 0.0], [20.0, 8.0, 0.0], [20.0, 0.0, 5.0]]) * person.signs
    lines = [f"v {x} {y} {z}" for x, y, z in corners_cm]
    (root / "Object_Models" / "031_cm.obj").write_text("\n".join([*lines, "f 1 3 2", "f 1 2 4", "f 2 3 4", "f 3 1 4"]))
    return RawTree(root)


class TestSeatedPerson(SeatedPersonContract):
    @pytest.fixture
    def look(self, tmp_path, hands):
        """Joints of both hands and the spoon's three edges in the world, of a person of known pose."""

        def of(person):
            (clip,) = TacoAdapter(margin_frames=N_FRAMES).load(write_seated(tmp_path, person), KEY, hands)
            assert isinstance(clip, Clip)
            spoon = corners(clip.object)
            return {side: joints_as_stored(clip.hands[side], hands[side], AT) for side in SIDES}, spoon[1:4] - spoon[0]

        write(tmp_path)
        return of
