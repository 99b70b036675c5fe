"""Calibration of trackers strapped on the hands: their constant offset from the wrist joints.

In the recording, both hands or one lie flat on a sheet of paper on the table, palms down. The body ``object`` is the
sheet: x along the middle fingers, y to the left, z up out of the table. The wrist joints are above two points on the
sheet's y axis, the left one at ``WRIST_M``, the right one at ``-WRIST_M``; their height is that of the hand model.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from hoidata.clips.clip import Side
from hoidata.errors import BadInput
from hoidata.geometry.averages import is_near_median, mean_transform
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import TrackedHand
from models.manipnet.control import Motion
from models.manipnet.stream import TrackedFrame
from models.manipnet.trajectory_files import TrajectoryFile

WRIST_M = 0.1
MAX_DISTANCE_M, MAX_ANGLE_RAD = 0.005, np.radians(2)  # from the median pose; a tracker further away has moved
MIN_REST_S, MIN_REST_FRACTION = 1.0, 0.8  # of the frames in which the tracker is not lost
MAX_OFFSET_M = 0.3
REMEDY = "record it again with flat hands at rest (docs/fingers.md)"

Offsets = Mapping[Side, RigidTransform]  # tracker_from_wrist of each hand


def sheet_from_wrist(hand: TrackedHand) -> RigidTransform:
    """The wrist joint of a hand that lies flat on the sheet."""
    sign = 1.0 if hand.side == "left" else -1.0
    rotation = np.diag([1.0, -sign, 1.0]) @ hand.wrist_from_canonical.T  # the thumbs point to each other
    return RigidTransform(rotation, np.array([0.0, sign * WRIST_M, hand.palm_depth_m]))


def offsets_of(
    recording: TrajectoryFile, hands: Mapping[Side, TrackedHand], required: Collection[Side]
) -> tuple[Offsets, list[str]]:
    """Measure the offset of each recorded tracker; with notes for the user.

    Raises BadInput if a tracker moved, is too far from its wrist, or if a required hand is missing.
    """
    if missing := [side for side in required if side not in recording.wrists]:
        remedy = f"record that hand too, or --fingers {next(iter(recording.wrists))}"
        raise BadInput(recording.source, f"the tracker on the {missing[0]} hand", "the other one only", remedy)
    offsets: Offsets = {side: _offset(recording, side, hands[side]) for side in recording.wrists}
    lengths_cm = {side: 100 * float(np.linalg.norm(offset.translation)) for side, offset in offsets.items()}
    return offsets, [f"the {side} tracker is {cm:.1f} cm from the wrist joint" for side, cm in lengths_cm.items()]


def _offset(recording: TrajectoryFile, side: Side, hand: TrackedHand) -> RigidTransform:
    tracker = recording.wrists[side]
    world_from_sheet = recording.object_body.at(tracker.time_s)
    offsets = tracker.at(tracker.time_s).inverse() @ world_from_sheet @ sheet_from_wrist(hand)
    rests = is_near_median(offsets, MAX_DISTANCE_M, MAX_ANGLE_RAD)
    rest_s = rests.sum() * np.median(np.diff(recording.object_body.time_s))
    if rest_s < MIN_REST_S - 1e-6 or rests.mean() < MIN_REST_FRACTION:
        expected = f"a {side} tracker at rest for {MIN_REST_S:g} s and in {MIN_REST_FRACTION:.0%} of its frames"
        raise BadInput(recording.source, expected, f"{rest_s:.2g} s, {rests.mean():.0%}", REMEDY)
    offset = mean_transform(offsets[rests])
    if (distance_m := float(np.linalg.norm(offset.translation))) > MAX_OFFSET_M:
        expected, got = f"a {side} tracker at most {MAX_OFFSET_M} m from the wrist joint", f"{distance_m:.3g} m"
        raise BadInput(recording.source, expected, got, "check the unit, and that `object` is the sheet of paper")
    return offset


def calibrated_file(file: TrajectoryFile, offsets: Offsets) -> TrajectoryFile:
    """Replace the poses of trackers by those of the wrist joints; hands without an offset are left out."""
    wrists: dict[Side, Motion] = {}
    for side, tracker in file.wrists.items():
        if side in offsets:
            world_from_wrist = tracker.at(tracker.time_s) @ offsets[side]
            wrists[side] = Motion(tracker.time_s, world_from_wrist.rotation, world_from_wrist.translation)
    return replace(file, wrists=wrists, axes="model", is_calibrated=True)


def calibrated_frame(frame: TrackedFrame, offsets: Offsets) -> TrackedFrame:
    """Replace the poses of trackers by those of the wrist joints; hands without an offset are left out."""
    poses = {side: frame.wrists.get(side) for side in offsets}
    return replace(frame, wrists={side: pose and pose @ offsets[side] for side, pose in poses.items()})
