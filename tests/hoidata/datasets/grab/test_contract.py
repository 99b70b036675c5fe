"""GRAB passes the tests of all adapters; also the problems its files can have."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from tests.builders import grab
from tests.builders.corruption import (
    HUGE_PLY,
    NO_FACE_PLY,
    Command,
    Corrupt,
    at,
    cut_in_half,
    emptied,
    holding,
    huge_npy,
    linked_outside,
    npy_of,
    removed,
    set_in,
    with_member,
)
from tests.hoidata.datasets.contract import AdapterContract, Problem

FILE = "grab/s3/cubelarge_offhand_1.npz"
MESH = "tools/object_meshes/contact_meshes/cubelarge.ply"
SHAPE = grab.N_FRAMES, grab.N_VERTICES


def edited(change: Callable[[dict], object], data: Callable[[], dict] = grab.sequence) -> Corrupt:
    """Rewrite the sequence's file with changed content."""

    def corrupt(root: Path) -> None:
        content = data()
        change(content)
        grab.write_sequence(root, content)

    return corrupt


def number(block: str, value: float) -> Corrupt:
    return edited(lambda data: data[block]["params"]["transl"].__setitem__((20, 1), value))


def contact(value: np.ndarray) -> Corrupt:
    return edited(set_in("contact", "object", value=value))


def components(columns: int) -> Corrupt:
    def change(data: dict) -> None:
        del data["lhand"]["params"]["fullpose"]
        data["lhand"]["params"]["hand_pose"] = np.zeros((61, columns))

    return edited(change)


def short_table(root: Path) -> None:
    grab.write_table(root)
    edited(lambda data: data["table"].update(params={k: v[:60] for k, v in data["table"]["params"].items()}),
           grab.with_table)(root)  # fmt: skip


