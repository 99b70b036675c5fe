"""OakInk2 (Zhan et al. 2024): motion capture of both hands and of every part of every object, 120 frames a second.

A recording is a long task; its program names the primitives in it, with a range of frames for each hand. Each becomes
a clip of the frames of both ranges. The object of a clip is the first one the leading hand is said to have to do with,
the others the program names are its other objects. Parts are tracked one by one: two parts of one object whose motion
is a turn about one axis are joined by that hinge, all others stay objects of their own.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import HandConvention, to_track
from hoidata.dataset_folders import facts_beside
from hoidata.datasets.base import DatasetPart, Described, Quarantined, RawTree, SequenceKey
from hoidata.datasets.gaps import bridge, has_pose, missing_poses, numbered, trimmed
from hoidata.datasets.hinge import HingeFit, box_corners, hinge_between, hinged_model
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.datasets.oakink2.files import (
    LARGEST_JSON_BYTES,
    STEP,
    Annotation,
    Range,
    Segment,
    noun_of,
    read_annotation,
    read_names,
    read_program,
    read_roots,
    verb_of,
)
from hoidata.errors import BadInput
from hoidata.geometry.intervals import runs
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.objects.mesh import Mesh
from hoidata.objects.model import ObjectModel

ANNOTATIONS = ("anno_preview", "anno")
PROGRAM = "program/program_info"
OBJECTS = ("object_repair", "object_raw", "object_preview")  # repaired, as scanned, the older name of the latter
TREE = "object_affordance/object_part_tree.json"
FRAME = WorldFrame(None, "unknown", "the world of the motion capture, right-handed, metres, axes not documented")
GRAVITY_NOTE = "OakInk2 does not say which way is up; converters of others take y for up"
CONVENTION = HandConvention(
    translation="wrist",
    fingers="absolute",
    shape="betas per frame",
    left_shape="as released",
    note="MANO: absolute quaternions w x y z, betas per frame, the translation is the wrist (manotorch, center_idx 0)",
)
PARTS = (
    DatasetPart("motion of hands and objects", tuple(f"{name}/*.pkl" for name in ANNOTATIONS), "anno_preview"),
    DatasetPart("programs", (f"{PROGRAM}/*.json",), "program.tar"),
    DatasetPart(
        "object meshes",
        tuple(f"{name}/align_ds/*/*.{suffix}" for name in OBJECTS for suffix in ("obj", "ply")),
        "object_repair.tar, or object_raw.tar",
    ),
    DatasetPart("names of objects", tuple(f"{name}/obj_desc.json" for name in OBJECTS), "object_repair.tar"),
    DatasetPart("parts of objects", (TREE,), "object_affordance.tar", optional=True),
)


class Thing(NamedTuple):
    """A part, or two with a hinge, short gaps in its poses bridged. tracked: (frame,) bool, poses of the source.

    words: None where it has no name. note: how the parts keep to the hinge, or "".
    """

    track: ObjectTrack
    tracked: np.ndarray
    words: str | None
    note: str = ""
    left_out: tuple[Quarantined, ...] = ()


@dataclass(frozen=True)
class Oakink2Adapter(Described):
    """Raw root: ``anno_preview``, ``program``, ``object_repair`` (or ``object_raw``), ``object_affordance``.

    margin_frames: kept before and after each primitive; shortest_frames: shorter ones are no clips; both at 30 fps.
    most_off_mm, most_off_deg: frames in which two parts lie farther off their hinge are left out; parts farther off in
    more than 5 % of all frames have none. Recordings are named as the source writes them, with ``/`` for ``++``.
    """

    facts = facts_beside(__file__)
    margin_frames: int = 0
    shortest_frames: int = 20
    most_off_mm: int = 20
    most_off_deg: int = 10
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION
    parts: tuple[DatasetPart, ...] = PARTS

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per annotation; its subject is what ends the scene's name, ``A001`` of ``scene_01__A001``."""
        tokens = {path.stem for folder in ANNOTATIONS for path in Path(root).glob(f"{folder}/*.pkl")}
        names = [token.replace("++", "/") for token in tokens]
        return sorted(SequenceKey(self.name, name.partition("/")[0].rpartition("__")[2], name) for name in names)

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """Clips of one recording, and the primitives and frames that cannot be used, with their reasons."""
        token = key.name.replace("/", "++")
        paths = [f"{folder}/{token}.pkl" for folder in ANNOTATIONS]
        path = next((own for own in paths if raw.has(own)), paths[0])
        seen = read_annotation(raw.read(path), path)
        program = read_program(raw.read(where := f"{PROGRAM}/{token}.json", LARGEST_JSON_BYTES), where)
        scene = Scene(raw, str(key), path, seen, *object_names(raw), self.most_off_mm, self.most_off_deg)
        tracks: dict[Side, HandTrack] = {side: to_track(seen.hands[side], CONVENTION, hands[side]) for side in SIDES}
        results = list[Clip | Quarantined]()
        for segment in program:
            things = scene.things(segment.objects)
            reason = _reason(segment, things)
            if reason is not None:
                results.append(Quarantined(f"{key}/{segment.name}", where, *reason, "nothing to do"))
                continue
            whole = Clip(
                clip_id=f"{key}/{segment.name}",
                dataset=self.name,
                subject=key.subject,
                sequence=key.name,
                hands=tracks,
                object=things[0].track,
                source_frames=seen.frames.astype(np.int32),
                gravity=None,
                verb=verb_of(segment.primitive),
                object_words=str(things[0].words),
                labelled_hand=segment.hand,
                other_objects=tuple(thing.track for thing in things[1:]),
                source_fps=self.source_fps,
                gravity_note="; ".join([GRAVITY_NOTE, *(thing.note for thing in things if thing.note)]),
            )
            results += self._cut(whole, where, segment.span, things)
        results += scene.left_out
        return [replace(item, sources=raw.sources) if isinstance(item, Clip) else item for item in results]

    def _cut(self, whole: Clip, where: str, span: Range, things: list[Thing]) -> Iterator[Clip | Quarantined]:
        """The intervals of a primitive in which its objects have poses."""
        frames, margin = whole.source_frames, self.margin_frames * STEP
        inside = (frames >= span[0] - margin) & (frames < span[1] + margin)
        known, recorded = (np.logical_and.reduce([of(own.tracked) for own in things]) for of in (has_pose, np.asarray))
        found = [trimmed(piece, recorded) for piece in runs(inside & known)]
        for thing in things:
            name, tracked = thing.track.model.name, thing.tracked[inside]
            yield from missing_poses(f"{whole.clip_id}/missing {name}", where, name, frames[inside], tracked)
        long = [piece for piece in found if piece.stop - piece.start >= self.shortest_frames]
        if not long:
            got = f"{max((b - a for a, b in found), default=0)} in mocap frames {span[0]} to {span[1] - 1}"
            expected = f"{self.shortest_frames} frames (at 30 per second) with the objects"
            yield Quarantined(whole.clip_id, where, expected, got, "nothing to do, or lower shortest_frames")
        for start, stop in long:
            own = "" if len(long) == 1 else f"/{frames[start]:06d}"
            clip = replace(whole.take(slice(start, stop)), clip_id=f"{whole.clip_id}{own}")
            yield replace(clip, source_frames=numbered(frames[start:stop], recorded[start:stop]))


