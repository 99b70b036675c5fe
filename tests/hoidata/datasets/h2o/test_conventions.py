"""H2O's conventions, one test each: the clip equals an independent formula, and the formula with the flipped convention
differs by 5 mm or by a discrete value. Formulas: NumPy and SciPy on the numbers typed here.

Sources: README of the dataset and the author's viewer (taeinkwon/h2odataset, taeinkwon/h2oplayer).
"""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import Clip
from hoidata.datasets import RawTree
from hoidata.datasets.h2o.adapter import H2OAdapter
from hoidata.errors import BadInput
from hoidata.hands import HandPair, load_embedded_hands, track_joints
from tests.builders.formulas import agrees, chain, rest_points
from tests.builders.h2o import camera, object_in_camera, write_text

N_FRAMES = 30
FIRST, LAST = 4, 26  # labelled frames, both inclusive
SAME_M, FAR_M = 1e-6, 5e-3
LEFT_T, RIGHT_T = (0.061, -0.083, 0.472), (-0.137, 0.022, 0.391)
LEFT_ORIENT, RIGHT_ORIENT = (0.41, -0.93, 0.57), (-0.33, 1.21, 0.18)
LEFT_BETAS = (1.7, -0.9, 0.4, 0.0, 0.8, 0.0, 0.0, -0.6, 0.0, 0.3)
RIGHT_BETAS = (-1.3, 0.7, 0.2, 0.9, 0.0, -0.5, 0.0, 0.0, 0.4, 0.0)
LEFT_INDEX, RIGHT_THUMB = (0.05, -0.12, 0.83), (0.31, 0.22, 0.47)  # first joint of each; all other fingers are flat


def betas(base: tuple[float, ...], frame: int) -> np.ndarray:
    """Betas that change with every frame, as in the files."""
    return np.array(base) + 0.04 * frame * np.eye(10)[0]


def hand_row(frame: int, left_flag: float = 1.0) -> list[float]:
    left = [left_flag, *LEFT_T, *LEFT_ORIENT, *LEFT_INDEX, *[0.0] * 42, *betas(LEFT_BETAS, frame)]
    right = [1.0, *RIGHT_T, *RIGHT_ORIENT, *[0.0] * 36, *RIGHT_THUMB, *[0.0] * 6, *betas(RIGHT_BETAS, frame)]
    return left + right


def joints_row(left_flag: float = 1.0) -> list[float]:
    """hand_pose of a flat hand in front of the camera, with the chain of each finger in OpenPose's order."""
    x = {"thumb": 0.045, "index": 0.025, "middle": 0.0, "ring": -0.02, "pinky": -0.04}
    start = {"thumb": 0.03, "index": 0.09, "middle": 0.092, "ring": 0.085, "pinky": 0.075}
    step = {"thumb": 0.03, "index": 0.028, "middle": 0.03, "ring": 0.027, "pinky": 0.021}
    points = [(0.0, 0.0, 0.4)]
    for finger in ("thumb", "index", "middle", "ring", "pinky"):
        points += [(x[finger], -(start[finger] + step[finger] * bone), 0.4) for bone in range(4)]
    left = np.add(points, (-0.15, 0.05, 0.0))
    right = np.multiply(points, (-1, 1, 1)) + np.array((0.15, 0.05, 0.02))
    return [left_flag, *left.ravel().tolist(), 1.0, *right.ravel().tolist()]


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """The left hand is not annotated in frame 9; "grab chips" (label 7) in frames 4 to 26."""
    root = tmp_path_factory.mktemp("h2o")
    folder = root / "subject1" / "o2" / "5" / "cam4"
    for frame in range(N_FRAMES):
        name = f"{frame:06d}.txt"
        write_text(folder / "cam_pose" / name, camera(frame))
        write_text(folder / "hand_pose_mano" / name, hand_row(frame, 0.0 if frame == 9 else 1.0))
        write_text(folder / "hand_pose" / name, joints_row(0.0 if frame == 9 else 1.0))
        write_text(folder / "obj_pose_rt" / name, [7, *object_in_camera(frame).ravel()])
        write_text(folder / "action_label" / name, [7 if FIRST <= frame <= LAST else 0])
    mesh = root / "object" / "chips" / "chips.obj"
    mesh.parent.mkdir(parents=True)
    mesh.write_text(
        "v 0.037 0 0.115\nv -0.037 0 0.115\nv 0 0.037 -0.115\nv 0 -0.037 -0.115\nf 1 2 3\nf 1 4 2\nf 1 3 4\nf 2 4 3\n"
    )
    return root


