"""Faults of a motion that a person would see are reported; differences of some centimetres are not."""

from dataclasses import replace

import numpy as np
import pytest

from hoidata.actions.action import learn_actions
from hoidata.batches.requests import ObjectPoints
from hoidata.clips.clip import SIDES, Clip, HandTrack
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.metrics.verb_ranges import VerbRanges, visible_faults
from hoidata.objects.sampling import sample_points
from tests.builders.clips import DOWN, clip_of, flat_hand, still_object
from tests.builders.objects import box_model

HANDS, FRAMES = load_embedded_hands(), 30
BOX = box_model((0.10, 0.10, 0.10))
RISE = 0.2 * np.clip(np.linspace(-0.5, 1.5, FRAMES), 0, 1)


def right_hand(depth_m: float, rise_m: np.ndarray) -> HandTrack:
    """One that lies on the box with its lowest vertex, or ``depth_m`` deep in it, and moves with it."""
    wrist = np.zeros((FRAMES, 3))
    skin = track_vertices(flat_hand(wrist), HANDS.right)[0]
    lowest = skin[skin[:, 2].argmin()]
    return flat_hand(wrist - lowest + [0, 0, 0.05 - depth_m] + np.outer(rise_m, [0, 0, 1]))


def lift(depth_m: float = 0.0, rise_m: np.ndarray = RISE, hand_rise_m: np.ndarray | None = None) -> Clip:
    track = still_object(BOX, FRAMES)
    track = replace(track, translation_m=np.outer(rise_m, [0, 0, 1]).astype(np.float32))
    hand = right_hand(depth_m, rise_m if hand_rise_m is None else hand_rise_m)
    away = flat_hand(np.zeros((FRAMES, 3)), np.zeros(FRAMES, bool))
    return clip_of("generated/box", track, {"left": away, "right": hand}, gravity=DOWN)


@pytest.fixture(scope="module")
def points() -> ObjectPoints:
    sampled = sample_points(BOX, 256)
    return ObjectPoints(sampled.points_m, sampled.normals, sampled.part)


@pytest.fixture(scope="module")
def ranges(points: ObjectPoints) -> VerbRanges:
    """Of lifts, usually by 19 to 21 cm, and of objects that nobody moved."""
    nothing = VerbRanges(learn_actions({}), 0.02, HANDS)
    clips = {
        "lift": [lift(rise_m=fraction * RISE) for fraction in (0.95, 1.0, 1.05)],
        "touch": [lift(rise_m=0 * RISE)] * 3,
    }
    numbers = {verb: [nothing.numbers(clip, points) for clip in verb_clips] for verb, verb_clips in clips.items()}
    usual = {"lift": {"rise_m": (0.19, 0.21), "path_m": (0.19, 0.21)}}
    return VerbRanges(replace(learn_actions(numbers), usual=usual), 0.02, HANDS)


def faults_of(clip: Clip, points: ObjectPoints, ranges: VerbRanges | None, verb: str | None) -> tuple[str, ...]:
    return visible_faults(clip, HANDS, ranges, verb, ranges.numbers(clip, points) if ranges else {})


@pytest.mark.parametrize("fraction", [0.7, 0.95, 1.0, 1.3])
def test_a_usual_lift_has_no_fault(fraction: float, points: ObjectPoints, ranges: VerbRanges) -> None:
    clip = lift(rise_m=fraction * RISE)
    assert faults_of(clip, points, ranges, "lift") == ()
    unusual = ranges.actions.unusual("lift", ranges.numbers(clip, points))
    assert bool(unusual) == (fraction in (0.7, 1.3))  # which the page has in numbers


@pytest.mark.parametrize("fraction", [0.3, 2.0])
def test_a_visibly_different_lift_is_reported_with_its_numbers(
    fraction: float, points: ObjectPoints, ranges: VerbRanges
) -> None:
    (fault,) = faults_of(lift(rise_m=fraction * RISE), points, ranges, "lift")
    assert fault.startswith("unlike 'lift' in training")
    assert f"highest rise {20 * fraction:.3g} cm (usual: " in fault
    assert (", more like 'touch': " in fault) == (fraction == 0.3)


def test_a_static_object_is_a_fault_if_the_verb_moves_it(points: ObjectPoints, ranges: VerbRanges) -> None:
    still = lift(rise_m=0 * RISE)
    assert faults_of(still, points, ranges, "lift") == ("the object does not move",)
    assert faults_of(still, points, ranges, "touch") == ()
    assert faults_of(still, points, None, None) == ()


@pytest.mark.parametrize("gap_m", [0.008, 0.012, 0.3])
def test_a_hand_without_contact_is_reported_from_one_centimetre(gap_m: float, points: ObjectPoints) -> None:
    said = faults_of(lift(-gap_m), points, None, None)
    expected = (f"the right hand never touches the object ({gap_m * 100:.1f} cm away)",)
    assert said == (expected if gap_m > 0.01 else ())


def test_penetration_by_the_thickness_of_a_finger_is_reported(points: ObjectPoints) -> None:
    shallow, deep = (faults_of(lift(depth), points, None, None) for depth in (0.015, 0.025))
    assert shallow == ()
    assert deep == (f"the right hand is up to 2.5 cm inside the object in {FRAMES} frames",)


def test_a_floating_object_is_reported(points: ObjectPoints) -> None:
    """The hand lies on the box first, then rises faster than it does."""
    floats = int((RISE > 0.02).sum())
    expected = f"the object is in the air and no hand touches it in {floats} frames"
    assert faults_of(lift(hand_rise_m=3 * RISE), points, None, None) == (expected,)


def test_inactive_hands_are_not_checked(points: ObjectPoints) -> None:
    assert not any(lift().hands[side].valid.any() for side in SIDES[:1])
    assert faults_of(lift(), points, None, None) == ()
