"""ManipNet's conventions, one test each: BVH and OBJ files typed here, joints worked out link by link in the files' own
left-handed decimetres, and the same with the convention the other way round, which must be off by more than 5 mm.
Neither our BVH reader nor our mirror is used in the formulas."""

import gzip
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Clip
from hoidata.datasets import RawTree, SequenceKey
from hoidata.datasets.manipnet.adapter import ManipNetAdapter, read_recording
from hoidata.hands import load_embedded_hands, track_joints
from tests.builders.formulas import EXACT_M, WRONG_M, agrees, off_m

N_FRAMES = 480
KEY = SequenceKey("manipnet", "manipnet", "wedge3")
MIRROR = np.array([-1.0, 1.0, 1.0])

# The right hand as its file has it, in decimetres; the left hand's file has the opposite sign before each x ("~").
HAND_BVH = """HIERARCHY
ROOT WRIST
{
	OFFSET 0.0 0.0 0.0
	CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
	JOINT THUMB_CMC_FE
	{
		OFFSET ~0.21 0.13 -0.07
		CHANNELS 3 Yrotation Xrotation Zrotation
		JOINT THUMB_CMC_AA
		{
			OFFSET ~0.19 0.17 -0.09
			CHANNELS 3 Yrotation Xrotation Zrotation
			JOINT THUMB_MCP_FE
			{
				OFFSET ~0.29 0.21 -0.05
				CHANNELS 3 Yrotation Xrotation Zrotation
				JOINT THUMB_IP_FE
				{
					OFFSET ~0.31 0.20 -0.03
					CHANNELS 3 Yrotation Xrotation Zrotation
					End Site
					{
						OFFSET 0.0 0.0 0.0
					}
				}
			}
		}
	}
	JOINT INDEX_MCP { OFFSET ~1.06 0.24 0.02 CHANNELS 3 Yrotation Xrotation Zrotation
		JOINT INDEX_PIP_FE { OFFSET ~0.42 0.03 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
			JOINT INDEX_DIP_FE { OFFSET ~0.27 0.02 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
				End Site { OFFSET 0.0 0.0 0.0 } } } }
	JOINT MIDDLE_MCP { OFFSET ~1.05 0.01 0.03 CHANNELS 3 Yrotation Xrotation Zrotation
		JOINT MIDDLE_PIP_FE { OFFSET ~0.47 0.01 0.02 CHANNELS 3 Yrotation Xrotation Zrotation
			JOINT MIDDLE_DIP_FE { OFFSET ~0.31 -0.01 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
				End Site { OFFSET 0.0 0.0 0.0 } } } }
	JOINT RING_MCP { OFFSET ~0.98 -0.20 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
		JOINT RING_PIP_FE { OFFSET ~0.43 -0.02 0.02 CHANNELS 3 Yrotation Xrotation Zrotation
			JOINT RING_DIP_FE { OFFSET ~0.29 -0.02 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
				End Site { OFFSET 0.0 0.0 0.0 } } } }
	JOINT PINKY_MCP { OFFSET ~0.87 -0.39 -0.06 CHANNELS 3 Yrotation Xrotation Zrotation
		JOINT PINKY_PIP_FE { OFFSET ~0.34 -0.03 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
			JOINT PINKY_DIP_FE { OFFSET ~0.23 -0.02 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
				End Site { OFFSET 0.0 0.0 0.0 } } } }
}
"""
OBJECT_BVH = """HIERARCHY
ROOT wedge
{
	OFFSET 0.0 0.0 0.0
	CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
	End Site
	{
		OFFSET 0.0 0.0 0.0
	}
}
"""
# Right-handed decimetres; no plane of symmetry; its middle lies 3 cm away from its origin.
WEDGE_OBJ = "v 0.9 0.1 0.2\nv 0.1 0.8 0.1\nv 0.2 0.1 0.5\nv -0.1 -0.2 -0.2\nf 1/1 2/2 3/3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n"
WEDGE = np.array([[0.9, 0.1, 0.2], [0.1, 0.8, 0.1], [0.2, 0.1, 0.5], [-0.1, -0.2, -0.2]])
# (parent, offset) of each joint of the right hand in file order, as in the text above.
CHAINS: dict[str, list[tuple[float, float, float]]] = {
    "thumb": [(-0.21, 0.13, -0.07), (-0.19, 0.17, -0.09), (-0.29, 0.21, -0.05), (-0.31, 0.20, -0.03)],
    "index": [(-1.06, 0.24, 0.02), (-0.42, 0.03, 0.01), (-0.27, 0.02, 0.01)],
    "middle": [(-1.05, 0.01, 0.03), (-0.47, 0.01, 0.02), (-0.31, -0.01, 0.01)],
    "ring": [(-0.98, -0.20, 0.01), (-0.43, -0.02, 0.02), (-0.29, -0.02, 0.01)],
    "pinky": [(-0.87, -0.39, -0.06), (-0.34, -0.03, 0.01), (-0.23, -0.02, 0.01)],
}
TIPS = {
    "thumb": ("THUMB_IP_FE", (-0.22, 0.16, -0.03)),
    "index": ("INDEX_DIP_FE", (-0.26, 0.03, 0.02)),
    "middle": ("MIDDLE_DIP_FE", (-0.29, 0.02, -0.01)),
    "ring": ("RING_DIP_FE", (-0.28, 0.01, -0.02)),
    "pinky": ("PINKY_DIP_FE", (-0.25, -0.02, -0.02)),
}
FILE_ORDER = ("thumb", "index", "middle", "ring", "pinky")
OUR_ORDER = ("index", "middle", "pinky", "ring", "thumb")
# Degrees about Y, X, Z as in the right hand's file: the wrist, then each joint of each chain.
WRIST_TURN = (35.0, -28.0, 17.0)
BENDS = {
    "thumb": [(9.0, -6.0, 7.0), (11.0, 18.0, -13.0), (4.0, 7.0, 8.0), (-9.0, 8.0, -11.0)],
    "index": [(-14.0, 9.0, 6.0), (-29.0, 3.0, 2.0), (-19.0, 5.0, -4.0)],
    "middle": [(-17.0, 2.0, 3.0), (-34.0, 2.0, 5.0), (-21.0, 4.0, 7.0)],
    "ring": [(-20.0, -6.0, 7.0), (-37.0, 8.0, 9.0), (-23.0, 10.0, 11.0)],
    "pinky": [(-24.0, -12.0, 13.0), (-39.0, 14.0, 15.0), (-25.0, 16.0, 14.0)],
}
OBJECT_TURN = (62.0, -31.0, 24.0)


