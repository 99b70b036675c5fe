"""Gaps in the poses of a tracked object: short ones are bridged and marked, long ones end a clip and are reported.

A source may lack an object's pose in some frames while hands and the other objects go on. Adapters of such sources
call ``bridge`` on the whole track, cut clips from frames that ``has_pose``, begin and end them with a recorded frame
(``trimmed``), mark made frames (``numbered``) and report the gaps that are left (``missing_poses``).
"""

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from hoidata.clips.clip import ObjectTrack
from hoidata.clips.quarantine import Quarantined
from hoidata.geometry.intervals import Interval, bridged, runs

# Frames at 30 per second. Interpolated poses of objects that people move are within 5 mm and 4 degrees in 95 of 100
# such gaps; with 5 frames they are within 8 mm and 6 degrees.
LONGEST_BRIDGED = 3
_NEIGHBOURS = 4  # tracked frames used on each side of a gap
_SHOWN = 5


def has_pose(tracked: np.ndarray) -> np.ndarray:
    """(frame,) bool: tracked frames, and those of gaps of at most three frames between them."""
    return bridged(tracked, LONGEST_BRIDGED)


def bridge(track: ObjectTrack, tracked: np.ndarray) -> ObjectTrack:
    """The track with interpolated poses in gaps of at most three frames: cubic splines through the frames around each.

    track: at 30 frames per second. tracked: (frame,) bool; other frames of the track may hold anything.
    """
    values = {"rotvec": track.rotvec.copy(), "translation_m": track.translation_m.copy()}
    if track.hinge_rad is not None:
        values["hinge_rad"] = track.hinge_rad.copy()
    for start, stop in runs(has_pose(tracked) & ~tracked):
        around = np.arange(max(0, start - _NEIGHBOURS), min(len(tracked), stop + _NEIGHBOURS))
        known, gap = around[tracked[around]], np.arange(start, stop)
        for name, array in values.items():
            known_values = array[known].astype(np.float64)
            if name == "rotvec":
                array[gap] = RotationSpline(known, Rotation.from_rotvec(known_values))(gap).as_rotvec()
            else:
                array[gap] = CubicSpline(known, known_values)(gap)
    return replace(track, **values)


def trimmed(interval: tuple[int, int], recorded: np.ndarray) -> Interval:
    """The interval from its first to its last recorded frame; empty where there is none. recorded: (frame,) bool."""
    start, stop = interval
    inside = start + np.flatnonzero(recorded[start:stop])
    return Interval(int(inside[0]), int(inside[-1]) + 1) if len(inside) else Interval(start, start)


def numbered(source_frames: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """(frame,) numbers in which a made frame has that of the recorded one before it, as ``Clip.recorded`` reads them.

    recorded: (frame,) bool, True in the first frame.
    """
    return np.maximum.accumulate(np.where(recorded, source_frames, source_frames[0]))


def missing_poses(
    source_key: str, where: str, what: str, source_frames: np.ndarray, tracked: np.ndarray
) -> list[Quarantined]:
    """One reason that names the gaps of more than three frames between tracked ones; none without such gaps.

    what: whose poses. source_frames: (frame,) numbers in the source. tracked: (frame,) bool.
    """
    seen = np.flatnonzero(tracked)
    gaps = [gap for gap in runs(~has_pose(tracked)) if len(seen) and seen[0] < gap.start < seen[-1]]
    if not gaps:
        return []
    spans = [f"{source_frames[start]} to {source_frames[stop - 1]}" for start, stop in gaps]
    more = f" and {len(spans) - _SHOWN} more" if len(spans) > _SHOWN else ""
    expected = f"poses of {what} without a gap of more than {LONGEST_BRIDGED} frames at 30 per second"
    got = f"none in source frames {', '.join(spans[:_SHOWN])}{more}"
    return [Quarantined(source_key, where, expected, got, "nothing to do: clips end there")]
