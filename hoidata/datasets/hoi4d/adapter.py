"""HOI4D (Liu et al. 2022): a head-worn camera, MANO hands, rigid and hinged objects, 15 frames per second.

All numbers are in the camera's frame. The world is that of the camera's trajectory, whose axes are not documented.
Clips have 30 frames per second, of which every second one is interpolated (``parts.upsample_frames``).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import SIDES, CameraTrack, Clip, HandTrack, HandType, ObjectTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import FrameChange, HandConvention, SourceHand, to_track
from hoidata.dataset_folders import facts_of_adapter
from hoidata.datasets.base import AdapterBase, DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.datasets.gaps import bridge, has_pose, mark_interpolated, missing_poses, trim_to_recorded
from hoidata.datasets.gravity import TrackedObject, estimate_gravity, hand_joints_m
from hoidata.datasets.hinge import box_corners, fit_hinge, hinged_model
from hoidata.datasets.hoi4d.files import (
    CATEGORIES,
    EVENTS,
    TASKS,
    Category,
    PartPose,
    ShortPose,
    action_events,
    aligned_from_whole,
    camera_poses,
    frame_numbers,
    hand_frame,
    hinge_joint,
    match_boxes,
    object_poses,
    upsample_frames,
    upsample_hand,
    upsample_rotvecs,
    upsample_values,
)
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.datasets.segments import ClipSource, has_description, segment_clips
from hoidata.errors import BadInput
from hoidata.geometry.intervals import runs
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.objects.resting import footing

ANNOTATIONS, MODELS = "HOI4D_annotations", "HOI4D_CAD_Model_for_release"
CLIP = "ZY*/H*/C*/N*/S*/s*/T*"
# Of an older download and of the current one.
HAND_FOLDERS = ("handpose/refinehandpose_{}", "Hand_pose/handpose_{}_hand")
FRAME = WorldFrame(None, "estimated", "the world of the camera's trajectory, right-handed, metres, axes not documented")
HAND_NOTE = "MANO: absolute axis-angles, one shape per person, translation added to the rest wrist, camera frame"
CONVENTION = HandConvention(
    translation="transl", fingers="absolute", shape="betas per sequence", left_shape="as released", note=HAND_NOTE
)
# A folder of frame files is recorded as one source, so a pattern for the folder is needed too.
_HANDS = tuple(
    f"{folder.format(side)}/{CLIP}{files}" for folder in HAND_FOLDERS for side in SIDES for files in ("/*.pickle", "")
)
_POSES = tuple(f"{ANNOTATIONS}/{CLIP}/objpose{files}" for files in ("/*.json", ""))
PARTS = (
    DatasetPart("object poses", _POSES, "HOI4D_annotations.zip"),
    DatasetPart("camera trajectory", (f"{ANNOTATIONS}/{CLIP}/3Dseg/output.log",), "HOI4D_annotations.zip"),
    DatasetPart("hand poses", _HANDS, "HOI4D_Handpose.zip"),
    DatasetPart(
        "object meshes", (f"{MODELS}/rigid/*/*.obj", f"{MODELS}/articulated/*/*/objs/*.obj"), "HOI4D_CAD_models.zip"
    ),
    DatasetPart(
        "hinges",
        (f"{MODELS}/articulated/*/*/mobility_v2.json", f"{MODELS}/articulated/*/*/result.json"),
        "HOI4D_CAD_models.zip",
        optional=True,
    ),
)
EVENT_FILES = (f"{ANNOTATIONS}/{CLIP}/action/color.json",)
EVENT_PART = DatasetPart("events", EVENT_FILES, "HOI4D_annotations.zip", unneeded_with="clips=segments")


class _ObjectMotion(NamedTuple):
    """Motion of the object at 30 fps."""

    track: ObjectTrack  # short gaps are interpolated
    tracked: np.ndarray  # (frame,) bool: a pose of the source, or interpolated between two neighbours
    recorded: np.ndarray  # (frame,) bool: a pose of the source
    note: str  # residuals of boxes and hinge
    rejected_frames: list[Quarantined]  # frames that are too far off the hinge


class _ClipRange(NamedTuple):
    """A range of source frames that becomes one clip, or several if object poses are missing."""

    clip_id: str  # if it becomes one clip
    start: int
    stop: int  # exclusive
    verb: str | None  # None if the source does not state it
    hand: HandType | None  # None if the source does not state it


@dataclass(frozen=True)
class Hoi4dAdapter(AdapterBase):
    """Raw root: the folder with ``HOI4D_annotations``, the CAD models, and ``handpose`` or ``Hand_pose``."""

    facts = facts_of_adapter(__file__)
    margin_frames: int = 0  # at 30 fps: frames kept before and after each event
    shortest_frames: int = 20  # at 30 fps: shorter events give no clip
    clips: ClipSource = "described"  # a described clip is an event of ``action/color.json`` that acts on the object
    # Frames in which two tracked parts are farther off their hinge are excluded.
    most_off_mm: int = 20
    most_off_deg: int = 10
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION

    @property
    def parts(self) -> tuple[DatasetPart, ...]:
        """Files of a complete raw folder. Events are required for the setting ``clips: described`` only."""
        return (*PARTS, replace(EVENT_PART, optional=self.clips != "described"))

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per recording that has a folder of annotations. The subject is the person, ``H2``."""
        folders = [path for path in Path(root).glob(f"{ANNOTATIONS}/{CLIP}") if path.is_dir()]
        names = ["/".join(path.parts[-7:]) for path in folders]
        return sorted(SequenceKey(self.name, name.split("/")[1], name) for name in names)

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """Clips of one recording, and reasons for unusable events, frames and hand files."""
        category = _category(key)
        camera = camera_poses(raw.read(path := f"{ANNOTATIONS}/{key.name}/3Dseg/output.log"), path)
        object_motion = self._object(raw, key, category, camera)
        tracks, results = _hands(raw, key, camera, hands)
        ranges, unknown_events = self._clip_ranges(raw, key, len(camera))
        camera_track = CameraTrack(
            name=key.name.partition("/")[0],
            rotvec=upsample_rotvecs(rotmat_to_rotvec(camera[:, :3, :3])).astype(np.float32),
            position_m=upsample_values(camera[:, :3, 3]).astype(np.float32),
            images=upsample_frames(len(camera)).astype(np.int32),
        )
        gravity, gravity_note = _gravity(object_motion, tracks, camera, hands)
        whole = self.new_clip(
            key,
            hands=tracks,
            object=object_motion.track,
            source_frames=mark_interpolated(camera_track.images, object_motion.recorded),
            gravity=gravity,
            gravity_note=f"{gravity_note}; {object_motion.note}",
            verb=None,
            object_words=category.words,
            sources=raw.sources,
            camera=camera_track,
        )
        clips = self._cut(whole, camera_track.images, ranges, object_motion)
        if self.clips != "whole" and not has_description(self.clips, raw, _events_path(key)):
            clips = segment_clips(clips, hands)
        return [*results, *object_motion.rejected_frames, *unknown_events, *clips]

    def _cut(
        self, whole: Clip, source_frames: np.ndarray, ranges: list[_ClipRange], object_motion: _ObjectMotion
    ) -> Iterator[Clip | Quarantined]:
        """One clip per interval of each range in which the object has a pose. source_frames: (frame,) in the source."""
        for item in ranges:
            start, stop = max(0, 2 * item.start - self.margin_frames), 2 * item.stop - 1 + self.margin_frames
            inside, location = slice(start, stop), f"{ANNOTATIONS}/{whole.sequence}/objpose"
            with_pose = [(start + a, start + b) for a, b in runs(has_pose(object_motion.tracked)[inside])]
            pieces = [trim_to_recorded(piece, object_motion.recorded) for piece in with_pose]
            frames_and_tracked = source_frames[inside], object_motion.tracked[inside]
            yield from missing_poses(f"{item.clip_id}/missing", location, "the object", *frames_and_tracked)
            accepted = [piece for piece in pieces if piece[1] - piece[0] >= self.shortest_frames]
            if not accepted:
                got = f"{max((b - a for a, b in pieces), default=0)} in frames {item.start} to {item.stop - 1}"
                expected = f"{self.shortest_frames} frames (at 30 per second) with the object"
                remedy = "nothing to do, or lower shortest_frames"
                yield Quarantined(item.clip_id, where=whole.clip_id, expected=expected, got=got, remedy=remedy)
            for a, b in accepted:
                frames = (int(whole.source_frames[a]), int(whole.source_frames[b - 1]) + 1)
                name = item.clip_id if len(accepted) == 1 else f"{whole.clip_id}/{frames[0]:04d}-{frames[1]:04d}"
                yield replace(whole.take(slice(a, b)), clip_id=name, verb=item.verb, labelled_hand=item.hand)

    def _clip_ranges(self, raw: RawTree, key: SequenceKey, n_frames: int) -> tuple[list[_ClipRange], list[Quarantined]]:
        """Ranges that become clips, and reasons for events with an unknown word."""
        path = _events_path(key)
        if not has_description(self.clips, raw, path):
            _, _, category, *_, task = key.name.split("/")
            verb = TASKS.get((category, task)) if self.clips == "whole" else None
            return [_ClipRange(str(key), start=0, stop=n_frames, verb=verb, hand=None)], []
        if not raw.has(path) and path not in (raw.manifest or ()):
            remedy = "unpack HOI4D_annotations.zip here, or set clips: segments, which needs no events"
            raise BadInput(path, "a file with the events of the recording", "nothing there", remedy)
        ranges, unknown_events = dict[tuple[int, int], _ClipRange](), list[Quarantined]()
        for event in action_events(raw.read(path), path):
            start, stop = event.start, min(event.stop, n_frames)
            word, clip_id = event.word.lower(), f"{key}/{start:04d}-{stop:04d}"
            if word not in EVENTS:
                problem = BadInput(path, f"one of {', '.join(EVENTS)}", repr(event.word)[:40], "nothing to do")
                unknown_events.append(Quarantined.from_error(clip_id, problem))
            elif (action := EVENTS[word]) is not None and stop > start:
                verb, hand = action
                ranges[start, stop] = _ClipRange(clip_id, start=start, stop=stop, verb=verb, hand=hand)
        return list(ranges.values()), unknown_events

    def _object(self, raw: RawTree, key: SequenceKey, category: Category, camera: np.ndarray) -> _ObjectMotion:
        folder = f"{ANNOTATIONS}/{key.name}/objpose"
        numbers = frame_numbers(folder, raw.names(folder, ".json"))
        if not numbers or max(numbers) >= len(camera):
            got = f"{len(numbers)} files, the last of frame {max(numbers, default=-1)}"
            raise BadInput(folder, f"object poses of frames 0 to {len(camera) - 1}, as output.log has", got)
        frames = np.array(sorted(numbers))
        names = [numbers[frame] for frame in frames]
        contents = _read_frames(raw, folder, names)
        poses = [object_poses(data, f"{folder}/{name}") for name, data in zip(names, contents, strict=True)]
        labels = [pose.label for pose in poses[0]]
        for name, frame_poses in zip(names, poses, strict=True):
            if [pose.label for pose in frame_poses] != labels:
                got = ", ".join(pose.label for pose in frame_poses)
                raise BadInput(f"{folder}/{name}", f"the parts {', '.join(labels)}", got)
        tracked = np.zeros(len(camera), bool)
        tracked[frames] = True
        boxes = [camera[frames] @ _transforms(part_poses) for part_poses in zip(*poses, strict=True)]
        extents = np.array([pose.extents_m for pose in poses[0]])
        build = self._hinged if category.hinged else _rigid
        return build(raw, key, category, extents, boxes, tracked)

    def _hinged(
        self,
        raw: RawTree,
        key: SequenceKey,
        category: Category,
        extents_m: np.ndarray,
        boxes: list[np.ndarray],
        tracked: np.ndarray,
    ) -> _ObjectMotion:
        location = f"{ANNOTATIONS}/{key.name}/objpose"
        model, names, aligned_from_whole = _hinged_model(raw, category, _instance(key))
        parts = [model.vertices_m[model.part == part] for part in (0, 1)]
        aligned = [part @ pose[:3, :3].T + pose[:3, 3] for part, pose in zip(parts, aligned_from_whole, strict=True)]
        chosen, ratio = match_boxes(location, extents_m, names, np.array([np.ptp(part, axis=0) for part in aligned]))
        base, moving = (boxes[box] @ pose for box, pose in zip(chosen, aligned_from_whole, strict=True))
        assert model.hinge is not None
        fit = fit_hinge(base, moving, model.hinge, (box_corners(parts[0]), box_corners(parts[1])))
        limits = (self.most_off_mm, self.most_off_deg)
        frames, off = np.flatnonzero(tracked), fit.exceeds(*limits)
        tracked[frames[off]] = False
        rejected = [fit.rejected_frames_reason(f"{key}/hinge", location, frames, *limits)] if off.any() else []
        note = f"{fit.note}; {_box_note(ratio, aligned)}"
        return _object_motion(model, fit.world_from_object, fit.hinge_rad, frames, tracked, note, rejected)


