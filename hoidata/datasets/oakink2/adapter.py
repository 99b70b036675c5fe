"""OakInk2 (Zhan et al. 2024): motion capture of both hands and of all object parts at 120 Hz.

A recording is a long task. Its program lists primitives with a range of frames for each hand. Each primitive becomes a
clip that covers both ranges. The clip's object is the first one in the list of the leading hand. The other listed
objects are the clip's other objects. Parts are tracked separately. Two parts of one object that rotate about a common
axis are joined by a hinge; all other parts are separate objects.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import Clip, ObjectTrack, WorldFrame
from hoidata.clips.hand_parameters import HandConvention, to_track
from hoidata.dataset_folders import facts_of_adapter
from hoidata.datasets.base import AdapterBase, DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.datasets.gaps import bridge, has_pose, mark_interpolated, missing_poses, trim_to_recorded
from hoidata.datasets.hinge import HingeFit, box_corners, hinge_between, hinged_model
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.datasets.oakink2.files import (
    MAX_JSON_BYTES,
    STEP,
    Annotation,
    Range,
    Segment,
    noun_of,
    read_annotation,
    read_names,
    read_program,
    read_roots,
)
from hoidata.datasets.segments import ClipSource, has_description, segment_clips
from hoidata.errors import BadInput
from hoidata.geometry.intervals import runs
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.objects.mesh import Mesh
from hoidata.objects.model import ObjectModel

ANNOTATIONS = ("anno_preview", "anno")
PROGRAM = "program/program_info"
OBJECTS = ("object_repair", "object_raw", "object_preview")  # repaired, as scanned, an older name of the scanned ones
TREE = "object_affordance/object_part_tree.json"
FRAME = WorldFrame(None, "unknown", "the world of the motion capture, right-handed, metres, axes not documented")
GRAVITY_NOTE = "OakInk2 does not say which way is up; converters of others take y for up"
HAND_NOTE = (
    "MANO: absolute quaternions w x y z, betas per frame, the translation is the wrist (manotorch, center_idx 0)"
)
CONVENTION = HandConvention(
    translation="wrist", fingers="absolute", shape="betas per frame", left_shape="as released", note=HAND_NOTE
)
PARTS = (
    DatasetPart("motion of hands and objects", tuple(f"{name}/*.pkl" for name in ANNOTATIONS), "anno_preview"),
    DatasetPart(
        "object meshes",
        tuple(f"{name}/align_ds/*/*.{suffix}" for name in OBJECTS for suffix in ("obj", "ply")),
        "object_repair.tar, or object_raw.tar",
    ),
    DatasetPart("names of objects", tuple(f"{name}/obj_desc.json" for name in OBJECTS), "object_repair.tar"),
    DatasetPart("parts of objects", (TREE,), "object_affordance.tar", optional=True),
)
PROGRAMS = DatasetPart("programs", (f"{PROGRAM}/*.json",), "program.tar", unneeded_with="clips=segments")


class SceneObject(NamedTuple):
    """A part, or two parts joined by a hinge."""

    track: ObjectTrack  # short gaps are interpolated
    tracked: np.ndarray  # (frame,) bool: the source has a pose
    words: str | None  # None if it has no name
    note: str = ""  # residuals of the hinge
    rejected_frames: tuple[Quarantined, ...] = ()


@dataclass(frozen=True)
class Oakink2Adapter(AdapterBase):
    """Raw root: ``anno_preview``, ``program``, ``object_repair`` (or ``object_raw``), ``object_affordance``.

    Recordings are named as in the source, with ``/`` for ``++``. A described clip is a primitive of the program.
    Without a program, each named object gives clips, without other objects.
    """

    facts = facts_of_adapter(__file__)
    margin_frames: int = 0  # at 30 fps: frames kept before and after each primitive
    shortest_frames: int = 20  # at 30 fps: shorter primitives give no clip
    # Frames in which two parts are farther off their hinge are excluded. Parts that exceed a limit in more than 5 % of
    # the frames are not joined.
    most_off_mm: int = 20
    most_off_deg: int = 10
    clips: ClipSource = "described"
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION

    @property
    def parts(self) -> tuple[DatasetPart, ...]:
        """Files of a complete raw folder. Programs are required for the setting ``clips: described`` only."""
        return (*PARTS, replace(PROGRAMS, optional=self.clips != "described"))

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per annotation. The subject is the suffix of the scene's name, ``A001`` of ``scene_01__A001``."""
        tokens = {path.stem for folder in ANNOTATIONS for path in Path(root).glob(f"{folder}/*.pkl")}
        names = [token.replace("++", "/") for token in tokens]
        return sorted(SequenceKey(self.name, name.partition("/")[0].rpartition("__")[2], name) for name in names)

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """Clips of one recording, and reasons for unusable primitives and frames."""
        token = key.name.replace("/", "++")
        paths = [f"{folder}/{token}.pkl" for folder in ANNOTATIONS]
        path = next((candidate for candidate in paths if raw.has(candidate)), paths[0])
        annotation = read_annotation(raw.read(path), path)
        program_path = f"{PROGRAM}/{token}.json"
        has_program = has_description(self.clips, raw, program_path)
        names, roots = object_names(raw)
        limits = self.most_off_mm, self.most_off_deg
        scene = Scene(raw, str(key), path, annotation, names=names, roots=roots, limits=limits)
        tracks = {side: to_track(hand, CONVENTION, hands[side]) for side, hand in annotation.hands.items()}
        results = list[Clip | Quarantined]()
        if has_program:
            program = read_program(raw.read(program_path, MAX_JSON_BYTES), program_path)
            actions = [(segment, scene.objects_of(segment.objects)) for segment in program]
        else:
            actions = [(_whole(annotation, item), [item]) for item in scene.objects_of(list(annotation.parts))]
        described_in = program_path if has_program else path
        for segment, objects in actions:
            if reason := _unusable_reason(segment, objects):
                problem = BadInput(described_in, *reason, "nothing to do")
                results.append(Quarantined.from_error(f"{key}/{segment.name}", problem))
                continue
            whole = self.new_clip(
                key,
                clip_id=f"{key}/{segment.name}",
                hands=tracks,
                object=objects[0].track,
                source_frames=annotation.frames.astype(np.int32),
                gravity=None,
                verb=segment.verb,
                object_words=str(objects[0].words),
                labelled_hand=segment.hand,
                other_objects=tuple(other.track for other in objects[1:]),
                gravity_note="; ".join([GRAVITY_NOTE, *(item.note for item in objects if item.note)]),
            )
            clips = self._cut(whole, described_in, segment.span, objects)
            results += clips if has_program or self.clips == "whole" else segment_clips(clips, hands)
        results += scene.rejected_frames
        return [replace(item, sources=raw.sources) if isinstance(item, Clip) else item for item in results]

    def _cut(
        self, whole: Clip, described_in: str, span: Range, objects: list[SceneObject]
    ) -> Iterator[Clip | Quarantined]:
        """One clip per interval of a primitive in which all its objects have poses. span: frames at 120 Hz."""
        frames, margin = whole.source_frames, self.margin_frames * STEP
        inside = (frames >= span[0] - margin) & (frames < span[1] + margin)
        all_have_pose = np.logical_and.reduce([has_pose(item.tracked) for item in objects])
        recorded = np.logical_and.reduce([item.tracked for item in objects])
        intervals = [trim_to_recorded(piece, recorded) for piece in runs(inside & all_have_pose)]
        for scene_object in objects:
            name, tracked = scene_object.track.model.name, scene_object.tracked[inside]
            yield from missing_poses(f"{whole.clip_id}/missing {name}", described_in, name, frames[inside], tracked)
        accepted = [piece for piece in intervals if piece.stop - piece.start >= self.shortest_frames]
        if not accepted:
            got = f"{max((b - a for a, b in intervals), default=0)} in mocap frames {span[0]} to {span[1] - 1}"
            expected = f"{self.shortest_frames} frames (at 30 per second) with the objects"
            remedy = "nothing to do, or lower shortest_frames"
            yield Quarantined(whole.clip_id, where=described_in, expected=expected, got=got, remedy=remedy)
        for start, stop in accepted:
            suffix = "" if len(accepted) == 1 else f"/{frames[start]:06d}"
            clip = replace(whole.take(slice(start, stop)), clip_id=f"{whole.clip_id}{suffix}")
            yield replace(clip, source_frames=mark_interpolated(frames[start:stop], recorded[start:stop]))


