"""ARCTIC keeps the contract of all adapters; what can be wrong with its files."""

import io
from collections.abc import Callable, Iterable

import numpy as np
import pytest

from hoidata.datasets.arctic.adapter import ArcticAdapter
from hoidata.errors import BadInput
from tests.builders import arctic
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
    one_after_the_other,
    removed,
    set_in,
)
from tests.hoidata.datasets.contract import AdapterContract, Row

HAND, OBJECT, CAMERA, BODY = (
    f"raw_seqs/s04/box_grab_01.{kind}.npy" for kind in ("mano", "object", "egocam.dist", "smplx")
)
TEXT = "description/s04/box_grab_01/description.txt"
MESH, PARTS = (f"meta/object_vtemplates/box/{name}" for name in ("mesh.obj", "parts.json"))


def boxed(path: str, content: object) -> Spoil:
    """A file that holds one Python object."""
    box = np.empty((), dtype=object)
    box[()] = content
    stream = io.BytesIO()
    np.save(stream, box)
    return holding(path, stream.getvalue())


def hand(change: Callable[[dict], object]) -> Spoil:
    data = {side: arctic.hand_params(side) for side in ("left", "right")}
    change(data)
    return boxed(HAND, data)


def camera(**changes: object) -> Spoil:
    """None takes the entry out."""
    head = {key: value for key, value in (arctic.head() | changes).items() if value is not None}
    return boxed(CAMERA, head)


def misc(content: bytes) -> Spoil:
    return one_after_the_other(camera(), holding("meta/misc.json", content))


