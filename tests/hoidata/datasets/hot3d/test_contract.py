"""HOT3D passes the tests of all adapters; also the problems its files can have."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path

from tests.builders import hot3d
from tests.builders.corruption import (
    Corrupt,
    at,
    cut_in_half,
    emptied,
    holding,
    linked_outside,
    malicious,
    one_after_the_other,
    removed,
    replaced,
    set_in,
)
from tests.builders.hot3d import ARIA, MUG, OBJECT_HEAD, UMETRACK_FILE
from tests.hoidata.datasets.contract import AdapterContract, Problem

HAND, OBJECT, META = f"{ARIA}/mano_hand_pose_trajectory.jsonl", f"{ARIA}/dynamic_objects.csv", f"{ARIA}/metadata.json"
QA, MESH, NAMES = f"{ARIA}/masks/mask_qa_pass.csv", f"assets/{MUG}.glb", "assets/instance.json"
PROFILE, ANGLES = f"{ARIA}/umetrack_hand_user_profile.json", f"{ARIA}/{UMETRACK_FILE}"
RIGHT = ("hand_poses", "1")


def line(change: Callable[[dict], object], number: int = 2) -> Corrupt:
    """One line of the hand file with a change."""

    def edit(data: bytes) -> bytes:
        lines = data.splitlines(keepends=True)
        content = json.loads(lines[number])
        change(content)
        return b"".join([*lines[:number], json.dumps(content).encode() + b"\n", *lines[number + 1 :]])

    return at(HAND, edit)


def edited(path: str, change: Callable[[dict], object]) -> Corrupt:
    def edit(data: bytes) -> bytes:
        content = json.loads(data)
        change(content)
        return json.dumps(content).encode()

    return at(path, edit)


def cell(text: str, column: int, path: str = OBJECT) -> Corrupt:
    """The third line of a table with another text in one column."""

    def edit(data: bytes) -> bytes:
        lines = data.decode().splitlines()
        cells = lines[2].split(",")
        cells[column] = text
        return "\n".join([*lines[:2], ",".join(cells), *lines[3:]]).encode()

    return at(path, edit)


def with_umetrack_alone(*corruptions: Corrupt) -> Corrupt:
    """Give the first recording UmeTrack's hands only, then corrupt it."""

    def write(root: Path) -> None:
        (root / HAND).unlink()
        whole = hot3d.truth("Aria", "umetrack", 0)
        (root / ANGLES).write_text(hot3d.hand_lines(whole, "Aria"))

    return one_after_the_other(write, *corruptions)


