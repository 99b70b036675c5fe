"""ManipNet's conventions, one test each: handwritten BVH and OBJ files, joints computed link by link in the files'
left-handed decimetres, and the same with the flipped convention, which must be off by more than 5 mm. The formulas use
neither hoidata's BVH reader nor its mirror."""

import gzip
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Clip
from hoidata.datasets import RawTree
from hoidata.datasets.manipnet.adapter import ManipNetAdapter, read_recording
from hoidata.hands import load_embedded_hands, track_joints
from tests.builders.formulas import EXACT_M, WRONG_M, agrees, off_m
from tests.builders.manipnet import HAND, KEY, MIRROR, POSE, TETRA, TIPS, write_tree

N_FRAMES = 480

WEDGE = np.array([line.split()[1:] for line in TETRA.splitlines() if line.startswith("v ")], float)
FILE_ORDER = ("thumb", "index", "middle", "ring", "pinky")
OUR_ORDER = ("index", "middle", "pinky", "ring", "thumb")
# Offset of each joint of the right hand, and degrees about Y, X, Z as in its file: the wrist, then each chain.
OFFSETS = np.array(re.findall(r"JOINT \w+ { OFFSET ~(\S+) (\S+) (\S+)", HAND), float) * (-1, 1, 1)
WRIST_TURN, TURNS = POSE[3:6], np.reshape(POSE[6:], (16, 3))
JOINTS = {finger: slice(3 * n + (n > 0), 3 * n + 4) for n, finger in enumerate(FILE_ORDER)}  # the thumb has four
CHAINS = {finger: OFFSETS[joints] for finger, joints in JOINTS.items()}
BENDS = {finger: TURNS[joints] for finger, joints in JOINTS.items()}
ENDS = {joint.partition("_")[0].lower(): end for joint, end in TIPS.items()}
OBJECT_TURN = (62.0, -31.0, 24.0)


HZ120, HZ116 = "0.008333334", "0.00862069"  # with the precision of the files


def wrist_dm(frame: int) -> np.ndarray:
    """The right wrist in its file: faster and faster upwards and away."""
    square_s = (frame / 120) ** 2
    return np.array([1.5, 2.0 + 1.5 * square_s, -0.5 + 0.9 * square_s])


def turned(degrees) -> np.ndarray:
    """Ry Rx Rz on column vectors."""
    return Rotation.from_euler("YXZ", degrees, degrees=True).as_matrix()


def other_order(degrees) -> np.ndarray:
    """Rz Rx Ry: the same angles in reverse order."""
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
        points.append(point + rotation @ ENDS[finger] if tips else point)
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
    """The object's position in its file: its centre is between index and middle fingertip."""
    chains = left_handed_hand(frame)
    between = (chains["index"][-1] + chains["middle"][-1]) / 2
    return between - turned(OBJECT_TURN) @ (WEDGE.mean(axis=0) * MIRROR)


def write(root: Path, frame_time: str = HZ120) -> RawTree:
    """Right hand and object move together; the left hand is the right one's mirror image, 6 dm to the side."""
    mirrored = [angle * sign for angle, sign in zip(POSE[3:], [-1, 1, -1] * 17, strict=True)]
    frames = range(N_FRAMES)
    right = [[*wrist_dm(frame), *POSE[3:]] for frame in frames]
    left = [[*(wrist_dm(frame) * MIRROR - (2, 0, 0)), *mirrored] for frame in frames]
    raw = write_tree(root, left, right, [[*object_dm(frame), *OBJECT_TURN] for frame in frames])
    for path in (root / "sequences" / KEY.name).iterdir():
        text = gzip.decompress(path.read_bytes()).decode()
        path.write_bytes(gzip.compress(text.replace(HZ120, frame_time).encode()))
    return raw


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
        """The result of mirroring positions and offsets alone."""
        return np.diag(MIRROR) @ turned(degrees) @ np.diag(MIRROR)

    agrees(right[FRAME], world_m(keypoints(120)), world_m(keypoints(120, left_handed_hand(120, not_turned_over))))


def test_a_unit_is_a_decimetre(right: np.ndarray, clip: Clip) -> None:
    bone_m = np.linalg.norm(right[FRAME, 1] - right[FRAME, 0])
    expected = np.linalg.norm([1.05, 0.25, 0.01]) * 0.1
    assert abs(bone_m - expected) < EXACT_M
    assert min(abs(bone_m - expected * 10), abs(bone_m - expected / 10)) > WRONG_M
    np.testing.assert_allclose(clip.object.model.vertices_m, WEDGE / 10, atol=EXACT_M)
    assert off_m(clip.object.model.vertices_m, WEDGE / 100) > WRONG_M


def test_angles_rotate_about_y_then_x_then_z_of_the_rotated_frame(right: np.ndarray) -> None:
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
        keypoints(120)[16 + number] + rotations[finger] @ (np.array(ENDS[finger]) * (MIRROR - 1))
        for number, finger in enumerate(OUR_ORDER)
    ]
    assert off_m(left[16:], world_m(np.array(unmirrored) * MIRROR - (2, 0, 0))) > WRONG_M


def test_meshes_are_right_handed_already(clip: Clip) -> None:
    """In the left-handed world an OBJ's vertices have their x negated; negated again they are as written."""
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


def test_the_116_hz_file_is_read_by_its_clock(tmp_path: Path) -> None:
    recording = read_recording(write(tmp_path, HZ116), KEY.name)
    nearest = [round(number / 30 / float(HZ116)) for number in range(len(recording.source_frames))]
    wrists = np.array([wrist_dm(frame) for frame in nearest])
    every_fourth = np.array([wrist_dm(4 * number) for number in range(len(nearest))])
    assert len(nearest) == int((N_FRAMES - 1) * float(HZ116) * 30) + 1
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
