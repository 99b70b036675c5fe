"""HOT3D (Banerjee et al. 2025): two hands and up to six rigid objects, motion capture beside Aria glasses or a Quest 3.

Hands are MANO parameters; where a recording has UmeTrack's alone, a MANO-layout hand is fitted to their joints. Nothing
says what is done: clips are intervals in which a hand is at an object that moves, without a verb.
Worlds are those of the headset, z up with Aria, y up with Quest 3; the latter are turned, so that z is up in all clips.
headset_trajectory.csv is not read: it tells where the device is, not its cameras.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import FrameChange, HandConvention, SourceHand, hand_track, to_track
from hoidata.dataset_folders import facts_beside
from hoidata.datasets import checks
from hoidata.datasets.base import DatasetPart, Described, Quarantined, RawTree, SequenceKey
from hoidata.datasets.gaps import LONGEST_BRIDGED, bridge, has_pose, missing_poses, numbered, trimmed
from hoidata.datasets.hot3d.files import HandFormat, Poses, object_words
from hoidata.datasets.hot3d.sources import PARTS, Profile, Source, joints_m, read_source
from hoidata.errors import BadInput
from hoidata.geometry.intervals import Interval, bridged, runs, widened
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair, track_joints
from hoidata.hands.fitting import fit_hands, fit_shape
from hoidata.objects.distance import closest_points
from hoidata.objects.model import ObjectModel
from hoidata.objects.user_mesh import read_mesh_file

STEP_NS = 1e9 / 30
SAME_NS = 2_000_000  # the cameras of one Aria look a tenth of a millisecond apart; each time has rows of its own
TOUCH_M, MOVED_M, BRIDGE_FRAMES = 0.02, 0.02, 10
# Aria's worlds have z up, those of Quest 3 y, as the makers' viewer says.
WORLD_FROM = {"Aria": np.eye(3), "Quest3": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}
LOWER = "nothing to do, or lower the setting shortest_frames"
GRAVITY = np.array([0.0, 0.0, -1.0])
FRAME = WorldFrame("+z", "stated", "the headset's world, metres, z up; Quest 3's, y up, is turned about x")
PARAMETERS = HandConvention(
    translation="transl",
    fingers="mean-relative",
    shape="betas per sequence",
    left_shape="corrected",
    components=15,
    note="MANO: 15 principal components relative to the mean pose, left shape directions corrected, translation added",
)
FITTED = HandConvention(
    translation="wrist",
    fingers="absolute",
    shape="fitted",
    left_shape="unused",
    note="UmeTrack: a MANO-layout hand was fitted to 20 joints and tips, one shape per recording",
)


class _Hands(NamedTuple):
    """tracks of the whole recording; error_m: (frame,) mean distance of both hands' joints where they were fitted."""

    tracks: dict[Side, HandTrack]
    error_m: np.ndarray | None = None


class _Thing(NamedTuple):
    """An object's motion over the whole recording, short gaps bridged. tracked: (frame,) bool, poses of the source."""

    track: ObjectTrack
    tracked: np.ndarray

    @property
    def has_pose(self) -> np.ndarray:
        return has_pose(self.tracked)

    def is_known_in(self, frames: slice) -> bool:
        """Whether it has a pose in every frame, of the source in the first and the last."""
        return bool(self.has_pose[frames].all() and self.tracked[frames][[0, -1]].all())


class _Recording(NamedTuple):
    """All frames of a sequence. times_ns: (frame,); failed: (frame,) bool, the makers' check found a fault there."""

    source: Source
    times_ns: np.ndarray
    failed: np.ndarray
    hands: _Hands
    things: list[_Thing]


class _Found(NamedTuple):
    """frames: intervals that become clips; short, still: touches too short, or of an object that does not move.

    cut: touches too short because poses of the object or of a hand are missing before or after them.
    """

    frames: list[Interval]
    short: list[Interval]
    cut: list[Interval]
    still: list[Interval]