def _whole(annotation: Annotation, item: SceneObject) -> Segment:
    """An object over the whole recording."""
    span = int(annotation.frames[0]), int(annotation.frames[-1]) + 1
    return Segment(left=span, right=span, primitive=None, objects=(item.track.model.name,))


def _unusable_reason(segment: Segment, objects: list[SceneObject]) -> tuple[str, str] | None:
    """Expected and actual, if a primitive cannot be a clip; else None."""
    if segment.primitive is not None and segment.verb is None:
        return "a primitive with a name", repr(segment.primitive)[:40]
    if not objects:
        return "poses of an object of the primitive", f"none of {', '.join(segment.objects) or 'no objects'}"[:80]
    if objects[0].words is None:
        return "a name of the object in obj_desc.json", f"none of {objects[0].track.model.name}"
    return None


def object_names(raw: RawTree) -> tuple[dict[str, str], dict[str, str]]:
    """Names by id, and the root object by part id."""
    paths = [f"{folder}/obj_desc.json" for folder in OBJECTS]
    path = next((candidate for candidate in paths if raw.has(candidate)), paths[0])
    roots = read_roots(raw.read(TREE, MAX_JSON_BYTES), TREE) if raw.has(TREE) else {}
    return read_names(raw.read(path, MAX_JSON_BYTES), path), roots


