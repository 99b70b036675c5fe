"""H2O (Kwon et al. 2021): one text file per frame and camera; hands and objects are in the camera's frame.

Only the head camera (cam4) is read, because the others have no action labels. Its pose files are camera to world.
The world's axes are not documented, so gravity is estimated per sequence from objects at rest.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import CameraTrack, Clip, ObjectTrack, SourceFile, WorldFrame
from hoidata.clips.hand_parameters import HandConvention
from hoidata.dataset_folders import facts_of_adapter
from hoidata.datasets.base import AdapterBase, DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.datasets.gaps import bridge, has_pose, mark_interpolated, missing_poses
from hoidata.datasets.gravity import GravityEstimate, TrackedObject, estimate_gravity
from hoidata.datasets.h2o.files import (
    ACTIONS,
    FITTED,
    LISTS,
    OBJECTS,
    PARAMETERS,
    HandSource,
    KeypointHands,
    ParameterHands,
    SequenceFrames,
    listed_segments,
    read_frames,
)
from hoidata.errors import BadInput
from hoidata.geometry.intervals import Interval, runs, widened
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.objects.mesh import load_mesh
from hoidata.objects.model import ObjectModel
from hoidata.objects.resting import Footing, footing

CAMERA = "cam4"
OLD_NAMES = {"spray": "lotion_spray", "cocoa": "ovomaltine", "chips": "pringles", "cappuccino": "starbucks"}
FRAME = WorldFrame(None, "estimated", "H2O's camera-rig world, right-handed, metres; its axes are not documented")
PARTS = (
    DatasetPart("pose files of the head camera", ("subject*/*/*/cam4/*/*.txt",), "subjectN_pose_v1_1.tar.gz"),
    DatasetPart("object meshes", ("object/*/*.obj",), "object.zip"),
    DatasetPart("the head camera's lens", ("subject*/*/*/cam4/*.txt",), "subjectN_pose_v1_1.tar.gz", optional=True),
    DatasetPart("segments of all subjects", ("label_split/action_*.txt",), "label_split.zip", optional=True),
)


class _Run(NamedTuple):
    """An interval of frames of one action."""

    start: int
    stop: int  # exclusive
    verb: str | None  # None if labels are withheld
    noun: str


class _Object(NamedTuple):
    model: ObjectModel
    footing: Footing


class _Sequence(NamedTuple):
    """Data that the clips of one sequence share."""

    key: SequenceKey
    frames: SequenceFrames
    hands: ParameterHands | KeypointHands
    objects: dict[str, _Object]
    gravity: GravityEstimate
    sources: tuple[SourceFile, ...]  # includes all meshes, because gravity depends on them


@dataclass(frozen=True)
class H2OAdapter(AdapterBase):
    """Raw root: ``object/<name>/<name>.obj`` and ``subjectN/<place>/<number>/cam4/<kind>/NNNNNN.txt``.

    A clip is a run of frames with one action label. A sequence without labels (subject4, whose labels are withheld)
    uses the segments of ``label_split``. A run is split at frames in which the tracked object differs from that of the
    label, or, without a label, from the most frequent one. Gaps of up to three frames without an object are
    interpolated.
    """

    facts = facts_of_adapter(__file__)
    without_mano = "hands=keypoints"
    margin_frames: int = 0  # frames kept before and after each run
    shortest_frames: int = 21  # shorter runs give no clip
    # "mano": MANO parameters, which need the licensed MANO files; "keypoints": a hand model fitted to the 21 joints
    hands: HandSource = "mano"
    frame: WorldFrame = FRAME
    parts: tuple[DatasetPart, ...] = PARTS

    @property
    def hand_convention(self) -> HandConvention:
        return PARAMETERS if self.needs_mano else FITTED

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per ``subjectN/<place>/<number>`` that has a cam4 folder."""
        folders = sorted(Path(root).glob(f"subject*/*/*/{CAMERA}"))
        parts = [path.relative_to(root).parts for path in folders if path.is_dir()]
        return [SequenceKey(self.name, part[0], "/".join(part[:3])) for part in parts]

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """One clip per run of frames of one action on one tracked object, and reasons for runs without a clip."""
        frames = read_frames(raw, f"{key.name}/{CAMERA}", self.hands)
        runs_and_reasons = list(self._runs(raw, key, frames))
        runs = [item for item in runs_and_reasons if isinstance(item, _Run)]
        if not runs:
            return [item for item in runs_and_reasons if isinstance(item, Quarantined)]
        paths = {noun: _mesh_path(raw, noun) for noun in sorted({run.noun for run in runs})}
        objects = {noun: _object(noun, raw.file(path), raw.recorded(path)[0].sha256) for noun, path in paths.items()}
        hand_source = ParameterHands(frames, hands) if self.needs_mano else KeypointHands(frames, hands)
        gravity = estimate_gravity(_tracked_objects(frames, objects), hand_source.joints_m(), frames.camera[:, :3, :3])
        sources = raw.recorded(frames.folder, LISTS, *paths.values())
        sequence = _Sequence(key, frames, hand_source, objects, gravity=gravity, sources=sources)
        return [item if isinstance(item, Quarantined) else self._clip(sequence, item) for item in runs_and_reasons]

    def _runs(self, raw: RawTree, key: SequenceKey, frames: SequenceFrames) -> Iterator[_Run | Quarantined]:
        """Runs of the labels or segments of the list, cut to frames in which their object is tracked."""
        earlier_intervals: set[tuple[int, int]] = set()
        for start, stop, label, location in _labelled_ranges(raw, key, frames):
            clip_id = _clip_id(key, frames, start, stop)
            try:
                for piece in _tracked_pieces(frames, start, stop, label, self.shortest_frames, location):
                    if (piece.start, piece.stop) in earlier_intervals:
                        raise BadInput(location, "each stretch once", f"{clip_id} twice", "correct the list")
                    earlier_intervals.add((piece.start, piece.stop))
                    yield piece
                tracked = frames.classes[start:stop] == frames.classes[piece.start]
                numbers, noun = frames.first + np.arange(start, stop), OBJECTS[frames.classes[piece.start]]
                yield from missing_poses(f"{clip_id}/missing", f"{frames.folder}/obj_pose_rt", noun, numbers, tracked)
            except BadInput as problem:
                yield Quarantined.from_error(clip_id, problem)

    def _clip(self, sequence: _Sequence, run: _Run) -> Clip:
        frames = sequence.frames
        tracked = frames.classes == frames.classes[run.start]
        start, stop = widened(Interval(run.start, run.stop), self.margin_frames, tracked)
        world_from_object = frames.camera[start:stop] @ _poses(frames)[start:stop]
        tracks, fit_error_m = sequence.hands.tracks(start, stop)
        source_frames = np.arange(frames.first + start, frames.first + stop, dtype=np.int32)
        return self.new_clip(
            sequence.key,
            clip_id=_clip_id(sequence.key, frames, run.start, run.stop),
            hands=tracks,
            object=bridge(
                ObjectTrack(
                    sequence.objects[run.noun].model,
                    rotmat_to_rotvec(world_from_object[:, :3, :3]).astype(np.float32),
                    world_from_object[:, :3, 3].astype(np.float32),
                ),
                tracked[start:stop],
            ),
            source_frames=mark_interpolated(source_frames, tracked[start:stop]),
            gravity=sequence.gravity.direction,
            gravity_note=sequence.gravity.note,
            verb=run.verb,
            object_words=run.noun,
            sources=sequence.sources,
            hands_from="parameters" if self.needs_mano else "keypoints",
            fit_error_m=fit_error_m,
            camera=_camera_track(frames, start, stop, source_frames),
        )


