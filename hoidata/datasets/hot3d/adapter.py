"""HOT3D (Banerjee et al. 2025): two hands and up to six rigid objects, motion capture with Aria glasses or a Quest 3.

Hands are MANO parameters. If a recording has only UmeTrack's, a MANO-layout hand is fitted to their joints. The files
do not state actions: clips are intervals in which a hand touches a moving object, without a verb.
The world is that of the headset, z up for Aria and y up for Quest 3. Quest 3's is rotated, so that z is up in all
clips. headset_trajectory.csv is not read, because it has poses of the device and not of its cameras.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import FrameChange, HandConvention, SourceHand, hand_track, to_track
from hoidata.dataset_folders import facts_of_adapter
from hoidata.datasets import checks
from hoidata.datasets.base import AdapterBase, DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.datasets.gaps import (
    MAX_BRIDGED_FRAMES,
    bridge,
    has_pose,
    mark_interpolated,
    missing_poses,
    trim_to_recorded,
)
from hoidata.datasets.gravity import hand_joints_m
from hoidata.datasets.hinge import box_corners
from hoidata.datasets.hot3d.files import PARTS, HandFormat, Poses, Profile, Source, joints_m, object_words, read_source
from hoidata.datasets.segments import segment_clips
from hoidata.errors import BadInput
from hoidata.geometry.intervals import Interval, bridged, runs, split_evenly, widened
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.hands.fitting import fit_hands, fit_shape
from hoidata.objects.distance import closest_points
from hoidata.objects.model import ObjectModel
from hoidata.objects.user_mesh import read_mesh_file

STEP_NS = 1e9 / 30
MAX_SAME_FRAME_NS = 2_000_000  # Aria's cameras differ by 0.1 ms, and each time has its rows
TOUCH_M, MOVED_M, MAX_CONTACT_GAP_FRAMES = 0.02, 0.02, 10
# Aria's world has z up, Quest 3's has y up (viewer of the authors).
WORLD_FROM = {"Aria": np.eye(3), "Quest3": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}
LOWER_SHORTEST_FRAMES = "nothing to do, or lower the setting shortest_frames"
GRAVITY = np.array([0.0, 0.0, -1.0])
FRAME = WorldFrame("+z", "stated", "the headset's world, metres, z up; Quest 3's, y up, is turned about x")
PARAMETERS_NOTE = (
    "MANO: 15 principal components relative to the mean pose, left shape directions corrected, translation added"
)
PARAMETERS = HandConvention(
    translation="transl",
    fingers="mean-relative",
    shape="betas per sequence",
    left_shape="corrected",
    components=15,
    note=PARAMETERS_NOTE,
)
FITTED_NOTE = "UmeTrack: a MANO-layout hand was fitted to 20 joints and tips, one shape per recording"
FITTED = HandConvention(translation="wrist", fingers="absolute", shape="fitted", left_shape="unused", note=FITTED_NOTE)


class _Hands(NamedTuple):
    """Hands of the whole recording."""

    tracks: dict[Side, HandTrack]
    error_m: np.ndarray | None = None  # (frame,) mean distance of fitted joints of both hands; None without a fit


class _RecordedObject(NamedTuple):
    """An object's motion over the whole recording."""

    track: ObjectTrack  # short gaps are interpolated
    tracked: np.ndarray  # (frame,) bool: the source has a pose

    @property
    def has_pose(self) -> np.ndarray:
        return has_pose(self.tracked)

    def has_poses_in(self, frames: slice) -> bool:
        """Whether every frame has a pose, and the first and last one have a recorded pose."""
        return bool(self.has_pose[frames].all() and self.tracked[frames][[0, -1]].all())


class _Recording(NamedTuple):
    """All frames of a sequence."""

    source: Source
    times_ns: np.ndarray  # (frame,)
    failed: np.ndarray  # (frame,) bool: the frame failed the authors' check
    hands: _Hands
    objects: list[_RecordedObject]