class TestGrab(AdapterContract):
    name = "grab"
    corrupted_sequence = "grab/s3/cubelarge_offhand_1"
    write = staticmethod(grab.write_two)
    bad_settings = {  # noqa: RUF012
        "margin_frames": (1.5, "0 or more"),
        "contact": ("yes", "true or false"),
        "body": (1, "true or false"),
    }
    conventions = {  # noqa: RUF012
        "unit": "test_meshes_and_places_are_metres",
        "handedness of the world": "contract.py::test_the_world_is_not_seen_in_a_mirror",
        "meshes": "test_objects_rotate_about_the_origin_of_their_mesh_not_its_centre",
        "object rotation": "test_objects_rotate_as_row_vectors",
        "hand translation": "test_the_hand_rotates_about_its_rest_wrist_and_is_moved_by_transl",
        "finger angles": "test_fingers_are_absolute",
        "principal components": "test_components_are_weights_of_the_models_first_rows_without_the_mean",
        "shape": "test_the_rest_mesh_is_that_of_the_subject_without_betas",
        "left and right": "contract.py::test_the_numbers_of_each_hand_bend_a_hand_of_that_side",
        "frames": "test_every_fourth_frame_counts_from_the_first_of_the_file_and_both_ends_of_the_contact_stay",
        "gravity": "test_things_fall_along_minus_z",
    }

    @staticmethod
    def file_problems() -> Iterable[Problem]:
        zeros = np.zeros((61, 3), np.float32)
        bomb = npy_of(np.zeros(3))[:-24].replace(b"(3,), }  ", b"(200000000,), }")
        outside = set_in("object", "object_mesh", value="../../../../../../../../etc/passwd")
        deep = edited(set_in("object", "params", "transl", value=Command()))
        words = edited(set_in("object", "params", "transl", value=zeros.astype("U3")))
        wrong = edited(set_in("rhand", "params", "transl", value=np.zeros((61, 4))))
        short = edited(set_in("lhand", "params", "transl", value=zeros[:60]))
        yield "truncated file", FILE, at(FILE, cut_in_half), "whole .npz"
        yield "empty file", FILE, at(FILE, emptied), "whole .npz"
        yield "malicious pickle", FILE, edited(set_in("rhand", value=Command())), "not allowed"
        yield "malicious pickle deep inside", FILE, deep, "not allowed"
        yield "NaN", FILE, number("object", np.nan), "finite"
        yield "infinity", FILE, number("rhand", np.inf), "finite"
        yield "wrong columns", FILE, wrong, "3 columns"
        yield "wrong dtype (words)", FILE, words, "numbers"
        yield "missing object file", MESH, removed(MESH), "nothing there"
        yield "frame-count mismatch", FILE, short, "61 frames"
        yield "non-UTF-8 text", FILE, edited(set_in("motion_intent", value=b"\xff\xfe")), "text"
        yield "duplicate member", FILE, at(FILE, with_member("rhand.npy", npy_of(np.zeros(2)), again=True)), "once"
        yield "symlink out of the root", FILE, linked_outside(FILE), "link that leaves"
        yield "path out of the root inside the file", "passwd", edited(outside), "link that leaves"
        yield "zero-face mesh", MESH, holding(MESH, NO_FACE_PLY), "with faces"
        yield "absurd size (10^9 vertices)", MESH, holding(MESH, HUGE_PLY), "more than"
        yield "absurd size (header)", FILE, at(FILE, with_member("n_frames.npy", huge_npy(b""))), "bytes of data"
        yield "zip bomb", FILE, at(FILE, with_member("n_frames.npy", bomb + bytes(1_200_000_000))), "when unpacked"

    @staticmethod
    def format_problems() -> Iterable[Problem]:
        third, ones = np.arange(grab.N_VERTICES) == 2, np.ones(SHAPE)
        hand = "tools/subject_meshes/male/s3_rhand.ply"
        for member in ("contact", "table", "framerate"):
            runs = edited(set_in(member, value={"params": Command(), "object": Command()}), grab.with_table)
            yield f"a command in {member}", FILE, runs, "not allowed"
        no_turn = edited(lambda data: data["object"]["params"].pop("global_orient"))
        yield "no rotation", "object", no_turn, "global_orient"
        yield "no contact", "contact.object", contact(np.zeros(SHAPE, np.int8)), "contact in at least one frame"
        yield "contact of another mesh", "contact.object", contact(np.ones((61, 9), np.int8)), "(61, 8)"
        yield "a frame rate of 100", "framerate", edited(set_in("framerate", value=100.0)), "multiple of 30"
        yield "an endless frame rate", "framerate", edited(set_in("framerate", value=np.inf)), "whole number"
        yield "an unreadable mesh", MESH, holding(MESH, "ply\nnothing"), "mesh"
        yield "a mesh header that is no text", MESH, holding(MESH, b"ply\nformat ascii \xff\xfe\n"), "mesh"
        yield "10^15 frames", "contact.object", edited(set_in("n_frames", value=10**15)), "(1000000000000000, 8)"
        yield "frames of another number", "contact.object", edited(set_in("n_frames", value=60)), "(60, 8)"
        yield "half a frame", "n_frames", edited(set_in("n_frames", value=61.5)), "whole number"
        yield "no contact entry", FILE, edited(lambda data: data.pop("contact")), "contact"
        yield "contact that is no dict", "contact", edited(set_in("contact", value=[1])), "dict"
        yield "contact of text", "contact.object", contact(np.full(SHAPE, "x")), "numbers"
        yield "contact of halves", "contact.object", contact(np.where(third, 0.5, 0) * ones), "whole numbers"
        yield "contact of NaN", "contact.object", contact(np.where(third, np.nan, 22) * ones), "whole numbers"
        yield "contact beyond all labels", "contact.object", contact(np.full(SHAPE, 300)), "up to 255"
        yield "components without columns", "lhand.hand_pose", components(0), "24 columns"
        yield "more components than the model has", "lhand.hand_pose", components(46), "24 columns"
        yield "a table of 60 frames", "table", short_table, "61 frames"
        yield "a missing hand mesh", hand, removed(hand), "a file"
