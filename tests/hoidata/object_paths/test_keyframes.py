"""Keyframes are reached at their times, without overshoot; impossible ones are refused with a remedy."""

import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.object_paths import ObjectPath, keyframed_path, parse_keyframes, read_keyframes
from hoidata.objects.model import ObjectModel
from tests.builders.objects import box_model, hinged_box, two_parts

CSV = b"""# a box is lifted, opened and put down elsewhere
time_s,x_cm,z_cm,rz_deg,hinge_deg
0, 0,  0,  0,  0
1, 0, 20,  0,  0
2, 5, 20, 90,-60
3, 5, 20, 90,-60
4.5, 5, 0, 90, 0
"""


def laptop() -> ObjectModel:
    """Base 30 x 20 x 2 cm, a lid on it of the same size that opens upward about its far edge; not at its origin."""
    base = box_model((0.30, 0.20, 0.02), middle_m=(0.5, 0.2, 0.3))
    lid = box_model((0.30, 0.20, 0.01), middle_m=(0.5, 0.2, 0.315))
    return two_parts(base, lid, (1, 0, 0), (0.5, 0.1, 0.31), "laptop")


def moved(csv: str, model: ObjectModel | None = None, **options) -> ObjectPath:
    return keyframed_path(model or laptop(), parse_keyframes(csv.encode(), "k.csv"), **options)


def heights(path: ObjectPath) -> np.ndarray:
    """(frame,) of the lowest point of the base, metres."""
    model = path.track.model
    return path.track.points_in_world(model.vertices_m, model.part)[:, model.part == 0, 2].min(axis=1)


def test_every_keyframe_is_reached_at_its_time_and_equal_keyframes_do_not_move():
    path = keyframed_path(hinged_box(), parse_keyframes(CSV, "k.csv"))
    track = path.track
    assert track.n_frames == 4.5 * 30 + 1
    shift = (track.world_from_object @ np.array([[0.0, -0.005, 0]]))[:, 0]  # the middle of box and lid
    shift = shift - shift[0]
    assert shift[[30, 60, 90, 135]] == pytest.approx(
        np.array([[0, 0, 0.2], [0.05, 0, 0.2], [0.05, 0, 0.2], [0.05, 0, 0]]), abs=1e-6
    )
    assert np.degrees(track.hinge_rad[[30, 60, 135]]) == pytest.approx([0, -60, 0], abs=1e-4)
    assert np.degrees(track.rotvec[60]) == pytest.approx([0, 0, 90], abs=1e-4)
    assert np.ptp(shift[60:91], axis=0).max() < 1e-6
    assert shift[:, 2].max() < 0.2 + 1e-6  # nothing overshoots


def test_json_csv_quaternions_and_every_unit_mean_the_same():
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.9])
    x, y, z, w = rotation.as_quat()
    rows = [{"time_ms": 0, "z_mm": 0, "qw": 1, "qx": 0, "qy": 0, "qz": 0}]
    rows.append({"time_ms": 1500, "z_mm": 400, "qw": w, "qx": x, "qy": y, "qz": z})
    one = parse_keyframes(json.dumps({"keyframes": rows}).encode(), "k.json")
    vector = ",".join(f"{value:.17g}" for value in np.degrees(rotation.as_rotvec()))
    other = parse_keyframes(f"time_s,z_m,rx_deg,ry_deg,rz_deg\n2,0,0,0,0\n3.5,0.4,{vector}\n".encode(), "k.csv")
    tracks = [keyframed_path(box_model(), keys).track for keys in (one, other)]
    assert tracks[0].rotvec == pytest.approx(tracks[1].rotvec, abs=1e-6)
    assert tracks[0].translation_m == pytest.approx(tracks[1].translation_m, abs=1e-6)


def test_velocity_passes_through_a_key_without_a_stop():
    keys = parse_keyframes(b"time_s,x_cm\n0,0\n1,10\n2,20\n3,30\n", "k.csv")
    x = keyframed_path(box_model(), keys).track.translation_m[:, 0].astype(float)
    assert np.gradient(x, 1 / 30)[30] == pytest.approx(0.1, rel=0.02)
    assert np.abs(np.diff(x, 2)).max() * 900 < 1.0


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "2 to 5000 keyframes"),
        (b"time_s,x\n0,0\n1,1\n", "x_m, x_cm, x_mm"),
        (b"time_s,zcm\n0,0\n1,1\n", "did you mean z_cm?"),
        (b"time_s,z_cm,z_m\n0,0,0\n1,1,1\n", "in one unit"),
        (b"time_s,z_cm\n0,0\n1\n", "2 numbers"),
        (b"time_s,z_cm\n0,0\n1,high\n", "high"),
        (b"time_s,z_cm\n0,0\n1,nan\n", "nan"),
        (b"z_cm\n0\n1\n", "add the time"),
        (b"time_s,z_cm\n0,0\n0,5\n", "a time after the key before"),
        (b"time_s,z_cm\n0,0\n3000,5\n", "time_ms"),
        (b"time_s,z_m\n0,0\n1,15\n", "x_cm or x_mm"),
        (b"time_s,qw\n0,1\n1,1\n", "one of the two, whole"),
        (b"time_s,qw,qx,qy,qz\n0,1,0,0,0\n1,2,0,0,0\n", "length 2"),
        (b"time_s,z_cm\n0,0\n1,-3\n", "3.0 cm under it, from 0."),
        (b"time_s,rx_deg\n0,0\n2,60\n", "lift it by"),
        (b"time_s,z_cm\n0,0\n1,-5\n", "under it"),
        (b"time_s,z_cm\n0,0\n0.1,100\n", "times as long"),
        (b"time_s,rx_deg,rz_deg\n0,20,0\n2,20,175\n", "add a key in between"),
        (b"time_s,z_cm,rx_deg,rz_deg\n0,10,90,0\n4,10,90,350\n", "got 350 deg"),
        (b"time_s,qw,qx,qy,qz\n0,1,0,0,0\n4,0.02,0,0,0.9998\n", "add a key in between"),
        (b"time_s,rz_rad\n0,0\n20,90\n", "call it rz_deg"),
        (b"time_s,hinge_rad\n0,0\n12,70\n", "call it hinge_deg"),
        (b"time_s,rz_deg\n0,0\n0.02,360\n", "give 'keyframes 1 to 2' 1.0 s"),
        (b"time_s,hinge_deg\n0,0\n2,40\n", "is rigid"),
        (b"[1, 2]", "a list of objects"),
        (b'[{"time_s": 0}, {"time_s": 1, "z_m": 0.1}]', "the same names"),
        (b'[{"time_s": [0]}, {"time_s": 1}]', "a number"),
        (b"\xff\xfe", "export it again"),
        (b"[" * 100_000, "export it again"),
    ],
)
def test_impossible_keyframes_are_refused_with_a_remedy(data, message):
    with pytest.raises(BadInput) as error:
        keyframed_path(box_model(), parse_keyframes(data, "k"))
    assert message in str(error.value)


