"""OakInk2's conventions, one test each: literal numbers, explicit formulas, and the same with the flipped convention,
which must be off by more than 5 mm. The formulas use no code of hoidata."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Clip
from hoidata.clips.hand_parameters import hands_for
from hoidata.datasets import RawTree, SequenceKey
from hoidata.datasets.oakink2.adapter import Oakink2Adapter
from hoidata.datasets.oakink2.files import read_program, verb_of
from hoidata.hands import load_embedded_hands
from tests.builders.formulas import EXACT_M, WRONG_M, agrees, chain, joints_as_stored, off_m, rest_points
from tests.builders.oakink2 import PREFIX, dump, quaternions, tensor, write_json
from tests.hoidata.datasets.contract import SeatedPersonContract

TOKEN = "scene_03__A007++seq__38754d477e531bf5aa62__2023-04-21-09-50-42"
KEY = SequenceKey("oakink2", "A007", TOKEN.replace("++", "/"))
FIRST, N_SOURCE = 8, 49  # mocap frames 8 to 56, of which every fourth is kept
AT = 9  # a frame of the clip
AT_SOURCE = 4 * AT
STEP_M = 0.003  # along x from mocap frame to frame
WRIST_M = {"left": (0.25, -0.12, 0.85), "right": (-0.17, 0.31, 0.92)}
ORIENT = {"left": (0.6, -1.0, 0.5), "right": (-0.3, 1.2, 0.9)}
BENT = [0.1, -0.2, 0.5] + [0.0] * 6 + [0.3, 0.4, 0.7] + [0.2] * 33
SHAPE = {
    "left": [1.2, -0.9, 0.7, 0.4, -0.5, 0.6, -0.3, 0.8, -0.1, 0.2],
    "right": [-1.0, 0.8, -0.7, 1.1, 0.3, -0.6, 0.5, -0.4, 0.9, -0.2],
}
BOX, DOOR, SPOON = "O02@0300@00001", "O02@0300@00002", "C12001"
CORNERS = {  # metres: the box of a microwave, its door next to it and a spoon
    BOX: [[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.25]],
    DOOR: [[0.0, 0.01, 0.0], [0.39, 0.01, 0.0], [0.0, 0.03, 0.0], [0.0, 0.01, 0.24]],
    SPOON: [[0.0, 0.0, 0.0], [0.18, 0.005, 0.0], [0.17, 0.02, 0.01], [0.01, -0.01, 0.025]],
}
TURN, SHIFT_M = (0.7, -0.4, 1.3), (-0.17, 0.31, 0.92)
HINGE_AXIS, HINGE_M = np.array([0.0, 0.0, 1.0]), np.array([0.4, 0.0, 0.0])
ANGLE = np.linspace(0.1, 1.4, N_SOURCE)


def frames() -> list[int]:
    return list(range(FIRST, FIRST + N_SOURCE))


def matrix(rotation, shift_m) -> np.ndarray:
    actual = np.eye(4)
    actual[:3, :3], actual[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), shift_m
    return actual


def place(at: int) -> np.ndarray:
    """World from spoon and box at a frame of the source; it acts on columns."""
    return matrix(TURN, np.array(SHIFT_M) + at * np.array([STEP_M, 0, 0]))


def door(at: int) -> np.ndarray:
    rotation = Rotation.from_rotvec(ANGLE[at] * HINGE_AXIS)
    return place(at) @ matrix(rotation.as_rotvec(), HINGE_M - rotation.apply(HINGE_M))


def wrist(side: str, at: int) -> np.ndarray:
    return np.array(WRIST_M[side]) + at * np.array([STEP_M, 0, 0])


def shape(side: str, at: int) -> np.ndarray:
    """It changes from frame to frame."""
    return np.array(SHAPE[side]) * (1 + at / N_SOURCE)


def annotation() -> dict:
    mano = {frame: {} for frame in frames()}
    for side in SIDES:
        for at, frame in enumerate(frames()):
            values = {"pose_coeffs": quaternions(ORIENT[side], BENT), "tsl": wrist(side, at), "betas": shape(side, at)}
            mano[frame] |= {f"{PREFIX[side]}{name}": tensor(value) for name, value in values.items()}
    parts = {BOX: place, DOOR: door, SPOON: place}
    poses = {name: {frame: of(at) for at, frame in enumerate(frames())} for name, of in parts.items()}
    return {"mocap_frame_id_list": frames(), "obj_list": list(parts), "obj_transf": poses, "raw_mano": mano}


def entry(primitive: str, mode: str, left: list | None, right: list | None) -> dict:
    lists = {"obj_list": [*(right or []), *(left or [])], "obj_list_lh": left, "obj_list_rh": right}
    return {"primitive": primitive, "interaction_mode": mode, **lists}


PROGRAM = {
    f"((8, {FIRST + N_SOURCE}), (16, 40))": entry("stir", "lh_main", [SPOON], [BOX]),
    "(None, (16, 41))": entry("open_gate", "rh_main", None, [DOOR]),
}


def write(root: Path, values: dict | None = None) -> Path:
    dump(root / f"anno_preview/{TOKEN}.pkl", annotation() if values is None else values)
    write_json(root / f"program/program_info/{TOKEN}.json", PROGRAM)
    names = {SPOON: "spoon", "O02@0300": "microwave oven"}
    write_json(root / "object_repair/obj_desc.json", {key: {"obj_id": key, "obj_name": n} for key, n in names.items()})
    write_json(root / "object_affordance/object_part_tree.json", {"O02@0300": [BOX, DOOR]})
    for name, corners in CORNERS.items():
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f 1 3 2", "f 1 2 4", "f 2 3 4", "f 3 1 4"]
        (root / f"object_repair/align_ds/{name}").mkdir(parents=True, exist_ok=True)
        (root / f"object_repair/align_ds/{name}/model.obj").write_text("\n".join(lines))
    return root


def load(root: Path) -> list[Clip]:
    actual = Oakink2Adapter(shortest_frames=2).load(RawTree(root), KEY, load_embedded_hands())
    return [item for item in actual if isinstance(item, Clip)]


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> list[Clip]:
    return load(write(tmp_path_factory.mktemp("oakink2")))


def corners(clip: Clip) -> np.ndarray:
    """(vertex, 3) of the clip's object in the world at AT."""
    return clip.object.points_in_world(clip.object.model.vertices_m, clip.object.model.part)[AT]