def label_runs(label: np.ndarray) -> list[tuple[int, int]]:
    """Half-open ranges of equal non-zero labels. label: (frame,) int."""
    edges = np.flatnonzero(np.diff(label)) + 1
    starts, stops = np.r_[0, edges], np.r_[edges, len(label)]
    return [(int(a), int(b)) for a, b in zip(starts, stops, strict=True) if label[a] != 0]


def _labelled_ranges(
    raw: RawTree, key: SequenceKey, frames: SequenceFrames
) -> Iterator[tuple[int, int, int | None, str]]:
    """Yield start, stop (exclusive), action label and location of each run, from labels or from a segment list.

    Raises BadInput without labels and list, or if the list names missing frames.
    """
    if frames.label is not None and frames.label.any():
        for start, stop in label_runs(frames.label):
            yield start, stop, int(frames.label[start]), f"{frames.folder}/action_label"
        return
    segments, path = listed_segments(raw, key.name)
    if not segments and frames.label is not None:
        return
    if not segments:
        expected = f"action labels, or {key.name} in a segment list {LISTS}/action_*.txt"
        remedy = f"unpack label_split.zip here: the labels of subject4 are withheld, its segments are in {LISTS}"
        raise BadInput(f"{frames.folder}/action_label", expected, "neither", remedy)
    for segment in segments:
        start, stop = segment.start - frames.first, segment.last + 1 - frames.first
        if start < 0 or stop > len(frames):
            expected = f"frames {frames.first} to {frames.first + len(frames) - 1}, as {frames.folder} has them"
            got = f"segment {segment.start} to {segment.last} of {key.name}"
            raise BadInput(path, expected, got, "download the pose archive of this subject again")
        yield start, stop, segment.label, path