def released(hands: HandPair) -> HandPair:
    """The hands with a fault of the released MANO_LEFT.pkl: x of its shape directions as in the right hand's."""
    directions = hands.left.shape_directions.copy()
    directions[:, 0] = hands.right.shape_directions[:, 0]
    return replace(hands, left=replace(hands.left, shape_directions=directions))


MODELS = released(load_embedded_hands())


def load(root: Path, **settings) -> Clip:
    adapter = H2OAdapter(**settings)
    (key,) = adapter.sequences(root)
    (clip,) = adapter.load(RawTree(root), key, MODELS)
    return clip


@pytest.fixture(scope="module")
def clip(root) -> Clip:
    return load(root)


@pytest.fixture(scope="module")
def joints(clip) -> dict[str, np.ndarray]:
    """(frame, 21, 3) of each hand of the clip, by file number."""
    return {
        side: dict(zip(clip.source_frames.tolist(), track_joints(track, MODELS[side]), strict=True))
        for side, track in clip.hands.items()
    }


FRAMES = (4, 11, 26)


def seen_right(frame: int, **change) -> np.ndarray:
    """(16, 3) joints of the right hand in the camera's frame; ``change`` flips one convention."""
    shape = change.get("betas", betas(RIGHT_BETAS, frame))
    rest = rest_points(MODELS.right, shape)
    fingers = np.zeros(45)
    fingers[36:39] = RIGHT_THUMB
    return chain(rest, RIGHT_ORIENT, fingers + change.get("added", 0.0), change.get("transl", RIGHT_T))


def to_world(points: np.ndarray, frame: int) -> np.ndarray:
    return points @ camera(frame)[:3, :3].T + camera(frame)[:3, 3]


def check(joints: dict[str, dict], wrong: Callable, frames=FRAMES) -> None:
    """The right hand is where the formula says, and with the other convention more than 5 mm off."""
    for frame in frames:
        agrees(joints["right"][frame][:16], to_world(seen_right(frame), frame), wrong(frame))


def test_camera_files_are_camera_to_world_and_not_its_inverse(joints):
    check(joints, lambda frame: (seen_right(frame) - camera(frame)[:3, 3]) @ camera(frame)[:3, :3])


def test_camera_files_are_written_by_rows(joints):
    check(joints, lambda frame: seen_right(frame) @ camera(frame)[:3, :3] + camera(frame)[:3, 3])


def test_each_frame_has_the_camera_of_its_number(joints):
    check(joints, lambda frame: to_world(seen_right(frame), frame - 1))


def test_the_translation_is_added_to_the_rest_wrist(joints):
    def as_wrist(frame: int) -> np.ndarray:
        rest_wrist = rest_points(MODELS.right, betas(RIGHT_BETAS, frame))[0]
        return to_world(seen_right(frame, transl=np.array(RIGHT_T) - rest_wrist), frame)

    check(joints, as_wrist)


def test_a_change_of_frame_rotates_the_wrist_and_not_the_translation_alone(joints):
    def naive(frame: int) -> np.ndarray:
        """The rotated hand at ``A t + b``, as if the model rotated about its origin."""
        rest = rest_points(MODELS.right, betas(RIGHT_BETAS, frame))
        rotated = (seen_right(frame) - RIGHT_T - rest[0]) @ camera(frame)[:3, :3].T
        return rotated + rest[0] + camera(frame)[:3, :3] @ RIGHT_T + camera(frame)[:3, 3]

    check(joints, naive)


def test_fingers_are_absolute_and_the_mean_pose_is_not_added(joints):
    check(joints, lambda frame: to_world(seen_right(frame, added=MODELS.right.mean_pose), frame))


def test_betas_are_read_in_every_frame(clip, joints):
    assert clip.hands["right"].betas.shape == (LAST - FIRST + 1, 10)
    check(
        joints,
        lambda frame: to_world(seen_right(frame, betas=betas(RIGHT_BETAS, frame - 22)), frame),
        frames=(LAST,),
    )
    np.testing.assert_allclose(clip.hands["right"].betas[0], betas(RIGHT_BETAS, FIRST), atol=1e-6)
    np.testing.assert_allclose(clip.hands["right"].betas[-1], betas(RIGHT_BETAS, LAST), atol=1e-6)


def left_vertices(model, frame: int) -> np.ndarray:
    """(778, 3) shaped but unposed left hand relative to its wrist, which shows the shape directions."""
    shaped = model.template_m + model.shape_directions @ betas(LEFT_BETAS, frame)
    return shaped - model.joint_regressor[0] @ shaped


