"""OakInk2 passes the tests of all adapters; also the problems its files can have."""

import json
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch

from tests.builders import oakink2
from tests.builders.corruption import (
    FAR_CORNER_OBJ,
    NO_FACE_OBJ,
    Command,
    Corrupt,
    at,
    cut_in_half,
    emptied,
    holding,
    linked_outside,
    removed,
    set_in,
)
from tests.builders.oakink2 import BASE, FIRST, LAPTOP, LID, MUG
from tests.hoidata.datasets.contract import AdapterContract, Problem

TOKEN = LAPTOP.replace("/", "++")
HAND, PROGRAM = f"anno_preview/{TOKEN}.pkl", f"program/program_info/{TOKEN}.json"
MESH, NAMES = f"object_repair/align_ds/{LID}/model.obj", "object_repair/obj_desc.json"
AT = FIRST + 8


def edited(change: Callable[[dict], object]) -> Corrupt:
    """The annotation, which the builder wrote, with a change."""

    def corrupt(root: Path) -> None:
        content = pickle.loads((root / HAND).read_bytes())
        change(content)
        oakink2.dump(root / HAND, content)

    return corrupt


def pose(change: Callable[[np.ndarray], object]) -> Corrupt:
    """The lid's matrix of one frame, changed in its place."""
    return edited(lambda values: change(values["obj_transf"][LID][AT]))


def mano(name: str, value: object) -> Corrupt:
    return edited(set_in("raw_mano", AT, name, value=value))  # type: ignore[arg-type]


def first(change: Callable[[dict], object]) -> Corrupt:
    """The first primitive of the program, with a change."""

    def corrupt(root: Path) -> None:
        value = json.loads((root / PROGRAM).read_text())
        change(next(iter(value.values())))
        (root / PROGRAM).write_text(json.dumps(value))

    return corrupt


class TestOakink2(AdapterContract):
    name = "oakink2"
    corrupted_sequence = f"oakink2/{LAPTOP}"
    write = staticmethod(oakink2.write_two)
    slow = True
    bad_settings = dict.fromkeys(("margin_frames", "shortest_frames", "most_off_mm", "most_off_deg"), (-1, "0 or more"))
    conventions = {  # noqa: RUF012
        "unit": "test_places_are_metres",
        "handedness of the world": "contract.py::test_the_world_is_not_seen_in_a_mirror",
        "meshes": "test_each_part_has_a_separate_mesh_and_pose",
        "object rotation": "test_object_matrices_act_on_columns",
        "hand translation": "test_the_translation_is_the_wrist_and_not_added_to_the_rest_wrist",
        "finger angles": "test_fingers_are_absolute_and_quaternions_begin_with_w",
        "shape": "test_the_shape_is_that_of_the_frame",
        "left shape directions": "test_left_shape_directions_stay_as_released",
        "left and right": "contract.py::test_the_numbers_of_each_hand_bend_a_hand_of_that_side",
        "parts": "test_the_tree_tells_which_parts_are_one_object_and_the_bigger_surface_is_its_base",
        "hinge": "test_the_hinge_is_estimated_and_rotates_by_the_right_hand_rule",
        "frames": "test_every_fourth_frame_from_the_first_is_kept_and_ranges_lack_their_last",
        "validity": "test_a_hand_is_not_valid_without_an_entry_for_the_frame",
        "labels": "test_primitives_are_verbs_and_ranges_tell_the_hand",
        "gravity": "test_gravity_is_unknown_with_its_reason",
    }

    @staticmethod
    def file_problems() -> Iterable[Problem]:
        long = torch.zeros(1).expand(10**9)
        yield "truncated file", HAND, at(HAND, cut_in_half), "pickle"
        yield "empty file", PROGRAM, at(PROGRAM, emptied), "JSON"
        yield "malicious pickle", HAND, mano("rh__tsl", Command()), "not allowed"
        yield "NaN", HAND, mano("rh__tsl", torch.full((1, 3), torch.nan)), "finite"
        yield "infinity", HAND, pose(lambda matrix: matrix.__setitem__((0, 3), np.inf)), "finite"
        yield "wrong columns", HAND, mano("rh__betas", torch.zeros(1, 11)), "shape (10,)"
        yield "wrong dtype (words)", HAND, mano("rh__betas", "words"), "arrays of shape"
        yield "missing object file", "align_ds", removed(MESH), "one mesh, OBJ or PLY"
        yield "frame-count mismatch", HAND, edited(set_in("raw_mano", value={})), "parameters of a hand"
        yield "symlink out of the root", HAND, linked_outside(HAND), "link that leaves"
        yield "zero-face mesh", MESH, holding(MESH, NO_FACE_OBJ), "with faces"
        yield "absurd size (face)", MESH, holding(MESH, FAR_CORNER_OBJ), "face corners"
        yield "absurd size (tensor of 10^9)", HAND, mano("rh__betas", long), "larger than"

    @staticmethod
    def format_problems() -> Iterable[Problem]:
        frames = "mocap_frame_id_list"
        yield "no program", PROGRAM, removed(PROGRAM), "expected a file"
        yield "no names", NAMES, removed(NAMES), "expected a file"
        yield "a list", HAND, holding(HAND, pickle.dumps([1])), "a dictionary with"
        yield "no poses", HAND, edited(lambda values: values.pop("obj_transf")), "'obj_transf'"
        yield "poses in a list", LID, edited(set_in("obj_transf", LID, value=[1])), "by frame number"
        yield "hands in a list", "raw_mano", edited(set_in("raw_mano", value=[1])), "by frame number"
        yield "words as frames", frames, edited(set_in(frames, value=["1"])), "frame numbers"
        yield "no frames", frames, edited(set_in(frames, value=[])), "frame numbers from 0"
        yield "frames twice", frames, edited(set_in(frames, value=[5, 5, 6])), "rising"
        yield "frames of a year", frames, edited(set_in(frames, value=[0, 9_000_000])), "without great gaps"
        yield "a place beyond all rooms", LID, pose(lambda matrix: matrix.__imul__(1e300)), "at most 1e+06"
        yield "a path as part", "obj_list", edited(set_in("obj_list", value=["../x"])), "part ids such as"
        yield "rows", "frame 14", pose(lambda matrix: matrix.__setitem__(slice(None), matrix.T.copy())), "rotation"
        yield "a mirror", "frame 14", pose(lambda matrix: matrix.__imul__([[-1], [1], [1], [1]])), "a mirror"
        yield "no quaternion", "pose_coeffs", mano("lh__pose_coeffs", torch.zeros(1, 16, 4)), "in frame 14"
        yield "no primitive", PROGRAM, first(lambda entry: entry.pop("primitive")), "'primitive'"
        yield "objects in a text", PROGRAM, first(lambda entry: entry.update(obj_list=MUG)), "part ids such as"
        yield "two meshes", BASE, holding(f"object_repair/align_ds/{BASE}/scan.ply", b""), "model.obj, scan.ply"
