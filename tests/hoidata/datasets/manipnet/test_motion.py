"""The BVH reader on a handwritten skeleton: joints by explicit products, and malformed files.

Also cuts, interactions and verbs of simple artificial motion.
"""

import gzip
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.datasets.manipnet.hand import parse_bvh, unpack_text
from hoidata.datasets.manipnet.segments import BodyMotion, find_cuts, height_above_table, interactions, motion_verb
from hoidata.errors import BadInput
from hoidata.geometry.intervals import Interval, widened

ARM = """HIERARCHY
ROOT SHOULDER
{
	OFFSET 0.5 0.0 -0.25
	CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
	JOINT ELBOW
	{
		OFFSET 3.0 0.5 0.0
		CHANNELS 3 Yrotation Xrotation Zrotation
		End Site
		{
			OFFSET 0.0 0.0 0.0
		}
	}
	JOINT FIN
	{
		OFFSET 0.0 -1.0 2.0
		CHANNELS 3 Yrotation Xrotation Zrotation
		End Site
		{
			OFFSET 0.0 0.0 0.0
		}
	}
}
MOTION
Frames: 2
Frame Time: 0.008333334
1.0 2.0 3.0 90.0 0.0 0.0 10.0 20.0 30.0 0.0 0.0 0.0
-1.0 0.5 2.5 30.0 -40.0 50.0 -60.0 70.0 -80.0 5.0 6.0 7.0
"""


