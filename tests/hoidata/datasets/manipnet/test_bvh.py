"""The BVH reader: a skeleton written by hand, joints by written-out products, and every way a file can be wrong."""

import gzip

import numpy as np
import pytest

from hoidata.datasets.manipnet.hand import parse_bvh, unpack_text
from hoidata.errors import BadInput

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
