"""Calibration of trackers strapped on hands; its recording has the sheet of ``hands.tracker_offset`` as ``object``."""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from hoidata.clips.clip import Side
from hoidata.errors import BadInput
from hoidata.geometry.motion import Motion
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.hands.tracker_offset import tracker_from_wrist
from hoidata.object_paths.trajectory_files import TrajectoryFile
from models.manipnet.stream import TrackedFrame

Offsets = Mapping[Side, RigidTransform]  # tracker_from_wrist of each hand


def offsets_of(
    recording: TrajectoryFile, hands: Mapping[Side, TrackedHand], required: Collection[Side]
) -> tuple[Offsets, list[str]]:
    """Measure the offset of each recorded tracker; with notes for the user.

    Raises BadInput if a tracker moved, is too far from its wrist, or if a required hand is missing.
    """
    if missing := [side for side in required if side not in recording.wrists]:
        remedy = f"record that hand too, or --fingers {next(iter(recording.wrists))}"
        raise BadInput(recording.source, f"the tracker on the {missing[0]} hand", "the other one only", remedy)
    offsets, notes, sheet = dict[Side, RigidTransform](), list[str](), recording.object_body
    for side, tracker in recording.wrists.items():
        sheet_from_tracker = sheet.at(tracker.time_s).inverse() @ tracker.at(tracker.time_s)
        step_s = float(np.median(np.diff(sheet.time_s)))
        offsets[side] = tracker_from_wrist(sheet_from_tracker, step_s, hands[side], recording.source)
        distance_cm = 100 * np.linalg.norm(offsets[side].translation)
        notes.append(f"the {side} tracker is {distance_cm:.1f} cm from the wrist joint")
    return offsets, notes


def calibrated_file(file: TrajectoryFile, offsets: Offsets) -> TrajectoryFile:
    """Replace the poses of trackers by those of the wrist joints; hands without an offset are skipped."""
    wrists: dict[Side, Motion] = {}
    for side, tracker in file.wrists.items():
        if side in offsets:
            world_from_wrist = tracker.at(tracker.time_s) @ offsets[side]
            wrists[side] = Motion(tracker.time_s, world_from_wrist.rotation, world_from_wrist.translation)
    return replace(file, wrists=wrists, axes="model", is_calibrated=True)


def calibrated_frame(frame: TrackedFrame, offsets: Offsets) -> TrackedFrame:
    """Replace the poses of trackers by those of the wrist joints; hands without an offset are skipped."""
    wrists = {side: pose and pose @ offsets[side] for side, pose in frame.wrists.items() if side in offsets}
    return replace(frame, wrists=wrists)
