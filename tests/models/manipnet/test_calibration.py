"""Calibration: the offset of a tracker from the wrist joint is recovered from a recording of flat hands."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.errors import BadInput
from hoidata.geometry.motion import Motion
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracker_offset import WRIST_M, sheet_from_wrist
from hoidata.object_paths.trajectory_files import PARTS, TrajectoryFile, parse_csv
from hoidata.sensors.mano_hand import mano_hand
from models.manipnet.calibration import calibrated_file, calibrated_frame, offsets_of
from models.manipnet.datagrams import parse_frame

HANDS = {side: mano_hand(load_embedded_hands(), side) for side in SIDES}
RATE_HZ, REST_FRAMES = 60, 180


def random_transforms(rng: np.random.Generator, count: int, spread_m: float) -> RigidTransform:
    rotation = Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix()
    return RigidTransform(rotation, rng.uniform(-spread_m, spread_m, (count, 3)))


def motion(poses: RigidTransform) -> Motion:
    return Motion(np.arange(len(poses.rotation)) / RATE_HZ, poses.rotation, poses.translation)


def noisy(poses: RigidTransform, rng: np.random.Generator, distance_m: float, angle_rad: float) -> RigidTransform:
    count = len(poses.rotation)
    rotation_error = Rotation.from_rotvec(rng.normal(0, angle_rad, (count, 3))).as_matrix()
    return RigidTransform(poses.rotation @ rotation_error, poses.translation + rng.normal(0, distance_m, (count, 3)))


def recording(
    wrist_from_tracker: dict[Side, RigidTransform], world_from_sheet: RigidTransform, count: int = REST_FRAMES
) -> TrajectoryFile:
    """Trackers on flat hands on a sheet that rests in the world."""
    sheet = RigidTransform(
        np.repeat(world_from_sheet.rotation, count, 0), world_from_sheet.translation.repeat(count, 0)
    )
    trackers = {side: sheet @ sheet_from_wrist(HANDS[side]) @ offset for side, offset in wrist_from_tracker.items()}
    return TrajectoryFile("flat.csv", {side: motion(poses) for side, poses in trackers.items()}, motion(sheet))


def errors(motion: Motion, expected: RigidTransform) -> tuple[float, float]:
    """Largest distance in metres and angle in degrees between two motions."""
    rotation_error = Rotation.from_matrix(motion.rotmats.swapaxes(1, 2) @ expected.rotation)
    return float(abs(motion.position_m - expected.translation).max()), float(
        np.degrees(rotation_error.magnitude()).max()
    )


def scene(seed: int) -> tuple[dict[Side, RigidTransform], dict[Side, RigidTransform], TrajectoryFile, TrajectoryFile]:
    """Random offsets, random motions of both wrists, their trackers' file, and the calibration."""
    rng = np.random.default_rng(seed)
    offsets: dict[Side, RigidTransform] = {side: random_transforms(rng, 1, 0.1)[0] for side in SIDES}
    wrists: dict[Side, RigidTransform] = {side: random_transforms(rng, 40, 1.0) for side in SIDES}
    trackers = {side: motion(wrists[side] @ offsets[side]) for side in SIDES}
    moved = TrajectoryFile("mine.csv", trackers, motion(random_transforms(rng, 40, 1.0)), axes="canonical")
    return offsets, wrists, moved, recording(offsets, random_transforms(rng, 1, 1.0))


@pytest.mark.parametrize("seed", range(5))
def test_random_offsets_and_motions_are_recovered_in_files_and_frames(seed: int) -> None:
    offsets, wrists, moved, calibration = scene(seed)
    measured, notes = offsets_of(calibration, HANDS, SIDES)
    calibrated = calibrated_file(moved, measured)
    assert (calibrated.axes, calibrated.is_calibrated) == ("model", True)
    for side in SIDES:
        distance_m, degrees = errors(calibrated.wrists[side], wrists[side])
        assert distance_m < 1e-4
        assert degrees < 0.01
        tracker = moved.wrists[side]
        quaternion = Rotation.from_matrix(tracker.rotmats[3]).as_quat()[[3, 0, 1, 2]]
        frame = parse_frame(json.dumps({"time_s": 1, side: [*tracker.position_m[3], *quaternion]}).encode())
        assert frame.wrists["left" if side == "right" else "right"] is None
        pose = calibrated_frame(frame, measured).wrists[side]
        np.testing.assert_allclose(pose.translation, wrists[side].translation[3], atol=1e-4)
        np.testing.assert_allclose(pose.rotation, wrists[side].rotation[3], atol=1e-4)
        assert f"{100 * np.linalg.norm(offsets[side].inverse().translation):.1f} cm" in notes[SIDES.index(side)]


