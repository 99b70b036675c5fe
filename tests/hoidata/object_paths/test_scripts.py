"""A short script becomes the motion it says."""

import re

import numpy as np
import pytest

from hoidata.clips.clip import FPS
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.object_paths import ObjectPath, scripted_path
from hoidata.objects.model import ObjectModel
from tests.builders.objects import box_model, two_parts

LIMITS = (0.0, np.radians(120))
EXAMPLE = "lift 15 cm, open to 70 deg in 1.5 s, tilt 30 deg, hold, put down"


def laptop() -> ObjectModel:
    """Base 30 x 20 x 2 cm, a lid on it of the same size that opens upward about its far edge; not at its origin."""
    base = box_model((0.30, 0.20, 0.02), middle_m=(0.5, 0.2, 0.3))
    lid = box_model((0.30, 0.20, 0.01), middle_m=(0.5, 0.2, 0.315))
    return two_parts(base, lid, (1, 0, 0), (0.5, 0.1, 0.31), "laptop")


def made(script: str, **wish) -> ObjectPath:
    return scripted_path(laptop(), script, **{"limits_rad": LIMITS, **wish})


def heights(path: ObjectPath) -> np.ndarray:
    """(frame,) of the lowest point of the base, metres."""
    model = path.track.model
    return path.track.points_in_world(model.vertices_m, model.part)[:, model.part == 0, 2].min(axis=1)


def at(path: ObjectPath, step: int) -> slice:
    """The frames of a step, rests counted."""
    return slice(round(path.steps[step].start_s * FPS), round(path.steps[step].end_s * FPS) + 1)


def test_the_example_reaches_the_stated_heights_and_angles_in_the_stated_time():
    path = made(EXAMPLE)
    lift, opening, tilting, holding, down = (at(path, step) for step in range(1, 6))
    assert heights(path)[0] == pytest.approx(0, abs=1e-6)
    assert heights(path)[lift][-1] == pytest.approx(0.15, abs=1e-6)
    hinge = path.track.hinge_rad
    assert hinge is not None
    assert hinge[opening][0] == 0
    assert np.degrees(hinge[opening][-1]) == pytest.approx(70)
    assert opening.stop - opening.start == 1.5 * FPS + 1
    assert np.degrees(np.linalg.norm(path.track.rotvec[tilting][-1])) == pytest.approx(30)
    assert np.ptp(path.track.translation_m[holding], axis=0).max() < 1e-6
    assert holding.stop - holding.start == FPS + 1
    assert heights(path)[down][-1] == pytest.approx(0, abs=1e-6)
    assert np.abs(path.track.rotvec[-1]).max() < 1e-6


def test_an_object_tilts_forward_turns_left_and_moves_as_a_person_would_say():
    path = made("lift 20 cm, turn 90 deg left, move left 10 cm and tilt 40 deg forward")
    turned = rotvec_to_rotmat(path.track.rotvec[-1].astype(float))
    assert turned @ [0, 0, 1] == pytest.approx([0, np.sin(np.radians(40)), np.cos(np.radians(40))], abs=1e-6)
    assert (turned @ [1, 0, 0])[0] == pytest.approx(0, abs=1e-6)
    assert (turned @ [1, 0, 0])[1] > 0.7
    middle = path.track.world_from_object @ np.array([[0.5, 0.2, 0.305]])
    assert middle[-1, 0] - middle[0, 0] == pytest.approx([-0.10, 0, 0.20], abs=1e-6)


def test_steps_joined_by_and_happen_at_once_and_others_after_each_other():
    together, apart = (
        made("lift 20 cm in 2 s and open to 50 deg in 1 s"),
        made("lift 20 cm in 2 s, open to 50 deg in 1 s"),
    )
    assert together.track.n_frames == 3 * FPS + 1
    assert apart.track.n_frames == 4 * FPS + 1


@pytest.mark.parametrize(
    ("script", "degrees"),
    [
        ("open 60 deg", 60),
        ("open to 60 deg, open by 20 deg", 80),
        ("open to 60 deg, close to 10 deg", 10),
        ("open to 60 deg, close 10 deg", 50),
        ("open, shut", 0),
        ("open to 1 rad", np.degrees(1)),
    ],
)
def test_opening_to_an_angle_and_by_an_angle_are_told_apart(script, degrees):
    assert np.degrees(made(script).track.hinge_rad[-1]) == pytest.approx(degrees, abs=1e-4)


@pytest.mark.parametrize(
    "script",
    [
        "pick it up, put it down",
        "lift the laptop, put the laptop down",
        "lift, set down",
        "pick up the laptop, lay it down",
    ],
)
def test_the_objects_name_and_the_words_between_say_nothing(script):
    assert heights(made(script)) == pytest.approx(heights(made("lift, put down")))


def test_a_hinge_that_opens_the_other_way_is_opened_by_the_same_words():
    hinge = made("lift 40 cm, open to 60 deg", limits_rad=(-2.0, 0.0)).track.hinge_rad
    assert np.degrees(hinge[-1]) == pytest.approx(-60)


@pytest.mark.parametrize("unit", ["150 mm", "15 cm", "0.15 m", "15cm", "5.905512 inches"])
def test_every_unit_of_length_means_itself(unit):
    assert heights(made(f"lift {unit}"))[-1] == pytest.approx(0.15, abs=1e-6)