def test_left_betas_belong_to_the_shape_directions_as_released(clip, hands):
    """The wrist offset J0 of the left hand depends on them."""
    for frame in FRAMES:
        wrist = clip.hands["left"].wrist_m[frame - FIRST]
        as_released = rest_points(MODELS.left, betas(LEFT_BETAS, frame))[0] + LEFT_T
        corrected = rest_points(hands.left, betas(LEFT_BETAS, frame))[0] + LEFT_T
        np.testing.assert_allclose(wrist, to_world(as_released[None], frame)[0], atol=SAME_M)
        shapes = left_vertices(MODELS.left, frame), left_vertices(hands.left, frame)
        assert np.linalg.norm(shapes[0] - shapes[1], axis=1).max() > FAR_M
        assert np.linalg.norm(as_released - corrected) > 100 * SAME_M
    assert H2OAdapter().hand_convention.left_shape == "as released"


def test_the_left_block_comes_first(clip, joints):
    index = np.zeros(45)
    index[:3] = LEFT_INDEX
    rest = {side: rest_points(MODELS[side], betas(LEFT_BETAS, 11)) for side in ("left", "right")}
    expected = to_world(chain(rest["left"], LEFT_ORIENT, index, LEFT_T), 11)
    np.testing.assert_allclose(joints["left"][11][:16], expected, atol=SAME_M)
    assert np.linalg.norm(joints["right"][11][:16] - expected, axis=1).min() > FAR_M


def test_a_block_has_62_numbers_and_not_the_59_of_the_readme(clip):
    for frame in FRAMES:
        row = np.array(hand_row(frame))
        rest_wrist = rest_points(MODELS.right, betas(RIGHT_BETAS, frame))[0]
        expected = to_world((rest_wrist + RIGHT_T)[None], frame)[0]
        np.testing.assert_allclose(clip.hands["right"].wrist_m[frame - FIRST], expected, atol=SAME_M)
        assert row[62:66].tolist() == [1.0, *RIGHT_T]
        assert np.linalg.norm(row[59 + 1 : 59 + 4] - RIGHT_T) > FAR_M


def test_everything_is_in_metres(clip, joints):
    """A hand at arm's length from the camera, an object 23 cm high; millimetres would be 1000 times off."""
    distance = np.linalg.norm(joints["right"][11][0] - camera(11)[:3, 3])
    assert 0.2 < distance < 0.8
    bones = np.linalg.norm(np.diff(joints["right"][11][4:7], axis=0), axis=1)
    assert ((bones > 0.01) & (bones < 0.08)).all()
    assert np.ptp(clip.object.model.vertices_m[:, 2]) == pytest.approx(0.23)
    in_camera = camera(11)[:3, :3].T @ (clip.object.translation_m[11 - FIRST] - camera(11)[:3, 3])
    np.testing.assert_allclose(in_camera, object_in_camera(11)[:3, 3], atol=SAME_M)


def test_the_object_goes_from_its_frame_through_the_camera_to_the_world(clip):
    vertices = clip.object.model.vertices_m
    for frame in FRAMES:
        rotation = Rotation.from_rotvec(clip.object.rotvec[frame - FIRST]).as_matrix()
        placed = vertices @ rotation.T + clip.object.translation_m[frame - FIRST]

        def through(matrix: np.ndarray, frame: int = frame) -> np.ndarray:
            return to_world(vertices @ matrix[:3, :3].T + matrix[:3, 3], frame)

        np.testing.assert_allclose(placed, through(object_in_camera(frame)), atol=SAME_M)
        turned_round = object_in_camera(frame)
        turned_round[:3, :3] = turned_round[:3, :3].T
        wrongs = {
            "camera to object": through(np.linalg.inv(object_in_camera(frame))),
            "row vectors": through(turned_round),
            "object to world already": vertices @ object_in_camera(frame)[:3, :3].T + object_in_camera(frame)[:3, 3],
        }
        for wrong in wrongs.values():
            assert np.linalg.norm(wrong - placed, axis=1).max() > FAR_M


def test_a_hand_without_its_flag_is_not_valid_although_numbers_stand_there(clip):
    assert np.flatnonzero(~clip.hands["left"].valid).tolist() == [9 - FIRST]
    assert clip.hands["right"].valid.all()
    assert hand_row(9, 0.0)[1:4] == list(LEFT_T)


def test_the_last_labelled_frame_belongs_to_the_clip(clip):
    assert clip.source_frames.tolist() == list(range(FIRST, LAST + 1))
    assert clip.clip_id.endswith("000004-000026")