@dataclass(frozen=True)
class Hot3dAdapter(Described):
    """Raw root: ``P<participant>_<recording>/`` with hands, objects and metadata, and ``assets/`` with GLB meshes.

    Or HOT3D-Clips: ``train_aria/clip-*.tar``, ``clip_definitions.json`` and ``object_models_eval/``; a clip is a
    sequence of its own, its subject the participant. Have one of the two: the clips are cut from the recordings, and
    several are from one, so that they are best split by subject.
    hands: "mano", and UmeTrack where a recording has no MANO file; or "umetrack" throughout, which needs no MANO files.
    margin_frames: frames kept before and after each interval. shortest_frames: shorter intervals give no clip;
    longest_frames: longer ones are divided evenly. most_fit_error_mm: clips whose fitted hands miss UmeTrack's joints
    by more on average are left out.
    """

    facts = facts_beside(__file__)
    without_mano = "hands=umetrack"
    hands: HandFormat = "mano"
    margin_frames: int = 0
    shortest_frames: int = 30
    longest_frames: int = 150
    most_fit_error_mm: int = 10
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
        """One key per folder named as a recording, whose participant is the subject, and per clip of HOT3D-Clips."""
        names = [path.name for path in Path(root).glob("P[0-9]*_*") if path.is_dir()]
        clips = [path for path in Path(root).glob("*_*/clip-*.tar") if path.stem[5:].isdecimal()]
        keys = [SequenceKey(self.name, name.partition("_")[0], name) for name in names]
        return sorted(keys + [SequenceKey(self.name, "clips", f"{path.parent.name}/{path.stem}") for path in clips])

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """A clip per interval in which a hand is at an object that moves, and what was left out."""
        source = read_source(raw, key, self.hands)
        recording = _recording(raw, source, hands)
        source_from_world = np.eye(4)
        source_from_world[:3, :3] = WORLD_FROM[source.headset].T
        whole = Clip(
            clip_id=str(key),
            dataset=self.name,
            subject=source.subject,
            sequence=key.name,
            hands=recording.hands.tracks,
            object=recording.things[0].track,
            source_frames=np.arange(len(recording.times_ns), dtype=np.int32),
            gravity=GRAVITY,
            verb=None,
            object_words="",
            source_from_world=source_from_world,
            source_fps=self.source_fps,
            hands_from="keypoints" if source.profile else "parameters",
            sources=raw.sources,
        )
        items = list(self._cut(whole, recording, hands))
        if not items:
            expected = f"a hand within {100 * TOUCH_M:g} cm of an object that moves"
            raise BadInput(key.name, expected, "none in any frame", "nothing to do if nobody moves anything")
        return items

    def _cut(self, whole: Clip, recording: _Recording, hands: HandPair) -> Iterator[Clip | Quarantined]:
        if recording.failed.any():
            yield _left_out(whole, "failed", "frames that passed the makers' check", runs(recording.failed))
        joints = [np.where(t.valid[:, None, None], track_joints(t, hands[s]), np.nan) for s, t in whole.hands.items()]
        together = np.concatenate(joints, axis=1).astype(np.float64)
        for thing in recording.things:
            name = thing.track.model.name
            found = self._intervals(thing, thing.has_pose & ~recording.failed, recording.times_ns, together)
            gaps = missing_poses(
                f"{whole.clip_id}/{name}/missing", whole.sequence, name, whole.source_frames, thing.tracked
            )
            yield from gaps
            if found.cut:
                expected = f"touches of {self.shortest_frames} frames between missing poses of the object or a hand"
                yield _left_out(whole, f"{name}/cut", expected, found.cut, LOWER)
            if found.short:
                yield _left_out(whole, f"{name}/short", f"touches of {self.shortest_frames} frames", found.short, LOWER)
            if found.still:
                yield _left_out(whole, f"{name}/still", f"an object that moves {100 * MOVED_M:g} cm", found.still)
            for interval in found.frames:
                yield self._clip(whole, interval, thing, recording)

    def _clip(self, whole: Clip, interval: Interval, thing: _Thing, recording: _Recording) -> Clip | Quarantined:
        name, frames, error_m = thing.track.model.name, slice(*interval), recording.hands.error_m
        others = [other for other in recording.things if other is not thing and other.is_known_in(frames)]
        clip_id = f"{whole.clip_id}/{interval.start:05d}-{interval.stop - 1:05d}-{name}"
        recorded = np.logical_and.reduce([own.tracked[frames] for own in (thing, *others)])
        everything = replace(
            whole, clip_id=clip_id, object=thing.track, other_objects=tuple(other.track for other in others)
        )
        clip = replace(
            everything.take(frames),
            object_words=object_words(name),
            source_frames=numbered(whole.source_frames[frames], recorded),
        )
        if error_m is None:
            return clip
        mean_m = float(np.nanmean(error_m[frames]))
        if mean_m * 1000 <= self.most_fit_error_mm:
            return replace(clip, fit_error_m=mean_m)
        expected = f"hands that miss UmeTrack's joints by {self.most_fit_error_mm} mm or less on average"
        return Quarantined(
            clip_id,
            recording.source.place,
            expected,
            f"{1000 * mean_m:.1f} mm",
            "nothing to do, or raise the setting most_fit_error_mm",
        )

    def _intervals(self, thing: _Thing, usable: np.ndarray, times: np.ndarray, joints_m: np.ndarray) -> _Found:
        """Usable frames without a gap in time in which a hand is at the object, in intervals of suitable length."""
        found, near = _Found([], [], [], []), _near(thing, joints_m)
        sides = np.split(joints_m, len(SIDES), axis=1)
        known = np.stack([thing.has_pose, *(np.isfinite(side).all(axis=(1, 2)) for side in sides)])
        for first, last in _unbroken(times):
            inside = np.zeros(len(times), bool)
            inside[first:last] = usable[first:last]
            for touch in runs(bridged(near & inside, BRIDGE_FRAMES) & inside):
                interval = trimmed(widened(touch, self.margin_frames, inside), thing.tracked)
                if interval.stop - interval.start < self.shortest_frames:
                    (found.cut if _is_cut(touch, known) else found.short).append(touch)
                elif not _moves(thing.track, interval):
                    found.still.append(touch)
                else:
                    pieces = _divided(interval, self.longest_frames)
                    found.frames.extend(trimmed(piece, thing.tracked) for piece in pieces)
        return found