@dataclass
class Scene:
    """The objects of a recording, each created when a primitive first names it."""

    raw: RawTree
    key: str
    path: str
    annotation: Annotation
    names: Mapping[str, str]
    roots: Mapping[str, str]
    limits: tuple[int, int]  # most millimetres and degrees that parts are off their hinge
    _objects: dict[str, SceneObject] = field(default_factory=dict)

    @property
    def rejected_frames(self) -> list[Quarantined]:
        """Reasons for frames in which parts are too far off their hinge, for the objects created so far."""
        return [reason for item in _unique(list(self._objects.values())) for reason in item.rejected_frames]

    def objects_of(self, parts: Sequence[str]) -> list[SceneObject]:
        """The objects of some parts, each once, in the order of the parts. Parts without poses are skipped."""
        return _unique([self.object_of(name) for name in parts if name in self.annotation.parts])

    def object_of(self, name: str) -> SceneObject:
        """The object of a part: two parts joined by a hinge, or the part alone."""
        if name not in self._objects:
            root = self.roots.get(name, name)
            same = [part for part in self.annotation.parts if self.roots.get(part, part) == root]
            pair = same if len(same) == 2 else [name]
            joined = self._hinged(root, pair) if len(pair) == 2 else None
            self._objects |= dict.fromkeys(pair, joined) if joined else {part: self._part(part) for part in pair}
        return self._objects[name]

    def _mesh(self, name: str) -> Mesh:
        """Read the only mesh in the folder of a part."""
        folders = [f"{folder}/align_ds/{name}" for folder in OBJECTS]
        meshes = [[n for n in self.raw.names(folder) if n.lower().endswith((".obj", ".ply"))] for folder in folders]
        folder, names = next((pair for pair in zip(folders, meshes, strict=True) if pair[1]), (folders[0], []))
        if len(names) != 1:
            got = ", ".join(names) or "none"
            raise BadInput(folder, "one mesh, OBJ or PLY", got, "unpack object_repair.tar or object_raw.tar here")
        return raw_mesh(self.raw, f"{folder}/{names[0]}")

    def _words(self, *ids: str) -> str | None:
        return next((noun_of(self.names[name]) for name in ids if self.names.get(name, "").strip(" _")), None)

    def _part(self, name: str) -> SceneObject:
        mesh, poses = self._mesh(name), self.annotation.parts[name]
        model = ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), np.uint8))
        track = bridge(_track(model, poses.world_from_part), poses.tracked)
        return SceneObject(track, poses.tracked, self._words(name))

    def _hinged(self, root: str, pair: list[str]) -> SceneObject | None:
        """Join two parts by a hinge. The part with the larger surface is the base. None if no hinge fits.

        The pose at rest is that of the meshes, which share a frame. If no hinge fits it, the first frame is the pose at
        rest.
        """
        meshes = {name: self._mesh(name) for name in pair}
        base, moving = sorted(pair, key=lambda name: (-_surface_m2(meshes[name]), name))
        tracked = self.annotation.parts[base].tracked & self.annotation.parts[moving].tracked
        if tracked.sum() < 2:
            return None
        poses = [self.annotation.parts[name].world_from_part[tracked] for name in (base, moving)]
        relative = np.linalg.inv(poses[0]) @ poses[1]
        base_vertices, faces = meshes[base].vertices, [meshes[name].faces for name in (base, moving)]
        for rest in (np.eye(4), relative[0]):
            moving_vertices = meshes[moving].vertices @ rest[:3, :3].T + rest[:3, 3]
            corners = box_corners(base_vertices), box_corners(moving_vertices)
            hinge_fit = hinge_between(poses[0], relative @ np.linalg.inv(rest), corners, *self.limits)
            if hinge_fit is not None:
                model = hinged_model(root, [base_vertices, moving_vertices], faces, hinge_fit[0])
                return self._joined(model, hinge_fit[1], tracked, self._words(root, base))
        return None

    def _joined(self, model: ObjectModel, fit: HingeFit, tracked: np.ndarray, words: str | None) -> SceneObject:
        frames = np.flatnonzero(tracked)
        exceeds, used_frames = fit.exceeds(*self.limits), tracked.copy()
        used_frames[frames[exceeds]] = False
        reason_key = f"{self.key}/hinge of {model.name}"
        rejected_frames: tuple[Quarantined, ...] = ()
        if exceeds.any():
            source_frames = self.annotation.frames[frames]
            rejected_frames = (fit.rejected_frames_reason(reason_key, self.path, source_frames, *self.limits),)
        # Frames in which a part is untracked repeat the previous pose, until short gaps are interpolated.
        last_tracked = np.clip(np.searchsorted(frames, np.arange(len(tracked)), side="right") - 1, 0, None)
        track = _track(model, fit.world_from_object[last_tracked], fit.hinge_rad[last_tracked])
        note = f"{model.name}: {fit.note}"
        return SceneObject(bridge(track, used_frames), used_frames, words, note, rejected_frames=rejected_frames)


def _surface_m2(mesh: Mesh) -> float:
    first, second, third = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(second - first, third - first), axis=1).sum() / 2)


def _unique(objects: Sequence[SceneObject]) -> list[SceneObject]:
    return list({id(item): item for item in objects}.values())


def _track(model: ObjectModel, poses: np.ndarray, hinge_rad: np.ndarray | None = None) -> ObjectTrack:
    angle = None if hinge_rad is None else hinge_rad.astype(np.float32)
    rotvec, position = rotmat_to_rotvec(poses[:, :3, :3]), poses[:, :3, 3]
    return ObjectTrack(model, rotvec.astype(np.float32), position.astype(np.float32), angle)