def _events_path(key: SequenceKey) -> str:
    return f"{ANNOTATIONS}/{key.name}/action/color.json"


def _category(key: SequenceKey) -> Category:
    name = key.name.split("/")[2]
    if name not in CATEGORIES:
        raise BadInput(str(key), f"a category among {', '.join(CATEGORIES)}", name, "nothing to do")
    return CATEGORIES[name]


def _instance(key: SequenceKey) -> str:
    number = key.name.split("/")[3][1:]
    if not number.isdecimal():
        raise BadInput(str(key), "an object number such as N12", number, "restore the folder's name")
    return f"{int(number):03d}"


def _transforms(poses: Sequence[PartPose]) -> np.ndarray:
    """(frame, 4, 4) camera from the part's mesh."""
    transforms = np.tile(np.eye(4), (len(poses), 1, 1))
    transforms[:, :3, :3] = [pose.rotation for pose in poses]
    transforms[:, :3, 3] = [pose.centre_m for pose in poses]
    return transforms


def _rigid(
    raw: RawTree,
    key: SequenceKey,
    category: Category,
    extents_m: np.ndarray,
    boxes: list[np.ndarray],
    tracked: np.ndarray,
) -> _ObjectMotion:
    number = _instance(key)
    mesh = raw_mesh(raw, f"{MODELS}/rigid/{category.folder}/{number}.obj")
    name = f"{category.folder.lower()}_{number}"
    location = f"{ANNOTATIONS}/{key.name}/objpose"
    (chosen,), ratio = match_boxes(location, extents_m, [name], np.ptp(mesh.vertices, axis=0)[None])
    model = ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), np.uint8))
    note = _box_note(ratio, [mesh.vertices])
    return _object_motion(model, boxes[chosen], None, np.flatnonzero(tracked), tracked, note, [])


