"""HOI4D passes the tests of all adapters; also the problems its files can have."""

import json
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from tests.builders import hoi4d
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
    replaced,
)
from tests.builders.hoi4d import ANNOTATIONS, MODELS, SAFE, pickled
from tests.hoidata.datasets.contract import AdapterContract, Problem

HAND = f"handpose/refinehandpose_right/{SAFE}/5.pickle"
POSE, CAMERA = f"{ANNOTATIONS}/{SAFE}/objpose/5.json", f"{ANNOTATIONS}/{SAFE}/3Dseg/output.log"
EVENTS, FOLDER = f"{ANNOTATIONS}/{SAFE}/action/color.json", f"{MODELS}/articulated/Safe/004"
MESH, HINGE, TREE = f"{FOLDER}/objs/new-1.obj", f"{FOLDER}/mobility_v2.json", f"{FOLDER}/result.json"


def edited(path: str, change: Callable[[dict], object]) -> Corrupt:
    """A JSON file, which the builder wrote, with a change."""

    def corrupt(root: Path) -> None:
        value = json.loads((root / path).read_text(encoding="utf-8"))
        change(value)
        (root / path).write_text(json.dumps(value), encoding="utf-8")

    return corrupt


def first(change: Callable[[dict], object]) -> Corrupt:
    """The first part of one frame, with a change."""
    return edited(POSE, lambda value: change(value["dataList"][0]))


def hand(**values: object) -> Corrupt:
    whole = {"poseCoeff": np.zeros(48), "beta": np.zeros(10), "trans": np.zeros(3)}
    return holding(HAND, pickled({name: np.asarray(value) for name, value in (whole | values).items()}))


class TestHoi4d(AdapterContract):
    name = "hoi4d"
    corrupted_sequence = f"hoi4d/{SAFE}"
    write = staticmethod(hoi4d.write_two)
    bad_settings = {  # noqa: RUF012
        **dict.fromkeys(("margin_frames", "shortest_frames", "most_off_mm", "most_off_deg"), (-1, "0 or more")),
        "clips": ("all", "described or whole"),
    }
    conventions = {  # noqa: RUF012
        "unit": "test_positions_are_metres",
        "handedness of the world": "contract.py::test_the_world_is_not_seen_in_a_mirror",
        "meshes": "test_a_pose_is_that_of_the_mesh_of_the_part",
        "object rotation": "test_angles_rotate_about_x_then_the_rotated_y_and_z_and_act_on_columns",
        "hand translation": "test_the_translation_is_added_to_the_rest_wrist",
        "finger angles": "test_fingers_are_absolute",
        "shape": "test_the_shape_is_that_of_the_file",
        "left shape directions": "test_left_shape_directions_stay_as_released",
        "left and right": "contract.py::test_the_numbers_of_each_hand_bend_a_hand_of_that_side",
        "parts": "test_parts_are_matched_by_their_size_and_not_by_label",
        "hinge": "test_the_hinge_rotates_by_the_right_hand_rule_about_its_axis_and_is_not_wrapped",
        "camera": "test_the_camera_matrix_takes_camera_to_world_row_by_row",
        "frames": "test_every_second_frame_is_interpolated_and_the_clock_counts_300_frames",
        "validity": "test_a_hand_is_not_valid_without_a_whole_file",
        "labels": "test_events_are_read_in_both_forms",
        "gravity": "hoi4d/test_hoi4d.py::test_gravity_is_estimated_where_a_mug_stands_on_two_of_its_sides",
    }

    @staticmethod
    def file_problems() -> Iterable[Problem]:
        yield "truncated file", POSE, at(POSE, cut_in_half), "JSON"
        yield "empty file", EVENTS, at(EVENTS, emptied), "an empty file"
        yield "malicious pickle", HAND, holding(HAND, pickle.dumps({"poseCoeff": Command()})), "not allowed"
        yield "NaN", POSE, at(POSE, replaced(b'"x": ', b'"x": NaN, "a": ')), "JSON"
        yield "NaN in a hand", HAND, hand(trans=[np.nan, 0, 0]), "finite"
        yield "infinity", CAMERA, at(CAMERA, replaced(b"0.0 0.0 0.0 1.0", b"0.0 0.0 0.0 inf")), "finite"
        yield "wrong columns", HAND, hand(poseCoeff=np.zeros(49)), "48 columns"
        yield "wrong dtype (words)", POSE, first(lambda part: part["center"].update(x="words")), "numbers"
        yield "missing object file", MESH, removed(MESH), "nothing there"
        yield "frame-count mismatch", "objpose", at(CAMERA, lambda data: _lines(data, 95)), "as output.log has"
        yield "symlink out of the root", POSE, linked_outside(POSE), "link that leaves"
        yield "zero-face mesh", MESH, holding(MESH, NO_FACE_OBJ), "with faces"
        yield "absurd size (face)", MESH, holding(MESH, FAR_CORNER_OBJ), "face corners"
        yield "absurd size (hand)", HAND, holding(HAND, b"\x80\x02" + bytes(100_000)), "at most 65536 bytes"

    @staticmethod
    def format_problems() -> Iterable[Problem]:
        yield "no trajectory", CAMERA, removed(CAMERA), "expected a file"
        yield "a matrix by columns", "output.log", at(CAMERA, _transposed), "a rotation and a shift"
        yield "a line too few", CAMERA, at(CAMERA, lambda data: _lines(data, 99)), "five lines per frame"
        yield "no events", EVENTS, removed(EVENTS), "expected a file"
        yield "events of no time", EVENTS, edited(EVENTS, lambda value: value["events"][0].pop("endTime")), "endTime"
        yield "another clock", EVENTS, edited(EVENTS, lambda value: value["info"].update(duration="long")), "seconds"
        yield "an object that is a list", POSE, holding(POSE, b"[1]"), "a dictionary with"
        yield "no objects", POSE, edited(POSE, lambda value: value["dataList"].clear()), "at least one object"
        yield "no centre", POSE, first(lambda part: part.pop("center")), "'center'"
        yield "a length of 0", POSE, first(lambda part: part["dimensions"].update(height=0)), "above 0"
        yield "other parts", POSE, first(lambda part: part.update(label="lid")), "the parts Safebox, Safedoor"
        yield "a part twice", POSE, edited(POSE, lambda v: v["dataList"].append(v["dataList"][0])), "of its own"
        yield "deep JSON", POSE, holding(POSE, b"[" * 100_000), "JSON"
        yield "code", POSE, holding(POSE, b"__import__('os').system('touch canary')"), "JSON"
        yield "no hinge", HINGE, edited(HINGE, lambda nodes: nodes.pop()), "one base and one part"
        yield "no mesh of a part", HINGE, edited(TREE, lambda tree: tree[0]["children"].pop()), "one mesh for each"
        yield "an axis of no length", HINGE, edited(HINGE, _without_axis), "a direction"


def _without_axis(nodes: list) -> None:
    for node in nodes:
        if node["jointData"]:
            node["jointData"]["axis"]["direction"] = [0, 0, 0]


def _lines(data: bytes, count: int) -> bytes:
    return b"\n".join(data.splitlines()[:count])


def _transposed(data: bytes) -> bytes:
    lines = data.decode().splitlines()
    for start in range(0, len(lines), 5):
        rows = zip(*(line.split() for line in lines[start + 1 : start + 5]), strict=True)
        lines[start + 1 : start + 5] = [" ".join(row) for row in rows]
    return "\n".join(lines).encode()
