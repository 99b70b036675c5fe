"""Measures of object motion on motions with known values; limits of verbs, from the file and from clips."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.actions.action import (
    MEASURE_TEXTS,
    MEASURES,
    VERB_MEASURES,
    Actions,
    action_numbers,
    describe_unusual,
    is_visible,
    learn_actions,
    written_limits,
)
from hoidata.clips.clip import FPS, ObjectTrack
from tests.builders.clips import in_another_world
from tests.builders.objects import box_model, notebook

DOWN = np.array([0.0, 0.0, -1.0])
NO_CONTACT = np.zeros((2, 1), bool)


def track(path_m=None, rotvec=None, model=None, hinge_rad=None) -> ObjectTrack:
    """An object with these (frame, 3) positions and rotations, by default zero."""
    n_frames = max(len(array) for array in (path_m, rotvec, hinge_rad) if array is not None)
    still = np.zeros((n_frames, 3), np.float32)
    translation_m, object_rotvec = (
        still if array is None else np.asarray(array, np.float32) for array in (path_m, rotvec)
    )
    return ObjectTrack(model or box_model(), object_rotvec, translation_m, hinge_rad)


def numbers_of(moving: ObjectTrack, touching=NO_CONTACT, gravity=DOWN) -> dict[str, float]:
    return action_numbers(moving, gravity, np.broadcast_to(touching, (2, moving.n_frames)))


def there_and_back(n_frames: int, far: tuple[float, float, float]) -> np.ndarray:
    progress = np.concatenate([np.linspace(0, 1, n_frames // 2), np.linspace(1, 0, n_frames - n_frames // 2)])
    return progress[:, None] * np.array(far)


def test_rise_sideways_and_path_are_those_of_the_object_centre():
    measures = numbers_of(track(there_and_back(40, (0.3, 0.4, 0.2))))
    assert set(measures) == set(MEASURES)
    assert measures["rise_m"] == pytest.approx(0.2, abs=1e-6)
    assert measures["sideways_m"] == pytest.approx(0.5, abs=1e-6)
    assert measures["end_rise_m"] == measures["end_sideways_m"] == pytest.approx(0, abs=1e-6)
    assert measures["path_m"] == pytest.approx(2 * np.sqrt(0.29), abs=1e-5)
    off_centre = track(rotvec=np.linspace(0, np.pi, 30)[:, None] * [1, 0, 0], model=box_model(middle_m=(0, 0, -0.3)))
    assert numbers_of(off_centre)["end_rise_m"] == pytest.approx(0.6, abs=1e-6)


def test_tilt_is_away_from_the_upright_and_turn_about_it():
    poured = numbers_of(track(rotvec=there_and_back(40, (np.pi / 2, 0, 0))))
    assert (poured["tilt_deg"], poured["end_tilt_deg"]) == pytest.approx((90, 0), abs=1e-3)
    assert poured["turn_deg"] == pytest.approx(0, abs=1e-3)
    screwed = numbers_of(track(rotvec=np.linspace(0, 3 * np.pi, 60)[:, None] * [0, 0, 1]))
    assert (screwed["turn_deg"], screwed["end_turn_deg"]) == pytest.approx((540, 540), abs=0.1)
    looked_at = numbers_of(track(rotvec=there_and_back(60, (0, 0, np.pi / 3))))
    assert (looked_at["turn_deg"], looked_at["end_turn_deg"]) == pytest.approx((120, 0), abs=6)
    assert numbers_of(track(rotvec=np.linspace(0, -1, 30)[:, None] * [0, 0, 1]))["end_turn_deg"] < -50
    noise = np.random.default_rng(0).normal(0, np.radians(0.3), (60, 1))
    assert numbers_of(track(rotvec=noise * [0, 0, 1]))["turn_deg"] < 12
    assert screwed["tilt_deg"] == pytest.approx(0, abs=0.05)


def test_reversals_are_the_turning_points_of_a_shake_and_not_of_a_lift_that_waits_above():
    time = np.arange(60) / FPS
    shaken = np.zeros((60, 3))
    shaken[:, 1] = 0.03 * np.sin(2 * np.pi * 3 * time)  # six turning points a second
    assert numbers_of(track(shaken))["reversals_per_s"] == pytest.approx(6, abs=0.51)
    shaken[:, 2] = 0.3 * np.clip(time * 4, 0, 1)  # the same at the top of a lift
    assert numbers_of(track(shaken))["reversals_per_s"] > 3
    waits = np.concatenate([np.linspace(0, 0.2, 20), np.full(20, 0.2), np.linspace(0.2, 0, 20)])
    assert numbers_of(track(waits[:, None] * [0, 0, 1]))["reversals_per_s"] == 0


@pytest.mark.parametrize(("turn_deg", "reversals"), [(30, 0), (90, 0), (115, 0), (125, 1), (180, 1)])
def test_a_corner_turns_back_where_it_is_sharper_than_120_degrees(turn_deg, reversals):
    """Half a second along x at 1 cm per frame, then as long in a way that is so far from it: one second in all."""
    turned = np.radians(turn_deg)
    steps = np.repeat([[1, 0, 0], [np.cos(turned), np.sin(turned), 0]], 15, axis=0)
    assert numbers_of(track(0.01 * np.cumsum(steps, axis=0)))["reversals_per_s"] == reversals


def test_hinge_change_is_relative_to_the_first_frame_and_zero_for_rigid_objects():
    hinge = np.radians(np.concatenate([np.linspace(10, -70, 20), np.linspace(-70, -20, 20)]))
    measures = numbers_of(track(hinge_rad=hinge, model=notebook()))
    assert (measures["hinge_net_deg"], measures["hinge_max_deg"]) == pytest.approx((-30, 80))
    rigid = numbers_of(track(np.zeros((5, 3))))
    assert (rigid["hinge_net_deg"], rigid["hinge_max_deg"]) == (0, 0)


def test_the_grasping_hands_at_start_and_end_are_measured():
    touching = np.zeros((2, 20), bool)
    touching[1, 2:12] = touching[0, 10:18] = True  # from right to left
    measures = numbers_of(track(np.zeros((20, 3))), touching)
    hands = {name: measures[name] for name in ("first_left", "first_right", "last_left", "last_right", "hand_changes")}
    assert hands == {"first_left": 0, "first_right": 1, "last_left": 1, "last_right": 0, "hand_changes": 2}
    assert numbers_of(track(np.zeros((20, 3))))["hand_changes"] == 0
    touching[:, 2:18] = True
    touching[0, 2:4] = touching[1, 17] = False  # both hold it, one comes later and the other leaves sooner
    measures = numbers_of(track(np.zeros((20, 3))), touching)
    assert (measures["hand_changes"], measures["first_left"], measures["last_right"]) == (0, 1, 1)


def test_numbers_are_the_same_in_another_world_and_without_gravity_only_what_needs_it_is_unknown(make_clip):
    clip, rotation = make_clip(20, articulated=True), Rotation.from_rotvec([0.4, -1.0, 2.0])
    moved = in_another_world(clip, rotation, np.array([1.0, -2.0, 0.5]))
    one, other = (action_numbers(item.object, item.gravity, np.zeros((2, 20), bool)) for item in (clip, moved))
    assert one == pytest.approx(other, abs=1e-2)
    assert one["tilt_deg"] > 1
    unknown = action_numbers(clip.object, None, np.zeros((2, 20), bool))
    assert {name for name, value in unknown.items() if np.isnan(value)} == {
        "rise_m", "end_rise_m", "sideways_m", "end_sideways_m", "tilt_deg", "end_tilt_deg", "turn_deg",
        "end_turn_deg",
    }  # fmt: skip


def lifts_and_pours(seed: int) -> dict[str, list[dict[str, float]]]:
    """Numbers of ten lifts of about 20 cm and of ten pours by about 80 degrees."""
    draw = np.random.default_rng(seed)
    lifts = [numbers_of(track(np.linspace(0, draw.uniform(0.15, 0.25), 30)[:, None] * [0, 0, 1])) for _ in range(10)]
    pours = [numbers_of(track(rotvec=there_and_back(30, (np.radians(draw.uniform(70, 90)), 0, 0)))) for _ in range(10)]
    return {"lift": lifts, "pour": pours}


def test_limits_learnt_from_training_clips_hold_for_others_of_the_verb_and_fail_for_another_verb():
    actions, others = learn_actions(lifts_and_pours(0)), lifts_and_pours(1)
    assert actions.facts == {"limits": [], "learnt": {"lift": 10, "pour": 10}}
    for verb, other in (("lift", "pour"), ("pour", "lift")):
        assert all(actions.satisfies_limits(verb, clip) is True for clip in others[verb])
        assert all(actions.satisfies_limits(other, clip) is False for clip in others[verb])
        assert all(actions.nearest_verb(clip) == verb for clip in others[verb])
    assert actions.satisfies_limits("juggle", others["lift"][0]) is None
    assert actions.satisfies_limits(None, others["lift"][0]) is None


def test_measures_outside_the_usual_range_are_described_whatever_the_written_limits():
    numbers, others = lifts_and_pours(0), lifts_and_pours(1)
    actions = learn_actions(numbers, {"lift": {"end_rise_m": (0.1, 0.3)}})
    for verb in ("lift", "pour"):
        assert all(actions.unusual(verb, clip) == () for clip in others[verb])
    texts = actions.unusual("lift", others["pour"][0])
    most = max(clip["tilt_deg"] for clip in numbers["lift"]) + 0.5 * actions.scale["tilt_deg"][1]
    tilt = others["pour"][0]["tilt_deg"]
    assert f"greatest tilt {tilt:.3g} degrees (usual: at most {most:.3g})" in texts
    least_m, most_m = (100 * bound for bound in actions.usual["lift"]["rise_m"])
    rise_m = 100 * others["pour"][0]["rise_m"]
    assert f"highest rise {rise_m:.3g} cm (usual: {least_m:.3g} to {most_m:.3g})" in texts
    assert actions.unusual("lift", numbers["lift"][0] | {"rise_m": float("nan")}) == ()
    assert actions.unusual("juggle", numbers["lift"][0]) == ()
    violations = actions.violations("lift", others["pour"][0])
    assert {"tilt_deg", "rise_m"} <= set(violations)
    assert len(violations) == len(texts)
    assert violations["tilt_deg"] == pytest.approx((tilt - most) / (2 * most))
    least_m, most_m = actions.usual["lift"]["rise_m"]
    low = numbers["lift"][0] | {"rise_m": least_m - 2 * (most_m - least_m)}
    assert actions.violations("lift", low)["rise_m"] == pytest.approx(2)
    assert actions.violations("lift", numbers["lift"][0]) == {} == actions.violations("juggle", low)


def test_usual_ranges_are_widened_by_the_verbs_deviation_unless_its_clips_hardly_differ():
    still = numbers_of(track(np.zeros((30, 3))))

    def shakes(apart: float) -> list[dict[str, float]]:
        return [still | {"reversals_per_s": 2.5 + apart * number} for number in range(-5, 6)]

    for apart, uses_verb_deviation in ((0.12, True), (0.06, False)):
        clips = {"shake": shakes(apart), "hold": [still] * 30}
        actions, verb_deviation = learn_actions(clips), np.sqrt(10) * apart
        deviation = np.std([clip["reversals_per_s"] for verb in clips for clip in clips[verb]])
        assert 1 < deviation == pytest.approx(actions.scale["reversals_per_s"][1])
        assert (verb_deviation > 0.25 * deviation) == uses_verb_deviation
        for verb, middle, half in (("shake", 2.5, 4.9 * apart), ("hold", 0, 0)):  # 1st and 99th percentile of eleven
            margin = 0.5 * (verb_deviation if uses_verb_deviation and verb == "shake" else deviation)
            bounds = actions.usual[verb]["reversals_per_s"]
            assert bounds == pytest.approx((middle - half - margin, middle + half + margin))


def test_a_verb_has_limits_only_if_they_exclude_an_object_at_rest():
    still = numbers_of(track(np.zeros((30, 3))))
    clips = lifts_and_pours(0) | {"hold": [still] * 10}
    actions = learn_actions(clips)
    assert set(actions.limits) == {"lift", "pour"}
    assert actions.limits == {verb: actions.usual[verb] for verb in ("lift", "pour")}
    assert actions.satisfies_limits("lift", still) is False
    assert actions.satisfies_limits("hold", still) is None
    assert set(actions.usual) == set(actions.centroids) == {"lift", "pour", "hold"}
    low = [numbers | {"rise_m": 0.01, "end_rise_m": 0.01, "path_m": 0.01} for numbers in clips["lift"]]
    assert set(learn_actions(clips | {"lift": low}).limits) == {"pour"}


def test_written_limits_are_used_if_the_training_clips_satisfy_them():
    numbers = lifts_and_pours(0)
    satisfied = learn_actions(numbers, {"lift": {"end_rise_m": (0.1, 0.3)}})
    assert satisfied.facts == {"limits": ["lift"], "learnt": {"pour": 10}}
    assert satisfied.satisfies_limits("lift", numbers["lift"][0] | {"tilt_deg": 170}) is True
    assert satisfied.satisfies_limits("lift", numbers["lift"][0] | {"end_rise_m": 0.09}) is False
    violated = learn_actions(numbers, {"lift": {"end_rise_m": (1.0, 2.0)}})
    assert violated.facts == {"limits": [], "learnt": {"lift": 10, "pour": 10}}


def test_a_clip_without_gravity_changes_no_measure_that_needs_it():
    numbers, rises = lifts_and_pours(0), ("rise_m", "tilt_deg", "turn_deg")
    weightless = numbers["lift"][0] | dict.fromkeys(rises, float("nan"))
    written = {"lift": {"rise_m": (0.1, 0.3)}}
    without, mixed = (learn_actions(numbers | {"lift": lifts}, written) for lifts in (
        numbers["lift"][1:], [weightless, *numbers["lift"][1:]]
    ))  # fmt: skip
    assert mixed.facts == without.facts == {"limits": ["lift"], "learnt": {"pour": 10}}
    assert list(mixed.scale) == list(without.scale) == list(VERB_MEASURES)
    for name in rises:
        assert mixed.scale[name] == without.scale[name]
        assert mixed.usual["lift"][name] == without.usual["lift"][name]
        number = VERB_MEASURES.index(name)
        assert mixed.centroids["lift"][number] == pytest.approx(without.centroids["lift"][number])
    assert mixed.nearest_verb(weightless) is None
    assert mixed.nearest_verb(numbers["lift"][0]) == "lift"


def test_a_measure_that_no_clip_of_a_verb_has_tells_no_verbs_apart():
    numbers = lifts_and_pours(0)
    weightless = [clip | {"rise_m": float("nan")} for clip in numbers["lift"]]
    few = [*weightless[:8], *numbers["lift"][8:]]
    assert set(VERB_MEASURES) - set(learn_actions(numbers | {"lift": weightless}).scale) == {"rise_m"}
    assert "rise_m" not in learn_actions(numbers | {"lift": few}).usual["lift"]  # two values bound nothing
    assert "rise_m" in learn_actions(numbers | {"lift": few}).usual["pour"]


def test_an_object_that_is_seen_in_one_frame_has_not_moved():
    assert numbers_of(track(np.zeros((1, 3)))) == numbers_of(track(np.zeros((9, 3))))


def test_limits_of_a_measure_that_is_nan_give_no_answer():
    actions = Actions({"lift": {"rise_m": (0, 1)}, "open": {"hinge_net_deg": (20, 90)}}, {}, {}, {})
    weightless = action_numbers(track(np.zeros((5, 3))), None, np.zeros((2, 5), bool))
    assert actions.satisfies_limits("lift", weightless) is None
    assert actions.satisfies_limits("open", weightless) is False
    assert actions.nearest_verb(weightless) is None


def test_the_limits_of_actions_toml_are_of_measures_and_distinguish_open_from_close():
    written = written_limits()
    limits = [(name, pair) for table in written.values() for name, pair in table.items()]
    assert all(name in VERB_MEASURES and least <= most for name, (least, most) in limits)
    assert written["open"]["hinge_net_deg"][0] > 0 > written["close"]["hinge_net_deg"][1]
    assert written["hand over"]["hand_changes"] == (1, 2)
    actions, still = Actions(written, {}, {}, {}), numbers_of(track(np.zeros((5, 3))))
    assert not any(actions.satisfies_limits(verb, still) for verb in written)


def test_each_verb_measure_has_a_text():
    assert set(VERB_MEASURES) <= set(MEASURE_TEXTS)
    assert len({text.label for text in MEASURE_TEXTS.values()}) == len(MEASURE_TEXTS)
    assert describe_unusual("end_rise_m", -0.031, -0.015, 0.02) == "rise at the end -3.1 cm (usual: -1.5 to 2)"
    assert describe_unusual("reversals_per_s", 2.0, -0.5, 0.5) == "turns back 2 times a second (usual: at most 0.5)"
    assert describe_unusual("hand_changes", 1.0, 1.5, 2.5) == "hands that take or give 1 (usual: 2 to 2)"
    assert describe_unusual("path_m", 12.344, 0.2, 1.0) == "length of the path 1234 cm (usual: 20 to 100)"


@pytest.mark.parametrize(
    ("name", "value", "most"),
    [("turn_deg", 27.14, 27.12), ("rise_m", 0.12341, 0.1234), ("slip_cm_s", 0.026501, 0.0265)],
)
def test_a_measure_that_rounds_to_its_bound_is_not_described(name: str, value: float, most: float) -> None:
    """It would be "27.1 degrees (usual: at most 27.1)"."""
    assert describe_unusual(name, value, 0.0, most) is None
    assert describe_unusual(name, value + MEASURE_TEXTS[name].visible_difference, 0.0, most) is not None
    actions = Actions(limits={}, learnt={}, centroids={}, scale={}, usual={"pour": {name: (0.0, most)}})
    assert actions.unusual("pour", {name: value}) == ()
    assert actions.violations("pour", {name: value})


@pytest.mark.parametrize("name", sorted(MEASURE_TEXTS))
def test_a_difference_is_visible_from_its_threshold_on_either_side(name: str) -> None:
    visible = MEASURE_TEXTS[name].visible_difference
    assert [is_visible(name, 2 + fraction * visible, 1.0, 2.0) for fraction in (0.0, 0.9, 1.01)] == [False, False, True]
    assert [is_visible(name, 1 - fraction * visible, 1.0, 2.0) for fraction in (0.0, 0.9, 1.01)] == [False, False, True]
    assert not is_visible(name, 1.5, 1.0, 2.0)
    actions = Actions(limits={}, learnt={}, centroids={}, scale={}, usual={"pour": {name: (1.0, 2.0)}})
    assert len(actions.visibly_unusual("pour", {name: 2 + 1.01 * visible})) == 1
    assert (
        actions.visibly_unusual("pour", {name: 2 + 0.9 * visible})
        == actions.visibly_unusual("lift", {name: 2 + 9 * visible})
        == ()
    )