class _Intervals(NamedTuple):
    """Contact intervals of one object, by outcome."""

    clips: list[Interval]  # accepted
    short: list[Interval]  # too short
    cut: list[Interval]  # too short because poses of the object or of a hand are missing before or after them
    still: list[Interval]  # the object does not move


@dataclass(frozen=True)
class Hot3dAdapter(AdapterBase):
    """Raw root: ``P<participant>_<recording>/`` with hands, objects and metadata, and ``assets/`` with GLB meshes.

    Or HOT3D-Clips: ``train_aria/clip-*.tar``, ``clip_definitions.json`` and ``object_models_eval/``. Each of its clips
    is a sequence, whose subject is the participant. Use one of the two, because HOT3D-Clips is cut from the recordings.
    Split by subject, because several clips come from one recording.
    """

    facts = facts_of_adapter(__file__)
    without_mano = "hands=umetrack"
    hands: HandFormat = "mano"  # "mano" falls back to UmeTrack without a MANO file; "umetrack" needs no MANO files
    margin_frames: int = 0  # frames that a clip keeps before and after its interval
    shortest_frames: int = 30  # shorter intervals give no clip
    longest_frames: int = 150  # longer intervals are split
    clips: Literal["interactions", "segments"] = "interactions"  # long intervals are split evenly or into segments
    most_fit_error_mm: int = 10  # clips with a larger mean error of fitted hands are quarantined
    frame: WorldFrame = FRAME
    parts: tuple[DatasetPart, ...] = PARTS

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.longest_frames:
            checks.refuse_setting(self.name, "longest_frames", "1 or more", self.longest_frames)

    @property
    def hand_convention(self) -> HandConvention:
        return PARAMETERS if self.needs_mano else FITTED

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per folder named like a recording, with the participant as subject, and per clip of HOT3D-Clips."""
        names = [path.name for path in Path(root).glob("P[0-9]*_*") if path.is_dir()]
        clips = [path for path in Path(root).glob("*_*/clip-*.tar") if path.stem[5:].isdecimal()]
        keys = [SequenceKey(self.name, name.partition("_")[0], name) for name in names]
        return sorted(keys + [SequenceKey(self.name, "clips", f"{path.parent.name}/{path.stem}") for path in clips])

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """One clip per interval in which a hand touches a moving object, and the rejected intervals."""
        source = read_source(raw, key, self.hands)
        recording = _recording(raw, source, hands)
        source_from_world = np.eye(4)
        source_from_world[:3, :3] = WORLD_FROM[source.headset].T
        whole = self.new_clip(
            key,
            subject=source.subject,
            hands=recording.hands.tracks,
            object=recording.objects[0].track,
            source_frames=np.arange(len(recording.times_ns), dtype=np.int32),
            gravity=GRAVITY,
            verb=None,
            object_words="",
            source_from_world=source_from_world,
            hands_from="keypoints" if source.profile else "parameters",
            sources=raw.sources,
        )
        items = list(self._cut(whole, recording, hands))
        items = list(segment_clips(items, hands)) if self.clips == "segments" else items
        if not items:
            expected = f"a hand within {100 * TOUCH_M:g} cm of an object that moves"
            raise BadInput(key.name, expected, "none in any frame", "nothing to do if nobody moves anything")
        return items

    def _cut(self, whole: Clip, recording: _Recording, hands: HandPair) -> Iterator[Clip | Quarantined]:
        if recording.failed.any():
            yield _rejected(whole, "failed", "frames that passed the makers' check", runs(recording.failed))
        joints_m = hand_joints_m(whole.hands, hands)
        for item in recording.objects:
            name, missing_key = item.track.model.name, f"{whole.clip_id}/{item.track.model.name}/missing"
            intervals = self._intervals(item, item.has_pose & ~recording.failed, recording.times_ns, joints_m)
            yield from missing_poses(missing_key, whole.sequence, name, whole.source_frames, item.tracked)
            if intervals.cut:
                expected = f"touches of {self.shortest_frames} frames between missing poses of the object or a hand"
                yield _rejected(whole, f"{name}/cut", expected, intervals.cut, LOWER_SHORTEST_FRAMES)
            if intervals.short:
                expected = f"touches of {self.shortest_frames} frames"
                yield _rejected(whole, f"{name}/short", expected, intervals.short, LOWER_SHORTEST_FRAMES)
            if intervals.still:
                yield _rejected(whole, f"{name}/still", f"an object that moves {100 * MOVED_M:g} cm", intervals.still)
            for interval in intervals.clips:
                yield self._clip(whole, interval, item, recording)

    def _clip(
        self, whole: Clip, interval: Interval, recorded_object: _RecordedObject, recording: _Recording
    ) -> Clip | Quarantined:
        name, frames, error_m = recorded_object.track.model.name, slice(*interval), recording.hands.error_m
        others = [other for other in recording.objects if other is not recorded_object and other.has_poses_in(frames)]
        clip_id = f"{whole.clip_id}/{interval.start:05d}-{interval.stop - 1:05d}-{name}"
        recorded = np.logical_and.reduce([item.tracked[frames] for item in (recorded_object, *others)])
        tracks = {"object": recorded_object.track, "other_objects": tuple(other.track for other in others)}
        source_frames = mark_interpolated(whole.source_frames[frames], recorded)
        clip = replace(whole, clip_id=clip_id, object_words=object_words(name), **tracks).take(frames)
        clip = replace(clip, source_frames=source_frames)
        if error_m is None:
            return clip
        mean_m = float(np.nanmean(error_m[frames]))
        if mean_m * 1000 <= self.most_fit_error_mm:
            return replace(clip, fit_error_m=mean_m)
        expected = f"hands that miss UmeTrack's joints by {self.most_fit_error_mm} mm or less on average"
        remedy = "nothing to do, or raise the setting most_fit_error_mm"
        problem = BadInput(recording.source.path, expected, f"{1000 * mean_m:.1f} mm", remedy)
        return Quarantined.from_error(clip_id, problem)

    def _intervals(
        self, recorded_object: _RecordedObject, usable: np.ndarray, times: np.ndarray, joints_m: np.ndarray
    ) -> _Intervals:
        """Find contact intervals without a gap in time, and check their length. usable: (frame,) bool."""
        intervals, near_object = _Intervals([], [], [], []), _near_object(recorded_object, joints_m)
        sides = np.split(joints_m, len(SIDES), axis=1)
        is_tracked = np.stack([recorded_object.has_pose, *(np.isfinite(side).all(axis=(1, 2)) for side in sides)])
        for first, last in _unbroken(times):
            inside = np.zeros(len(times), bool)
            inside[first:last] = usable[first:last]
            for touch in runs(bridged(near_object & inside, MAX_CONTACT_GAP_FRAMES) & inside):
                interval = trim_to_recorded(widened(touch, self.margin_frames, inside), recorded_object.tracked)
                if interval.stop - interval.start < self.shortest_frames:
                    (intervals.cut if _is_cut(touch, is_tracked) else intervals.short).append(touch)
                elif not _moves(recorded_object.track, interval):
                    intervals.still.append(touch)
                else:
                    pieces = [interval] if self.clips == "segments" else split_evenly(interval, self.longest_frames)
                    intervals.clips.extend(trim_to_recorded(piece, recorded_object.tracked) for piece in pieces)
        return intervals


def _recording(raw: RawTree, source: Source, hands: HandPair) -> _Recording:
    world = WORLD_FROM[source.headset]
    all_poses = (*source.poses.values(), *source.object_poses.values())
    times = frame_times(source.path, [poses.time_ns for poses in all_poses])
    if source.profile is None:
        hand_tracks = _parameter_hands(source.poses, times, hands, world)
    else:
        hand_tracks = _fitted_hands(source.profile, source.poses, times, hands, world)
    models_and_poses = [(source.models[key], poses) for key, poses in source.object_poses.items()]
    objects = [_recorded_object(raw, *model, poses, times, world) for model, poses in models_and_poses]
    return _Recording(source, times, rows_of_frames(times, source.failed_ns) >= 0, hand_tracks, objects=objects)


def frame_times(path: str, times_ns: list[np.ndarray]) -> np.ndarray:
    """Merge the times of all files to frames: (frame,) int64, the first time of each frame in ns.

    Times within 2 ms belong to one frame. Gaps of up to three frames are filled, so that poses can be interpolated.
    Raises BadInput for frames closer than half of 1/30 s.
    """
    times = np.unique(np.concatenate(times_ns))
    first = times[np.r_[True, np.diff(times) > MAX_SAME_FRAME_NS]]
    steps = np.diff(first)
    if len(steps) and steps.min() < STEP_NS / 2:
        index = int(steps.argmin())
        expected = "frames 1/30 s apart, or times of one frame within 2 ms"
        raise BadInput(f"{path}: times", expected, f"{first[index]} and {first[index + 1]} ns")
    n_missing = np.rint(steps / STEP_NS).astype(int) - 1
    added = [
        np.linspace(first[index], first[index + 1], n_missing[index] + 2)[1:-1].round().astype(np.int64)
        for index in np.flatnonzero((n_missing > 0) & (n_missing <= MAX_BRIDGED_FRAMES))
    ]
    return np.sort(np.concatenate([first, *added]))


def rows_of_frames(frames_ns: np.ndarray, times_ns: np.ndarray) -> np.ndarray:
    """(frame,) index of the first row of each frame, -1 without a row. times_ns: (row,) increasing."""
    rows = np.searchsorted(times_ns, frames_ns - MAX_SAME_FRAME_NS)
    time_at_row = np.append(times_ns, np.iinfo(np.int64).max)[rows]
    return np.where(time_at_row - frames_ns <= MAX_SAME_FRAME_NS, rows, -1)


def _parameter_hands(poses: dict[Side, Poses], times: np.ndarray, hands: HandPair, world: np.ndarray) -> _Hands:
    tracks: dict[Side, HandTrack] = {}
    for side in SIDES:
        rows, valid = _rows(poses.get(side), times)
        side_poses = poses.get(side) or next(iter(poses.values()))
        betas = side_poses.numbers["betas"][rows]
        source = SourceHand(
            translation_m=side_poses.translation_m[rows],
            global_orient=rotmat_to_rotvec(side_poses.rotation[rows]),
            fingers=side_poses.numbers["pose"][rows],
            betas=betas[:1] if (betas == betas[:1]).all() else betas,
            valid=valid,
        )
        tracks[side] = to_track(source, PARAMETERS, hands[side], FrameChange(world[None]))
    return _Hands(tracks)


def _fitted_hands(
    profile: Profile, poses: dict[Side, Poses], times: np.ndarray, hands: HandPair, world: np.ndarray
) -> _Hands:
    """Fit a MANO-layout hand to UmeTrack's joints: one shape per recording, each run of valid frames separately."""
    points, tracks = dict[Side, np.ndarray](), dict[Side, HandTrack]()
    for side, side_poses in poses.items():
        points[side] = joints_m(profile, side_poses, side) @ world.T
    betas = fit_shape(points, hands)
    errors = np.full((len(SIDES), len(times)), np.nan)
    for side_index, side in enumerate(SIDES):
        rows, valid = _rows(poses.get(side), times)
        values = np.zeros((len(times), 3 + 3 + 45))
        for start, stop in runs(valid):
            fit = fit_hands({side: points[side][rows[start:stop]]}, hands, betas)[side]
            values[start:stop] = np.concatenate((fit.wrist_m, fit.global_orient, fit.hand_pose), axis=1)
            errors[side_index, start:stop] = np.nanmean(fit.error_m, axis=1)
        tracks[side] = hand_track(values[:, :3], values[:, 3:6], values[:, 6:], betas[None], valid)
    is_fitted = np.isfinite(errors)
    # Mean over the fitted hands of each frame; NaN without one.
    n_fitted = np.where(is_fitted.any(axis=0), is_fitted.sum(axis=0), np.nan)
    return _Hands(tracks, np.where(is_fitted, errors, 0).sum(axis=0) / n_fitted)


