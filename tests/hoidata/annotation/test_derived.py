"""Verbs from motion: each rule on a motion made for it, and on its reverse or its mirror image."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hoidata.annotation.derived import derive_verb, object_motion, turning_points
from hoidata.annotation.grammar import default_grammar
from hoidata.clips import Clip, ObjectTrack, Side
from hoidata.objects.model import ObjectModel
from hoidata.store.hand_evidence import HandEvidence
from tests.builders.clips import DOWN, clip_of, in_another_world, with_object
from tests.builders.objects import box_model, notebook

FRAMES = 90
PHASE = np.linspace(0, 1, FRAMES)
SMOOTH = PHASE**3 * (10 - 15 * PHASE + 6 * PHASE**2)
THERE_AND_BACK = np.sin(np.pi * PHASE) ** 2

BOX, NOTEBOOK = box_model((0.06, 0.08, 0.2)), notebook()
LEVER = replace(NOTEBOOK, name="espressomachine")


def clip(
    model: ObjectModel, path_m: Any = 0.0, turn_rad: Any = 0.0, hinge_rad: Any = None, gravity: Any = DOWN
) -> Clip:
    """path_m: (frame, 3); turn_rad: (frame,) about x, after a start that is not the identity."""
    rotation = Rotation.from_rotvec(np.broadcast_to(turn_rad, FRAMES)[:, None] * np.eye(3)[0])
    path = (np.array([0.3, -0.2, 0.9]) + path_m + np.zeros((FRAMES, 3))).astype(np.float32)
    hinge = None if hinge_rad is None else np.broadcast_to(hinge_rad, FRAMES).astype(np.float32)
    rotvec = (rotation * Rotation.from_rotvec([0.4, -1.1, 0.7])).as_rotvec().astype(np.float32)
    return clip_of("toy/s1/1", ObjectTrack(model, rotvec, path, hinge), gravity=gravity, verb=None)


def reversed_in_time(clip: Clip) -> Clip:
    track = clip.object
    hinge = None if track.hinge_rad is None else track.hinge_rad[::-1]
    return with_object(clip, rotvec=track.rotvec[::-1], translation_m=track.translation_m[::-1], hinge_rad=hinge)


def evidence(near: float = 1.0) -> HandEvidence:
    """The right hand is 1 cm away in the first share ``near`` of the frames and 10 cm in the others."""
    distance: dict[Side, np.ndarray] = {"left": np.full(FRAMES, np.inf), "right": np.where(near >= PHASE, 0.01, 0.1)}
    return HandEvidence(distance, 0.02)


def verb(clip: Clip, near: float = 1.0) -> str:
    return derive_verb(clip, evidence(near)).verb


def along(axis: int, metres: np.ndarray) -> np.ndarray:
    return metres[:, None] * np.eye(3)[axis]


LIFT = clip(BOX, path_m=along(2, 0.15 * SMOOTH))
HELD = clip(BOX, path_m=along(2, 0.01 * SMOOTH))  # in a hand, hardly moving
SLIDE = clip(BOX, path_m=along(0, 0.12 * SMOOTH))
# The verb of a motion, and of the motion backwards.
EITHER_WAY = {
    "a hinge leaves zero": (clip(NOTEBOOK, hinge_rad=0.1 + 0.5 * SMOOTH), "open", "close"),
    "a hinge leaves zero downwards": (clip(NOTEBOOK, hinge_rad=-0.1 - 0.5 * SMOOTH), "open", "close"),
    "a lever turns": (clip(LEVER, hinge_rad=0.1 + 0.5 * SMOOTH), "operate", "operate"),
    "a lever turns and comes back": (clip(LEVER, hinge_rad=0.2 + 0.6 * THERE_AND_BACK), "operate", "operate"),
    "a lever hardly turns": (clip(LEVER, hinge_rad=0.2 + 0.2 * SMOOTH), "touch", "touch"),
    "a hinge comes back": (clip(NOTEBOOK, hinge_rad=0.2 + 0.6 * THERE_AND_BACK), *["open and close"] * 2),
    "an open hinge comes back": (clip(NOTEBOOK, hinge_rad=0.8 - 0.6 * THERE_AND_BACK), *["close and open"] * 2),
    "a hinge turns by 11 degrees": (clip(NOTEBOOK, hinge_rad=0.2 + 0.2 * SMOOTH), "touch", "touch"),
    "a hinge turns by 13 degrees": (clip(NOTEBOOK, hinge_rad=0.1 + np.deg2rad(13) * SMOOTH), "touch", "touch"),
    "a hinge turns by 17 degrees": (clip(NOTEBOOK, hinge_rad=0.1 + np.deg2rad(17) * SMOOTH), "open", "close"),
    "at rest": (clip(BOX), "touch", "touch"),
    "a rise": (LIFT, "lift", "place"),
    "a rise upside down": (replace(LIFT, gravity=-DOWN), "place", "lift"),
    "a rise without gravity": (replace(LIFT, gravity=None), "move", "move"),
    "a rise and back": (clip(BOX, path_m=along(2, 0.15 * THERE_AND_BACK)), "lift", "lift"),
    "a rise of 1 cm": (clip(BOX, path_m=along(2, 0.01 * SMOOTH)), "hold", "hold"),
    "a rise of 2 cm": (clip(BOX, path_m=along(2, 0.02 * SMOOTH)), "grasp", "hold"),
    "a rise of 9 cm": (clip(BOX, path_m=along(2, 0.09 * SMOOTH)), "grasp", "place"),
    "a slide": (SLIDE, "move", "move"),
    "a slide up the wall": (replace(SLIDE, gravity=np.array([-1.0, 0, 0])), "lift", "place"),
    "a dip and back": (clip(BOX, path_m=along(2, -0.08 * THERE_AND_BACK)), "move", "move"),
    "a turn of 45 degrees": (clip(BOX, turn_rad=np.deg2rad(45) * SMOOTH), "turn", "turn"),
    "a turn of -45 degrees": (clip(BOX, turn_rad=np.deg2rad(-45) * SMOOTH), "turn", "turn"),
    "a turn of 20 degrees": (clip(BOX, turn_rad=np.deg2rad(20) * SMOOTH), "hold", "hold"),
}


@pytest.mark.parametrize("name", EITHER_WAY)
def test_a_motion_has_its_verb_forwards_and_backwards(name: str) -> None:
    motion, forwards, backwards = EITHER_WAY[name]
    assert (verb(motion), verb(reversed_in_time(motion))) == (forwards, backwards)


@pytest.mark.parametrize(
    ("amplitude_m", "per_second", "seconds", "expected"),
    [
        (0.02, 4, 3, "shake"),
        (0.02, 2, 3, "shake"),
        (0.003, 4, 3, "hold"),
        (0.02, 0.6, 3, "grasp"),
        (0.02, 4, 0.5, "grasp"),
        (0.02, 2, 1.0, "grasp"),
        (0.05, 1.1, 3, "grasp"),
    ],
)
def test_three_fast_wide_swings_are_shaking(amplitude_m, per_second, seconds, expected) -> None:
    time = np.arange(FRAMES) / 30
    swing = amplitude_m * np.sin(2 * np.pi * per_second * time) * (time < seconds)
    assert verb(clip(BOX, path_m=along(2, swing))) == expected


def test_shaking_counts_before_the_lift_it_comes_with_and_in_any_direction() -> None:
    swing = 0.02 * np.sin(2 * np.pi * 4 * np.arange(FRAMES) / 30)
    for axis in range(3):
        assert verb(clip(BOX, path_m=along(2, 0.2 * THERE_AND_BACK) + along(axis, swing))) == "shake"


def test_swings_in_less_than_a_fifth_of_the_clip_do_not_name_it() -> None:
    swing = 0.02 * np.sin(2 * np.pi * 6 * np.arange(FRAMES) / 30)
    briefly, longer = (clip(BOX, path_m=along(0, swing * (seconds > PHASE * 3))) for seconds in (0.55, 1.0))
    assert object_motion(briefly, evidence()).shakes == 3
    assert object_motion(briefly, evidence()).shaken_frames in range(13, 18)
    assert (verb(briefly), verb(longer)) == ("touch", "shake")


def test_at_rest_the_share_of_touched_frames_tells_hold_from_touch() -> None:
    assert verb(HELD, near=0.9) == "hold"
    assert verb(HELD, near=0.5) == "touch"


def test_an_object_that_rests_on_its_support_is_touched_not_held() -> None:
    noise = np.random.default_rng(0).normal(0, 0.0003, (FRAMES, 3))
    assert verb(clip(BOX, path_m=noise), near=1) == "touch"
    assert verb(clip(BOX, path_m=noise + along(0, 0.03 * SMOOTH)), near=1) == "touch"
    assert verb(clip(BOX, path_m=noise + along(2, 0.006 * SMOOTH)), near=1) == "hold"


def test_an_object_that_turns_on_its_support_is_touched_and_one_that_tilts_is_held() -> None:
    """The box stands on a face, and turns by 20 degrees about a vertical or a horizontal axis."""
    for axis, expected in ((2, "touch"), (0, "hold")):
        rotvec = along(axis, np.deg2rad(20) * SMOOTH).astype(np.float32)
        translation_m = np.zeros((FRAMES, 3), np.float32)
        for gravity in (DOWN, None):
            turning = clip_of("toy/s1/1", ObjectTrack(BOX, rotvec, translation_m, None), gravity=gravity, verb=None)
            assert verb(turning) == ("hold" if gravity is None else expected)


def test_the_lowest_point_is_that_of_the_posed_vertices() -> None:
    track = clip(NOTEBOOK, path_m=along(1, 0.2 * SMOOTH), turn_rad=SMOOTH, hinge_rad=0.3 + SMOOTH).object
    up = np.array([0.6, 0.0, 0.8])
    expected = (track.points_in_world(NOTEBOOK.vertices_m, NOTEBOOK.part) @ up).min(axis=1)
    np.testing.assert_allclose(track.lowest_m(up), expected, atol=1e-9)


def test_an_object_that_is_lowered_but_does_not_come_to_rest_is_not_placed() -> None:
    lowered = along(2, -0.15 * SMOOTH[:: FRAMES // 45][:45].repeat(2))
    assert verb(clip(BOX, path_m=lowered)) == "place"
    falling = along(2, -0.3 * PHASE**2)
    assert verb(clip(BOX, path_m=falling)) == "move"


def test_a_frame_is_touched_by_either_hand() -> None:
    """The left hand is near in the first half, the right one in the second."""
    distance: dict[Side, np.ndarray] = {
        "left": np.where(PHASE < 0.5, 0.01, 0.1),
        "right": np.where(PHASE < 0.5, 0.1, 0.01),
    }
    result = HandEvidence(distance, 0.02)
    assert object_motion(HELD, result).touched == 1
    assert derive_verb(HELD, result).verb == "hold"


SWING = along(0, 0.02 * np.sin(2 * np.pi * 4 * np.arange(FRAMES) / 30))
TWO_AT_ONCE = {
    "open": clip(NOTEBOOK, hinge_rad=0.1 + 0.5 * SMOOTH, path_m=SWING),
    "shake": clip(BOX, path_m=SWING + along(2, -0.15 * SMOOTH)),
    "place": clip(BOX, path_m=along(2, 0.3 * THERE_AND_BACK - 0.1 * SMOOTH)),
    "lift": clip(BOX, path_m=along(2, 0.15 * SMOOTH), turn_rad=np.deg2rad(45) * SMOOTH),
    "turn": clip(BOX, path_m=along(0, 0.12 * SMOOTH), turn_rad=np.deg2rad(45) * SMOOTH),
    "move": clip(BOX, path_m=along(0, 0.12 * SMOOTH) + along(2, 0.04 * SMOOTH)),
}


@pytest.mark.parametrize("expected", TWO_AT_ONCE)
def test_of_two_rules_that_hold_the_earlier_one_names_the_verb(expected: str) -> None:
    """Each motion is also that of the next rule: opened and shaken, shaken and put down, raised and put down, ..."""
    assert verb(TWO_AT_ONCE[expected]) == expected


def test_an_object_far_from_its_own_origin_moves_only_when_its_middle_does() -> None:
    """A turn of 20 degrees about its middle swings the origin, half a metre away, by 17 cm."""
    offset = np.array([0.0, 0.5, 0.0])
    far = replace(BOX, vertices_m=BOX.vertices_m + offset)
    turning = clip(far, turn_rad=np.deg2rad(20) * SMOOTH)
    origin = np.array([0.3, -0.2, 0.9]) - Rotation.from_rotvec(turning.object.rotvec).apply(offset)
    assert verb(with_object(turning, translation_m=origin.astype(np.float32))) == "hold"


def test_the_evidence_says_what_was_measured() -> None:
    assert derive_verb(clip(BOX, path_m=along(2, 0.15 * SMOOTH)), evidence()).evidence == "rises 15.0 cm"
    result = derive_verb(clip(NOTEBOOK, hinge_rad=0.6 - 0.5 * SMOOTH), evidence())
    assert result.evidence == "hinge from 0.60 to 0.10 rad, between 0.10 and 0.60"


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.sampled_from(
        [along(2, 0.15 * SMOOTH), along(0, 0.12 * SMOOTH), along(2, 0.04 * SMOOTH), along(2, -0.15 * SMOOTH)]
    ),
)
def test_a_world_that_is_turned_and_shifted_changes_no_verb(rotation: tuple[float, ...], path_m: np.ndarray) -> None:
    still = clip(BOX, path_m=path_m)
    assert verb(in_another_world(still, Rotation.from_rotvec(rotation), np.array([1.0, -2.0, 0.5]))) == verb(still)


MOTIONS = {
    "open": clip(NOTEBOOK, hinge_rad=0.1 + 0.5 * SMOOTH),
    "close": clip(NOTEBOOK, hinge_rad=0.6 - 0.5 * SMOOTH),
    "open and close": clip(NOTEBOOK, hinge_rad=0.2 + 0.6 * THERE_AND_BACK),
    "lift": clip(BOX, path_m=along(2, 0.15 * SMOOTH)),
    "place": clip(BOX, path_m=along(2, -0.15 * SMOOTH)),
    "turn": clip(BOX, turn_rad=np.deg2rad(45) * SMOOTH),
    "move": clip(BOX, path_m=along(0, 0.12 * SMOOTH)),
    "grasp": clip(BOX, path_m=along(2, 0.04 * SMOOTH)),
    "hold": clip(BOX),
}


@pytest.mark.parametrize("expected", MOTIONS)
def test_jitter_of_two_millimetres_and_one_degree_changes_no_verb(expected: str) -> None:
    rng, track = np.random.default_rng(0), MOTIONS[expected].object
    rotation = Rotation.from_rotvec(rng.normal(size=(FRAMES, 3)) * np.deg2rad(1) / 3**0.5)
    hinge = None if track.hinge_rad is None else track.hinge_rad + rng.normal(size=FRAMES) * np.deg2rad(1)
    shaken = replace(
        track,
        rotvec=(rotation * Rotation.from_rotvec(track.rotvec)).as_rotvec().astype(np.float32),
        translation_m=(track.translation_m + rng.normal(size=(FRAMES, 3)) * 0.002).astype(np.float32),
        hinge_rad=hinge,
    )
    assert verb(replace(MOTIONS[expected], object=shaken)) == expected


def test_turning_points_of_a_zigzag() -> None:
    zigzag = np.array([0, 1, 2, 1, 1.2, 0.9, 0, 3, 2.9, 3.1, 0.0])
    assert turning_points(zigzag, 1.0) == [0, 2, 6, 9]
    assert turning_points(zigzag, 2.5) == [0, 9]
    assert turning_points(np.zeros(5), 1.0) == []


def test_every_verb_that_is_derived_has_its_forms_in_the_word_table() -> None:
    assert {*MOTIONS, "shake", "touch"} <= set(default_grammar().verbs)