def number(place: tuple[int, int], value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array[place] = value
        return array

    return change


class TestArctic(AdapterContract):
    name = "arctic"
    spoilt = "arctic/s04/box_grab_01"
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
        "object rotation": "test_it_is_turned_as_column_vectors",
        "hand translation": "test_the_hand_turns_about_its_shaped_rest_wrist_and_is_moved_by_trans",
        "finger angles": "test_fingers_are_relative_to_the_mean_pose",
        "angles beyond pi": "test_angles_beyond_pi_gain_the_mean_as_they_are",
        "shape": "test_one_row_of_betas_holds_for_the_whole_sequence",
        "left shape directions": "test_left_betas_belong_to_the_shape_directions_as_mano_released_them",
        "left and right": "contract.py::test_each_hands_numbers_bend_a_hand_of_that_side",
        "parts": "test_part_0_of_the_file_is_the_top_and_moves",
        "hinge": "test_the_hinge_turns_about_minus_z",
        "camera": "test_the_file_takes_the_world_to_the_camera_and_the_clip_the_camera_to_the_world",
        "frames": "test_ranges_count_from_one_and_include_both_ends",
        "gravity": "test_things_fall_along_minus_z",
    }

    @staticmethod
    def rows() -> Iterable[Row]:
        infinite = hand(lambda data: data["left"]["rot"].__setitem__((3, 2), -np.inf))
        twice = at(TEXT, lambda data: data + b"15-44 lift, both hands\n")
        yield Row("truncated file", HAND, at(HAND, cut_in_half), "pickle")
        yield Row("empty file", OBJECT, at(OBJECT, emptied), "NumPy file")
        yield Row("malicious pickle", HAND, hand(set_in("left", value=Command())), "not allowed")
        yield Row("NaN", OBJECT, at(OBJECT, in_array(number((3, 2), np.nan))), "finite")
        yield Row("infinity", HAND, infinite, "finite")
        yield Row("wrong columns", OBJECT, at(OBJECT, in_array(lambda array: array[:, :6])), "7 columns")
        yield Row("wrong dtype (words)", OBJECT, at(OBJECT, in_array(lambda array: array.astype("U4"))), "numbers")
        yield Row("missing object file", MESH, removed(MESH), "nothing there")
        yield Row("missing object motion", OBJECT, removed(OBJECT), "nothing there")
        yield Row("frame-count mismatch", HAND, at(OBJECT, in_array(lambda array: array[:-1])), "69 frames")
        yield Row("non-UTF-8 text", TEXT, at(TEXT, lambda data: b"\xff\xfe" + data), "UTF-8")
        yield Row("duplicate ids", "box_grab_01", twice, "twice")
        yield Row("symlink out of the root", HAND, linked_outside(HAND), "link that leaves")
        yield Row("zero-face mesh", MESH, holding(MESH, NO_FACE_OBJ), "with faces")
        yield Row("parts of another mesh", PARTS, holding(PARTS, "[1, 0]"), "8 zeros and ones")
        yield Row("nested JSON", PARTS, holding(PARTS, b"[" * 100_000), "JSON")
        yield Row("absurd size (header)", OBJECT, at(OBJECT, huge_npy), "bytes of data")

    @staticmethod
    def further_rows() -> Iterable[Row]:
        turns, shift = arctic.head()["R_k_cam_np"], arctic.head()["T_k_cam_np"]
        short = hand(lambda data: data["left"].update(trans=np.zeros((69, 3))))
        five_betas = hand(lambda data: data["left"].update(shape=np.zeros((5, 10))))
        nine_betas = hand(lambda data: data["right"].update(shape=np.zeros(9)))
        one_for_two = holding(TEXT, "1-40 open, left hand\n1-40 close, left hand\n")
        yield Row("a missing hand file", HAND, removed(HAND), "a file")
        yield Row("hands that are a list", HAND, boxed(HAND, [1, 2]), "dictionary")
        yield Row("a missing hand", HAND, hand(lambda data: data.pop("left")), "left")
        yield Row("hands of another number of frames", "left.trans", short, "70 frames")
        yield Row("betas of another number of frames", "left.shape", five_betas, "70 rows")
        yield Row("nine betas", "right.shape", nine_betas, "10 columns")
        yield Row("a frame too many", HAND, holding(OBJECT, npy_of(np.zeros((71, 7)))), "71 frames")
        for path, kind in ((OBJECT, "motion"), (CAMERA, "the camera")):
            yield Row(f"a command in {kind}", path, boxed(path, {"R_k_cam_np": Command()}), "not allowed")
        yield Row("no description", TEXT, removed(TEXT), "segments")
        yield Row("a range described twice", "arctic/s04/box_grab_01", one_for_two, "one line per range and hand")
        yield Row("a description beyond all bounds", TEXT, holding(TEXT, b"\n" * (17 << 20)), "at most")
        yield Row("parts that are no JSON", PARTS, holding(PARTS, "[1, 1,"), "a JSON list")
        yield Row("parts that are no list", PARTS, holding(PARTS, '{"0": 1}'), "8 zeros and ones")
        yield Row("a part 2", PARTS, holding(PARTS, "[1, 1, 1, 1, 0, 0, 0, 2]"), "8 zeros and ones")
        yield Row("a mesh that is no text", MESH, holding(MESH, b"\xff\xfe\x00v"), "vertices")
        yield Row("a corner beyond all vertices", MESH, holding(MESH, NO_FACE_OBJ + b"f 1 2 900\n"), "corners")
        yield Row("a camera of 69 frames", "T_k_cam_np", camera(T_k_cam_np=shift[:69]), "70 frames")
        yield Row("a camera without rotation", "egocam", camera(R_k_cam_np=None), "R_k_cam_np")
        yield Row("a camera that mirrors", "R_k_cam_np", camera(R_k_cam_np=turns * (1, 1, -1)), "rotations")
        yield Row("a camera that grows", "R_k_cam_np", camera(R_k_cam_np=turns * 1.01), "rotations")
        yield Row("a camera of other matrices", "R_k_cam_np", camera(R_k_cam_np=np.zeros((70, 4, 4))), "3 x 3")
        yield Row("a camera of text", "R_k_cam_np", camera(R_k_cam_np=np.full((70, 3, 3), "x")), "numbers")
        yield Row("intrinsics of two rows", "intrinsics", camera(intrinsics=np.ones((2, 3))), "3 rows")
        yield Row("offsets that are no JSON", "misc.json", misc(b"{"), "JSON object")
        yield Row("offsets in a list", "misc.json", misc(b"[1]"), "JSON object")
        yield Row("a subject without offset", "misc.json: s04", misc(b'{"s04": {"gender": "male"}}'), "ioi_offset")
        yield Row("an offset of half a frame", "ioi_offset", misc(b'{"s04": {"ioi_offset": 0.5}}'), "whole number")


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