@pytest.mark.parametrize("seed", range(5))
def test_noise_and_outliers_leave_an_error_of_less_than_a_millimetre(seed: int) -> None:
    offsets, *_, calibration = scene(seed)
    rng = np.random.default_rng(seed)
    trackers = {}
    for side, body in calibration.wrists.items():
        poses = noisy(body.at(body.time_s), rng, 0.001, np.radians(0.3))
        outliers = rng.choice(REST_FRAMES, REST_FRAMES // 10, replace=False)
        poses.rotation[outliers] = random_transforms(rng, len(outliers), 1.0).rotation
        poses.offset[outliers] += rng.normal(0, 0.5, (len(outliers), 3))
        trackers[side] = motion(poses)
    measured, _ = offsets_of(replace(calibration, wrists=trackers), HANDS, SIDES)
    for side in SIDES:
        shift = measured[side] @ offsets[side]  # the identity without an error
        assert np.linalg.norm(shift.translation) < 5e-4
        assert np.degrees(Rotation.from_matrix(shift.rotation).magnitude()) < 0.2


def test_a_flat_hand_touches_the_sheet_with_its_palm_and_a_left_hand_is_the_mirror_image() -> None:
    flat = {side: HANDS[side].state(np.tile(np.eye(3), (1, 15, 1, 1))) for side in SIDES}
    placed = {side: flat[side].placed(sheet_from_wrist(HANDS[side])[None]) for side in SIDES}
    np.testing.assert_allclose(placed["left"].joint_m, placed["right"].joint_m * [1, -1, 1], atol=1e-4)
    right, palm = placed["right"], HANDS["right"].skin.weight[5:].argmax(axis=1) == 0
    assert right.sensor_m[0, palm, 2].min() == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(right.joint_m[0, 0, :2], [0, -WRIST_M], atol=1e-9)
    middle, thumb_tip = right.joint_m[0, 4] - right.joint_m[0, 0], right.tip_m[0, 4]
    assert middle[0] > 0.08
    assert abs(middle[1]) < 1e-3
    assert thumb_tip[1] > -WRIST_M + 0.03


def test_a_calibration_is_a_table_with_lost_frames() -> None:
    calibration = recording(
        {"right": RigidTransform(np.eye(3), np.array([0.02, 0.03, 0.04]))},
        RigidTransform(np.eye(3)[None], np.zeros((1, 3))),
    )
    bodies = {"object": calibration.object_body, "right": calibration.wrists["right"]}
    lines = ["time_s," + ",".join(f"{body}_{part}" for body in bodies for part in PARTS)]
    for frame in range(REST_FRAMES):
        cells = [f"{frame / RATE_HZ}"]
        for name, body in bodies.items():
            quaternion = Rotation.from_matrix(body.rotmats[frame]).as_quat()[[3, 0, 1, 2]]
            lost = name == "right" and frame % 7 == 3
            cells += ["", *["nan"] * 6] if lost else map(str, [*body.position_m[frame], *quaternion])
        lines.append(",".join(cells))
    measured, _ = offsets_of(parse_csv("\n".join(lines).encode(), "flat.csv"), HANDS, ["right"])
    np.testing.assert_allclose(measured["right"].translation, [-0.02, -0.03, -0.04], atol=1e-9)


@pytest.mark.parametrize(
    ("fault", "answer"),
    [
        (
            "moved",
            r"flat.csv: expected a right tracker at rest for 1 s and in 80% of its frames, got .*; record it again",
        ),
        ("short", r"got 0.5 s, 100%; record it again"),
        ("turned", r"got 0.73 s, 24%; record it again"),
        ("far", r"at most 0.3 m from the wrist joint, got .* m; check the unit, and that `object` is the sheet"),
        ("left only", "expected the tracker on the right hand, got the other one only; .* or --fingers left"),
    ],
)
def test_an_unusable_recording_is_refused(fault: str, answer: str) -> None:
    side: Side = "left" if fault == "left only" else "right"
    offset = RigidTransform(np.eye(3), np.array([0.0, 0.02, 0.4 if fault == "far" else 0.04]))
    sheet = RigidTransform(np.eye(3)[None], np.zeros((1, 3)))
    unusable = recording({side: offset}, sheet, RATE_HZ // 2 if fault == "short" else REST_FRAMES)
    if fault == "moved":
        unusable.wrists["right"].position_m[:, 0] += np.linspace(0, 0.03, REST_FRAMES)
    if fault == "turned":
        rotating = Rotation.from_rotvec(np.linspace([0, 0, 0], [0, 0, np.radians(16)], REST_FRAMES)).as_matrix()
        unusable = replace(
            unusable,
            wrists={"right": replace(unusable.wrists["right"], rotmats=rotating @ unusable.wrists["right"].rotmats)},
        )
    with pytest.raises(BadInput, match=answer):
        offsets_of(unusable, HANDS, ["right"])