def turn(axis: str, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array(
        {
            "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }[axis]
    )


def y_x_z(y: float, x: float, z: float) -> np.ndarray:
    return turn("y", y) @ turn("x", x) @ turn("z", z)


def test_joints_follow_the_written_out_products() -> None:
    motion = parse_bvh(ARM, "arm.bvh")
    positions, rotations = motion.world_joints()
    assert motion.names == ("SHOULDER", "ELBOW", "FIN")
    np.testing.assert_allclose(positions[0, 1], [1.5, 2.5, 2.75 - 3.0], atol=1e-12)  # 90 degrees about y: x to -z
    shoulder, root = np.array([-0.5, 0.5, 2.25]), y_x_z(30, -40, 50)
    np.testing.assert_allclose(positions[1, 0], shoulder, atol=1e-12)
    np.testing.assert_allclose(positions[1, 1], shoulder + root @ [3.0, 0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(positions[1, 2], shoulder + root @ [0.0, -1.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(rotations[1, 1], root @ y_x_z(-60, 70, -80), atol=1e-12)


def test_the_mirrored_motion_is_the_mirror_image_of_the_motion() -> None:
    motion = parse_bvh(ARM, "arm.bvh")
    mirror = np.diag([-1.0, 1.0, 1.0])
    positions, rotations = motion.world_joints()
    seen_positions, seen_rotations = motion.seen_in_mirror_x().world_joints()
    np.testing.assert_allclose(seen_positions, positions @ mirror, atol=1e-12)
    np.testing.assert_allclose(seen_rotations, mirror @ rotations @ mirror, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(seen_rotations), 1, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Frames: 2", "Frames: 3", "3 motion lines as announced, got 2"),
        ("Frames: 2", "Frames: two", "Frames: N"),
        ("Frames: 2", "Frames: 2000000000", "1000000 frames"),
        ("0.008333334", "0.0", "frames of 0.0001 to 1 s"),
        ("5.0 6.0 7.0", "5.0 6.0", "12 columns, got 11 in frame 1"),
        ("5.0 6.0 7.0", "5.0 6.0 nan", "nan in frame 1, column 11"),
        ("5.0 6.0 7.0", "5.0 6.0 seven", "expected numbers"),
        ("MOTION", "", "a line MOTION"),
        ("6 Xposition Yposition", "6 Yposition Xposition", "expected Xposition"),
        ("3 Yrotation Xrotation Zrotation", "3 Zrotation Xrotation Yrotation", "expected Yrotation"),
        ("OFFSET 3.0 0.5 0.0", "OFFSET 3.0 0.5 wide", "three numbers after OFFSET"),
        ("OFFSET 3.0 0.5 0.0", "OFFSET 3.0 inf 0.0", "finite numbers after OFFSET"),
        ("JOINT FIN", "BONE FIN", "JOINT, End Site or a closing brace"),
        ("HIERARCHY", "", "HIERARCHY"),
        ("}\nMOTION", "MOTION", "more of the hierarchy"),
        ("}\nMOTION", "}\nROOT SECOND\nMOTION", "MOTION after the one root"),
    ],
)
def test_a_file_of_another_form_is_refused_with_file_expected_and_got(old: str, new: str, message: str) -> None:
    with pytest.raises(BadInput, match=message) as caught:
        parse_bvh(ARM.replace(old, new, 1), "arm.bvh")
    assert str(caught.value).startswith("arm.bvh")


def test_a_deeply_nested_file_is_refused_before_it_exhausts_the_stack() -> None:
    joint = "JOINT A { OFFSET 0 0 0 CHANNELS 3 Yrotation Xrotation Zrotation "
    text = ARM.replace("JOINT ELBOW", joint * 5000 + "JOINT ELBOW", 1)
    with pytest.raises(BadInput, match="at most 256 joints"):
        parse_bvh(text, "arm.bvh")


def test_packed_text_comes_back() -> None:
    assert unpack_text(gzip.compress(ARM.encode()), "arm.bvh.gz") == ARM


@pytest.mark.parametrize(
    "data",
    [b"not gzip at all", gzip.compress(ARM.encode())[:-30], gzip.compress(b"\xff\xfe\xff")],
    ids=["not gzip", "truncated", "not text"],
)
def test_unreadable_packed_files_are_refused(data: bytes) -> None:
    with pytest.raises(BadInput, match="gzipped text"):
        unpack_text(data, "arm.bvh.gz")


def test_a_packed_file_that_swells_beyond_the_limit_is_refused() -> None:
    with pytest.raises(BadInput, match="at most 1000 bytes"):
        unpack_text(gzip.compress(b" " * 100_000), "bomb.bvh.gz", max_bytes=1000)


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


def cuts_of(tracked_object: BodyMotion) -> list:
    n_frames = len(tracked_object.position_m)
    return find_cuts(body("left hand", swaying(n_frames)), body("right hand", swaying(n_frames)), tracked_object)


def test_a_step_of_the_object_is_a_jump_but_fast_smooth_motion_is_not() -> None:
    fast = swaying(400)
    fast[:, 2] = 0.3 * np.sin(np.arange(400) / 120 * 12)  # up to 3.6 m/s: 3 cm per frame
    assert cuts_of(body("object", fast)) == []
    stepped = swaying(400)
    stepped[250:, 1] += 0.057
    (cut,) = cuts_of(body("object", stepped))
    assert (cut.start, cut.stop, cut.got) == (248, 252, "object jumps 5.7 cm, 0 degrees")


def test_a_sudden_rotation_without_displacement_is_a_jump() -> None:
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
    tracked_object = swaying(400)
    tracked_object[200:260] = tracked_object[200]
    tracked_object[230:, 0] += 1.5
    cuts = cuts_of(body("object", tracked_object))
    assert cuts
    assert all(before.stop <= after.start for before, after in pairwise(cuts))


def test_each_lift_becomes_an_interval_and_long_contact_between_lifts_another() -> None:
    touched, lifted = flags(600, (20, 520)), flags(600, (60, 140), (300, 400))
    pieces = interactions(np.ones(600, dtype=bool), touched, lifted)
    assert pieces == [(20, 155), (155, 285), (285, 415), (415, 520)]


def test_intervals_are_short_enough_and_cover_each_usable_contact_once() -> None:
    random = np.random.default_rng(5)
    touched = np.repeat(random.random(60) < 0.7, 40)
    lifted = touched & np.repeat(random.random(120) < 0.5, 20)
    usable = np.repeat(random.random(240) < 0.95, 10)
    coverage = np.zeros(2400, dtype=int)
    for start, stop in interactions(usable, touched, lifted):
        assert 0 < stop - start <= 150
        coverage[start:stop] += 1
    np.testing.assert_array_equal(coverage, (touched & usable).astype(int))


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
    fraction = np.linspace(0, 1, 60)
    height = np.linspace(*lift_m, 60)
    centre = np.column_stack((way_m * fraction, height, np.zeros(60)))
    rotation = Rotation.from_euler("z", (degrees * fraction)[:, None], degrees=True).as_matrix()
    assert motion_verb(height, centre, rotation) == verb


@pytest.mark.parametrize(("margin", "expected"), [(0, (10, 20)), (3, (7, 23)), (12, (2, 28)), (50, (2, 28))])
def test_a_margin_adds_as_many_usable_frames_on_both_sides(margin, expected):
    usable = np.ones(30, dtype=bool)
    usable[[1, 28]] = False
    assert tuple(widened(Interval(10, 20), margin, usable)) == expected


def test_a_few_frames_below_the_table_do_not_move_it():
    lowest_m = np.repeat([-0.5, 0.1, 0.4], [2, 38, 60])
    np.testing.assert_allclose(height_above_table(lowest_m)[[2, -1]], [0.0, 0.3], atol=1e-12)