def _recording(raw: RawTree, source: Source, hands: HandPair) -> _Recording:
    world = WORLD_FROM[source.headset]
    times = frame_times(source.place, [own.time_ns for own in (*source.poses.values(), *source.placed.values())])
    if source.profile is None:
        own_hands = _parameter_hands(source.poses, times, hands, world)
    else:
        own_hands = _fitted_hands(source.profile, source.poses, times, hands, world)
    things = [_thing(raw, *source.models[key], own, times, world) for key, own in source.placed.items()]
    return _Recording(source, times, rows_of_frames(times, source.failed_ns) >= 0, own_hands, things)


def frame_times(where: str, times_ns: list[np.ndarray]) -> np.ndarray:
    """(frame,) int64, ns: the first time of each frame; times of one frame lie less than 2 ms apart.

    Up to three frames that no file has are added between those that are there, so that they can be bridged. Raises
    BadInput where frames are nearer to each other than half of 1/30 s.
    """
    times = np.unique(np.concatenate(times_ns))
    first = times[np.r_[True, np.diff(times) > SAME_NS]]
    steps = np.diff(first)
    if len(steps) and steps.min() < STEP_NS / 2:
        at = int(steps.argmin())
        expected = "frames 1/30 s apart, or times of one frame within 2 ms"
        raise BadInput(f"{where}: times", expected, f"{first[at]} and {first[at + 1]} ns")
    lost = np.rint(steps / STEP_NS).astype(int) - 1
    added = [
        np.linspace(first[at], first[at + 1], lost[at] + 2)[1:-1].round().astype(np.int64)
        for at in np.flatnonzero((lost > 0) & (lost <= LONGEST_BRIDGED))
    ]
    return np.sort(np.concatenate([first, *added]))


def rows_of_frames(frames_ns: np.ndarray, times_ns: np.ndarray) -> np.ndarray:
    """(frame,) the first row of each frame, -1 where there is none. times_ns: (row,) rising."""
    rows = np.searchsorted(times_ns, frames_ns - SAME_NS)
    near = np.append(times_ns, np.iinfo(np.int64).max)[rows]
    return np.where(near - frames_ns <= SAME_NS, rows, -1)


def _parameter_hands(poses: dict[Side, Poses], times: np.ndarray, hands: HandPair, world: np.ndarray) -> _Hands:
    tracks: dict[Side, HandTrack] = {}
    for side in SIDES:
        rows, valid = _rows(poses.get(side), times)
        own = poses.get(side) or next(iter(poses.values()))
        betas = own.numbers["betas"][rows]
        source = SourceHand(
            own.translation_m[rows],
            rotmat_to_rotvec(own.rotation[rows]),
            own.numbers["pose"][rows],
            betas[:1] if (betas == betas[:1]).all() else betas,
            valid,
        )
        tracks[side] = to_track(source, PARAMETERS, hands[side], FrameChange(world[None]))
    return _Hands(tracks)


