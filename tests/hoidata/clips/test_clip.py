"""Frames taken from a clip hold the numbers of these frames, those and no others, whatever the clip has."""

import numpy as np
import pytest

from hoidata.clips import SIDES, Clip
from hoidata.clips.validation import check_clip

START, STOP = 5, 17


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


def entries(clip: Clip) -> set[tuple[int, int, int]]:
    contact = clip.source_contact
    assert contact is not None
    return {
        (int(f), int(v), int(label)) for f, v, label in zip(contact.frame, contact.vertex, contact.label, strict=True)
    }


@pytest.mark.parametrize("frames", [slice(START, STOP), np.array([STOP, START, START - 1])], ids=["slice", "numbers"])
def test_arrays_and_contacts_are_those_of_the_frames_in_their_order(clips, frames):
    fields, touched = set(), set()
    for whole in clips:
        part, numbers = whole.take(frames), np.arange(whole.n_frames)[frames]
        before, after = per_frame(whole), per_frame(part)
        assert list(before) == list(after)
        for name, array in before.items():
            assert len(array) == whole.n_frames
            np.testing.assert_array_equal(after[name], array[frames], err_msg=name)
        fields |= set(before)
        if whole.source_contact is not None:
            old = entries(whole)
            assert entries(part) == {(new, v, label) for new, n in enumerate(numbers) for f, v, label in old if f == n}
            assert part.source_contact.frame.dtype == whole.source_contact.frame.dtype
            touched |= {frame for frame, _, _ in old}
    assert {"left betas", "object 2 rotvec", "object 0 hinge_rad", "camera images", "body expression"} <= fields
    assert {START - 1, START, STOP - 1, STOP} <= touched


def test_constant_fields_are_unchanged(clips):
    for whole in clips:
        part = whole.take(slice(START, STOP))
        assert check_clip(part) is part
        assert (part.clip_id, part.n_frames, part.source_fps) == (whole.clip_id, STOP - START, whole.source_fps)
        for side in SIDES:
            assert part.hands[side].template_m is whole.hands[side].template_m
            if len(whole.hands[side].betas) == 1:
                assert part.hands[side].betas is whole.hands[side].betas
        assert part.object.model is whole.object.model
