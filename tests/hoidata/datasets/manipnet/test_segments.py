"""Cuts, interactions and verbs from made-up motion whose right answer is plain."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.datasets.manipnet.segments import BodyMotion, find_cuts, interactions, motion_verb
from hoidata.geometry.intervals import Interval, widened


def body(name: str, position_m: np.ndarray, degrees: np.ndarray | None = None) -> BodyMotion:
    angle = np.zeros(len(position_m)) if degrees is None else degrees
    rotation = Rotation.from_euler("y", angle[:, None], degrees=True).as_matrix()
    return BodyMotion(name, position_m, rotation, np.column_stack((position_m, angle)))


def swaying(n_frames: int, x_m: float = 0.0) -> np.ndarray:
    time = np.arange(n_frames) / 120
    return np.column_stack((x_m + 0.1 * np.sin(time), np.zeros(n_frames), np.zeros(n_frames)))


def flags(length: int, *stretches: tuple[int, int]) -> np.ndarray:
    array = np.zeros(length, dtype=bool)
    for start, stop in stretches:
        array[start:stop] = True
    return array


def cuts_of(thing: BodyMotion) -> list:
    n_frames = len(thing.position_m)
    return find_cuts(body("left hand", swaying(n_frames)), body("right hand", swaying(n_frames)), thing)


def test_a_step_of_the_object_is_a_jump_but_fast_smooth_motion_is_not() -> None:
    fast = swaying(400)
    fast[:, 2] = 0.3 * np.sin(np.arange(400) / 120 * 12)  # up to 3.6 m/s: 3 cm per frame
    assert cuts_of(body("object", fast)) == []
    stepped = swaying(400)
    stepped[250:, 1] += 0.057
    (cut,) = cuts_of(body("object", stepped))
    assert (cut.start, cut.stop, cut.got) == (248, 252, "object jumps 5.7 cm, 0 degrees")


def test_a_sudden_turn_without_displacement_is_a_jump() -> None:
    degrees = np.arange(300) * 0.5
    degrees[120:] += 108
    (cut,) = cuts_of(body("object", swaying(300), degrees))
    assert (cut.start, cut.stop) == (118, 122)


def test_only_all_three_standing_still_exactly_counts_as_frozen() -> None:
    n_frames = 300
    tracks = [swaying(n_frames), swaying(n_frames), swaying(n_frames)]
    tracks[2][100:200] = tracks[2][100]
    bodies = [body(name, track) for name, track in zip(("left hand", "right hand", "object"), tracks, strict=True)]
    assert not [cut for cut in find_cuts(*bodies) if "equal" in cut.got]
    for track in tracks:
        track[150:180] = track[150]
    bodies = [body(name, track) for name, track in zip(("left hand", "right hand", "object"), tracks, strict=True)]
    frozen = [cut for cut in find_cuts(*bodies) if "equal" in cut.got]
    assert [(cut.start, cut.stop) for cut in frozen] == [(150, 180)]


def test_cuts_never_overlap() -> None:
    thing = swaying(400)
    thing[200:260] = thing[200]
    thing[230:, 0] += 1.5
    cuts = cuts_of(body("object", thing))
    assert cuts
    assert all(before.stop <= after.start for before, after in pairwise(cuts))


def test_each_lift_becomes_a_stretch_and_long_touch_between_lifts_its_own() -> None:
    touched, lifted = flags(600, (20, 520)), flags(600, (60, 140), (300, 400))
    pieces = interactions(np.ones(600, dtype=bool), touched, lifted)
    assert pieces == [(20, 155), (155, 285), (285, 415), (415, 520)]


def test_stretches_are_short_enough_and_cover_every_usable_touch_once() -> None:
    random = np.random.default_rng(5)
    touched = np.repeat(random.random(60) < 0.7, 40)
    lifted = touched & np.repeat(random.random(120) < 0.5, 20)
    usable = np.repeat(random.random(240) < 0.95, 10)
    seen = np.zeros(2400, dtype=int)
    for start, stop in interactions(usable, touched, lifted):
        assert 0 < stop - start <= 150
        seen[start:stop] += 1
    np.testing.assert_array_equal(seen, (touched & usable).astype(int))


def test_a_short_gap_in_touch_does_not_divide_an_interaction() -> None:
    touched = flags(200, (20, 70), (78, 130))
    assert interactions(np.ones(200, dtype=bool), touched, flags(200, (40, 110))) == [(20, 130)]


@pytest.mark.parametrize(
    ("lift_m", "way_m", "degrees", "verb"),
    [
        ((0.0, 0.2), 0.2, 0, "lift"),
        ((0.2, 0.0), 0.2, 0, "place"),
        ((0.2, 0.2), 0.02, 90, "turn"),
        ((0.2, 0.2), 0.3, 20, "move"),
        ((0.2, 0.2), 0.02, 20, "hold"),
        ((0.0, 0.0), 0.0, 45, "turn"),
        ((0.0, 0.0), 0.05, 0, "move"),
        ((0.0, 0.0), 0.01, 10, None),
    ],
)
def test_the_verb_says_what_the_object_does(lift_m: tuple, way_m: float, degrees: float, verb: str | None) -> None:
    share = np.linspace(0, 1, 60)
    height = np.linspace(*lift_m, 60)
    centre = np.column_stack((way_m * share, height, np.zeros(60)))
    rotation = Rotation.from_euler("z", (degrees * share)[:, None], degrees=True).as_matrix()
    assert motion_verb(height, centre, rotation) == verb


@pytest.mark.parametrize(("margin", "expected"), [(0, (10, 20)), (3, (7, 23)), (12, (2, 28)), (50, (2, 28))])
def test_a_margin_adds_as_many_usable_frames_on_both_sides(margin, expected):
    usable = np.ones(30, dtype=bool)
    usable[[1, 28]] = False
    assert tuple(widened(Interval(10, 20), margin, usable)) == expected
