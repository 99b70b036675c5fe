"""H2O passes the tests of all adapters; also the problems its files can have."""

from collections.abc import Iterable

import numpy as np

from tests.builders import h2o
from tests.builders.corruption import (
    FAR_CORNER_OBJ,
    FLAT_OBJ,
    NO_FACE_OBJ,
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
    without_folder,
)
from tests.hoidata.datasets.contract import AdapterContract, Problem

FOLDER = "subject2/k1/3/cam4"
CAMERA, HAND, POSE, LABEL = (
    f"{FOLDER}/{kind}/000010.txt" for kind in ("cam_pose", "hand_pose_mano", "obj_pose_rt", "action_label")
)
MESH = "object/chips/chips.obj"


def numbers(path: str, values: object) -> Corrupt:
    return holding(path, " ".join(repr(float(value)) for value in np.ravel(values)))


class TestH2O(AdapterContract):
    name = "h2o"
    corrupted_sequence = "h2o/subject2/k1/3"
    write = staticmethod(h2o.write_two)
    bad_settings = {  # noqa: RUF012
        "margin_frames": (-5, "0 or more"),
        "shortest_frames": (20.5, "0 or more"),
        "hands": ("joints", "mano or keypoints"),
    }
    conventions = {  # noqa: RUF012
        "unit": "test_everything_is_in_metres",
        "handedness of the world": "test_the_object_goes_from_its_frame_through_the_camera_to_the_world",
        "meshes": "test_the_object_goes_from_its_frame_through_the_camera_to_the_world",
        "object rotation": "test_the_object_goes_from_its_frame_through_the_camera_to_the_world",
        "hand translation": "test_the_translation_is_added_to_the_rest_wrist",
        "finger angles": "test_fingers_are_absolute_and_the_mean_pose_is_not_added",
        "shape": "test_betas_are_read_in_every_frame",
        "left shape directions": "test_left_betas_belong_to_the_shape_directions_as_released",
        "left and right": "test_the_left_block_comes_first",
        "numbers per hand": "test_a_block_has_62_numbers_and_not_the_59_of_the_readme",
        "joint order": "test_joint_files_list_the_thumb_first_and_ring_before_pinky",
        "camera": "test_camera_files_are_camera_to_world_and_not_its_inverse",
        "frames": "test_the_last_labelled_frame_belongs_to_the_clip",
        "validity": "test_a_hand_without_its_flag_is_not_valid_although_numbers_stand_there",
        "labels": "test_label_seven_is_grab_chips_and_class_seven_is_chips",
        "gravity": "test_gravity.py::test_gravity_points_to_the_side_on_which_objects_stand",
    }

    @staticmethod
    def file_problems() -> Iterable[Problem]:
        last = f"{FOLDER}/hand_pose_mano/000026.txt"
        yield "truncated file", HAND, at(HAND, cut_in_half), "124 numbers"
        yield "empty file", CAMERA, at(CAMERA, emptied), "16 numbers"
        yield "malicious pickle", HAND, at(HAND, malicious), "124 numbers"
        yield "NaN", POSE, at(POSE, replaced(b"0.45", b"nan")), "finite"
        yield "infinity", HAND, at(HAND, replaced(b"1.1", b"inf")), "finite"
        yield "wrong columns", HAND, at(HAND, lambda data: data + b" 5"), "got 125"
        yield "wrong dtype (words)", POSE, at(POSE, replaced(b"0.45", b"near")), "17 numbers"
        yield "missing camera file", CAMERA, removed(CAMERA), "nothing there"
        yield "missing object file", MESH, removed(MESH), "object's mesh"
        yield "frame-count mismatch", last, removed(last), "one file for each of 27 frames"
        yield "non-UTF-8 text", LABEL, holding(LABEL, b"\xff\xfe2\x006\x00"), "1 numbers"
        yield "symlink out of the root", CAMERA, linked_outside(CAMERA), "link that leaves"
        yield "zero-face mesh", MESH, holding(MESH, NO_FACE_OBJ), "with faces"
        yield "mesh without area", MESH, holding(MESH, FLAT_OBJ), "faces with area"
        yield "absurd size (frame file)", HAND, at(HAND, lambda data: data + b" 0" * (1 << 20)), "at most"
        yield "absurd size (corner 10^9)", MESH, holding(MESH, FAR_CORNER_OBJ), "face corners"

    @staticmethod
    def format_problems() -> Iterable[Problem]:
        intrinsics, beyond = f"{FOLDER}/cam_intrinsics.txt", f"{FOLDER}/cam_pose/000027.txt"
        mirror = [7, *(h2o.object_in_camera(10) @ np.diag([1, 1, -1, 1])).ravel()]
        first_two = [numbers(f"{FOLDER}/obj_pose_rt/00000{frame}.txt", np.zeros(17)) for frame in (0, 1)]
        behind = one_after_the_other(*first_two, numbers(POSE, [7, *np.full(16, 0.5)]))
        kinds = ("cam_pose", "hand_pose_mano", "obj_pose_rt", "action_label")
        gap = one_after_the_other(*(removed(f"{FOLDER}/{kind}/000010.txt") for kind in kinds))
        far = b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
        yield "a frame that no folder has", CAMERA, gap, "each of 27 frames"
        yield "a frame too many", "000027", numbers(beyond, h2o.camera(27)), "each of 28 frames"
        yield "too many columns", POSE, at(POSE, lambda data: data + b" 1.0"), "17"
        yield "infinity in a pose", POSE, numbers(POSE, [1e308] * 16 + [np.inf]), "finite"
        yield "an empty first line", CAMERA, at(CAMERA, lambda data: b"\n" + data), "16 numbers, got 0"
        yield "a binary file", HAND, holding(HAND, bytes(range(256))), "124 numbers"
        yield "JSON", LABEL, holding(LABEL, "[26]"), "1 numbers"
        yield "a label that is no whole number", LABEL, holding(LABEL, "26.5"), "0 to 36"
        yield "an unknown label", LABEL, holding(LABEL, "37"), "0 to 36"
        yield "an unknown object", POSE, numbers(POSE, [9, *np.eye(4).ravel()]), "0 to 8"
        yield "broken intrinsics", intrinsics, holding(intrinsics, "636.6 636.3"), "6 numbers, got 2"
        yield "a matrix that is no rotation", CAMERA, numbers(CAMERA, [0.5] * 16), "rotation"
        yield "a matrix by columns", CAMERA, numbers(CAMERA, h2o.camera(10).T), "row 0 0 0 1"
        yield "a mirror", POSE, numbers(POSE, mirror), "a mirror"
        yield "a bad pose behind frames without object", POSE, behind, "rotation"
        for kind in kinds[:3]:
            yield f"no {kind}", f"cam4/{kind}", without_folder(f"{FOLDER}/{kind}"), "a folder of NNNNNN.txt files"
        yield "an empty mesh", MESH, at(MESH, emptied), "vertices"
        yield "a mesh with NaN", MESH, holding(MESH, far), "finite"