def _tracked_pieces(
    frames: SequenceFrames, start: int, stop: int, label: int | None, shortest: int, location: str
) -> list[_Run]:
    """Intervals of a run, at least ``shortest`` frames long, in which its object is tracked. Raises BadInput for none.

    The object is that of the label. Without a label it is the most frequent one (the first of equals).
    """
    named_frames = f"frames {frames.first + start} to {frames.first + stop - 1}"
    if stop - start < shortest:
        got, remedy = f"{stop - start} ({named_frames})", "nothing to do, or lower the setting shortest_frames"
        raise BadInput(location, f"a run of {shortest} frames or more", got, remedy)
    classes = frames.classes[start:stop]
    class_counts = np.bincount(classes[classes > 0], minlength=len(OBJECTS))
    target_class = int(class_counts.argmax()) if label is None else OBJECTS.index(ACTIONS[label][1])
    # Short gaps are interpolated, unless another object is tracked in them.
    has_target_pose = has_pose(classes == target_class) & np.isin(classes, (0, target_class))
    accepted = [(first, last) for first, last in runs(has_target_pose) if last - first >= shortest]
    if not class_counts.any() or not accepted:
        of_label = f"class {target_class} ({OBJECTS[target_class]}), the object of action {label},"
        got = f"classes {np.unique(classes).tolist()} ({named_frames})"
        expected = f"{'one object' if label is None else of_label} for {shortest} frames or more"
        raise BadInput(f"{frames.folder}/obj_pose_rt", expected, got, "check the annotation")
    verb = None if label is None else ACTIONS[label][0]
    return [_Run(start + first, start + last, verb, OBJECTS[target_class]) for first, last in accepted]


def _clip_id(key: SequenceKey, frames: SequenceFrames, start: int, stop: int) -> str:
    return f"{key}/{frames.first + start:06d}-{frames.first + stop - 1:06d}"


def _camera_track(frames: SequenceFrames, start: int, stop: int, images: np.ndarray) -> CameraTrack:
    poses = frames.camera[start:stop]
    rotvec = rotmat_to_rotvec(poses[:, :3, :3]).astype(np.float32)
    return CameraTrack(CAMERA, rotvec, poses[:, :3, 3].astype(np.float32), images, intrinsics=frames.intrinsics)


def _tracked_objects(frames: SequenceFrames, objects: dict[str, _Object]) -> list[TrackedObject]:
    poses = frames.camera @ _poses(frames)
    return [TrackedObject(item.footing, frames.classes == OBJECTS.index(noun), poses) for noun, item in objects.items()]


def _poses(frames: SequenceFrames) -> np.ndarray:
    """(frame, 4, 4) camera from object; the identity in frames without an object, whose numbers are undefined."""
    return np.where(frames.classes[:, None, None] == 0, np.eye(4), frames.objects)


def _mesh_path(raw: RawTree, name: str) -> str:
    for candidate in (name, OLD_NAMES.get(name, name)):
        exact = f"{candidate}.obj"
        names = raw.names(f"object/{candidate}", ".obj")
        if names:
            return f"object/{candidate}/{exact if exact in names else names[0]}"
    raise BadInput(f"object/{name}/{name}.obj", "the object's mesh", "nothing there", "unpack object.zip here")


@lru_cache(maxsize=16)
def _object(name: str, file: Path, sha256: str) -> _Object:
    """Read a mesh, cached because sequences share objects. sha256: makes a changed file another cache entry."""
    mesh = load_mesh(file)
    model = ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), dtype=np.uint8))
    return _Object(model, footing(mesh.vertices, mesh.faces))