class Rates(NamedTuple):
    text: str
    frame_time_s: float


HZ120, HZ116 = Rates("0.008333334", 0.008333334), Rates("0.00862069", 0.00862069)


def wrist_dm(frame: int) -> np.ndarray:
    """The right wrist in its file: faster and faster upwards and away."""
    square_s = (frame / 120) ** 2
    return np.array([1.5, 2.0 + 1.5 * square_s, -0.5 + 0.9 * square_s])


def turned(degrees) -> np.ndarray:
    """Ry Rx Rz on column vectors."""
    return Rotation.from_euler("YXZ", degrees, degrees=True).as_matrix()


def other_order(degrees) -> np.ndarray:
    """Rz Rx Ry: the same angles the other way round."""
    return Rotation.from_euler("ZXY", tuple(degrees)[::-1], degrees=True).as_matrix()


def left_handed_hand(frame: int, turn=turned, tips: bool = True) -> dict[str, np.ndarray]:
    """Per chain its joints, then its tip, in the file's world (decimetres), link by link."""
    chains = {}
    for finger, offsets in CHAINS.items():
        point, rotation, points = wrist_dm(frame), turn(WRIST_TURN), []
        for offset, bend in zip(offsets, BENDS[finger], strict=True):
            point = point + rotation @ offset
            rotation = rotation @ turn(bend)
            points.append(point)
        points.append(point + rotation @ TIPS[finger][1] if tips else point)
        chains[finger] = np.array(points)
    return chains


def keypoints(frame: int, chains: dict[str, np.ndarray] | None = None, order=OUR_ORDER, thumb: int = 1) -> np.ndarray:
    """(21, 3) still in the file's world: wrist, three joints of each finger, five tips. thumb: its first joint."""
    chains = left_handed_hand(frame) if chains is None else chains
    joints = [chains[finger][(thumb if finger == "thumb" else 0) :][:3] for finger in order]
    return np.concatenate(([wrist_dm(frame)], *joints, [chains[finger][-1] for finger in order]))


def world_m(points_dm: np.ndarray) -> np.ndarray:
    """Right-handed metres."""
    return points_dm * MIRROR / 10


def object_dm(frame: int) -> np.ndarray:
    """The object's place in its file: its middle lies between index and middle fingertip."""
    chains = left_handed_hand(frame)
    between = (chains["index"][-1] + chains["middle"][-1]) / 2
    return between - turned(OBJECT_TURN) @ (WEDGE.mean(axis=0) * MIRROR)


def bvh(head: str, rows: list[list[float]], rates: Rates) -> str:
    lines = ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {rates.text}"]
    return head + "\n".join(lines + [" ".join(f"{value:.7f}" for value in row) for row in rows]) + "\n"


