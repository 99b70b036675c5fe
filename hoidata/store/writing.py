"""Writes a store from a stream of clips: at most one shard is in memory, and equal clips give equal bytes."""

import shutil
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from hoidata.clips.clip import (
    FPS,
    SIDES,
    BodyTrack,
    CameraTrack,
    Clip,
    HandTrack,
    ObjectTrack,
    SourceContact,
    SourceFile,
)
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.recording import HandRecording
from hoidata.clips.validation import check_clip
from hoidata.files import atomic_folder, canonical_json, sha256_bytes
from hoidata.files.arrays import write_npz
from hoidata.files.written import write_table
from hoidata.objects.model import ObjectModel
from hoidata.store.fields import (
    AXES,
    BODY,
    FRAMES,
    OBJECT_ARRAYS,
    RECORDINGS,
    SCHEMA_VERSION,
    SOURCE_CONTACT,
    SOURCE_HANDS,
    TABLES,
    UNITS,
    StoreFile,
    arrow_schema,
    empty_array,
)
from hoidata.store.info import check_info
from hoidata.store.mapped import map_npz
from hoidata.store.recordings import RecordingWriter

FRAMES_PER_SHARD = 65536
CONTACTS_PER_SHARD = 1 << 23  # 9 bytes each: GRAB's labels can be ten times the motion