def _reason(segment: Segment, things: list[Thing]) -> tuple[str, str] | None:
    """Expected and got, where a primitive cannot be a clip."""
    if verb_of(segment.primitive) is None:
        return "a primitive with a name", repr(segment.primitive)[:40]
    if not things:
        return "poses of an object of the primitive", f"none of {', '.join(segment.objects) or 'no objects'}"[:80]
    if things[0].words is None:
        return "a name of the object in obj_desc.json", f"none of {things[0].track.model.name}"
    return None


def object_names(raw: RawTree) -> tuple[dict[str, str], dict[str, str]]:
    """Names of objects, and the object each part belongs to."""
    paths = [f"{folder}/obj_desc.json" for folder in OBJECTS]
    path = next((own for own in paths if raw.has(own)), paths[0])
    roots = read_roots(raw.read(TREE, LARGEST_JSON_BYTES), TREE) if raw.has(TREE) else {}
    return read_names(raw.read(path, LARGEST_JSON_BYTES), path), roots


@dataclass
class Scene:
    """The objects of a recording, each made when a primitive first names it."""

    raw: RawTree
    key: str
    path: str
    seen: Annotation
    names: Mapping[str, str]
    roots: Mapping[str, str]
    most_off_mm: int
    most_off_deg: int
    _things: dict[str, Thing] = field(default_factory=dict)

    @property
    def left_out(self) -> list[Quarantined]:
        """Frames in which parts lie too far off their hinge, of the objects made so far."""
        return [reason for thing in _distinct(list(self._things.values())) for reason in thing.left_out]

    def things(self, parts: Sequence[str]) -> list[Thing]:
        """The objects some parts belong to, each once, in the order of the parts; none for parts without poses."""
        return _distinct([self.thing(name) for name in parts if name in self.seen.parts])

    def thing(self, name: str) -> Thing:
        """The object a part belongs to where it has a hinge, else the part alone."""
        if name not in self._things:
            root = self.roots.get(name, name)
            same = [part for part in self.seen.parts if self.roots.get(part, part) == root]
            pair = same if len(same) == 2 else [name]
            joined = self._hinged(root, pair) if len(pair) == 2 else None
            self._things |= dict.fromkeys(pair, joined) if joined else {part: self._part(part) for part in pair}
        return self._things[name]

    def _mesh(self, name: str) -> Mesh:
        """The one mesh in the folder of a part."""
        folders = [f"{folder}/align_ds/{name}" for folder in OBJECTS]
        found = {own: [n for n in self.raw.names(own) if n.lower().endswith((".obj", ".ply"))] for own in folders}
        folder = next((own for own in folders if found[own]), folders[0])
        if len(found[folder]) != 1:
            got = ", ".join(found[folder]) or "none"
            raise BadInput(folder, "one mesh, OBJ or PLY", got, "unpack object_repair.tar or object_raw.tar here")
        return raw_mesh(self.raw, f"{folder}/{found[folder][0]}")

    def _words(self, *ids: str) -> str | None:
        return next((noun_of(self.names[name]) for name in ids if self.names.get(name, "").strip(" _")), None)

    def _part(self, name: str) -> Thing:
        mesh, poses = self._mesh(name), self.seen.parts[name]
        model = ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), np.uint8))
        return Thing(bridge(_track(model, poses.world_from_part), poses.tracked), poses.tracked, self._words(name))

    def _hinged(self, root: str, pair: list[str]) -> Thing | None:
        """Two parts as one object, the one with the bigger surface as its base; None where no hinge fits them.

        At rest both lie as their meshes do, which share a frame; where that fits no hinge, as in the first frame.
        """
        meshes = {name: self._mesh(name) for name in pair}
        base, moving = sorted(pair, key=lambda name: (-_surface_m2(meshes[name]), name))
        tracked = self.seen.parts[base].tracked & self.seen.parts[moving].tracked
        if tracked.sum() < 2:
            return None
        poses = [self.seen.parts[name].world_from_part[tracked] for name in (base, moving)]
        relative = np.linalg.inv(poses[0]) @ poses[1]
        own, faces = meshes[base].vertices, [meshes[name].faces for name in (base, moving)]
        limits = (self.most_off_mm, self.most_off_deg)
        for rest in (np.eye(4), relative[0]):
            moved = meshes[moving].vertices @ rest[:3, :3].T + rest[:3, 3]
            corners = box_corners(own), box_corners(moved)
            found = hinge_between(poses[0], relative @ np.linalg.inv(rest), corners, *limits)
            if found is not None:
                model = hinged_model(root, [own, moved], faces, found[0])
                return self._joined(model, found[1], tracked, self._words(root, base))
        return None

    def _joined(self, model: ObjectModel, fit: HingeFit, tracked: np.ndarray, words: str | None) -> Thing:
        limits, frames = (self.most_off_mm, self.most_off_deg), np.flatnonzero(tracked)
        off, good = fit.off(*limits), tracked.copy()
        good[frames[off]] = False
        name = f"{self.key}/hinge of {model.name}"
        left_out = (fit.left_out(name, self.path, self.seen.frames[frames], *limits),) if off.any() else ()
        # Frames in which one of both is not tracked repeat the one before, until short gaps are bridged.
        source = np.clip(np.searchsorted(frames, np.arange(len(tracked)), side="right") - 1, 0, None)
        track = _track(model, fit.world_from_object[source], fit.hinge_rad[source])
        return Thing(bridge(track, good), good, words, f"{model.name}: {fit.note}", left_out)


def _surface_m2(mesh: Mesh) -> float:
    first, second, third = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(second - first, third - first), axis=1).sum() / 2)


def _distinct(things: Sequence[Thing]) -> list[Thing]:
    return list({id(thing): thing for thing in things}.values())


def _track(model: ObjectModel, poses: np.ndarray, hinge_rad: np.ndarray | None = None) -> ObjectTrack:
    angle = None if hinge_rad is None else hinge_rad.astype(np.float32)
    rotvec, place = rotmat_to_rotvec(poses[:, :3, :3]), poses[:, :3, 3]
    return ObjectTrack(model, rotvec.astype(np.float32), place.astype(np.float32), angle)