def _rows(poses: Poses | None, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row of each frame (frame,), 0 without a row; and whether there is one (frame,) bool."""
    rows = np.full(len(times), -1) if poses is None else rows_of_frames(times, poses.time_ns)
    return np.maximum(rows, 0), rows >= 0


def _recorded_object(
    raw: RawTree, name: str, path: str, poses: Poses, times: np.ndarray, world: np.ndarray
) -> _RecordedObject:
    file = raw.file(path)
    model = _model(name, file, raw.recorded(path)[0].sha256)
    rows, tracked = _rows(poses, times)
    rotvec = rotmat_to_rotvec(world @ poses.rotation)[rows].astype(np.float32)
    track = ObjectTrack(model, rotvec, (poses.translation_m @ world.T)[rows].astype(np.float32))
    return _RecordedObject(bridge(track, tracked), tracked)


@lru_cache(maxsize=48)
def _model(name: str, file: Path, sha256: str) -> ObjectModel:
    """Read a mesh, cached because recordings share 33 objects. sha256: makes a changed file another cache entry."""
    mesh = read_mesh_file(file)
    return ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), dtype=np.uint8))


def _near_object(recorded_object: _RecordedObject, joints_m: np.ndarray) -> np.ndarray:
    """(frame,) bool: a hand joint or tip is within 2 cm of the object's surface. joints_m: NaN without a hand."""
    model, pose = recorded_object.track.model, recorded_object.track.world_from_object
    local = (joints_m - pose.translation[:, None]) @ pose.rotation
    low, high = model.vertices_m.min(axis=0) - TOUCH_M, model.vertices_m.max(axis=0) + TOUCH_M
    near_box = ((local >= low) & (local <= high)).all(axis=2) & recorded_object.has_pose[:, None]
    near = np.zeros(near_box.shape, bool)
    if near_box.any():
        near[near_box] = closest_points(model.vertices_m, model.faces, local[near_box]).distance_m < TOUCH_M
    return np.asarray(near.any(axis=1))


def _moves(track: ObjectTrack, interval: Interval) -> bool:
    """Whether a corner of the object's box moves 2 cm or more from its first position."""
    corners_world = track.take(slice(*interval)).world_from_object @ box_corners(track.model.vertices_m)
    return bool(np.linalg.norm(corners_world - corners_world[:1], axis=2).max() >= MOVED_M)


def _is_cut(interval: Interval, is_tracked: np.ndarray) -> bool:
    """Whether tracking of the object or a hand begins or ends at the ends of a contact interval.

    A hand that is untracked on both sides of an end does not count, because the other hand touches.
    is_tracked: (object and hands, frame) bool.
    """
    ends = (interval.start, interval.start - 1), (interval.stop - 1, interval.stop)
    return any((is_tracked[:, a] & ~is_tracked[:, b]).any() for a, b in ends if 0 <= b < is_tracked.shape[1])


def _unbroken(times: np.ndarray) -> list[Interval]:
    """Intervals of consecutive frames at 30 fps."""
    edges = np.flatnonzero(np.diff(times) > 1.5 * STEP_NS) + 1
    return [Interval(int(a), int(b)) for a, b in zip(np.r_[0, edges], np.r_[edges, len(times)], strict=True)]


def _rejected(
    whole: Clip, id_suffix: str, expected: str, intervals: list[Interval], remedy: str = "nothing to do"
) -> Quarantined:
    n_frames = sum(stop - start for start, stop in intervals)
    got = f"{len(intervals)} others, {n_frames} frames, the first frame {intervals[0].start}"
    return Quarantined(f"{whole.clip_id}/{id_suffix}", where=whole.sequence, expected=expected, got=got, remedy=remedy)
