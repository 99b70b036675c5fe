"""ARCTIC passes the tests of all adapters; also the problems its files can have."""

import io
from collections.abc import Callable, Iterable

import numpy as np
import pytest

from hoidata.datasets.arctic.adapter import ArcticAdapter
from hoidata.errors import BadInput
from tests.builders import arctic
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
    one_after_the_other,
    removed,
    set_in,
)
from tests.hoidata.datasets.contract import AdapterContract, Problem

HAND, OBJECT, CAMERA, BODY = (
    f"raw_seqs/s04/box_grab_01.{kind}.npy" for kind in ("mano", "object", "egocam.dist", "smplx")
)
TEXT = "description/s04/box_grab_01/description.txt"
MESH, PARTS = (f"meta/object_vtemplates/box/{name}" for name in ("mesh.obj", "parts.json"))


def boxed(path: str, content: object) -> Corrupt:
    """A file that holds one Python object."""
    box = np.empty((), dtype=object)
    box[()] = content
    stream = io.BytesIO()
    np.save(stream, box)
    return holding(path, stream.getvalue())


def hand(change: Callable[[dict], object]) -> Corrupt:
    data = {side: arctic.hand_params(side) for side in ("left", "right")}
    change(data)
    return boxed(HAND, data)


def camera(**changes: object) -> Corrupt:
    """None takes the entry out."""
    head = {key: value for key, value in (arctic.head() | changes).items() if value is not None}
    return boxed(CAMERA, head)


def misc(content: bytes) -> Corrupt:
    return one_after_the_other(camera(), holding("meta/misc.json", content))


