"""A fault in a good clip raises its measure over the limit and leaves the others unchanged."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips import Clip
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.quality.measures import ObjectFacts, clip_row, object_motion, object_row
from hoidata.quality.thresholds import (
    CLIP_MEASURES,
    DEFAULT_LIMITS,
    MESH_MEASURES,
    Finding,
    Limit,
    Measure,
    Thresholds,
    findings,
    reasons_of,
    verdict_of,
)
from tests.builders.clips import jumping, with_hand, with_object
from tests.builders.objects import box_model

FRAMES = 60
HANDS = load_embedded_hands()
NAMES = [measure.name for measure in CLIP_MEASURES if measure.name != "beta_distance"]


def row(clip: Clip, thresholds: Thresholds | None = None) -> dict:
    return clip_row(clip, ObjectFacts.of(clip.object.model), HANDS, thresholds or Thresholds())


def over_limit(measured: dict) -> dict[str, str]:
    """Verdict by measure, of those over a limit."""
    verdicts = {}
    for measure in CLIP_MEASURES:
        for finding in findings({**measured, "beta_distance": np.nan}, [measure], DEFAULT_LIMITS):
            verdicts[measure.name] = finding.verdict
    return verdicts


@pytest.fixture
def good(make_clip) -> Clip:
    return make_clip(n_frames=FRAMES, seed=3)


def noise(sigma: float, *shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(0, sigma, shape).astype(np.float32)


def from_frame_30(values: np.ndarray, change) -> np.ndarray:
    changed = values.copy()
    changed[30:] += change
    return changed


def no_hand(clip: Clip) -> Clip:
    return with_hand(with_hand(clip, valid=np.zeros(FRAMES, bool)), "left", valid=np.zeros(FRAMES, bool))


def sunken_hand(clip: Clip) -> Clip:
    return with_hand(clip, wrist_m=clip.object.translation_m.copy())


def jumping_hand(clip: Clip) -> Clip:
    return with_hand(clip, wrist_m=from_frame_30(clip.hands["right"].wrist_m, 0.5))


def giant_betas(clip: Clip) -> Clip:
    return with_hand(clip, betas=np.full((1, 10), -11.0, np.float32))


def shaking_wrist(clip: Clip) -> Clip:
    return with_hand(clip, wrist_m=clip.hands["right"].wrist_m + noise(0.03, FRAMES, 3))


FAULTS: dict[str, tuple[Callable[[Clip], Clip], dict[str, str]]] = {
    "shaking wrist": (shaking_wrist, {"wrist_acceleration_m_s2": "left out", "shaking_share": "left out"}),
    "shaking fingers": (
        lambda clip: with_hand(clip, hand_pose=clip.hands["right"].hand_pose + noise(1.2, FRAMES, 45)),
        {"finger_acceleration_m_s2": "left out"},
    ),
    "shaking object": (
        lambda clip: with_object(clip, translation_m=clip.object.translation_m + noise(0.03, FRAMES, 3)),
        {"object_acceleration_m_s2": "left out", "shaking_share": "left out"},
    ),
    "jumping hand": (jumping_hand, {"hand_jump_m": "left out"}),
    "jumping object": (lambda clip: jumping(clip, 30, 0.5), {"object_jump_m": "left out"}),
    "turning object": (
        lambda clip: with_object(clip, rotvec=np.r_[clip.object.rotvec[:30], np.tile((0, 0, 3.1), (30, 1))]),
        {"object_jump_m": "warned"},
    ),
    "lost hand": (
        lambda clip: with_hand(clip, valid=(np.arange(FRAMES) < 5) | (np.arange(FRAMES) >= 50)),
        {"gap_share": "left out"},
    ),
    "no hand": (no_hand, {"handless_share": "left out"}),
    "giant betas": (giant_betas, {"largest_beta": "left out"}),
    "sunken hand": (sunken_hand, {"penetration_m": "warned", "penetration_share": "warned"}),
}


def test_good_clip_is_over_no_limit(good):
    measured = row(good)
    assert over_limit(measured) == {}
    assert all(np.isfinite(measured[name]) for name in NAMES)
    assert measured["time_offset_frames"] == 0


@pytest.mark.parametrize("name", FAULTS)
def test_planted_fault_is_found(good, name):
    plant, expected = FAULTS[name]
    assert expected.items() <= over_limit(row(plant(good))).items()


def test_fault_does_not_raise_what_it_does_not_concern(good):
    assert set(over_limit(row(giant_betas(good)))) <= {"largest_beta", "penetration_m", "penetration_share"}
    assert set(over_limit(row(no_hand(good)))) == {"handless_share"}
    assert "finger_acceleration_m_s2" not in over_limit(row(shaking_wrist(good)))
    assert set(over_limit(row(jumping(good, 30, 0.5)))) <= {"object_jump_m"}


def test_jump_says_between_which_frames_it_is(good):
    measured = row(jumping_hand(good))
    assert measured["hand_jump_frame"] == 29
    assert measured["object_jump_frame"] == -1
    (finding,) = findings(measured, [CLIP_MEASURES[4]], DEFAULT_LIMITS)
    assert finding.reason.startswith("largest sudden step of a joint: 0.8")
    assert finding.reason.endswith("m at frame 29, above 0.3 m")


STILL_FRAMES = np.r_[np.clip(np.arange(29), None, 9), np.arange(29, FRAMES)]  # still in frames 9 to 28


def test_one_frozen_hand_and_a_frozen_recording_are_distinguished(good):
    pose = {"rotvec": good.object.rotvec[STILL_FRAMES], "translation_m": good.object.translation_m[STILL_FRAMES]}
    hands = {side: _frozen(track, STILL_FRAMES) for side, track in good.hands.items()}
    one, both = (
        replace(good, hands={**good.hands, "right": hands["right"]}),
        replace(with_object(good, **pose), hands=hands),
    )
    frozen_frames = [(row(clip)["frozen_hand_frames"], row(clip)["frozen_all_frames"]) for clip in (one, both)]
    assert frozen_frames == [(20, 0), (0, 20)]


def test_a_hand_is_frozen_while_only_the_other_one_moves(good):
    still = {"rotvec": good.object.rotvec[:1].repeat(FRAMES, 0), "translation_m": np.zeros((FRAMES, 3), np.float32)}
    clip = with_object(
        replace(good, hands={**good.hands, "right": _frozen(good.hands["right"], STILL_FRAMES)}), **still
    )
    assert row(clip)["frozen_hand_frames"] == 20


def test_nothing_is_frozen_while_another_object_or_the_lid_moves(make_clip):
    clip = make_clip(n_frames=FRAMES, articulated=True, seed=3)
    moving = clip.object
    pose = {"rotvec": moving.rotvec[STILL_FRAMES], "translation_m": moving.translation_m[STILL_FRAMES]}
    hands = {side: _frozen(track, STILL_FRAMES) for side, track in clip.hands.items()}
    closed = replace(with_object(clip, **pose, hinge_rad=np.zeros(FRAMES, np.float32)), hands=hands)
    assert row(closed)["frozen_all_frames"] == 20
    assert row(replace(closed, other_objects=(moving,)))["frozen_all_frames"] == 0
    assert row(with_object(closed, hinge_rad=moving.hinge_rad))["frozen_all_frames"] == 0


def test_one_hand_is_enough(good):
    """Left valid in the first 30 frames, right in frames 20 to 50: nobody is there in the last 10."""
    frames = np.arange(FRAMES)
    left = replace(good.hands["left"], valid=frames < 30)
    measured = row(with_hand(replace(good, hands={**good.hands, "left": left}), valid=(frames >= 20) & (frames < 50)))
    assert measured["handless_share"] == pytest.approx(10 / 60)
    assert (measured["left_invalid_share"], measured["right_invalid_share"]) == (0.5, 0.5)


def _frozen(track, source_frames):
    names = ("wrist_m", "global_orient", "hand_pose")
    return replace(track, **{name: getattr(track, name)[source_frames] for name in names})


def test_late_hands_are_found_with_their_lag(make_clip):
    clip = make_clip(n_frames=FRAMES, seed=1)
    seconds = np.arange(FRAMES, dtype=np.float32)[:, None] / 30
    sway = 0.1 * np.sin(5 * seconds) * np.array([[1, 0.5, 0]], np.float32)
    late = 0.1 * np.sin(5 * (seconds - 3 / 30)) * np.array([[1, 0.5, 0]], np.float32)
    still = {"rotvec": np.zeros((FRAMES, 3), np.float32), "translation_m": sway}
    start = clip.hands["right"].wrist_m[:1] - clip.object.translation_m[:1]
    orient = clip.hands["right"].global_orient[:1].repeat(FRAMES, axis=0)
    moved = with_hand(with_object(clip, **still), wrist_m=start + late, global_orient=orient)
    assert abs(row(moved)["time_offset_frames"] - 3) <= 1


def test_penetration_is_not_claimed_where_the_mesh_is_open(good):
    model = replace(good.object.model, faces=good.object.model.faces[1:])
    measured = row(with_object(sunken_hand(good), model=model))
    assert np.isnan(measured["penetration_m"])
    assert np.isnan(measured["penetration_share"])
    assert measured["note"] == "penetration not measured: the mesh of box is not solid"


def test_penetration_is_the_depth_of_the_deepest_vertex(make_clip):
    """A wrist at the centre of a box of 10 x 8 x 6 cm: its vertices lie up to 3 cm deep, never deeper."""
    measured = row(sunken_hand(make_clip(n_frames=6)))
    assert 0.025 < measured["penetration_m"] <= 0.03
    assert measured["penetration_share"] == 1


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_deeper_hand_counts_whichever_it_is(make_clip, side):
    clip = make_clip(n_frames=6)
    sunken = replace(clip.hands[side], wrist_m=clip.object.translation_m.copy())
    far = {other: replace(track, wrist_m=track.wrist_m + np.float32(2)) for other, track in clip.hands.items()}
    assert row(replace(clip, hands={**far, side: sunken}))["penetration_m"] > 0.025


def test_only_parts_with_an_inside_are_penetrated(make_clip):
    """A box without one triangle, and its lid of 1 cm: a hand inside the box is at most 5 mm deep, in the lid."""
    clip = sunken_hand(make_clip(n_frames=6, articulated=True))
    model = replace(clip.object.model, faces=clip.object.model.faces[1:])
    assert row(clip)["penetration_m"] > 0.02
    measured = row(with_object(clip, model=model))
    assert measured["penetration_m"] <= 0.005 + 1e-6
    assert measured["note"] == "penetration measured in the 1 solid of 2 parts only"


def test_penetration_looks_at_every_nth_frame_from_the_first_on(good):
    wrist = good.hands["right"].wrist_m.copy()
    wrist[7] = good.object.translation_m[7]
    clip = with_hand(good, wrist_m=wrist)
    depths = [row(clip, Thresholds(penetration_every=stride))["penetration_m"] for stride in (7, 2)]
    assert depths[0] > 0.02
    assert depths[1] < 0.01


def test_a_hand_that_is_not_seen_penetrates_nothing(make_clip):
    """What a frame without the hand holds means nothing, wherever it lies."""
    clip = sunken_hand(make_clip(n_frames=11))
    valid = np.arange(11) >= 5  # measured in frames 0, 5 and 10
    partly_valid, never_valid = row(with_hand(clip, valid=valid)), row(with_hand(clip, valid=np.zeros(11, bool)))
    assert partly_valid["penetration_share"] == pytest.approx(2 / 3)
    assert (never_valid["penetration_m"], never_valid["penetration_share"]) == (0, 0)


def test_object_measures_are_those_of_its_worst_part(make_clip):
    model = make_clip(articulated=True).object.model
    measured = object_row(ObjectFacts.of(replace(model, faces=model.faces[:-1])))
    assert measured["open_edge_share"] == pytest.approx(3 / 33)
    assert (measured["parts"], measured["watertight"], measured["solid"]) == (2, False, False)
    assert measured["size_m"] == pytest.approx(0.1)
    assert [finding.verdict for finding in findings(measured, MESH_MEASURES, DEFAULT_LIMITS)] == ["warned"]


def test_object_as_large_as_a_room_is_left_out():
    (finding,) = findings(object_row(ObjectFacts.of(box_model((4.0, 1, 1)))), MESH_MEASURES, DEFAULT_LIMITS)
    assert finding == ("left out", "longest side of the bounding box: 4 m, above 3 m")


SIZE = Measure("size", "m", "size")


@pytest.mark.parametrize(
    ("value", "limit", "expected"),
    [
        (2.0, Limit(1.0, 3.0), "warned"),
        (4.0, Limit(1.0, 3.0), "left out"),
        (-4.0, Limit(1.0, 3.0), "left out"),
        (1.0, Limit(1.0, 3.0), "ok"),
        (4.0, Limit(1.0, None), "warned"),
        (4.0, Limit(None, None), "ok"),
        (float("nan"), Limit(1.0, 3.0), "ok"),
    ],
)
def test_verdict_follows_from_the_limits(value, limit, expected):
    assert verdict_of(findings({"size": value}, [SIZE], {"size": limit})) == expected


def test_reasons_are_those_of_the_verdict():
    violations = [Finding("warned", "a"), Finding("left out", "b"), Finding("left out", "c")]
    assert reasons_of(violations) == "b; c"
    assert reasons_of(violations[:1]) == "a"
    assert reasons_of([]) == ""


def test_limit_of_an_unknown_measure_is_refused():
    with pytest.raises(BadInput, match="wrist_jerk"):
        Thresholds(limits={**DEFAULT_LIMITS, "wrist_jerk": Limit(1, 2)})
    with pytest.raises(BadInput, match="size_m"):
        Thresholds(limits={name: limit for name, limit in DEFAULT_LIMITS.items() if name != "size_m"})
    with pytest.raises(BadInput, match="penetration_every"):
        Thresholds(penetration_every=0)


def test_each_parts_pose_carries_its_points_through_the_world(make_clip):
    track = make_clip(6, articulated=True).object
    facts = ObjectFacts.of(track.model)
    motion, moved = object_motion(track, facts), facts.part == 1
    assert 0 < moved.sum() < len(moved)
    for part, rows in enumerate((~moved, moved)):
        placed = facts.points_m[rows] @ motion.rotmats[part].transpose(0, 2, 1) + motion.positions_m[part][:, None]
        np.testing.assert_allclose(placed, motion.points_m[:, rows], atol=1e-9)


def test_frames_deeper_than_a_centimetre_are_too_deep(good, monkeypatch):
    depth_m = {"left": np.repeat([0.003, 0.011, 0.003], 4), "right": np.repeat([0.0, 0.0, 0.0099], 4)}
    monkeypatch.setattr("hoidata.quality.measures.hand_in_object_frame", lambda clip, side, hands: side)
    monkeypatch.setattr("hoidata.quality.measures.deepest_m", lambda side, index: depth_m[side])
    shares = [row(good, Thresholds(**one))["penetration_share"] for one in ({}, {"too_deep_m": 0.005})]
    assert shares == pytest.approx([4 / 12, 8 / 12])