def write(root: Path, rates: Rates = HZ120) -> RawTree:
    """Right hand and object move together; the left hand is the right one's mirror image, 6 dm to the side."""
    angles = [*WRIST_TURN, *(angle for finger in FILE_ORDER for bend in BENDS[finger] for angle in bend)]
    mirrored = [angle * sign for angle, sign in zip(angles, [-1, 1, -1] * 17, strict=True)]
    frames = range(N_FRAMES)
    right = [[*wrist_dm(frame), *angles] for frame in frames]
    left = [[*(wrist_dm(frame) * MIRROR - (2, 0, 0)), *mirrored] for frame in frames]
    thing = [[*object_dm(frame), *OBJECT_TURN] for frame in frames]
    folder = root / "sequences" / KEY.name
    texts = {
        folder / "rightHand.bvh.gz": bvh(HAND_BVH.replace("~", "-"), right, rates),
        folder / "leftHand.bvh.gz": bvh(HAND_BVH.replace("~", ""), left, rates),
        folder / "wedge.bvh.gz": bvh(OBJECT_BVH, thing, rates),
        root / "objects" / "Primitive" / "wedge.obj.gz": WEDGE_OBJ,
    }
    for path, text in texts.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(gzip.compress(text.encode(), mtime=0))
    (root / "hand").mkdir()
    capsules = [{"joint": joint, "end_local": end} for joint, end in TIPS.values()]
    (root / "hand" / "hand_reference.json").write_text(json.dumps({"capsules": capsules}))
    return RawTree(root)


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> RawTree:
    return write(tmp_path_factory.mktemp("manipnet"))


@pytest.fixture(scope="module")
def right(raw: RawTree) -> np.ndarray:
    """(frame, 21, 3) the right hand's keypoints as read."""
    return read_recording(raw, KEY.name).keypoints_m["right"]


@pytest.fixture(scope="module")
def clip(raw: RawTree) -> Clip:
    return next(item for item in ManipNetAdapter().load(raw, KEY, load_embedded_hands()) if isinstance(item, Clip))


FRAME = 30  # of the recording at 30 fps: source frame 120


def test_the_world_is_seen_in_a_mirror_with_normal_x(right: np.ndarray) -> None:
    expected = world_m(keypoints(120))
    agrees(right[FRAME], expected, keypoints(120) / 10)


def test_joint_rotations_are_seen_in_the_mirror_too(right: np.ndarray) -> None:
    def not_turned_over(degrees) -> np.ndarray:
        """What mirroring positions and offsets alone would do: M R M in the place of R, undone by the last mirror."""
        return np.diag(MIRROR) @ turned(degrees) @ np.diag(MIRROR)

    agrees(right[FRAME], world_m(keypoints(120)), world_m(keypoints(120, left_handed_hand(120, not_turned_over))))


def test_a_unit_is_a_decimetre(right: np.ndarray, clip: Clip) -> None:
    bone_m = np.linalg.norm(right[FRAME, 1] - right[FRAME, 0])
    expected = np.linalg.norm([1.06, 0.24, 0.02]) * 0.1
    assert abs(bone_m - expected) < EXACT_M
    assert min(abs(bone_m - expected * 10), abs(bone_m - expected / 10)) > WRONG_M
    np.testing.assert_allclose(clip.object.model.vertices_m, WEDGE / 10, atol=EXACT_M)
    assert off_m(clip.object.model.vertices_m, WEDGE / 100) > WRONG_M


def test_angles_turn_about_y_then_x_then_z_of_the_turned_frame(right: np.ndarray) -> None:
    agrees(right[FRAME], world_m(keypoints(120)), world_m(keypoints(120, left_handed_hand(120, other_order))))


def test_the_ring_finger_comes_before_the_little_one_in_the_file_and_after_it_here(right: np.ndarray) -> None:
    exchanged = keypoints(120, order=("index", "middle", "ring", "pinky", "thumb"))
    assert off_m(right[FRAME], world_m(keypoints(120))) < EXACT_M
    for joints in (slice(7, 13), slice(18, 20)):
        assert off_m(right[FRAME, joints], world_m(exchanged)[joints]) > WRONG_M


def test_the_thumbs_first_joint_is_its_second_one_in_the_file(right: np.ndarray) -> None:
    one_too_early = keypoints(120, thumb=0)
    agrees(right[FRAME, 13:16], world_m(keypoints(120))[13:16], world_m(one_too_early)[13:16])


