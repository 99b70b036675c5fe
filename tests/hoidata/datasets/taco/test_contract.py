"""TACO keeps the contract of all adapters; what can be wrong with its files."""

import pickle
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch

from tests.builders import taco
from tests.builders.spoilt import (
    NO_FACE_OBJ,
    Command,
    Spoil,
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
from tests.hoidata.datasets.contract import AdapterContract, Row

NAME = taco.NAMES[0]
HAND = f"Hand_Poses/{NAME}/right_hand.pkl"
TOOL, TARGET = f"Object_Poses/{NAME}/tool_012.npy", f"Object_Poses/{NAME}/target_105.npy"
MESH = "Object_Models/012_cm.obj"
FAR_AWAY = np.float32([[0, 0, 0, 2], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])


def edited(change: Callable[[dict], object]) -> Spoil:
    """The right hand's pickle, which the builder wrote, with a change."""

    def spoil(root: Path) -> None:
        content = pickle.loads((root / HAND).read_bytes())
        change(content)
        taco.dump(root / HAND, content)

    return spoil


class TestTaco(AdapterContract):
    name = "taco"
    spoilt = f"taco/{NAME}"
    write = staticmethod(taco.write_two)
    bad_settings = {"margin_frames": (-1, "0 or more")}  # noqa: RUF012
    conventions = {  # noqa: RUF012
        "unit": "test_meshes_are_in_centimetres_and_motion_in_metres",
        "handedness of the world": "contract.py::test_the_world_is_not_seen_in_a_mirror",
        "meshes": "test_meshes_are_in_centimetres_and_motion_in_metres",
        "object rotation": "test_object_matrices_act_on_columns",
        "hand translation": "test_the_translation_is_the_wrist_and_not_added_to_the_rest_wrist",
        "finger angles": "test_fingers_are_absolute",
        "shape": "test_each_side_has_its_own_shape",
        "left shape directions": "test_left_shape_directions_stay_as_released",
        "left and right": "contract.py::test_each_hands_numbers_bend_a_hand_of_that_side",
        "frames": "test_frame_keys_are_sorted_as_numbers",
        "gravity": "test_gravity_is_unknown_with_its_reason",
    }

    @staticmethod
    def rows() -> Iterable[Row]:
        long = torch.zeros(1).expand(10**9)
        infinite = at(TOOL, in_array(lambda poses: poses + np.float32(np.inf)))
        yield Row("truncated file", HAND, at(HAND, cut_in_half), "pickle")
        yield Row("empty file", TOOL, at(TOOL, emptied), "NumPy file")
        yield Row("malicious pickle", HAND, edited(set_in("00003", value=Command())), "not allowed")
        yield Row("NaN", HAND, edited(lambda data: data["00003"]["hand_trans"].fill_(np.nan)), "finite")
        yield Row("infinity", TOOL, infinite, "finite")
        yield Row("wrong columns", HAND, edited(set_in("00003", "hand_pose", value=torch.zeros(47))), "48")
        yield Row("wrong dtype (words)", HAND, edited(set_in("00003", "hand_pose", value="words")), "numbers")
        yield Row("missing object file", MESH, removed(MESH), "nothing there")
        yield Row("frame-count mismatch", NAME, at(TOOL, in_array(lambda poses: poses[:-1])), "frames")
        yield Row("symlink out of the root", HAND, linked_outside(HAND), "link that leaves")
        yield Row("zero-face mesh", MESH, holding(MESH, NO_FACE_OBJ), "with faces")
        yield Row("absurd size (tensor of 10^9)", HAND, edited(set_in("00003", "hand_pose", value=long)), "larger than")
        yield Row("absurd size (header)", TOOL, at(TOOL, huge_npy), "bytes of data")

    @staticmethod
    def further_rows() -> Iterable[Row]:
        second = f"Object_Poses/{NAME}/tool_013.npy"
        tensor = edited(lambda data: data.update({"00003": data["00003"]["hand_pose"]}))
        by_rows = at(TOOL, in_array(lambda poses: poses.transpose(0, 2, 1)))
        mirrored = at(TOOL, in_array(lambda poses: poses * [[[-1], [1], [1], [1]]]))
        yield Row("no hand file", HAND, removed(HAND), "expected a file")
        yield Row("a list", HAND, holding(HAND, pickle.dumps([1, 2])), "expected a dictionary, got list")
        yield Row("an entry that is a tensor", "00003", tensor, "dictionary")
        yield Row("no translation", "00003", edited(lambda data: data["00003"].pop("hand_trans")), "'hand_trans'")
        yield Row("no tool", "tool_<id>.npy", removed(TOOL), "poses of one object, got 0")
        yield Row("two tools", "tool_<id>.npy", holding(second, b""), "got 2: tool_012.npy, tool_013.npy")
        yield Row("another count", "target", at(TARGET, in_array(lambda p: p[:-1])), "30 frames as the tool, got 29")
        yield Row("rows", "tool_012.npy/frame 0", by_rows, "a rotation and a shift")
        yield Row("a mirror", "tool_012.npy", mirrored, "a mirror")
        yield Row("3x4", TOOL, at(TOOL, in_array(lambda poses: poses[:, :3])), "of shape (frames, 4, 4)")
        yield Row("objects", TOOL, holding(TOOL, npy_of(np.array([None]))), "tool_012.npy")
        yield Row("no touch", NAME, at(TOOL, in_array(lambda p: p + FAR_AWAY)), "a hand within 2 cm of the tool")
