"""OakInk2 (Zhan et al. 2024): motion capture of both hands and of every part of every object, 120 frames a second.

A recording is a long task; its program names the primitives in it, with a range of frames for each hand. Each becomes
a clip of the frames of both ranges. The object of a clip is the first one the leading hand is said to have to do with,
the others the program names are its other objects. Parts are tracked one by one: two parts of one object whose motion
is a turn about one axis are joined by that hinge, all others stay objects of their own.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hoidata.clips.clip import SIDES, Clip, HandTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import HandConvention, to_track
from hoidata.dataset_folders import facts_beside
from hoidata.datasets.base import DatasetPart, Described, Quarantined, RawTree, SequenceKey
from hoidata.datasets.gaps import has_pose, missing_poses, numbered, trimmed
from hoidata.datasets.oakink2.files import LARGEST_JSON_BYTES, STEP, Range, Segment, read_annotation, read_program
from hoidata.datasets.oakink2.scene import OBJECTS, TREE, Scene, Thing, object_names
from hoidata.datasets.oakink2.words import verb_of
from hoidata.geometry.intervals import runs
from hoidata.hands import HandPair

ANNOTATIONS = ("anno_preview", "anno")
PROGRAM = "program/program_info"
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