class TestHot3d(AdapterContract):
    name = "hot3d"
    slow = True
    corrupted_sequence = f"hot3d/{ARIA}"
    write = staticmethod(hot3d.write_two)
    bad_settings = {  # noqa: RUF012
        "margin_frames": (-1, "0 or more"),
        "shortest_frames": (1.5, "0 or more"),
        "longest_frames": (0, "1 or more"),
        "most_fit_error_mm": (True, "0 or more"),
        "hands": ("both", "mano or umetrack"),
        "clips": ("all", "interactions or segments"),
    }
    conventions = {  # noqa: RUF012
        "unit": "test_files_are_in_metres_and_the_profile_in_millimetres",
        "handedness of the world": "contract.py::test_the_world_is_not_seen_in_a_mirror",
        "meshes": "test_meshes_are_in_metres_where_their_scene_puts_them",
        "object rotation": "test_quaternions_have_w_first_and_rotate_columns",
        "hand translation": "test_the_translation_is_added_to_the_rest_wrist",
        "finger angles": "test_fingers_are_relative_to_the_mean_pose",
        "principal components": "test_fifteen_components_are_weights_of_the_models_first_rows",
        "shape": "test_both_hands_have_the_shape_of_the_file",
        "left shape directions": "test_left_shape_directions_are_corrected",
        "left and right": "test_0_is_the_left_hand_and_1_the_right",
        "joint order": "test_umetracks_joints_are_converted_to_hoidatas_order_and_its_right_hand_is_the_mirrored_left",
        "frames": "test_two_times_of_one_aria_frame_are_one_frame_and_rows_are_joined_by_time",
        "validity": "test_a_hand_without_a_row_is_not_valid_there",
        "gravity": "test_objects_fall_along_minus_z_with_either_headset",
    }

    @staticmethod
    def file_problems() -> Iterable[Problem]:
        fat = b'{"timestamp_ns": 1, "hand_poses": [' + b"[]," * 30_000 + b"[]]}\n"
        yield "truncated file", HAND, at(HAND, cut_in_half), "JSON text"
        yield "empty file", OBJECT, at(OBJECT, emptied), "the columns object_uid"
        yield "malicious pickle", HAND, at(HAND, malicious), "JSON text"
        yield "NaN", HAND, at(HAND, replaced(b'"betas": [', b'"betas": [NaN, ')), "JSON text"
        yield "infinity", OBJECT, cell("1e400", 2), "finite"
        yield "wrong columns", HAND, line(set_in(*RIGHT, "pose", value=[0.1] * 45)), "15 numbers, got 45"
        yield "wrong dtype (words)", HAND, line(set_in(*RIGHT, "pose", value="words")), "15 numbers"
        yield "missing object file", MESH, removed(MESH), "nothing there"
        yield "missing object motion", OBJECT, removed(OBJECT), "nothing there"
        yield "non-UTF-8 text", OBJECT, cell("\xff", 0), "an object id of digits"
        yield "symlink out of the root", HAND, linked_outside(HAND), "link that leaves"
        yield "zero-face mesh", MESH, holding(MESH, hot3d.glb(hot3d.box(1), faces=())), "with faces"
        yield "absurd size (line)", HAND, holding(HAND, fat), "a line of at most"
        yield "absurd size (header)", MESH, at(MESH, replaced(b'"count": 8, "min"', b'"count":9e5,"min"')), "corners in"
        yield "duplicate ids", OBJECT, at(OBJECT, lambda data: data + data.splitlines()[1]), "twice"

    @staticmethod
    def format_problems() -> Iterable[Problem]:
        quaternion = line(set_in(*RIGHT, "wrist_xform", "q_wxyz", value=[2.0, 0.0, 0.0, 0.0]))
        wide = hot3d.packed(b'{"asset": {"version": "2.0"}}', b"")
        withheld = one_after_the_other(removed(HAND), removed(PROFILE))
        yield "no hands", HAND, withheld, "nothing to do: of some participants"
        yield "hands of nobody", HAND, holding(HAND, b'{"timestamp_ns": 5, "hand_poses": {}}\n'), "got none"
        yield "a third hand", ":3: hand_poses", line(lambda data: data["hand_poses"].update({"2": 1})), "hands 0"
        yield "a hand that is a list", ":3: hand 1", line(set_in(*RIGHT, value=[])), "a dictionary"
        yield "no betas", ":3: hand 1", line(lambda data: data["hand_poses"]["1"].pop("betas")), "'betas'"
        yield "true for a number", "t_xyz", line(set_in(*RIGHT, "wrist_xform", "t_xyz", value=[True, 1, 1])), "3 nu"
        yield "a time in seconds", "timestamp_ns", line(set_in("timestamp_ns", value=1.5)), "nanoseconds, got 1.5"
        yield "a quaternion of length 2", "right hand", quaternion, "one of length 2"
        yield "a time twice", "left hand", at(HAND, lambda data: data + data.splitlines()[0]), "each time once"
        yield "times of 120 Hz", "times", line(set_in("timestamp_ns", value=56752117188860)), "1/30 s apart"
        yield "an empty line", ":1", at(HAND, lambda data: b"\n" + data), "JSON text"
        yield "a missing column", OBJECT, holding(OBJECT, OBJECT_HEAD.replace("q_wo_w,", "")), "q_wo_w"
        yield "a place beyond the town", OBJECT, cell("1e200", 2), "numbers up to 1000"
        yield "no rows", OBJECT, holding(OBJECT, OBJECT_HEAD + "\n"), "poses of an object"
        yield "too many cells", f"{OBJECT}:3", cell("1,2", 2), "9 cells"
        yield "digits of another script", f"{OBJECT}:3", cell("٣", 2), "numbers"
        yield "an underscore in a number", f"{OBJECT}:3", cell("1_0", 2), "numbers"
        yield "a time in words", f"{OBJECT}:3", cell("now", 1), "nanoseconds"
        yield "an unknown object", NAMES, edited(NAMES, lambda data: data.pop(MUG)), f"the object {MUG}"
        yield "a name with a path", MUG, edited(NAMES, set_in(MUG, "instance_name", value="../mug")), "lower-case"
        yield "objects as a list", NAMES, holding(NAMES, b"[1]"), "a dictionary of objects"
        yield "another headset", META, edited(META, set_in("headset", value="Quest4")), "Aria or Quest3"
        yield "a mask of maybe", f"{QA}:3", cell("maybe", 2, QA), "True or False"
        yield "a scene without mesh", MESH, holding(MESH, wide), "with vertices"
        yield "nobody moves anything", ARIA, at(OBJECT, _far_away), "none in any frame"
        yield "no profile", PROFILE, with_umetrack_alone(removed(PROFILE)), "expected a file"
        yield "a profile of nobody", PROFILE, with_umetrack_alone(holding(PROFILE, b"{}")), "'hand_model'"
        yield "a bone 17", PROFILE, with_umetrack_alone(edited(PROFILE, _bone(17))), "bones 0 to 16"
        yield "half a bone", PROFILE, with_umetrack_alone(edited(PROFILE, _bone(1.5))), "bones 0 to 16"
        yield "an axis of length 2", PROFILE, with_umetrack_alone(edited(PROFILE, _long_axis)), "axes of length 1"


def _bone(value: float) -> Callable[[dict], None]:
    return lambda data: data["hand_model"]["landmark_rest_bone_indices"][3].__setitem__(0, value)


def _long_axis(data: dict) -> None:
    data["hand_model"]["joint_rotation_axes"][4] = [0.0, 2.0, 0.0]


def _far_away(data: bytes) -> bytes:
    head, *lines = data.decode().splitlines()
    cells = [row.split(",") for row in lines]
    return "\n".join([head, *(",".join([*row[:2], "9.0", *row[3:]]) for row in cells)]).encode()