def test_source_frames_are_the_numbers_of_the_files(clip):
    assert clip.camera.images.tolist() == clip.source_frames.tolist()
    np.testing.assert_allclose(clip.camera.position_m[0], camera(FIRST)[:3, 3], atol=SAME_M)
    assert np.linalg.norm(camera(FIRST)[:3, 3] - camera(0)[:3, 3]) > FAR_M


def test_label_seven_is_grab_chips_and_class_seven_is_chips(clip):
    assert (clip.verb, clip.object_words, clip.object.model.name) == ("grab", "chips", "chips")


# hoidata's order: wrist, index, middle, pinky, ring, thumb (three joints each), then five tips; OpenPose's names.
OURS = ["wrist", *(f"{f}{j}" for f in ("index", "middle", "pinky", "ring", "thumb") for j in (0, 1, 2))]
OURS += [f"{f}3" for f in ("index", "middle", "pinky", "ring", "thumb")]
OPENPOSE = ["wrist", *(f"{f}{j}" for f in ("thumb", "index", "middle", "ring", "pinky") for j in (0, 1, 2, 3))]
RING_LAST = ["wrist", *(f"{f}{j}" for f in ("thumb", "index", "middle", "pinky", "ring") for j in (0, 1, 2, 3))]
TIPS = slice(16, 21)


@pytest.fixture(scope="module")
def fitted(root, tmp_path_factory) -> Clip:
    """The clip from joints alone, without MANO parameters."""
    bare = tmp_path_factory.mktemp("bare") / "h2o"
    shutil.copytree(root, bare, ignore=shutil.ignore_patterns("hand_pose_mano"))
    return load(bare, hands="keypoints")


def in_our_order(names: list[str], side: str) -> np.ndarray:
    """The joints of frame 11 in the world, for a file with the joint order ``names``."""
    points = np.array(joints_row()).reshape(2, 64)[0 if side == "left" else 1, 1:].reshape(21, 3)
    named = dict(zip(names, to_world(points, 11), strict=True))
    return np.array([named[name] for name in OURS])


@pytest.mark.parametrize("side", ["left", "right"])
def test_joint_files_list_the_thumb_first_and_ring_before_pinky(fitted, side):
    joints = track_joints(fitted.hands[side], MODELS[side])[11 - FIRST]
    expected = in_our_order(OPENPOSE, side)
    assert np.linalg.norm(joints - expected, axis=1)[TIPS].max() < FAR_M
    for wrong in (OURS, RING_LAST):
        assert np.linalg.norm(in_our_order(wrong, side) - expected, axis=1)[TIPS].max() > 4 * FAR_M


def test_joint_files_are_in_the_frame_of_the_camera(fitted):
    joints = track_joints(fitted.hands["right"], MODELS.right)[11 - FIRST]
    joints_camera = (in_our_order(OPENPOSE, "right") - camera(11)[:3, 3]) @ camera(11)[:3, :3]
    inverse = (joints_camera - camera(11)[:3, 3]) @ camera(11)[:3, :3]
    for wrong in (joints_camera, inverse):
        assert np.linalg.norm(joints - wrong, axis=1).min() > 20 * FAR_M


def test_a_clip_of_joints_alone_needs_no_mano_and_says_so(fitted):
    adapter = H2OAdapter(hands="keypoints")
    assert not adapter.needs_mano
    assert (adapter.hand_convention.shape, adapter.hand_convention.left_shape) == ("fitted", "unused")
    assert fitted.hands_from == "keypoints"
    assert 0 < fitted.fit_error_m < FAR_M
    assert np.flatnonzero(~fitted.hands["left"].valid).tolist() == [9 - FIRST]
    assert len(fitted.hands["left"].betas) == len(fitted.hands["right"].betas) == 1
    np.testing.assert_array_equal(fitted.hands["left"].betas, fitted.hands["right"].betas)
    assert H2OAdapter().needs_mano
    assert H2OAdapter().hand_convention.shape == "betas per frame"


def test_parameters_and_joints_are_never_mixed(root, clip, tmp_path):
    assert (clip.hands_from, clip.fit_error_m) == ("parameters", None)
    shutil.copytree(root, tmp_path / "h2o", ignore=shutil.ignore_patterns("hand_pose"))
    again = load(tmp_path / "h2o")
    np.testing.assert_array_equal(again.hands["left"].wrist_m, clip.hands["left"].wrist_m)
    with pytest.raises(BadInput, match=r"cam4/hand_pose: expected a folder"):
        load(tmp_path / "h2o", hands="keypoints")