def number(index: tuple[int, int], value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array[index] = value
        return array

    return change


class TestArctic(AdapterContract):
    name = "arctic"
    corrupted_sequence = "arctic/s04/box_grab_01"
    write = staticmethod(arctic.write_two)
    bad_settings = {  # noqa: RUF012
        "clips": ("all", "described or whole"),
        "margin_frames": (-2, "0 or more"),
        "shortest_frames": (2.5, "0 or more"),
        "trimmed_frames": ("ten", "0 or more"),
        "body": (None, "true or false"),
    }
    conventions = {  # noqa: RUF012
        "unit": "test_the_translation_is_in_millimetres",
        "handedness of the world": "contract.py::test_the_world_is_not_seen_in_a_mirror",
        "meshes": "test_the_mesh_is_in_millimetres",
        "object rotation": "test_it_rotates_column_vectors",
        "hand translation": "test_the_hand_rotates_about_its_shaped_rest_wrist_and_is_moved_by_trans",
        "finger angles": "test_fingers_are_relative_to_the_mean_pose",
        "angles beyond pi": "test_angles_beyond_pi_gain_the_mean_as_they_are",
        "shape": "test_one_row_of_betas_holds_for_the_whole_sequence",
        "left shape directions": "test_left_betas_belong_to_the_shape_directions_as_mano_released_them",
        "left and right": "contract.py::test_the_numbers_of_each_hand_bend_a_hand_of_that_side",
        "parts": "test_part_0_of_the_file_is_the_top_and_moves",
        "hinge": "test_the_hinge_rotates_about_minus_z",
        "camera": "test_the_file_takes_the_world_to_the_camera_and_the_clip_the_camera_to_the_world",
        "frames": "test_ranges_count_from_one_and_include_both_ends",
        "gravity": "test_things_fall_along_minus_z",
    }

    @staticmethod
    def file_problems() -> Iterable[Problem]:
        infinite = hand(lambda data: data["left"]["rot"].__setitem__((3, 2), -np.inf))
        twice = at(TEXT, lambda data: data + b"15-44 lift, both hands\n")
        yield "truncated file", HAND, at(HAND, cut_in_half), "pickle"
        yield "empty file", OBJECT, at(OBJECT, emptied), "NumPy file"
        yield "malicious pickle", HAND, hand(set_in("left", value=Command())), "not allowed"
        yield "NaN", OBJECT, at(OBJECT, in_array(number((3, 2), np.nan))), "finite"
        yield "infinity", HAND, infinite, "finite"
        yield "wrong columns", OBJECT, at(OBJECT, in_array(lambda array: array[:, :6])), "7 columns"
        yield "wrong dtype (words)", OBJECT, at(OBJECT, in_array(lambda array: array.astype("U4"))), "numbers"
        yield "missing object file", MESH, removed(MESH), "nothing there"
        yield "missing object motion", OBJECT, removed(OBJECT), "nothing there"
        yield "frame-count mismatch", HAND, at(OBJECT, in_array(lambda array: array[:-1])), "69 frames"
        yield "non-UTF-8 text", TEXT, at(TEXT, lambda data: b"\xff\xfe" + data), "UTF-8"
        yield "duplicate ids", "box_grab_01", twice, "twice"
        yield "symlink out of the root", HAND, linked_outside(HAND), "link that leaves"
        yield "zero-face mesh", MESH, holding(MESH, NO_FACE_OBJ), "with faces"
        yield "parts of another mesh", PARTS, holding(PARTS, "[1, 0]"), "8 zeros and ones"
        yield "nested JSON", PARTS, holding(PARTS, b"[" * 100_000), "JSON"
        yield "absurd size (header)", OBJECT, at(OBJECT, huge_npy), "bytes of data"

    @staticmethod
    def format_problems() -> Iterable[Problem]:
        turns, shift = arctic.head()["R_k_cam_np"], arctic.head()["T_k_cam_np"]
        short = hand(lambda data: data["left"].update(trans=np.zeros((69, 3))))
        five_betas = hand(lambda data: data["left"].update(shape=np.zeros((5, 10))))
        nine_betas = hand(lambda data: data["right"].update(shape=np.zeros(9)))
        one_for_two = holding(TEXT, "1-40 open, left hand\n1-40 close, left hand\n")
        yield "a missing hand file", HAND, removed(HAND), "a file"
        yield "hands that are a list", HAND, boxed(HAND, [1, 2]), "dictionary"
        yield "a missing hand", HAND, hand(lambda data: data.pop("left")), "left"
        yield "hands of another number of frames", "left.trans", short, "70 frames"
        yield "betas of another number of frames", "left.shape", five_betas, "70 rows"
        yield "nine betas", "right.shape", nine_betas, "10 columns"
        yield "a frame too many", HAND, holding(OBJECT, npy_of(np.zeros((71, 7)))), "71 frames"
        for path, kind in ((OBJECT, "motion"), (CAMERA, "the camera")):
            yield f"a command in {kind}", path, boxed(path, {"R_k_cam_np": Command()}), "not allowed"
        yield "no description", TEXT, removed(TEXT), "segments"
        yield "a range described twice", "arctic/s04/box_grab_01", one_for_two, "one line per range and hand"
        yield "a description beyond all bounds", TEXT, holding(TEXT, b"\n" * (17 << 20)), "at most"
        yield "parts that are not JSON", PARTS, holding(PARTS, "[1, 1,"), "JSON text"
        yield "parts that are no list", PARTS, holding(PARTS, '{"0": 1}'), "8 zeros and ones"
        yield "a part 2", PARTS, holding(PARTS, "[1, 1, 1, 1, 0, 0, 0, 2]"), "8 zeros and ones"
        yield "a mesh that is no text", MESH, holding(MESH, b"\xff\xfe\x00v"), "vertices"
        yield "a corner beyond all vertices", MESH, holding(MESH, NO_FACE_OBJ + b"f 1 2 900\n"), "corners"
        yield "a camera of 69 frames", "T_k_cam_np", camera(T_k_cam_np=shift[:69]), "70 frames"
        yield "a camera without rotation", "egocam", camera(R_k_cam_np=None), "R_k_cam_np"
        yield "a camera that mirrors", "R_k_cam_np", camera(R_k_cam_np=turns * (1, 1, -1)), "rotations"
        yield "a camera that grows", "R_k_cam_np", camera(R_k_cam_np=turns * 1.01), "rotations"
        yield "a camera of other matrices", "R_k_cam_np", camera(R_k_cam_np=np.zeros((70, 4, 4))), "3 x 3"
        yield "a camera of text", "R_k_cam_np", camera(R_k_cam_np=np.full((70, 3, 3), "x")), "numbers"
        yield "intrinsics of two rows", "intrinsics", camera(intrinsics=np.ones((2, 3))), "3 rows"
        yield "offsets that are not JSON", "misc.json", misc(b"{"), "JSON text"
        yield "offsets in a list", "misc.json", misc(b"[1]"), "JSON object"
        yield "a subject without offset", "misc.json: s04", misc(b'{"s04": {"gender": "male"}}'), "ioi_offset"
        yield "an offset of half a frame", "ioi_offset", misc(b'{"s04": {"ioi_offset": 0.5}}'), "whole number"


@pytest.mark.parametrize("change", ["body of 69 frames", "no body", "no jaw", "a command"])
def test_a_bad_body_is_named_when_bodies_are_asked_for_and_does_not_matter_otherwise(tmp_path, load_all, change):
    root = arctic.write_root(tmp_path)
    content = arctic.body()
    bad = {
        "body of 69 frames": {"transl": content["transl"][:69]},
        "no jaw": {"jaw_pose": None},
        "a command": {"transl": Command()},
    }
    if change in bad:
        boxed(BODY, {key: value for key, value in (content | bad[change]).items() if value is not None})(root)
    assert load_all(ArcticAdapter(), root)[0].body is None
    with pytest.raises(BadInput) as caught:
        load_all(ArcticAdapter(body=True), root)
    assert "smplx.npy" in caught.value.where