def _hinged_model(raw: RawTree, category: Category, number: str) -> tuple[ObjectModel, list[str], list[np.ndarray]]:
    """Whole object at rest, names of its two meshes (base first), and (4, 4) mesh frame from whole for each."""
    folder = f"{MODELS}/articulated/{category.folder}/{number}"
    mobility, tree = f"{folder}/mobility_v2.json", f"{folder}/result.json"
    joint = hinge_joint(raw.read(mobility), raw.read(tree), mobility, tree)
    names = [joint.base, joint.moving]
    meshes = [raw_mesh(raw, f"{folder}/objs/{name}.obj") for name in names]
    paths = [f"{folder}/objs/{name}-align.obj" for name in names]
    aligned_vertices = [raw_mesh(raw, path).vertices for path in paths]
    whole_vertices = [mesh.vertices for mesh in meshes]
    transforms = [aligned_from_whole(*item) for item in zip(paths, aligned_vertices, whole_vertices, strict=True)]
    faces = [mesh.faces for mesh in meshes]
    hinge = Hinge(joint.axis, joint.origin_m)
    model = hinged_model(f"{category.folder.lower()}_{number}", whole_vertices, faces, hinge)
    return model, names, transforms


def _box_note(ratio: np.ndarray, aligned_m: list[np.ndarray]) -> str:
    """Compare annotated boxes with the meshes, in words. Meshes are not resized."""
    offset_m = max(float(np.linalg.norm((part.min(axis=0) + part.max(axis=0)) / 2)) for part in aligned_m)
    sizes = f"boxes {ratio.min():.2f} to {ratio.max():.2f} of the mesh"
    return f"{sizes}, whose middle is {1000 * offset_m:.1f} mm off"