def seen_corners(name: str, pose: np.ndarray, scale: float = 1.0) -> np.ndarray:
    return np.array(CORNERS[name]) * scale @ pose[:3, :3].T + pose[:3, 3]


def stirred(clips) -> Clip:
    (actual,) = (clip for clip in clips if clip.verb == "stir")
    return actual


def test_places_are_metres(clips):
    wrong = seen_corners(SPOON, matrix(TURN, place(AT_SOURCE)[:3, 3] / 1000)), seen_corners(SPOON, place(0), 0.001)
    agrees(corners(stirred(clips)), seen_corners(SPOON, place(AT_SOURCE)), *wrong)


def test_object_matrices_act_on_columns(clips):
    by_rows = matrix(-np.array(TURN), place(AT_SOURCE)[:3, 3])
    agrees(corners(stirred(clips)), seen_corners(SPOON, place(AT_SOURCE)), seen_corners(SPOON, by_rows))


def test_each_part_has_a_separate_mesh_and_pose(clips):
    """The door's pose is that of its mesh in the world, not in the box."""
    (oven,) = stirred(clips).other_objects
    actual = oven.points_in_world(oven.model.vertices_m, oven.model.part)[AT]
    expected = [seen_corners(BOX, place(AT_SOURCE)), seen_corners(DOOR, door(AT_SOURCE))]
    in_the_box = seen_corners(DOOR, place(AT_SOURCE) @ door(AT_SOURCE))
    agrees(actual, np.concatenate(expected), np.concatenate([expected[0], in_the_box]))


def test_the_tree_tells_which_parts_are_one_object_and_the_bigger_surface_is_its_base(clips, tmp_path):
    model = stirred(clips).other_objects[0].model
    assert (model.name, model.vertices_m[model.part == 0].tolist()) == ("O02@0300", CORNERS[BOX])
    (tmp_path / "raw").mkdir()
    write(tmp_path / "raw")
    write_json(tmp_path / "raw/object_affordance/object_part_tree.json", {BOX: [], DOOR: []})
    (alone,) = stirred(load(tmp_path / "raw")).other_objects
    assert (alone.model.name, alone.is_articulated) == (BOX, False)


def test_the_hinge_is_estimated_and_rotates_by_the_right_hand_rule(clips):
    oven = stirred(clips).other_objects[0]
    assert np.abs(oven.model.hinge.axis - HINGE_AXIS).max() < 1e-6
    assert np.abs(oven.model.hinge.origin_m - HINGE_M).max() < 1e-6
    assert np.abs(oven.hinge_rad - ANGLE[::4]).max() < 1e-6
    assert off_m(oven.model.hinge.turn(-ANGLE) @ np.eye(3), oven.model.hinge.turn(ANGLE) @ np.eye(3)) > WRONG_M


def test_every_fourth_frame_from_the_first_is_kept_and_ranges_lack_their_last(clips):
    assert stirred(clips).source_frames.tolist() == list(range(FIRST, FIRST + N_SOURCE, 4))
    (opened,) = (clip for clip in clips if clip.verb == "open")
    assert opened.source_frames.tolist() == [16, 20, 24, 28, 32, 36, 40]
    (last,) = (hand_values for hand_values in read_program(b'{"(None, (16, 40))": %s}' % ENTRY, "x"))
    assert last.span == (16, 40)
    assert [str(key) for key in Oakink2Adapter().sequences(Path("nowhere"))] == []
    speed = np.linalg.norm(np.diff(stirred(clips).hands["left"].wrist_m[:2], axis=0)) * 30
    assert abs(speed - STEP_M * 120) < 1e-4


ENTRY = b'{"primitive": "pour", "interaction_mode": "rh_main", "obj_list": [], "obj_list_rh": null}'


def test_names_have_a_slash_for_two_pluses(tmp_path):
    write(tmp_path)
    assert Oakink2Adapter().sequences(tmp_path) == [KEY]