def test_tips_are_the_ends_of_the_capsules_not_the_end_sites(right: np.ndarray) -> None:
    end_sites = keypoints(120, left_handed_hand(120, tips=False))
    agrees(right[FRAME, 16:], world_m(keypoints(120))[16:], world_m(end_sites)[16:])


def test_the_left_hands_tips_are_the_mirrored_capsule_ends(raw: RawTree, right: np.ndarray) -> None:
    left = read_recording(raw, KEY.name).keypoints_m["left"][FRAME]
    expected = world_m(keypoints(120) * MIRROR - (2, 0, 0))
    assert off_m(left, expected) < EXACT_M
    rotations = {}
    for finger, bends in BENDS.items():
        rotations[finger] = turned(WRIST_TURN)
        for bend in bends:
            rotations[finger] = rotations[finger] @ turned(bend)
    unmirrored = [  # the mirror image of a tip whose capsule end was mirrored once more
        keypoints(120)[16 + number] + rotations[finger] @ (np.array(TIPS[finger][1]) * (MIRROR - 1))
        for number, finger in enumerate(OUR_ORDER)
    ]
    assert off_m(left[16:], world_m(np.array(unmirrored) * MIRROR - (2, 0, 0))) > WRONG_M


def test_meshes_are_right_handed_already(clip: Clip) -> None:
    """In the left-handed world an OBJ's vertices have their x negated; seen in the mirror they are as written."""
    at = clip.source_frames.tolist().index(120)
    placed = (clip.object.world_from_object @ clip.object.model.vertices_m)[at]
    expected = world_m(WEDGE * MIRROR @ turned(OBJECT_TURN).T + object_dm(120))
    mirrored_once_more = world_m(WEDGE @ turned(OBJECT_TURN).T + object_dm(120))
    agrees(placed, expected, mirrored_once_more)


def test_object_matrices_act_on_columns(clip: Clip) -> None:
    at = clip.source_frames.tolist().index(120)
    placed = (clip.object.world_from_object @ clip.object.model.vertices_m)[at]
    transposed = world_m(WEDGE * MIRROR @ turned(OBJECT_TURN) + object_dm(120))
    agrees(placed, world_m(WEDGE * MIRROR @ turned(OBJECT_TURN).T + object_dm(120)), transposed)


def test_the_source_is_read_at_120_hz_every_fourth_frame(right: np.ndarray, raw: RawTree) -> None:
    recording = read_recording(raw, KEY.name)
    np.testing.assert_array_equal(recording.source_frames, np.arange(0, N_FRAMES, 4))
    wrists = np.array([wrist_dm(frame) for frame in range(0, N_FRAMES, 4)])
    every_frame = np.array([wrist_dm(frame) for frame in range(len(right))])
    agrees(right[:, 0], world_m(wrists), world_m(every_frame))


def test_the_116_hz_file_is_read_by_its_own_clock(tmp_path: Path) -> None:
    recording = read_recording(write(tmp_path, HZ116), KEY.name)
    nearest = [round(number / 30 / HZ116.frame_time_s) for number in range(len(recording.source_frames))]
    wrists = np.array([wrist_dm(frame) for frame in nearest])
    every_fourth = np.array([wrist_dm(4 * number) for number in range(len(nearest))])
    assert len(nearest) == int((N_FRAMES - 1) * HZ116.frame_time_s * 30) + 1
    np.testing.assert_array_equal(recording.source_frames, nearest)
    agrees(recording.keypoints_m["right"][:, 0], world_m(wrists), world_m(every_fourth))


def test_things_fall_along_minus_y(clip: Clip) -> None:
    """The file's wrist rises in y, and the object with it."""
    assert clip.gravity is not None
    first, last = clip.source_frames[[0, -1]] / 120
    moved_m = clip.object.translation_m[-1] - clip.object.translation_m[0]
    fallen_m = moved_m @ clip.gravity
    assert fallen_m == pytest.approx(-0.15 * (last**2 - first**2), abs=1e-5)
    along_z = moved_m @ (0.0, 0.0, -1.0)
    assert abs(fallen_m - along_z) > WRONG_M


def test_a_right_hand_is_fitted_to_the_right_hands_file(clip: Clip) -> None:
    hands = load_embedded_hands()
    at = clip.source_frames.tolist().index(120)
    expected = world_m(keypoints(120))
    right = track_joints(clip.hands["right"], hands["right"])[at]
    taken_for_left = track_joints(clip.hands["right"], hands["left"])[at]
    error_m = np.linalg.norm(right - expected, axis=-1).mean()
    assert error_m < 0.010
    assert np.linalg.norm(taken_for_left - expected, axis=-1).mean() > error_m + WRONG_M