def _object_motion(
    model: ObjectModel,
    world_from_object: np.ndarray,
    hinge_rad: np.ndarray | None,
    frames: np.ndarray,
    tracked: np.ndarray,
    note: str,
    rejected_frames: list[Quarantined],
) -> _ObjectMotion:
    """Convert poses of source frames to a track at 30 fps. Frames without a pose repeat the previous one."""
    source = np.clip(np.searchsorted(frames, np.arange(len(tracked)), side="right") - 1, 0, None)
    rotvec, position = rotmat_to_rotvec(world_from_object[:, :3, :3])[source], world_from_object[source, :3, 3]
    angle = None if hinge_rad is None else upsample_values(hinge_rad[source], tracked).astype(np.float32)
    position = upsample_values(position, tracked).astype(np.float32)
    track = ObjectTrack(model, upsample_rotvecs(rotvec).astype(np.float32), position, angle)
    usable, recorded = np.zeros(track.n_frames, bool), np.zeros(track.n_frames, bool)
    usable[::2], usable[1::2], recorded[::2] = tracked, tracked[:-1] & tracked[1:], tracked
    return _ObjectMotion(bridge(track, usable), usable, recorded, note, rejected_frames=rejected_frames)


def _hands(
    raw: RawTree, key: SequenceKey, camera: np.ndarray, hands: HandPair
) -> tuple[dict[Side, HandTrack], list[Clip | Quarantined]]:
    """Both hands in the world at 30 fps, and reasons for unusable files. Raises BadInput without a usable file."""
    tracks, faulty = dict[Side, HandTrack](), list[Clip | Quarantined]()
    change = FrameChange(camera[:, :3, :3], camera[:, :3, 3])
    for side in SIDES:
        source, problems = _source_hand(raw, key, side, len(camera))
        tracks[side] = upsample_hand(to_track(source, CONVENTION, hands[side], change))
        faulty += problems
    if not any(track.valid.any() for track in tracks.values()):
        folders = " or ".join(folder.format("right") for folder in HAND_FOLDERS)
        remedy = "nothing to do: the makers publish no hands of some recordings"
        raise BadInput(key.name, f"hand poses below {folders}", "none", remedy)
    return tracks, faulty


