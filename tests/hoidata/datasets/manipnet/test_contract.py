"""ManipNet passes the tests of all adapters; also the problems its files can have."""

import gzip
from collections.abc import Iterable

import pytest

from tests.builders import manipnet
from tests.builders.corruption import (
    NO_FACE_OBJ,
    Change,
    Corrupt,
    at,
    cut_in_half,
    emptied,
    holding,
    in_gzip,
    linked_outside,
    malicious,
    one_after_the_other,
    removed,
)
from tests.builders.manipnet import HAND, THING, motion_text
from tests.hoidata.datasets.contract import AdapterContract, Problem

FOLDER = "sequences/tetra_large7"
LEFT, RIGHT, OBJECT = (f"{FOLDER}/{name}.bvh.gz" for name in ("leftHand", "rightHand", "tetra_large"))
MESH, REFERENCE = "objects/Primitive/tetra_large.obj.gz", "hand/hand_reference.json"
N_FRAMES = 600


def zipped(path: str, text: str) -> Corrupt:
    return holding(path, gzip.compress(text.encode(), mtime=0))


def last_line(data: bytes) -> bytes:
    return data[: data.rstrip().rfind(b"\n") + 1]


def ending(line: bytes) -> Change:
    return in_gzip(lambda data: last_line(data) + line + b"\n")


def billion_frames(data: bytes) -> bytes:
    before, _, after = data.partition(b"Frames: ")
    return before + b"Frames: 1000000000\n" + after.partition(b"\n")[2]


@pytest.mark.long
class TestManipNet(AdapterContract):
    name = "manipnet"
    corrupted_sequence = "manipnet/tetra_large7"
    write = staticmethod(manipnet.write_two)
    common_sources = True
    bad_settings = {"margin_frames": (-1, "0 or more"), "clips": ("all", "interactions or segments")}  # noqa: RUF012
    conventions = {  # noqa: RUF012
        "unit": "test_a_unit_is_a_decimetre",
        "handedness of the world": "test_the_world_is_seen_in_a_mirror_with_normal_x",
        "meshes": "test_meshes_are_right_handed_already",
        "object rotation": "test_object_matrices_act_on_columns",
        "hand translation": "test_the_thumbs_first_joint_is_its_second_one_in_the_file",
        "finger angles": "test_angles_rotate_about_y_then_x_then_z_of_the_rotated_frame",
        "left and right": "test_a_right_hand_is_fitted_to_the_right_hands_file",
        "joint order": "test_the_ring_finger_comes_before_the_little_one_in_the_file_and_after_it_here",
        "finger tips": "test_tips_are_the_ends_of_the_capsules_not_the_end_sites",
        "frames": "test_the_116_hz_file_is_read_by_its_clock",
        "gravity": "test_things_fall_along_minus_y",
    }

    @staticmethod
    def file_problems() -> Iterable[Problem]:
        bomb = gzip.compress(bytes(300 << 20), 1, mtime=0)
        mesh = MESH.rpartition("/")[2]
        yield "truncated file", LEFT, at(LEFT, cut_in_half), "gzipped text"
        yield "empty file", OBJECT, at(OBJECT, emptied), "line MOTION"
        yield "malicious pickle", LEFT, at(LEFT, malicious), "gzipped text"
        yield "NaN", OBJECT, at(OBJECT, ending(b"0 0 0 0 0 nan")), "finite"
        yield "infinity", OBJECT, at(OBJECT, ending(b"0 0 0 0 0 inf")), "finite"
        yield "wrong columns", OBJECT, at(OBJECT, ending(b"0 0 0")), "6 columns"
        yield "wrong dtype (words)", OBJECT, at(OBJECT, ending(b"0 0 0 0 0 x")), "numbers"
        yield "missing object file", mesh, removed(MESH), "nothing there"
        yield "frame-count mismatch", LEFT, at(LEFT, in_gzip(last_line)), "motion lines as announced"
        yield "non-UTF-8 text", OBJECT, at(OBJECT, in_gzip(lambda data: b"\xff" + data)), "gzipped text"
        yield "symlink out of the root", LEFT, linked_outside(LEFT), "link that leaves"
        yield "zero-face mesh", MESH, at(MESH, in_gzip(lambda _: NO_FACE_OBJ)), "with faces"
        yield "gzip bomb", OBJECT, holding(OBJECT, bomb), "of text"
        yield "absurd size (10^9 frames)", OBJECT, at(OBJECT, in_gzip(billion_frames)), "1 to 1000000 frames"

    @staticmethod
    def format_problems() -> Iterable[Problem]:
        neither = one_after_the_other(removed(LEFT), removed(RIGHT))
        other_bones = zipped(RIGHT, motion_text(THING, [[0.0] * 6] * N_FRAMES))
        shorter = zipped(OBJECT, motion_text(THING, [[0.0] * 6] * (N_FRAMES - 1)))
        narrow = zipped(LEFT, motion_text(HAND.replace("~", ""), [[0.0] * 53] * N_FRAMES))
        unknown = "sequences/tetra_large7/teapot9.bvh.gz"
        renamed = lambda root: (root / OBJECT).rename(root / unknown)  # noqa: E731
        yield "no right hand", FOLDER, removed(RIGHT), f"no {RIGHT}"
        yield "no hands", FOLDER, neither, "object motion only"
        yield "no object", FOLDER, removed(OBJECT), "expected motion of one object, got 0"
        yield "another skeleton", RIGHT, other_bones, "17 joints"
        yield "a frame too few", FOLDER, shorter, "599 frames"
        yield "a column too few", LEFT, narrow, "54 columns"
        yield "an object without a mesh", "teapot9", renamed, "objects/*/teapot9.obj.gz"
        yield "half a vertex", "tetra_large.obj", zipped(MESH, "v 1 2\nf 1 2 3"), "tetra_large.obj"
        yield "no capsules", REFERENCE, holding(REFERENCE, '{"capsules": [1]}'), "hand_reference.json"