def test_shaking_goes_both_ways_as_often_as_asked_and_ends_where_it_began():
    path = made("lift 20 cm, shake left 4 cm 5 times in 2 s, hold 1 s")
    x = path.track.translation_m[at(path, 2), 0] - path.track.translation_m[0, 0]
    assert (x.min(), x.max()) == (pytest.approx(-0.04, abs=0.004), pytest.approx(0.04, abs=0.004))
    assert (np.diff(np.signbit(x[np.abs(x) > 0.01])) != 0).sum() == 2 * 5 - 1
    assert x[-1] == pytest.approx(0, abs=1e-6)


def test_velocity_and_acceleration_never_jump():
    place = made("lift 20 cm in 1 s, move right 30 cm in 2 s, put down in 1 s").track.translation_m.astype(float)
    jerk = np.diff(place, 3, axis=0) * FPS**3
    assert np.abs(jerk).max() < 60 * 0.2 * 1.05  # of least jerk, 60 way / time**3; at constant speed it were 180


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("lfit 15 cm", "did you mean 'lift'"),
        ("lift 15 cmm", "write 15 cm"),
        ("lift 15", "write 15 cm"),
        ("lift 15 deg", "a length (cm)"),
        ("open to 7 cm", "an angle (deg)"),
        ("lift 15 cm sideways", "leave 'sideways' out"),
        ("move 15 cm lefft", "did you mean 'left'"),
        ("lift the mug 10 cm", "leave 'mug' out"),
        ("put the laptop on the table", "did you mean 'put down'"),
        ("pick it", "did you mean 'pick up'"),
        ("puut down", "did you mean 'put down'"),
        ("move 15 cm", "move left 20 cm"),
        ("lift 1 m in 0.1 s", "times as long"),
        ("lift 10 cm and lift 5 cm", "write 'then'"),
        ("open to 150 deg", "0 to 120 deg"),
        ("lower 3 cm", "3.0 cm under it, from 0."),
        ("tilt 60 deg", "lift it by"),
        ("hold 200 s", "at most 120"),
        ("lift 5 cm" + ", hold 100 s" * 2, "make two of it"),
        ("", "write e.g."),
        ("lift 5 cm," * 201, "200 steps"),
        ("x" * 6000, "5000 letters"),
        ("turn up", "left or right"),
        ("tilt up", "left, right"),
        ("lift - cm", "15 cm"),
        ("turn 360 deg in 0.03 s", "give 'turn 360 deg in 0.03 s' 1.0 s"),
        ("lift 0 cm in 1e-17 s", "0.001 or more"),
        ("turn 360 deg in 0.001 s", "1.0 s or more"),
        ("lift 20 cm, shake 100 times in 1 s", "give it 10 s"),
        ("open to 400 deg in 10 s", "0 to 120 deg"),
    ],
)
def test_what_cannot_be_gets_an_answer_that_says_what_to_do(script, words):
    with pytest.raises(BadInput) as error:
        made(script)
    assert words in str(error.value)


@pytest.mark.parametrize("script", ["lift 1 m in 0.1 s", "turn 720 deg in 0.5 s", "lift 45 cm in 0.3 s"])
def test_a_step_that_is_too_fast_is_taken_in_the_time_the_answer_names(script):
    with pytest.raises(BadInput) as error:
        made(script)
    seconds = re.findall(r"' ([\d.]+) s or more", str(error.value))[0]
    assert made(re.sub(r"in [\d.]+ s", f"in {seconds} s", script)).track.n_frames > float(seconds) * FPS


def test_a_lid_opens_no_farther_than_180_degrees_where_nobody_says_more():
    with pytest.raises(BadInput, match=r"-180 to 180 deg, got 400 deg.*--hinge-range"):
        made("lift 50 cm, open to 400 deg in 10 s", limits_rad=None)


def test_a_rigid_object_is_not_opened_but_may_be_lifted():
    mug = box_model(name="mug")
    assert scripted_path(mug, "lift 10 cm, put down").track.hinge_rad is None
    with pytest.raises(BadInput, match="--hinge"):
        scripted_path(mug, "open to 40 deg")


def test_an_object_whose_own_z_is_not_up_begins_as_it_stands_and_is_lifted_from_there():
    standing = rotvec_to_rotmat(np.array([np.pi / 2, 0, 0]))  # its y is up
    path = made("lift 10 cm, turn 90 deg left", standing=standing)
    assert heights(path)[0] == pytest.approx(0, abs=1e-3)  # of the base; the lid is part of what stands
    assert heights(path)[-1] == pytest.approx(0.10, abs=1e-3)
    first, last = rotvec_to_rotmat(path.track.rotvec[[0, -1]].astype(float))
    assert first == pytest.approx(standing, abs=1e-6)
    assert last @ [0, 1, 0] == pytest.approx([0, 0, 1], abs=1e-6)


def test_the_same_script_gives_the_same_bytes():
    first, second = made(EXAMPLE).track, made(EXAMPLE).track
    assert all(np.array_equal(getattr(first, name), getattr(second, name)) for name in first.PER_FRAME)