class ShardWriter:
    """Collects the rows of one shard of ``frames-*``, ``body-*`` and ``source_contact-*`` files.

    At most one shard is in memory. A clip is never divided between shards.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.number = 0
        self._start()

    def _start(self) -> None:
        self.pieces = {file.path: {f.name: [empty_array(f)] for f in file.fields} for file in _SHARDED}
        self.lengths = {file.path: {field.name: 0 for field in file.fields} for file in _SHARDED}

    def append(self, file: StoreFile, name: str, array: np.ndarray) -> int:
        """Add rows to one member, in its dtype. Returns the number of the first added row."""
        pieces, lengths = self.pieces[file.path], self.lengths[file.path]
        pieces[name].append(np.array(array, pieces[name][0].dtype))
        lengths[name] += len(array)
        return lengths[name] - len(array)

    def append_all(self, file: StoreFile, arrays: dict[str, np.ndarray]) -> int:
        """Add equally many rows to several members. Returns the number of the first added row."""
        (first,) = {self.append(file, name, array) for name, array in arrays.items()}
        return first

    def rows(self, file: StoreFile, name: str) -> int:
        return self.lengths[file.path][name]

    def end_clip(self) -> None:
        """Write the shard if it is full."""
        full = self.rows(FRAMES, "source_frames") >= FRAMES_PER_SHARD
        if full or self.rows(SOURCE_CONTACT, "frame") >= CONTACTS_PER_SHARD:
            self._flush()

    def finish(self) -> None:
        """Write the last shard. A store has at least one shard."""
        if self.number == 0 or self.rows(FRAMES, "source_frames"):
            self._flush()

    def _flush(self) -> None:
        for file in _SHARDED:
            pieces = self.pieces.pop(file.path)
            if file is FRAMES or any(self.lengths[file.path].values()):
                arrays = {name: np.concatenate(pieces.pop(name)) for name in list(pieces)}
                write_npz(self.folder / file.path.replace("*", f"{self.number:05d}"), arrays)
        self.number += 1
        self._start()


_SHARDED = (FRAMES, BODY, SOURCE_CONTACT)

MeshKey = tuple[str, str]
_DIGITS = 8


class MeshWriter:
    """Collects the distinct meshes of a store by (name, digest); only their facts stay in memory.

    The key of a mesh in the store is its name. If several meshes share a name, each key is the name, ``#`` and the
    first 8 digits of the digest, so that keys do not depend on the order of the clips.
    """

    def __init__(self, folder: Path) -> None:
        self._temporary = folder / "meshes.part"
        self._facts: dict[MeshKey, dict[str, Any]] = {}

    def add(self, model: ObjectModel) -> MeshKey:
        arrays = mesh_arrays(model)
        key = model.name, mesh_digest(arrays, model)
        if key not in self._facts:
            write_npz(self._temporary / f"{len(self._facts)}.npz", arrays)
            hinge = model.hinge
            self._facts[key] = {
                "n_vertices": len(model.vertices_m),
                "n_faces": len(model.faces),
                "articulated": hinge is not None,
                "hinge_axis": None if hinge is None else hinge.axis.tolist(),
                "hinge_origin_m": None if hinge is None or hinge.is_prismatic else hinge.origin_m.tolist(),
                "digest": key[1],
            }
        return key

    def names(self) -> dict[MeshKey, str]:
        """Return the key in the store of each mesh added so far."""
        meshes_of = Counter(name for name, _ in self._facts)
        return {key: key[0] if meshes_of[key[0]] == 1 else f"{key[0]}#{key[1][:_DIGITS]}" for key in self._facts}

    def finish(self, path: Path) -> list[dict[str, Any]]:
        """Write the arrays of all meshes to ``path``. Returns the rows of objects.parquet."""
        names, members, rows = self.names(), {}, {}
        for number, (key, facts) in enumerate(self._facts.items()):
            name = names[key]
            rows[name] = {"object": name, **facts}
            members |= {f"{name}/{kind}": array for kind, array in map_npz(self._temporary / f"{number}.npz").items()}
        write_npz(path, dict(sorted(members.items())))
        shutil.rmtree(self._temporary, ignore_errors=True)
        return [rows[name] for name in sorted(rows)]


def mesh_arrays(model: ObjectModel) -> dict[str, np.ndarray]:
    """Return vertices_m, faces and part in the dtypes of the store."""
    return {f.name: np.ascontiguousarray(getattr(model, f.name), f.dtype) for f in OBJECT_ARRAYS.fields}


def mesh_digest(arrays: dict[str, np.ndarray], model: ObjectModel) -> str:
    """Return the SHA-256 of vertices_m, faces, part and, for articulated objects, ``Hinge.arrays`` (float64)."""
    hinge = () if model.hinge is None else model.hinge.arrays
    ordered = [arrays[field.name] for field in OBJECT_ARRAYS.fields]
    return sha256_bytes(b"".join(array.tobytes() for array in (*ordered, *map(np.float64, hinge))))


def write_store(
    folder: str | Path, clips: Iterable[Clip | HandRecording | Quarantined], info: dict[str, Any]
) -> dict[str, int]:
    """Write clips, in the order given, as the store ``folder``; it appears whole or not at all. Returns the counts.

    A clip with the id of an earlier clip is quarantined. info: the facts of ``hoidata.store.info.store_info``, and
    further keys for ``meta/info.json``. Raises BadInput if a clip breaks the schema, or ``info`` lacks a required fact.
    """
    check_info(info)
    with atomic_folder(folder) as partial:
        (partial / "meta").mkdir()
        (partial / "arrays").mkdir()
        writer = _Writer(partial)
        for item in clips:
            if isinstance(item, Quarantined):
                writer.quarantined.append(vars(item))
            elif isinstance(item, HandRecording):
                writer.add_recording(item)
            else:
                writer.add(check_clip(item))
        return writer.finish(info)


class _Writer:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.shards = ShardWriter(folder)
        self.meshes = MeshWriter(folder)
        self.recordings = RecordingWriter()
        self.rows: dict[str, dict[str, Any]] = {}
        self.quarantined: list[dict[str, Any]] = []
        self.templates: dict[str, np.ndarray] = {}
        self.files: dict[SourceFile, int] = {}

    def add(self, clip: Clip) -> None:
        if clip.clip_id in self.rows:
            self.quarantined.append(vars(_repeated_id(clip, self.rows[clip.clip_id])))
            return
        facts = self._facts(clip)
        facts["first_row"] = self.shards.append(FRAMES, "source_frames", clip.source_frames)
        for side in SIDES:
            facts |= self._add_hand(side, clip.hands[side])
        self._add_pose("object", clip.object)
        facts["other_row"] = self.shards.rows(FRAMES, "other_rotvec")
        for track in clip.other_objects:
            self._add_pose("other", track)
        facts |= self._add_camera(clip.camera) | self._add_body(clip.body) | self._add_contact(clip.source_contact)
        self.rows[clip.clip_id] = facts
        self.shards.end_clip()

    def _facts(self, clip: Clip) -> dict[str, Any]:
        names = ("clip_id", "dataset", "subject", "sequence", "verb", "object_words", "labelled_hand", "n_frames")
        optional = ("source_fps", "synthetic", "gravity_note", "hands_from", "fit_error_m")
        return {name: getattr(clip, name) for name in (*names, *optional)} | {
            "shard": self.shards.number,
            "object": self.meshes.add(clip.object.model),
            "other_objects": [self.meshes.add(track.model) for track in clip.other_objects],
            "articulated": clip.object.is_articulated,
            "gravity": None if clip.gravity is None else clip.gravity.tolist(),
            "source_from_world": clip.source_from_world.ravel().tolist(),
            "first_source_frame": int(clip.source_frames[0]),
            "last_source_frame": int(clip.source_frames[-1]),
            "source_files": self._numbers(clip.sources),
        }

    def add_recording(self, recording: HandRecording) -> None:
        model = self.meshes.add(recording.object.model)
        self.recordings.add(recording, model, self._numbers(recording.sources))

    def _numbers(self, sources: tuple[SourceFile, ...]) -> list[int]:
        return [self.files.setdefault(source, len(self.files)) for source in sources]

    def _add_hand(self, side: str, track: HandTrack) -> dict[str, Any]:
        names = ("wrist_m", "global_orient", "hand_pose", "valid")
        self.shards.append_all(FRAMES, {f"{side}_{name}": getattr(track, name) for name in names})
        return {
            f"{side}_betas_row": self.shards.append(FRAMES, f"{side}_betas", track.betas),
            f"{side}_betas_count": len(track.betas),
            f"{side}_template": self._add_template(track.template_m),
            f"{side}_valid_frames": int(track.valid.sum()),
        }

    def _add_template(self, template_m: np.ndarray | None) -> str | None:
        if template_m is None:
            return None
        template_m = np.ascontiguousarray(template_m, dtype=np.float32)
        key = template_key(template_m)
        self.templates[key] = template_m
        return key

    def _add_pose(self, prefix: str, track: ObjectTrack) -> None:
        hinge = np.zeros(track.n_frames) if track.hinge_rad is None else track.hinge_rad
        arrays = {"rotvec": track.rotvec, "translation_m": track.translation_m, "hinge_rad": hinge}
        self.shards.append_all(FRAMES, {f"{prefix}_{name}": array for name, array in arrays.items()})

    def _add_camera(self, track: CameraTrack | None) -> dict[str, Any]:
        if track is None:
            return {"camera_name": None, "camera_intrinsics": None, "camera_row": -1}
        arrays = {f"camera_{name}": getattr(track, name) for name in ("rotvec", "position_m", "images")}
        return {
            "camera_name": track.name,
            "camera_intrinsics": None if track.intrinsics is None else track.intrinsics.tolist(),
            "camera_row": self.shards.append_all(FRAMES, arrays),
        }

    def _add_body(self, track: BodyTrack | None) -> dict[str, Any]:
        if track is None:
            return {"body_row": -1, "expression_row": -1}
        names = ("transl_m", "global_orient", "body_pose", "face_pose")
        expression = track.expression
        return {
            "body_row": self.shards.append_all(BODY, {name: getattr(track, name) for name in names}),
            "expression_row": -1 if expression is None else self.shards.append(BODY, "expression", expression),
        }

    def _add_contact(self, contact: SourceContact | None) -> dict[str, Any]:
        if contact is None:
            return {"source_contact_row": -1, "source_contact_count": 0}
        first_row = self.shards.append_all(SOURCE_CONTACT, vars(contact))
        return {"source_contact_row": first_row, "source_contact_count": len(contact.frame)}

    def finish(self, info: dict[str, Any]) -> dict[str, int]:
        self.shards.finish()
        names = self.meshes.names()
        for clip in self.rows.values():
            clip |= {"object": names[clip["object"]], "other_objects": [names[key] for key in clip["other_objects"]]}
        rows = list(self.rows.values())
        objects = self.meshes.finish(self.folder / "arrays" / "objects.npz")
        write_npz(self.folder / "arrays" / "templates.npz", dict(sorted(self.templates.items())))
        files = [vars(item) for item in self.files]
        tables = {"sequences": rows, "objects": objects, "files": files, "quarantine": self.quarantined}
        for name, table in tables.items():
            write_table(self.folder / TABLES[name].path, table, arrow_schema(TABLES[name]))
        counts = {
            "clips": len(rows),
            "frames": sum(clip["n_frames"] for clip in rows),
            "objects": len(objects),
            "files": len(files),
            "quarantined": len(self.quarantined),
        }
        recordings = self._write_recordings(names)
        written = {"schema_version": SCHEMA_VERSION, "fps": FPS, "units": UNITS, "axes": AXES, "counts": counts}
        facts = orjson.loads(canonical_json(info | written | recordings))
        text = orjson.dumps(facts, option=orjson.OPT_INDENT_2 | orjson.OPT_SORT_KEYS)
        (self.folder / "meta" / "info.json").write_bytes(text + b"\n")
        return counts

    def _write_recordings(self, object_names: dict[MeshKey, str]) -> dict[str, Any]:
        """Write the recordings, if any. Returns their entries for info.json."""
        recordings = self.recordings
        if not recordings.facts:
            return {}
        write_npz(self.folder / RECORDINGS.path, dict(sorted(recordings.arrays.items())))
        write_npz(self.folder / SOURCE_HANDS.path, dict(sorted(recordings.hands.items())))
        facts = {name: {**fact, "object": object_names[fact["object"]]} for name, fact in recordings.facts.items()}
        return {"recordings": facts, "source_hands": recordings.hand_facts}


def template_key(template_m: np.ndarray) -> str:
    """Return the name in templates.npz of a personal rest mesh (778, 3) float32."""
    return sha256_bytes(np.ascontiguousarray(template_m).tobytes())[:16]


def _repeated_id(clip: Clip, first: dict[str, Any]) -> Quarantined:
    frames = f"{first['first_source_frame']} to {first['last_source_frame']} of {first['sequence']}"
    got = f"a second one, frames {clip.source_frames[0]} to {clip.source_frames[-1]} of {clip.sequence}"
    remedy = "the first was kept; rename the sequence, or report it as a defect of the adapter"
    expected = f"one clip of this id (frames {frames})"
    return Quarantined(source_key=clip.clip_id, where="clip_id", expected=expected, got=got, remedy=remedy)