def _read_frames(raw: RawTree, folder: str, names: list[str]) -> list[bytes]:
    """The files of a folder in the order of ``names``. Reads them sorted, which the folder's digest requires."""
    in_order = sorted(names)
    contents = dict(zip(in_order, raw.read_folder(folder, in_order) if names else [], strict=True))
    return [contents[name] for name in names]


def _source_hand(raw: RawTree, key: SequenceKey, side: Side, n_frames: int) -> tuple[SourceHand, list[Quarantined]]:
    folders = [f"{folder.format(side)}/{key.name}" for folder in HAND_FOLDERS]
    folder = next((candidate for candidate in folders if raw.names(candidate, ".pickle")), folders[0])
    numbers = frame_numbers(folder, raw.names(folder, ".pickle"))
    pose, translation_m, betas = np.zeros((n_frames, 48)), np.zeros((n_frames, 3)), np.zeros((n_frames, 10))
    valid, faulty = np.zeros(n_frames, bool), []
    frames = sorted(numbers)
    if frames and frames[-1] >= n_frames:
        raise BadInput(folder, f"frames 0 to {n_frames - 1}, as output.log has", f"{frames[-1]}")
    contents = _read_frames(raw, folder, [numbers[frame] for frame in frames])
    for frame, data in zip(frames, contents, strict=True):
        try:
            hand = hand_frame(data, f"{folder}/{numbers[frame]}")
        except ShortPose as problem:
            faulty.append(Quarantined.from_error(f"{key}/{side}-{frame:05d}", problem))
            continue
        pose[frame], betas[frame], translation_m[frame], valid[frame] = *hand[:2], hand.translation_m, True
    betas[~valid] = betas[valid][0] if valid.any() else 0
    source = SourceHand(translation_m, pose[:, :3], pose[:, 3:], betas, valid=valid)
    return source, faulty


def _gravity(
    object_motion: _ObjectMotion, tracks: dict[Side, HandTrack], camera: np.ndarray, hands: HandPair
) -> tuple[np.ndarray | None, str]:
    """Estimate gravity from the base of the object at rest, because the source does not state it."""
    track = object_motion.track
    poses = np.tile(np.eye(4), (track.n_frames, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = track.world_from_object.rotation, track.translation_m
    camera_rotation = np.repeat(camera[:, :3, :3], 2, axis=0)[: track.n_frames]
    base = TrackedObject(footing(track.model.vertices_m, track.model.faces_of(0)), object_motion.tracked, poses)
    return estimate_gravity([base], hand_joints_m(tracks, hands), camera_rotation)
