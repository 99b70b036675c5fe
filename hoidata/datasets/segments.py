"""Cuts a long recording into clips of one action each, from contact, object motion and hinge angle.

A recording needs no words for it. The verb of each segment follows later (``hoidata.annotation.derived``).
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from hoidata.actions.action import object_middle_m
from hoidata.annotation.derived import turning_points
from hoidata.clips.clip import FPS, SIDES, Clip, Side
from hoidata.clips.quarantine import Quarantined
from hoidata.contact.maps import find_active_hands
from hoidata.contact.proximity import ProximityIndex
from hoidata.contact.settings import ContactSettings
from hoidata.datasets.base import RawTree
from hoidata.datasets.gaps import trim_to_recorded
from hoidata.errors import BadInput
from hoidata.geometry.intervals import Interval, bridged, runs
from hoidata.geometry.rotations import rotation_angle
from hoidata.hands import HandPair, track_joints
from hoidata.objects.sampling import sample_points
from hoidata.store.hand_evidence import HandEvidence

LONGEST_FRAMES = 5 * FPS  # Text2HOI's models see 150 frames
SHORTEST_FRAMES = FPS  # a shorter event belongs to the segment before or after it
MARGIN_FRAMES = FPS // 2  # of approach before the first contact, and of release after the last
LOST_FRAMES = FPS // 3  # a contact that is lost for at most this long continues
# Motion is the range within half a second: tracker noise of about 0.5 mm per frame is not motion.
WINDOW_FRAMES = FPS // 2
CARRIED_M, CARRIED_RAD = 0.012, np.deg2rad(8)
ARTICULATED_RAD = np.deg2rad(6)
REVERSED_RAD = np.deg2rad(15)  # a hinge that reverses by this much was opened and is now closed
LIFTED_M = 0.08  # an object that rises and sinks by this much is lifted and then placed

# The setting ``clips`` of adapters with descriptions: one clip per described action, the whole recording, its segments,
# or the segments of recordings without a description.
ClipSource = Literal["described", "whole", "segments", "described-else-segments"]


class ObjectSignals(NamedTuple):
    """The motion of an object, frame by frame."""

    is_carried: np.ndarray  # (frame,) bool: the whole object moves
    is_articulated: np.ndarray  # (frame,) bool: the hinge moves
    speed_m: np.ndarray  # (frame,) metres per frame, smoothed; of a hinge the speed of the moving part's rim
    height_m: np.ndarray | None  # (frame,) above the first frame; None if gravity is unknown
    hinge_rad: np.ndarray | None  # (frame,); None for a rigid object


def has_description(clips: ClipSource, raw: RawTree, path: str) -> bool:
    """Whether an adapter with the setting ``clips`` needs the description of a sequence, the raw file ``path``."""
    is_present = raw.has(path) or path in (raw.manifest or ())
    return clips == "described" or (clips == "described-else-segments" and is_present)


def segment_clips(items: Iterable[Clip | Quarantined], hands: HandPair) -> Iterator[Clip | Quarantined]:
    """The segments of each recording as clips. Ids get the frames, counted from 1 and including the last.

    A recording of at most 150 frames is not cut. One without contact is quarantined.
    """
    for item in items:
        yield from [item] if isinstance(item, Quarantined) else _segments_of(item, hands)


def _segments_of(recording: Clip, hands: HandPair) -> Iterator[Clip | Quarantined]:
    points, settings = sample_points(recording.object.model, ContactSettings().points), ContactSettings()
    joints_m: dict[Side, np.ndarray] = {side: track_joints(recording.hands[side], hands[side]) for side in SIDES}
    evidence = find_active_hands(recording, joints_m, ProximityIndex(points), settings.threshold_m)
    if evidence.hand_type is None:
        expected = f"a hand within {settings.threshold_m * 100:g} cm of the object"
        problem = BadInput(recording.sequence, expected, "none in any frame", "nothing to do")
        yield Quarantined.from_error(recording.clip_id, problem)
    elif recording.n_frames <= LONGEST_FRAMES:
        yield recording
    else:
        for segment in find_segments(recording, evidence):
            clip = recording.take(slice(*trim_to_recorded(segment, recording.recorded)))
            first, last = int(clip.source_frames[0]) + 1, int(clip.source_frames[-1]) + 1
            yield replace(clip, clip_id=f"{recording.clip_id}/{first:04d}-{last:04d}")


def find_segments(recording: Clip, evidence: HandEvidence) -> list[Interval]:
    """The segments of a recording, disjoint and in order: at most 150 frames each, with contact in each.

    Every contact of a hand with the object lies in segments, with up to half a second of approach and release. A
    contact is cut where the hinge starts, stops or reverses, a hand arrives or leaves, the object is picked up or put
    down, or is highest; at the frame of slowest motion if a segment is still too long. Cuts are at least a second
    apart; if they are closer, the earlier kind in this list is chosen.
    """
    signals = object_signals(recording)
    near: dict[Side, np.ndarray] = {side: bridged(evidence.near(side), LOST_FRAMES) for side in SIDES}
    contacts = runs(bridged(near["left"] | near["right"], LOST_FRAMES))
    next_starts = [*(contact.start for contact in contacts[1:]), recording.n_frames]
    segments: list[Interval] = []
    for contact, next_start in zip(contacts, next_starts, strict=False):
        start = max(contact.start - MARGIN_FRAMES, segments[-1].stop if segments else 0)
        stop = min(contact.stop + MARGIN_FRAMES, next_start)
        cuts = chosen_cuts(contact, _candidates(signals, near))
        segments += [Interval(*ends) for ends in pairwise(_divided([start, *cuts, stop], signals.speed_m))]
    return segments


def _candidates(signals: ObjectSignals, near: Mapping[Side, np.ndarray]) -> Iterator[int]:
    """Frames of possible cuts, the most important kind first."""
    for interval in runs(signals.is_articulated):
        yield from interval
        if signals.hinge_rad is not None:
            reversals = turning_points(signals.hinge_rad[slice(*interval)], REVERSED_RAD)
            yield from (interval.start + frame for frame in reversals)
    for flags in near.values():
        yield from (frame for interval in runs(flags) for frame in interval)
    for interval in runs(signals.is_carried):
        yield from interval
        if signals.height_m is not None:
            tops = turning_points(signals.height_m[slice(*interval)], LIFTED_M)
            yield from (interval.start + frame for frame in tops)


def chosen_cuts(contact: Interval, candidates: Iterator[int]) -> list[int]:
    """The candidates at least a second from both ends of the contact and from each other; the first ones win."""
    chosen: list[int] = []
    for cut in candidates:
        is_inside = contact.start < cut < contact.stop
        if is_inside and min(abs(cut - frame) for frame in (*contact, *chosen)) >= SHORTEST_FRAMES:
            chosen.append(cut)
    return sorted(chosen)


def _divided(cuts: list[int], speed_m: np.ndarray) -> list[int]:
    """The cuts, with further ones at slow frames, so that no segment is longer than 150 frames."""
    divided = cuts[:1]
    for cut in cuts[1:]:
        while (left := cut - divided[-1]) > LONGEST_FRAMES:
            latest = divided[-1] + min(LONGEST_FRAMES, left - SHORTEST_FRAMES)
            earliest = max(divided[-1] + SHORTEST_FRAMES, latest - LONGEST_FRAMES // 2)
            divided.append(earliest + int(np.argmin(speed_m[earliest : latest + 1])))
        divided.append(cut)
    return divided


def object_signals(recording: Clip) -> ObjectSignals:
    """What the object does in each frame: the centre of its base part, its rotation and its hinge."""
    track = recording.object
    rotation, centre_m = track.world_from_object.rotation, object_middle_m(track)
    hinge_rad = None if track.hinge_rad is None else track.hinge_rad.astype(np.float64)
    step_m = np.linalg.norm(np.diff(centre_m, axis=0, prepend=centre_m[:1]), axis=1)
    if hinge_rad is not None:
        radius_m = np.linalg.norm(np.ptp(track.model.vertices_m, axis=0)) / 2
        step_m += radius_m * np.abs(np.diff(hinge_rad, prepend=hinge_rad[0]))
    frames, half = np.arange(recording.n_frames), WINDOW_FRAMES // 2
    before, after = np.maximum(frames - half, 0), np.minimum(frames + half, recording.n_frames - 1)
    turned_rad = rotation_angle(rotation[before].transpose(0, 2, 1) @ rotation[after])
    moved_m = np.linalg.norm(_range_in_window(centre_m), axis=1)
    down, no_frames = recording.gravity, np.zeros(len(frames), bool)
    return ObjectSignals(
        is_carried=(moved_m > CARRIED_M) | (turned_rad > CARRIED_RAD),
        is_articulated=no_frames if hinge_rad is None else _range_in_window(hinge_rad) > ARTICULATED_RAD,
        speed_m=uniform_filter1d(step_m, WINDOW_FRAMES),
        height_m=None if down is None else -(centre_m - centre_m[0]) @ np.asarray(down, np.float64),
        hinge_rad=hinge_rad,
    )


def _range_in_window(signal: np.ndarray) -> np.ndarray:
    """Largest minus smallest value of (frame, ...) within half a second about each frame."""
    highest = maximum_filter1d(signal, WINDOW_FRAMES, axis=0, mode="nearest")
    return highest - minimum_filter1d(signal, WINDOW_FRAMES, axis=0, mode="nearest")
