"""The verdict on a motion: bad motions fail the check that a viewer would name, good motions pass."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.actions.action import learn_actions
from hoidata.batches.requests import ObjectPoints
from hoidata.clips.clip import SIDES, Clip, HandTrack, Side
from hoidata.hands import load_embedded_hands, track_joints, track_vertices
from hoidata.metrics.verb_ranges import VerbRanges, object_ups
from hoidata.metrics.verdict import (
    GIVEN_MOTION,
    UNKNOWN_UP,
    Check,
    RequestedVerb,
    fewest_failed,
    summary,
    verdict,
    verdict_lines,
)
from hoidata.objects.sampling import sample_points
from hoidata.store.annotated import AnnotatedStore, load_annotated
from tests.builders.clips import DOWN, build_clip, clip_of, flat_hand, still_object
from tests.builders.objects import box_model, model_of
from tests.builders.stores import write_annotated

HANDS, FRAMES = load_embedded_hands(), 30
BOX = box_model((0.10, 0.10, 0.10))
Z = np.array([0.0, 0.0, 1.0])
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


def checks_of(clip: Clip, ranges: VerbRanges | None = None, verb: str = "lift", **options) -> dict[str, Check]:
    cloud = sample_points(clip.object.model, 256)
    points = ObjectPoints(cloud.points_m, cloud.normals, cloud.part)
    requested = RequestedVerb(verb, ranges, ranges.numbers(clip, points)) if ranges else GIVEN_MOTION
    return {check.name: check for check in verdict(clip, HANDS, requested=requested, **options)}


def failed(checks: dict[str, Check]) -> list[str]:
    return [name for name, check in checks.items() if check.passed is False]


@pytest.mark.parametrize("fraction", [0.7, 0.95, 1.0, 1.3])
def test_a_usual_lift_passes_all_checks(fraction: float, points: ObjectPoints, ranges: VerbRanges) -> None:
    clip = lift(rise_m=fraction * RISE)
    checks = checks_of(clip, ranges, up=Z)
    assert all(check.passed for name, check in checks.items() if name != "does not sink")
    assert list(checks) == ["touches", "carries", "does not pierce", "stands upright", "does not sink", "does the verb"]
    assert summary(tuple(checks.values())) == "all 5 checks pass, 1 not measured"
    assert "right hand 0.0 cm from the object at its nearest (at most 1 cm)" in checks["touches"].words
    unusual = ranges.actions.unusual("lift", ranges.numbers(clip, points))
    assert bool(unusual) == (fraction in (0.7, 1.3))  # which the page has in numbers


@pytest.mark.parametrize("fraction", [0.3, 2.0])
def test_a_visibly_different_lift_is_reported_with_its_numbers(fraction: float, ranges: VerbRanges) -> None:
    check = checks_of(lift(rise_m=fraction * RISE), ranges)["does the verb"]
    assert check.passed is False
    assert check.words.startswith("unlike 'lift' in training")
    assert f"highest rise {20 * fraction:.3g} cm (usual: " in check.words
    assert (", more like 'touch': " in check.words) == (fraction == 0.3)


def test_an_object_that_stands_still_fails_if_the_verb_moves_it(ranges: VerbRanges) -> None:
    still = lift(rise_m=0 * RISE)
    check = checks_of(still, ranges)["does the verb"]
    assert check.passed is False
    assert check.words == "'lift' moves its object, but no point of it moves farther than 0.0 cm (at least 1 cm)"
    assert checks_of(still, ranges, "touch")["does the verb"].passed is not False
    # A tremble of 2 mm adds up to a path of centimetres, but nothing moves.
    track = still.object.translation_m + 0.002 * np.random.default_rng(0).choice([-1, 1], (FRAMES, 3))
    trembling = replace(still, object=replace(still.object, translation_m=track.astype(np.float32)))
    assert "no point of it moves farther" in checks_of(trembling, ranges)["does the verb"].words


def test_trembling_and_slipping_do_not_count_against_the_verb_but_a_shake_must_shake(ranges: VerbRanges) -> None:
    tremble_m = 0.01 * np.sin(np.arange(FRAMES) * np.pi / 3)
    clip = lift(rise_m=RISE + tremble_m, hand_rise_m=RISE)
    bounds = {"slip_cm_s": (0.0, 1.0), "path_m": (0.1, 2.0)}
    for verb, least, most, passes in (
        ("lift", 0.0, 0.5, True),
        ("shake", 1.0, 2.0, True),
        ("shake", 20.0, 30.0, False),
    ):
        usual = {verb: bounds | {"reversals_per_s": (least, most)}}
        check = checks_of(clip, replace(ranges, actions=replace(ranges.actions, usual=usual)), verb)["does the verb"]
        assert check.passed is passes, check.words
    assert check.words.startswith("unlike 'shake' in training: turns back ")


@pytest.mark.parametrize("gap_m", [0.008, 0.012, 0.3])
def test_a_hand_without_contact_is_reported_from_one_centimetre(gap_m: float) -> None:
    check = checks_of(lift(-gap_m))["touches"]
    assert check.passed is (gap_m < 0.01)
    assert f"right hand {gap_m * 100:.1f} cm from the object" in check.words


def test_a_ring_three_centimetres_from_the_hand_neither_touches_nor_is_carried() -> None:
    ring = trimesh.creation.torus(0.025, 0.004)
    ring.apply_translation([0, 0, 0.05 - ring.bounds[1, 2]])  # its top is where the top of the box is
    track = still_object(model_of(ring), FRAMES)
    track = replace(track, translation_m=np.outer(RISE, Z).astype(np.float32))
    clip = replace(lift(-0.03), object=track)
    assert {"touches", "carries"} <= set(failed(checks_of(clip)))


def test_a_ball_lifted_without_contact_is_not_carried() -> None:
    track = still_object(model_of(trimesh.creation.icosphere(3, 0.05)), FRAMES)
    track = replace(track, translation_m=np.outer(RISE, Z).astype(np.float32))
    checks = checks_of(replace(lift(-0.05), object=track))
    assert failed(checks) == ["touches", "carries"]
    in_air = int((RISE > 0.02).sum())
    assert checks["carries"].words == (
        "without a hand within 1 cm the object moves 20.0 cm (at most 2 cm); "
        f"frames in the air: {in_air} (at most 2), and the last frame"
    )


def test_an_object_that_floats_in_the_last_frame_is_reported() -> None:
    hand_rise = RISE + np.where(np.arange(FRAMES) == FRAMES - 1, 0.03, 0.0)
    check = checks_of(lift(hand_rise_m=hand_rise))["carries"]
    assert check.passed is False
    assert check.words.endswith("frames in the air: 1 (at most 2), and the last frame")


@pytest.mark.parametrize("way_m", [0.018, 0.022])
def test_an_object_that_slides_away_without_a_hand_is_reported_but_not_one_that_trembles(way_m: float) -> None:
    slid = np.outer(np.linspace(0, way_m, FRAMES), [1, 0, 0])
    tremble = np.outer(0.009 * (-1.0) ** np.arange(FRAMES), [0, 1, 0])
    clip = lift(-0.05, rise_m=0 * RISE)
    for name, motion in (("slides", slid), ("trembles", tremble)):
        moved = replace(clip, object=replace(clip.object, translation_m=motion.astype(np.float32)))
        check = checks_of(moved)["carries"]
        assert (check.passed is False) is (name == "slides" and way_m > 0.02), check.words
    # As long as a hand is near, the object may travel.
    touched = lift(0.0, rise_m=0 * RISE)
    moved = replace(touched, object=replace(touched.object, translation_m=slid.astype(np.float32)))
    assert checks_of(moved)["carries"].passed is not False


def test_a_floating_object_is_reported() -> None:
    """The hand lies on the box first, then rises faster than it does."""
    assert failed(checks_of(lift(hand_rise_m=3 * RISE))) == ["carries"]
    assert failed(checks_of(lift())) == []


def test_penetration_deeper_than_manipnets_limit_is_reported() -> None:
    shallow, deep = (checks_of(lift(depth))["does not pierce"] for depth in (0.012, 0.018))
    assert shallow.passed
    assert deep.passed is False
    assert f"1.8 cm deep, too deep in {FRAMES} frames (a line through, or deeper than 1.5 cm" in deep.words


@pytest.mark.parametrize(
    ("height_m", "lines"), [(0.0, 4), (-0.06, 4), (0.15, 0)], ids=["fingers", "palm", "beyond the tips"]
)
def test_a_plate_pierced_by_fingers_or_palm_is_reported(height_m: float, lines: int) -> None:
    """An upright plate, 8 mm thick, cuts a flat hand; its inside is nowhere deeper than 4 mm."""
    hand = right_hand(0.0, 0 * RISE)
    joints = track_joints(hand, HANDS.right)[0].astype(np.float64)
    knuckles, tips = joints[[1, 4, 7, 10]], joints[[16, 17, 18, 19]]
    middle, along = (knuckles.mean(0) + tips.mean(0)) / 2, tips.mean(0) - knuckles.mean(0)
    plate = trimesh.creation.box((0.008, 0.3, 0.3))
    plate.apply_transform(trimesh.geometry.align_vectors([1, 0, 0], along))
    plate.apply_translation(middle + height_m * along / np.linalg.norm(along))
    clip = replace(lift(rise_m=0 * RISE), object=still_object(model_of(plate), FRAMES))
    check = checks_of(clip)["does not pierce"]
    assert f"right hand: {lines} of 5 lines from wrist to fingertip through the object" in check.words
    assert check.passed is (not lines)


def test_a_hand_on_a_box_edge_is_not_through_it() -> None:
    """The check needs surfaces on opposite sides: a finger across an edge crosses two at a right angle."""
    clip = lift(0.012)
    assert "0 of 5 lines from wrist to fingertip through the object" in checks_of(clip)["does not pierce"].words


@pytest.mark.parametrize(("axis", "degrees", "upright"), [("x", 10, True), ("x", 90, False), ("z", 90, True)])
def test_an_object_on_its_side_does_not_stand_upright(axis: str, degrees: float, upright: bool) -> None:
    bottle = model_of(trimesh.creation.cylinder(0.03, 0.2))
    rotvec = np.tile(np.radians(degrees) * np.eye(3)["xyz".index(axis)], (FRAMES, 1)).astype(np.float32)
    clip = replace(lift(), object=replace(still_object(bottle, FRAMES), rotvec=rotvec))
    assert checks_of(clip, up=Z)["stands upright"].passed is upright


@pytest.mark.parametrize(("below_m", "frames", "sinks"), [(0.014, 10, False), (0.017, 10, True), (0.017, 2, False)])
def test_an_object_that_goes_into_what_it_stood_on_sinks(below_m: float, frames: int, sinks: bool) -> None:
    path_m = np.zeros((FRAMES, 3), np.float32)
    path_m[5 : 5 + frames, 2] = -below_m
    clip = lift(-0.05)  # with the hand 5 cm above the box
    check = checks_of(replace(clip, object=replace(clip.object, translation_m=path_m)))["does not sink"]
    assert check.passed is not sinks, check.words
    assert f"{100 * below_m:.1f} cm below where it stood" in check.words


def test_an_object_that_is_held_in_the_first_frame_may_go_lower() -> None:
    check = checks_of(lift(rise_m=-RISE))["does not sink"]
    assert check.passed is None
    assert "a hand is at the object in the first frame" in check.words


@pytest.mark.parametrize("shape", ["ball", "cube"])
def test_an_object_that_looks_the_same_on_its_side_stands_upright(shape: str) -> None:
    model = model_of(trimesh.creation.icosphere(3, 0.05)) if shape == "ball" else BOX
    rotvec = np.tile([np.pi / 2, 0, 0], (FRAMES, 1)).astype(np.float32)
    clip = replace(lift(), object=replace(still_object(model, FRAMES), rotvec=rotvec))
    check = checks_of(clip, up=Z)["stands upright"]
    assert check.passed
    assert "looks the same" in check.words


def test_what_cannot_be_measured_says_why(ranges: VerbRanges) -> None:
    checks = checks_of(replace(lift(), gravity=None), up=Z)
    assert checks["stands upright"] == Check("stands upright", None, "gravity is not known")
    assert checks["does the verb"] == Check("does the verb", None, GIVEN_MOTION.reason)
    assert summary(tuple(checks.values())) == "all 3 checks pass, 3 not measured"
    assert checks_of(lift())["stands upright"].words == UNKNOWN_UP.reason
    few = replace(ranges, actions=replace(ranges.actions, usual={}))
    assert checks_of(lift(), few)["does the verb"].words == "training had too few clips of 'lift' for usual ranges"
    lines = verdict_lines(2, tuple(checks.values()))
    assert lines[0] == "sample 3: all 3 checks pass, 3 not measured"
    assert lines[-1] == f"  not measured: does the verb: {GIVEN_MOTION.reason}"
    open_box = model_of(trimesh.Trimesh(BOX.vertices_m, BOX.faces[2:], process=False))
    words = checks_of(replace(lift(), object=replace(lift().object, model=open_box)))["does not pierce"].words
    assert "encloses no solid" in words


def test_a_motion_without_hands_is_not_carried_and_the_rest_is_not_measured() -> None:
    invalid = {side: replace(track, valid=np.zeros(FRAMES, bool)) for side, track in lift().hands.items()}
    checks = checks_of(replace(lift(), hands=invalid))
    assert {name: check.passed for name, check in checks.items()} == {
        "touches": None, "carries": False, "does not pierce": None, "stands upright": None,
        "does not sink": True, "does the verb": None,
    }  # fmt: skip


def test_inactive_and_unselected_hands_are_not_checked() -> None:
    assert not any(lift().hands[side].valid.any() for side in SIDES[:1])
    assert failed(checks_of(lift())) == []
    sides: list[Side] = ["right"]
    far = replace(lift(), hands={"left": lift(-0.3).hands["right"], "right": lift().hands["right"]})
    assert failed(checks_of(far)) == ["touches"]
    assert failed(checks_of(far, sides=sides)) == []


def test_the_usual_up_direction_of_each_training_object(annotated: AnnotatedStore) -> None:
    ups = object_ups(annotated)
    assert sorted(ups) == sorted({annotated.clip(clip_id).object.model.name for clip_id in annotated.ids("train")})
    for clip_id in annotated.ids("train"):
        clip = annotated.clip(clip_id)
        rotation = Rotation.from_rotvec(clip.object.rotvec[0])
        assert rotation.apply(ups[clip.object.model.name]) @ clip.gravity < -0.9


def test_an_object_that_starts_in_too_different_poses_has_no_side_that_is_up(tmp_path, monkeypatch) -> None:
    clips = [build_clip(12, seed=number, clip_id=f"toy/s1/{number}") for number in range(2)]
    store = load_annotated(write_annotated(tmp_path, clips, rule={"by": "subject", "train": "rest"}))
    for degrees, is_known in ((0, True), (30, True), (60, False)):
        angles = itertools.cycle(np.radians((degrees, -degrees)))
        monkeypatch.setattr(
            "hoidata.metrics.verb_ranges.up_in_object", lambda *_, a=angles: Rotation.from_euler("x", next(a)).apply(Z)
        )
        assert list(object_ups(store).values()) == [pytest.approx(Z)] * is_known


def test_the_samples_that_fail_the_fewest_checks_are_kept_the_best_first() -> None:
    """A check that was not measured does not count as failed."""
    results: list[list[bool | None]] = [[False, False, True], [True, None, None], [True, False, True], [True] * 3]
    verdicts = [[Check("touches", passed, "") for passed in one] for one in results]
    assert [fewest_failed(verdicts, count) for count in (None, 1, 3, 9)] == [[0, 1, 2, 3], [1], [1, 3, 2], [1, 3, 2, 0]]
