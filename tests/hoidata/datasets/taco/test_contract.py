"""TACO passes the tests of all adapters; also the problems its files can have."""

import pickle
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch

from tests.builders import taco
from tests.builders.corruption import (
    NO_FACE_OBJ,
    Command,
    Corrupt,
    at,
    cut_in_half,
    emptied,
    holding,
    huge_npy,
    in_array,
    linked_outside,
    npy_of,
    removed,
    set_in,
)
from tests.hoidata.datasets.contract import AdapterContract, Problem

NAME = taco.NAMES[0]
HAND = f"Hand_Poses/{NAME}/right_hand.pkl"
TOOL, TARGET = f"Object_Poses/{NAME}/tool_012.npy", f"Object_Poses/{NAME}/target_105.npy"
MESH = "Object_Models/012_cm.obj"
FAR_AWAY = np.float32([[0, 0, 0, 2], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])


def edited(change: Callable[[dict], object]) -> Corrupt:
    """The right hand's pickle, which the builder wrote, with a change."""

    def corrupt(root: Path) -> None:
        content = pickle.loads((root / HAND).read_bytes())
        change(content)
        taco.dump(root / HAND, content)

    return corrupt


class TestTaco(AdapterContract):
    name = "taco"
    corrupted_sequence = f"taco/{NAME}"
    write = staticmethod(taco.write_two)
    bad_settings = {"margin_frames": (-1, "0 or more")}  # noqa: RUF012
    conventions = {  # noqa: RUF012
        "unit": "test_meshes_are_in_centimetres_and_motion_in_metres",
        "handedness of the world": "contract.py::test_the_world_is_not_seen_in_a_mirror",
        "meshes": "test_meshes_are_in_centimetres_and_motion_in_metres",
        "object rotation": "test_object_matrices_act_on_columns",
        "hand translation": "test_the_translation_is_the_wrist_and_not_added_to_the_rest_wrist",
        "finger angles": "test_fingers_are_absolute",
        "shape": "test_each_side_has_a_separate_shape",
        "left shape directions": "test_left_shape_directions_stay_as_released",
        "left and right": "contract.py::test_the_numbers_of_each_hand_bend_a_hand_of_that_side",
        "frames": "test_frame_keys_are_sorted_as_numbers",
        "gravity": "test_gravity_is_unknown_with_its_reason",
    }

    @staticmethod
    def file_problems() -> Iterable[Problem]:
        long = torch.zeros(1).expand(10**9)
        infinite = at(TOOL, in_array(lambda poses: poses + np.float32(np.inf)))
        yield "truncated file", HAND, at(HAND, cut_in_half), "pickle"
        yield "empty file", TOOL, at(TOOL, emptied), "NumPy file"
        yield "malicious pickle", HAND, edited(set_in("00003", value=Command())), "not allowed"
        yield "NaN", HAND, edited(lambda data: data["00003"]["hand_trans"].fill_(np.nan)), "finite"
        yield "infinity", TOOL, infinite, "finite"
        yield "wrong columns", HAND, edited(set_in("00003", "hand_pose", value=torch.zeros(47))), "48"
        yield "wrong dtype (words)", HAND, edited(set_in("00003", "hand_pose", value="words")), "numbers"
        yield "missing object file", MESH, removed(MESH), "nothing there"
        yield "frame-count mismatch", NAME, at(TOOL, in_array(lambda poses: poses[:-1])), "frames"
        yield "symlink out of the root", HAND, linked_outside(HAND), "link that leaves"
        yield "zero-face mesh", MESH, holding(MESH, NO_FACE_OBJ), "with faces"
        yield "absurd size (tensor of 10^9)", HAND, edited(set_in("00003", "hand_pose", value=long)), "larger than"
        yield "absurd size (header)", TOOL, at(TOOL, huge_npy), "bytes of data"

    @staticmethod
    def format_problems() -> Iterable[Problem]:
        second = f"Object_Poses/{NAME}/tool_013.npy"
        tensor = edited(lambda data: data.update({"00003": data["00003"]["hand_pose"]}))
        by_rows = at(TOOL, in_array(lambda poses: poses.transpose(0, 2, 1)))
        mirrored = at(TOOL, in_array(lambda poses: poses * [[[-1], [1], [1], [1]]]))
        yield "no hand file", HAND, removed(HAND), "expected a file"
        yield "a list", HAND, holding(HAND, pickle.dumps([1, 2])), "expected a dictionary, got list"
        yield "an entry that is a tensor", "00003", tensor, "dictionary"
        yield "no translation", "00003", edited(lambda data: data["00003"].pop("hand_trans")), "'hand_trans'"
        yield "no tool", "tool_<id>.npy", removed(TOOL), "poses of one object, got 0"
        yield "two tools", "tool_<id>.npy", holding(second, b""), "got 2: tool_012.npy, tool_013.npy"
        yield "another count", "target", at(TARGET, in_array(lambda p: p[:-1])), "30 frames as the tool, got 29"
        yield "rows", "tool_012.npy/frame 0", by_rows, "a rotation and a shift"
        yield "a mirror", "tool_012.npy", mirrored, "a mirror"
        yield "3x4", TOOL, at(TOOL, in_array(lambda poses: poses[:, :3])), "of shape (frames, 4, 4)"
        yield "objects", TOOL, holding(TOOL, npy_of(np.array([None]))), "tool_012.npy"
        yield "no touch", NAME, at(TOOL, in_array(lambda p: p + FAR_AWAY)), "a hand within 2 cm of the tool"
