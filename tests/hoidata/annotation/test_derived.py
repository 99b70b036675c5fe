"""Verbs from motion: each rule on a motion made for it, and on its reverse or its mirror image."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hoidata.annotation.derived import derive_verb, object_motion, turning_points
from hoidata.annotation.grammar import default_grammar
from hoidata.clips import SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.store.hand_evidence import HandEvidence

FRAMES = 90
PHASE = np.linspace(0, 1, FRAMES)
SMOOTH = PHASE**3 * (10 - 15 * PHASE + 6 * PHASE**2)
THERE_AND_BACK = np.sin(np.pi * PHASE) ** 2
DOWN = np.array([0.0, 0.0, -1.0])


def rigid() -> ObjectModel:
    box = trimesh.creation.box((0.06, 0.08, 0.2))
    return ObjectModel("box", box.vertices, box.faces, np.zeros(8, np.uint8))


def hinged() -> ObjectModel:
    base = trimesh.creation.box((0.1, 0.1, 0.01))
    vertices = np.concatenate([base.vertices - np.array([0.05, 0, 0]), base.vertices + np.array([0.05, 0, 0])])
    faces = np.concatenate([base.faces, base.faces + 8])
    return ObjectModel(
        "notebook", vertices, faces, (np.arange(16) >= 8).astype(np.uint8), Hinge(np.eye(3)[1], np.zeros(3))
    )


def clip(
    model: ObjectModel, path_m: Any = 0.0, turn_rad: Any = 0.0, hinge_rad: Any = None, gravity: Any = DOWN
) -> Clip:
    """path_m: (frame, 3); turn_rad: (frame,) about x, after a start that is not the identity."""
    zeros, pose = np.zeros((FRAMES, 3), np.float32), np.zeros((FRAMES, 45), np.float32)
    hand = HandTrack(zeros, zeros, pose, np.zeros((1, 10), np.float32), np.ones(FRAMES, bool))
    start = Rotation.from_rotvec([0.4, -1.1, 0.7])
    turn = Rotation.from_rotvec(np.broadcast_to(turn_rad, FRAMES)[:, None] * np.eye(3)[0])
    path = (np.array([0.3, -0.2, 0.9]) + path_m + zeros).astype(np.float32)
    hinge = None if hinge_rad is None else np.broadcast_to(hinge_rad, FRAMES).astype(np.float32)
    track = ObjectTrack(model, (turn * start).as_rotvec().astype(np.float32), path, hinge)
    return Clip(
        "toy/1", "toy", "s1", "1", dict.fromkeys(SIDES, hand), track, np.arange(FRAMES, dtype=np.int32), gravity,
        None, "box",
    )  # fmt: skip


def reversed_in_time(clip: Clip) -> Clip:
    track = clip.object
    hinge = None if track.hinge_rad is None else track.hinge_rad[::-1]
    back = replace(track, rotvec=track.rotvec[::-1], translation_m=track.translation_m[::-1], hinge_rad=hinge)
    return replace(clip, object=back)


def evidence(near: float = 1.0) -> HandEvidence:
    """The right hand is 1 cm away in the first share ``near`` of the frames and 10 cm in the others."""
    distance: dict[Side, np.ndarray] = {"left": np.full(FRAMES, np.inf), "right": np.where(near >= PHASE, 0.01, 0.1)}
    return HandEvidence(None, distance, 0.02).at_threshold(0.02)


def verb(clip: Clip, near: float = 1.0) -> str:
    return derive_verb(clip, evidence(near)).verb


def along(axis: int, metres: np.ndarray) -> np.ndarray:
    return metres[:, None] * np.eye(3)[axis]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_hinge_that_leaves_zero_is_opened_and_backwards_closed(sign: int) -> None:
    opening = clip(hinged(), hinge_rad=sign * (0.1 + 0.5 * SMOOTH), path_m=along(2, 0.2 * THERE_AND_BACK))
    assert verb(opening) == "open"
    assert verb(reversed_in_time(opening)) == "close"


def test_a_hinge_that_comes_back_is_operated_either_way_round_and_a_still_one_says_nothing() -> None:
    there_and_back = clip(hinged(), hinge_rad=0.2 + 0.6 * THERE_AND_BACK)
    assert verb(there_and_back) == verb(reversed_in_time(there_and_back)) == "operate"
    assert verb(clip(hinged(), hinge_rad=0.2 + 0.2 * SMOOTH)) == "hold"  # 11 degrees
    assert verb(clip(rigid())) == "hold"


def test_what_rises_is_lifted_and_backwards_placed_and_upside_down_too() -> None:
    rising = clip(rigid(), path_m=along(2, 0.15 * SMOOTH))
    assert verb(rising) == "lift"
    assert verb(reversed_in_time(rising)) == "place"
    assert verb(replace(rising, gravity=-DOWN)) == "place"


def test_what_rises_and_comes_back_is_lifted_either_way_round() -> None:
    there_and_back = clip(rigid(), path_m=along(2, 0.15 * THERE_AND_BACK))
    assert verb(there_and_back) == verb(reversed_in_time(there_and_back)) == "lift"


def test_what_rises_a_little_is_grasped_and_what_moves_level_is_moved() -> None:
    for rise in (0.02, 0.04, 0.09):
        assert verb(clip(rigid(), path_m=along(2, rise * SMOOTH))) == "grasp"
    assert verb(clip(rigid(), path_m=along(2, 0.01 * SMOOTH))) == "hold"
    sliding = clip(rigid(), path_m=along(0, 0.12 * SMOOTH))
    assert verb(sliding) == verb(reversed_in_time(sliding)) == "move"
    assert verb(replace(sliding, gravity=np.array([-1.0, 0, 0]))) == "lift"


def test_what_dips_and_comes_back_is_moved_and_not_placed() -> None:
    assert verb(clip(rigid(), path_m=along(2, -0.08 * THERE_AND_BACK))) == "move"
    assert verb(clip(rigid(), path_m=along(2, -0.08 * SMOOTH))) == "place"


def test_without_gravity_a_rise_is_a_move() -> None:
    assert verb(clip(rigid(), path_m=along(2, 0.15 * SMOOTH), gravity=None)) == "move"


@pytest.mark.parametrize(("degrees", "expected"), [(45, "turn"), (-45, "turn"), (20, "hold")])
def test_what_turns_on_the_spot_is_turned(degrees: float, expected: str) -> None:
    assert verb(clip(rigid(), turn_rad=np.deg2rad(degrees) * SMOOTH)) == expected


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
    assert verb(clip(rigid(), path_m=along(2, swing))) == expected


def test_shaking_counts_before_the_lift_it_comes_with_and_in_any_direction() -> None:
    swing = 0.02 * np.sin(2 * np.pi * 4 * np.arange(FRAMES) / 30)
    for axis in range(3):
        assert verb(clip(rigid(), path_m=along(2, 0.2 * THERE_AND_BACK) + along(axis, swing))) == "shake"


def test_swings_in_less_than_a_fifth_of_the_clip_do_not_name_it() -> None:
    swing = 0.02 * np.sin(2 * np.pi * 6 * np.arange(FRAMES) / 30)
    briefly, longer = (clip(rigid(), path_m=along(0, swing * (seconds > PHASE * 3))) for seconds in (0.55, 1.0))
    assert object_motion(briefly, evidence()).shakes == 3
    assert object_motion(briefly, evidence()).shaken_frames in range(13, 18)
    assert (verb(briefly), verb(longer)) == ("hold", "shake")


def test_at_rest_the_share_of_touched_frames_tells_hold_from_touch() -> None:
    assert verb(clip(rigid()), near=0.9) == "hold"
    assert verb(clip(rigid()), near=0.5) == "touch"


def test_a_frame_is_touched_by_either_hand() -> None:
    """The left hand is near in the first half, the right one in the second."""
    distance: dict[Side, np.ndarray] = {
        "left": np.where(PHASE < 0.5, 0.01, 0.1),
        "right": np.where(PHASE < 0.5, 0.1, 0.01),
    }
    found = HandEvidence(None, distance, 0.02).at_threshold(0.02)
    assert object_motion(clip(rigid()), found).touched == 1
    assert derive_verb(clip(rigid()), found).verb == "hold"


@pytest.mark.parametrize(("degrees", "expected"), [(13, "hold"), (17, "open")])
def test_a_hinge_counts_from_fifteen_degrees_on(degrees: float, expected: str) -> None:
    assert verb(clip(hinged(), hinge_rad=0.1 + np.deg2rad(degrees) * SMOOTH)) == expected


SWING = along(0, 0.02 * np.sin(2 * np.pi * 4 * np.arange(FRAMES) / 30))
TWO_AT_ONCE = {
    "open": clip(hinged(), hinge_rad=0.1 + 0.5 * SMOOTH, path_m=SWING),
    "shake": clip(rigid(), path_m=SWING + along(2, -0.15 * SMOOTH)),
    "place": clip(rigid(), path_m=along(2, 0.3 * THERE_AND_BACK - 0.1 * SMOOTH)),
    "lift": clip(rigid(), path_m=along(2, 0.15 * SMOOTH), turn_rad=np.deg2rad(45) * SMOOTH),
    "turn": clip(rigid(), path_m=along(0, 0.12 * SMOOTH), turn_rad=np.deg2rad(45) * SMOOTH),
    "move": clip(rigid(), path_m=along(0, 0.12 * SMOOTH) + along(2, 0.04 * SMOOTH)),
}


@pytest.mark.parametrize("expected", TWO_AT_ONCE)
def test_of_two_rules_that_hold_the_earlier_one_names_the_verb(expected: str) -> None:
    """Each motion is also that of the next rule: opened and shaken, shaken and put down, raised and put down, ..."""
    assert verb(TWO_AT_ONCE[expected]) == expected


def test_an_object_far_from_its_own_origin_moves_only_when_its_middle_does() -> None:
    """A turn of 20 degrees about its middle swings the origin, half a metre away, by 17 cm."""
    offset = np.array([0.0, 0.5, 0.0])
    far = replace(rigid(), vertices_m=rigid().vertices_m + offset)
    turning = clip(far, turn_rad=np.deg2rad(20) * SMOOTH)
    origin = np.array([0.3, -0.2, 0.9]) - Rotation.from_rotvec(turning.object.rotvec).apply(offset)
    track = replace(turning.object, translation_m=origin.astype(np.float32))
    assert verb(replace(turning, object=track)) == "hold"


def test_the_evidence_says_what_was_measured() -> None:
    assert derive_verb(clip(rigid(), path_m=along(2, 0.15 * SMOOTH)), evidence()).evidence == "rises 15.0 cm"
    found = derive_verb(clip(hinged(), hinge_rad=0.6 - 0.5 * SMOOTH), evidence())
    assert found.evidence == "hinge from 0.60 to 0.10 rad, between 0.10 and 0.60"


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.sampled_from(
        [along(2, 0.15 * SMOOTH), along(0, 0.12 * SMOOTH), along(2, 0.04 * SMOOTH), along(2, -0.15 * SMOOTH)]
    ),
)
def test_a_world_that_is_turned_and_shifted_changes_no_verb(turn: tuple[float, ...], path_m: np.ndarray) -> None:
    world = Rotation.from_rotvec(turn)
    still = clip(rigid(), path_m=path_m)
    track = still.object
    moved = replace(
        track,
        rotvec=(world * Rotation.from_rotvec(track.rotvec)).as_rotvec().astype(np.float32),
        translation_m=(world.apply(track.translation_m) + np.array([1.0, -2.0, 0.5])).astype(np.float32),
    )
    assert verb(replace(still, object=moved, gravity=world.apply(DOWN))) == verb(still)


MOTIONS = {
    "open": clip(hinged(), hinge_rad=0.1 + 0.5 * SMOOTH),
    "close": clip(hinged(), hinge_rad=0.6 - 0.5 * SMOOTH),
    "operate": clip(hinged(), hinge_rad=0.2 + 0.6 * THERE_AND_BACK),
    "lift": clip(rigid(), path_m=along(2, 0.15 * SMOOTH)),
    "place": clip(rigid(), path_m=along(2, -0.15 * SMOOTH)),
    "turn": clip(rigid(), turn_rad=np.deg2rad(45) * SMOOTH),
    "move": clip(rigid(), path_m=along(0, 0.12 * SMOOTH)),
    "grasp": clip(rigid(), path_m=along(2, 0.04 * SMOOTH)),
    "hold": clip(rigid()),
}


@pytest.mark.parametrize("expected", MOTIONS)
def test_jitter_of_two_millimetres_and_one_degree_changes_no_verb(expected: str) -> None:
    rng, track = np.random.default_rng(0), MOTIONS[expected].object
    turn = Rotation.from_rotvec(rng.normal(size=(FRAMES, 3)) * np.deg2rad(1) / 3**0.5)
    hinge = None if track.hinge_rad is None else track.hinge_rad + rng.normal(size=FRAMES) * np.deg2rad(1)
    shaken = replace(
        track,
        rotvec=(turn * Rotation.from_rotvec(track.rotvec)).as_rotvec().astype(np.float32),
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
