"""Frames taken from a clip hold the numbers of these frames, those and no others, whatever the clip has."""

import numpy as np
import pytest

from hoidata.clips import SIDES, Clip
from hoidata.clips.validation import check_clip

START, STOP = 5, 17


@pytest.fixture
def cuts(clips) -> list[tuple[Clip, Clip]]:
    return [(clip, clip.take(slice(START, STOP))) for clip in clips]


def per_frame(clip: Clip) -> dict[str, np.ndarray]:
    """Every array of a clip that has one row per frame."""
    arrays = {"source_frames": clip.source_frames}
    for side in SIDES:
        track = clip.hands[side]
        names = ("wrist_m", "global_orient", "hand_pose", "valid", *(["betas"] if len(track.betas) > 1 else []))
        arrays |= {f"{side} {name}": getattr(track, name) for name in names}
    for number, track in enumerate((clip.object, *clip.other_objects)):
        names = ("rotvec", "translation_m", *(["hinge_rad"] if track.is_articulated else []))
        arrays |= {f"object {number} {name}": getattr(track, name) for name in names}
    if clip.camera is not None:
        arrays |= {f"camera {name}": getattr(clip.camera, name) for name in ("rotvec", "position_m", "images")}
    if clip.body is not None:
        names = ("transl_m", "global_orient", "body_pose", "face_pose", "expression")
        arrays |= {f"body {name}": value for name in names if (value := getattr(clip.body, name)) is not None}
    return arrays


def test_every_array_is_cut_to_the_same_frames(cuts):
    field_names = set()
    for whole, part in cuts:
        before, after = per_frame(whole), per_frame(part)
        assert list(before) == list(after)
        for name, array in before.items():
            assert len(array) == whole.n_frames
            np.testing.assert_array_equal(after[name], array[START:STOP], err_msg=name)
        field_names |= set(before)
    expected_names = {"left betas", "object 2 rotvec", "object 0 hinge_rad", "camera images", "body expression"}
    assert expected_names <= field_names


def test_constant_fields_are_unchanged(cuts):
    for whole, part in cuts:
        assert check_clip(part) is part
        assert (part.clip_id, part.n_frames, part.source_fps) == (whole.clip_id, STOP - START, whole.source_fps)
        for side in SIDES:
            assert part.hands[side].template_m is whole.hands[side].template_m
            if len(whole.hands[side].betas) == 1:
                assert part.hands[side].betas is whole.hands[side].betas
        assert part.object.model is whole.object.model


def entries(clip: Clip) -> set[tuple[int, int, int]]:
    contact = clip.source_contact
    assert contact is not None
    return {
        (int(f), int(v), int(label)) for f, v, label in zip(contact.frame, contact.vertex, contact.label, strict=True)
    }


def test_contacts_are_selected_and_renumbered_from_the_first_frame(cuts):
    touched = [(whole, part) for whole, part in cuts if whole.source_contact is not None]
    at_the_edges = {START - 1, START, STOP - 1, STOP}
    assert at_the_edges <= {frame for whole, _ in touched for frame, _, _ in entries(whole)}
    for whole, part in touched:
        expected = {(f - START, v, label) for f, v, label in entries(whole) if START <= f < STOP}
        assert entries(part) == expected


def test_frames_may_be_taken_by_number_in_any_order_with_their_contacts(clips):
    frame_numbers = np.array([STOP, START, START - 1])
    for whole in clips:
        taken = whole.take(frame_numbers)
        for name, array in per_frame(whole).items():
            np.testing.assert_array_equal(per_frame(taken)[name], array[frame_numbers], err_msg=name)
        if whole.source_contact is not None:
            expected = {
                (new, v, label) for new, old in enumerate(frame_numbers) for f, v, label in entries(whole) if f == old
            }
            assert entries(taken) == expected
            assert taken.source_contact.frame.dtype == whole.source_contact.frame.dtype