@pytest.mark.parametrize("degrees", [200, 270, 360, -720])
@pytest.mark.parametrize("axis", ["rx", "rz"])
def test_a_rotation_about_one_axis_may_exceed_half_a_turn(axis, degrees):
    keys = parse_keyframes(f"time_s,z_cm,{axis}_deg\n0,40,10\n4,40,10\n9,40,{10 + degrees}\n".encode(), "k.csv")
    turns = Rotation.from_rotvec(keyframed_path(box_model(), keys).track.rotvec.astype(float))
    whole = np.degrees((turns[1:] * turns[:-1].inv()).as_rotvec()).sum(axis=0)
    assert whole == pytest.approx(degrees * np.eye(3)["xyz".index(axis[1])], abs=1e-2)


def test_a_hinge_angle_beyond_180_degrees_needs_a_range():
    keys = parse_keyframes(b"time_s,z_cm,hinge_deg\n0,40,0\n9,40,-200\n", "k.csv")
    with pytest.raises(BadInput, match="--hinge-range"):
        keyframed_path(hinged_box(), keys)
    path = keyframed_path(hinged_box(), keys, (np.radians(-220), 0.0))
    assert np.degrees(path.track.hinge_rad.min()) == pytest.approx(-200, abs=1e-3)


def test_an_angle_outside_the_limits_names_the_limits():
    keys = parse_keyframes(b"time_s,hinge_deg\n0,0\n2,-80\n", "k.csv")
    with pytest.raises(BadInput, match="-45 to 0 deg, got -80 deg"):
        keyframed_path(hinged_box(), keys, (np.radians(-45), 0.0))


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(BadInput, match="correct the path"):
        read_keyframes(tmp_path / "none.csv")
    (tmp_path / "keys.csv").write_bytes(CSV)
    assert len(read_keyframes(tmp_path / "keys.csv").time_s) == 5


def test_velocity_and_acceleration_never_jump():
    keys = "time_s,x_cm,z_cm\n0,0,0\n1,0,20\n3,30,20\n4,30,0\n"
    jerk = np.diff(moved(keys).track.translation_m.astype(float), 3, axis=0) * FPS**3
    assert (
        np.abs(jerk).max() < 60 * 0.2 * 1.05
    )  # minimum jerk is 60 distance / time**3; constant speed between keys gives 180


@pytest.mark.parametrize(("column", "end"), [("z_m", "0.1,1"), ("rz_deg", "0.5,720"), ("z_cm", "0.3,45")])
def test_a_step_that_is_too_fast_is_accepted_with_the_duration_of_the_remedy(column, end):
    with pytest.raises(BadInput) as error:
        moved(f"time_s,{column}\n0,0\n{end}\n")
    seconds = re.findall(r"' ([\d.]+) s or more", str(error.value))[0]
    path = moved(f"time_s,{column}\n0,0\n{seconds},{end.split(',')[1]}\n")
    assert path.track.n_frames == round(float(seconds) * FPS) + 1


def test_an_object_whose_z_axis_is_not_up_starts_as_it_stands():
    standing = rotvec_to_rotmat(np.array([np.pi / 2, 0, 0]))  # its y is up
    path = moved("time_s,z_cm,rz_deg\n0,0,0\n1,10,0\n3,10,90\n", standing=standing)
    assert heights(path)[0] == pytest.approx(0, abs=1e-3)  # of the base; the bounding box includes the lid
    assert heights(path)[-1] == pytest.approx(0.10, abs=1e-3)
    first, last = rotvec_to_rotmat(path.track.rotvec[[0, -1]].astype(float))
    assert first == pytest.approx(standing, abs=1e-6)
    assert last @ [0, 1, 0] == pytest.approx([0, 0, 1], abs=1e-6)


def test_a_rigid_object_has_no_hinge_angles():
    assert moved("time_s,z_cm\n0,0\n1,10\n", box_model(name="mug")).track.hinge_rad is None


def test_the_same_keyframes_give_the_same_bytes():
    first, second = (keyframed_path(hinged_box(), parse_keyframes(CSV, "k.csv")).track for _ in range(2))
    assert all(np.array_equal(getattr(first, name), getattr(second, name)) for name in first.PER_FRAME)