def test_primitives_are_verbs_and_ranges_tell_the_hand(clips):
    assert {clip.verb: clip.labelled_hand for clip in clips} == {"stir": "both", "open": "right"}
    assert {clip.verb: clip.object_words for clip in clips} == {"stir": "spoon", "open": "microwave oven"}
    assert [verb_of(name) for name in ("take_outside", "cut", "some_new_thing", "?(unk)")] == [
        "take out", "cut", "some new thing", None,
    ]  # fmt: skip


def test_a_hand_is_not_valid_without_an_entry_for_the_frame(tmp_path):
    values = annotation()
    del values["raw_mano"][FIRST + 12]
    for name in ("pose_coeffs", "tsl", "betas"):
        del values["raw_mano"][FIRST + 24][f"rh__{name}"]
    (tmp_path / "raw").mkdir()
    clip = stirred(load(write(tmp_path / "raw", values)))
    assert [np.flatnonzero(~clip.hands[side].valid).tolist() for side in SIDES] == [[3], [3, 6]]
    assert clip.hands["right"].wrist_m[5].any()


def test_gravity_is_unknown_with_its_reason(clips):
    assert stirred(clips).gravity is None
    assert "which way is up" in stirred(clips).gravity_note
    assert (Oakink2Adapter().frame.up_axis, Oakink2Adapter().frame.gravity) == (None, "unknown")


# --- hands


def hand_joints(side: str, hands, bends=BENT, betas=None, added_to_rest: bool = False, orient=None) -> np.ndarray:
    """(16, 3) joints by OakInk2's convention: wrist at the origin, hand rotated, then translated."""
    rest = rest_points(hands[side], shape(side, AT_SOURCE) if betas is None else betas)
    joints = chain(rest, ORIENT[side] if orient is None else orient, np.array(bends), np.zeros(3))
    return joints - (0 if added_to_rest else rest[0]) + wrist(side, AT_SOURCE)


@pytest.mark.parametrize("side", SIDES)
class TestHands:
    def test_the_translation_is_the_wrist_and_not_added_to_the_rest_wrist(self, clips, hands, side):
        actual = joints_as_stored(stirred(clips).hands[side], hands[side], AT)
        agrees(actual, hand_joints(side, hands), hand_joints(side, hands, added_to_rest=True))

    def test_fingers_are_absolute_and_quaternions_begin_with_w(self, clips, hands, side):
        actual = joints_as_stored(stirred(clips).hands[side], hands[side], AT)
        relative = hand_joints(side, hands, bends=BENT + hands[side].mean_pose)
        stored = quaternions(ORIENT[side], BENT)  # as if their last number were w
        turns = Rotation.from_quat(stored).as_rotvec().ravel()
        agrees(actual, hand_joints(side, hands), relative, hand_joints(side, hands, turns[3:], orient=turns[:3]))

    def test_the_shape_is_that_of_the_frame(self, clips, hands, side):
        actual = joints_as_stored(stirred(clips).hands[side], hands[side], AT)
        assert stirred(clips).hands[side].betas.shape == (13, 10)
        other = hand_joints(side, hands, betas=6 * shape(side, 0))
        agrees(actual, hand_joints(side, hands), other)
        first = joints_as_stored(stirred(clips).hands[side], hands[side], 0)
        moved = hand_joints(side, hands, betas=shape(side, 0)) - (wrist(side, AT_SOURCE) - wrist(side, 0))
        assert off_m(first, moved) < EXACT_M


def test_left_shape_directions_stay_as_released(hands):
    released = replace(hands, left=replace(hands.left, shape_directions=hands.right.shape_directions))
    assert hands_for(Oakink2Adapter().hand_convention, released) is released


class TestSeatedPerson(SeatedPersonContract):
    @pytest.fixture
    def look(self, tmp_path, hands):
        """Joints of both hands and the spoon's three edges in the world, of a person of known pose."""

        def of(person):
            values = annotation()
            for side, (orient, angles, wrist_m) in person.hands.items():
                hand_values = {"pose_coeffs": quaternions(orient, angles), "tsl": wrist_m}
                for frame in frames():
                    values["raw_mano"][frame] |= {f"{PREFIX[side]}{name}": tensor(v) for name, v in hand_values.items()}
            values["obj_transf"][SPOON] = dict.fromkeys(frames(), matrix(person.object_orient, (0.2, 0.1, 0.8)))
            write(tmp_path, values)
            spoon = np.array([[0.2, 0, 0], [-0.2, 0, 0], [0.2, 0.08, 0], [0.2, 0, 0.05]]) * person.signs
            lines = [f"v {x} {y} {z}" for x, y, z in spoon] + ["f 1 3 2", "f 1 2 4", "f 2 3 4", "f 3 1 4"]
            (tmp_path / f"object_repair/align_ds/{SPOON}/model.obj").write_text("\n".join(lines))
            clip = stirred(load(tmp_path))
            joints = {side: joints_as_stored(clip.hands[side], hands[side], AT) for side in SIDES}
            return joints, corners(clip)[1:4] - corners(clip)[0]

        return of