def _fitted_hands(
    profile: Profile, poses: dict[Side, Poses], times: np.ndarray, hands: HandPair, world: np.ndarray
) -> _Hands:
    """A MANO-layout hand on UmeTrack's joints; each run of frames with a hand is fitted by itself, with one shape."""
    points: dict[Side, np.ndarray] = {side: joints_m(profile, own, side) @ world.T for side, own in poses.items()}
    betas = fit_shape(points, hands)
    tracks: dict[Side, HandTrack] = {}
    errors = np.full((len(SIDES), len(times)), np.nan)
    for number, side in enumerate(SIDES):
        rows, valid = _rows(poses.get(side), times)
        values = np.zeros((len(times), 3 + 3 + 45))
        for start, stop in runs(valid):
            fit = fit_hands({side: points[side][rows[start:stop]]}, hands, betas)[side]
            values[start:stop] = np.concatenate((fit.wrist_m, fit.global_orient, fit.hand_pose), axis=1)
            errors[number, start:stop] = np.nanmean(fit.error_m, axis=1)
        tracks[side] = hand_track(values[:, :3], values[:, 3:6], values[:, 6:], betas[None], valid)
    known = np.isfinite(errors)
    return _Hands(
        tracks, np.where(known, errors, 0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    )


def _rows(poses: Poses | None, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(frame,) the row of each frame, 0 where there is none, and whether there is one."""
    rows = np.full(len(times), -1) if poses is None else rows_of_frames(times, poses.time_ns)
    return np.maximum(rows, 0), rows >= 0


def _thing(raw: RawTree, name: str, path: str, poses: Poses, times: np.ndarray, world: np.ndarray) -> _Thing:
    place = raw.file(path)
    model = _model(name, place, raw.recorded(path)[0].sha256)
    rows, tracked = _rows(poses, times)
    rotvec = rotmat_to_rotvec(world @ poses.rotation)[rows].astype(np.float32)
    track = ObjectTrack(model, rotvec, (poses.translation_m @ world.T)[rows].astype(np.float32))
    return _Thing(bridge(track, tracked), tracked)


@lru_cache(maxsize=48)
def _model(name: str, place: Path, sha256: str) -> ObjectModel:
    """The mesh read from ``place``; sha256 tells whether it is still the same file: recordings share 33 objects."""
    mesh = read_mesh_file(place)
    return ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), dtype=np.uint8))


def _near(thing: _Thing, joints_m: np.ndarray) -> np.ndarray:
    """(frame,) bool: a joint or tip of a hand within 2 cm of the object's surface. joints_m: NaN for no hand."""
    model, pose = thing.track.model, thing.track.world_from_object
    local = (joints_m - pose.translation[:, None]) @ pose.rotation
    low, high = model.vertices_m.min(axis=0) - TOUCH_M, model.vertices_m.max(axis=0) + TOUCH_M
    asked = ((local >= low) & (local <= high)).all(axis=2) & thing.has_pose[:, None]
    near = np.zeros(asked.shape, bool)
    if asked.any():
        near[asked] = closest_points(model.vertices_m, model.faces, local[asked]).distance_m < TOUCH_M
    return np.asarray(near.any(axis=1))


def _moves(track: ObjectTrack, interval: Interval) -> bool:
    """Some corner of the object's box gets 2 cm or more from where it was first."""
    vertices = track.model.vertices_m
    corners = np.array(np.meshgrid(*np.stack([vertices.min(axis=0), vertices.max(axis=0)], axis=1))).reshape(3, -1).T
    placed = track.take(slice(*interval)).world_from_object @ corners
    return bool(np.linalg.norm(placed - placed[:1], axis=2).max() >= MOVED_M)


def _is_cut(interval: Interval, known: np.ndarray) -> bool:
    """Whether what is known in the first or last frame is lost right before or after. known: (object and hands, frame).

    A hand that is not known there may just not be in view: the touch is another's.
    """
    ends = (interval.start, interval.start - 1), (interval.stop - 1, interval.stop)
    return any((known[:, a] & ~known[:, b]).any() for a, b in ends if 0 <= b < known.shape[1])


def _unbroken(times: np.ndarray) -> list[Interval]:
    """Frames that follow each other at 30 a second."""
    edges = np.flatnonzero(np.diff(times) > 1.5 * STEP_NS) + 1
    return [Interval(int(a), int(b)) for a, b in zip(np.r_[0, edges], np.r_[edges, len(times)], strict=True)]


def _divided(interval: Interval, longest: int) -> list[Interval]:
    pieces = -(-(interval.stop - interval.start) // longest)
    edges = np.linspace(interval.start, interval.stop, pieces + 1).round().astype(int).tolist()
    return [Interval(a, b) for a, b in pairwise(edges)]


def _left_out(
    whole: Clip, what: str, expected: str, intervals: list[Interval], remedy: str = "nothing to do"
) -> Quarantined:
    n_frames = sum(stop - start for start, stop in intervals)
    got = f"{len(intervals)} others, {n_frames} frames, the first frame {intervals[0].start}"
    return Quarantined(f"{whole.clip_id}/{what}", whole.sequence, expected, got, remedy)
