"""Writing a store: clips stream in, at most one shard of them is in memory, equal clips give equal bytes."""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pyarrow as pa
import pyarrow.parquet as pq

from hoidata.errors import BadInput
from hoidata.files import atomic_folder, canonical_json, sha256_bytes
from hoidata.files.arrays import write_npz
from hoidata.objects.model import ObjectModel
from hoidata.schema.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, SourceFile
from hoidata.schema.quarantine import Quarantined
from hoidata.schema.validation import check_clip

SCHEMA_VERSION = "1.0.0"
FRAMES_PER_SHARD = 65536
UNITS = {"length": "metre", "angle": "radian", "time": "second"}
AXES = {
    "source_frames": ["frame"],
    "<side>_wrist_m": ["frame", "xyz"],
    "<side>_global_orient": ["frame", "axis-angle"],
    "<side>_hand_pose": ["frame", "joint x axis-angle"],
    "<side>_valid": ["frame"],
    "<side>_betas": ["betas row", "component"],
    "object_rotvec": ["frame", "axis-angle"],
    "object_translation_m": ["frame", "xyz"],
    "object_hinge_rad": ["frame"],
    "other_rotvec": ["other object x frame", "axis-angle"],
    "other_translation_m": ["other object x frame", "xyz"],
    "other_hinge_rad": ["other object x frame"],
}

_TEXT, _LIST = pa.string(), pa.list_
SEQUENCES = pa.schema(
    [
        *((name, _TEXT) for name in ("clip_id", "dataset", "subject", "sequence", "verb", "object_words")),
        ("labelled_hand", _TEXT),
        ("object", _TEXT),
        ("other_objects", _LIST(_TEXT)),
        ("n_frames", pa.int32()),
        ("shard", pa.int32()),
        ("first_row", pa.int64()),
        ("articulated", pa.bool_()),
        *((f"{side}_betas_row", pa.int64()) for side in SIDES),
        *((f"{side}_betas_count", pa.int32()) for side in SIDES),
        *((f"{side}_template", _TEXT) for side in SIDES),
        *((f"{side}_valid_frames", pa.int32()) for side in SIDES),
        ("other_row", pa.int64()),
        ("gravity", _LIST(pa.float64())),
        ("source_from_world", _LIST(pa.float64())),
        ("source_fps", pa.float64()),
        ("first_source_frame", pa.int32()),
        ("last_source_frame", pa.int32()),
        ("source_files", _LIST(pa.int32())),
        ("synthetic", pa.bool_()),
    ]
)
OBJECTS = pa.schema(
    [
        ("object", _TEXT),
        ("n_vertices", pa.int32()),
        ("n_faces", pa.int32()),
        ("articulated", pa.bool_()),
        ("hinge_axis", _LIST(pa.float64())),
        ("hinge_origin_m", _LIST(pa.float64())),
        ("digest", _TEXT),
    ]
)
FILES = pa.schema([("path", _TEXT), ("size", pa.int64()), ("sha256", _TEXT)])
QUARANTINE = pa.schema([(name, _TEXT) for name in ("source_key", "where", "expected", "got", "remedy")])


def write_store(folder: str | Path, clips: Iterable[Clip | Quarantined], info: dict[str, Any]) -> dict[str, int]:
    """Write clips, in the order given, as the store ``folder``; it appears whole or not at all.

    info: JSON values added to ``meta/info.json`` (dataset, synthetic, hand_model, licence, frame, ...).
    Returns the counts: clips, frames, objects, files, quarantined. Raises BadInput for a clip that breaks the schema,
    an id given twice, or two different objects of one name.
    """
    with atomic_folder(folder) as part:
        (part / "meta").mkdir()
        (part / "arrays").mkdir()
        writer = _Writer(part)
        for item in clips:
            if isinstance(item, Quarantined):
                writer.quarantined.append(vars(item))
            else:
                writer.add(check_clip(item))
        return writer.finish(info)


class _Writer:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows: list[dict[str, Any]] = []
        self.quarantined: list[dict[str, Any]] = []
        self.objects: dict[str, dict[str, Any]] = {}
        self.object_arrays: dict[str, np.ndarray] = {}
        self.templates: dict[str, np.ndarray] = {}
        self.files: dict[SourceFile, int] = {}
        self.ids: set[str] = set()
        self.shard = 0
        self._start_shard()

    def _start_shard(self) -> None:
        self.arrays: dict[str, list[np.ndarray]] = defaultdict(list)
        self.lengths: dict[str, int] = defaultdict(int)
        for name, array in _empty_arrays().items():
            self.arrays[name].append(array)

    def _append(self, name: str, array: np.ndarray) -> int:
        """Add rows to one array of the shard; the row they start at."""
        first = self.lengths[name]
        self.arrays[name].append(array)
        self.lengths[name] += len(array)
        return first

    def add(self, clip: Clip) -> None:
        if clip.clip_id in self.ids:
            raise BadInput(clip.clip_id, "an id of its own for every clip", "the same id twice", "rename the sequence")
        self.ids.add(clip.clip_id)
        row = self._facts(clip)
        row["first_row"] = self._append("source_frames", clip.source_frames.astype(np.int32))
        for side in SIDES:
            row |= self._add_hand(side, clip.hands[side])
        self._add_pose("object", clip.object)
        row["other_row"] = self.lengths["other_rotvec"]
        for track in clip.other_objects:
            self._add_pose("other", track)
        self.rows.append(row)
        if self.lengths["source_frames"] >= FRAMES_PER_SHARD:
            self._flush()

    def _facts(self, clip: Clip) -> dict[str, Any]:
        names = ("clip_id", "dataset", "subject", "sequence", "verb", "object_words", "labelled_hand")
        return {name: getattr(clip, name) for name in (*names, "n_frames", "source_fps", "synthetic")} | {
            "shard": self.shard,
            "object": self._add_object(clip.object.model),
            "other_objects": [self._add_object(track.model) for track in clip.other_objects],
            "articulated": clip.object.is_articulated,
            "gravity": None if clip.gravity is None else clip.gravity.tolist(),
            "source_from_world": clip.source_from_world.ravel().tolist(),
            "first_source_frame": int(clip.source_frames[0]),
            "last_source_frame": int(clip.source_frames[-1]),
            "source_files": [self.files.setdefault(source, len(self.files)) for source in clip.sources],
        }

    def _add_hand(self, side: str, track: HandTrack) -> dict[str, Any]:
        for name in ("wrist_m", "global_orient", "hand_pose"):
            self._append(f"{side}_{name}", getattr(track, name).astype(np.float32))
        self._append(f"{side}_valid", track.valid)
        return {
            f"{side}_betas_row": self._append(f"{side}_betas", track.betas.astype(np.float32)),
            f"{side}_betas_count": len(track.betas),
            f"{side}_template": self._add_template(track.template_m),
            f"{side}_valid_frames": int(track.valid.sum()),
        }

    def _add_template(self, template_m: np.ndarray | None) -> str | None:
        if template_m is None:
            return None
        template_m = np.ascontiguousarray(template_m, dtype=np.float32)
        key = sha256_bytes(template_m.tobytes())[:16]
        self.templates[key] = template_m
        return key

    def _add_pose(self, prefix: str, track: ObjectTrack) -> None:
        self._append(f"{prefix}_rotvec", track.rotvec.astype(np.float32))
        self._append(f"{prefix}_translation_m", track.translation_m.astype(np.float32))
        hinge = np.zeros(track.n_frames) if track.hinge_rad is None else track.hinge_rad
        self._append(f"{prefix}_hinge_rad", hinge.astype(np.float32))

    def _add_object(self, model: ObjectModel) -> str:
        arrays, digest = _object_arrays(model)
        known = self.objects.get(model.name)
        if known is not None and known["digest"] != digest:
            remedy = "give each mesh a name of its own"
            raise BadInput(f"object {model.name}", "one mesh under one name", "two different ones", remedy)
        if known is None:
            hinge = model.hinge
            self.object_arrays |= arrays
            self.objects[model.name] = {
                "object": model.name,
                "n_vertices": len(model.vertices_m),
                "n_faces": len(model.faces),
                "articulated": hinge is not None,
                "hinge_axis": None if hinge is None else hinge.axis.tolist(),
                "hinge_origin_m": None if hinge is None else hinge.origin_m.tolist(),
                "digest": digest,
            }
        return model.name

    def _flush(self) -> None:
        arrays = {name: np.concatenate(parts) for name, parts in self.arrays.items()}
        write_npz(self.folder / "arrays" / f"frames-{self.shard:05d}.npz", arrays)
        self.shard += 1
        self._start_shard()

    def finish(self, info: dict[str, Any]) -> dict[str, int]:
        if self.lengths["source_frames"] or not self.rows:
            self._flush()
        write_npz(self.folder / "arrays" / "objects.npz", dict(sorted(self.object_arrays.items())))
        write_npz(self.folder / "arrays" / "templates.npz", dict(sorted(self.templates.items())))
        files = [{"path": item.path, "size": item.size, "sha256": item.sha256} for item in self.files]
        self._write_table("sequences", self.rows, SEQUENCES)
        self._write_table("objects", [self.objects[name] for name in sorted(self.objects)], OBJECTS)
        self._write_table("files", files, FILES)
        self._write_table("quarantine", self.quarantined, QUARANTINE)
        counts = {
            "clips": len(self.rows),
            "frames": sum(row["n_frames"] for row in self.rows),
            "objects": len(self.objects),
            "files": len(files),
            "quarantined": len(self.quarantined),
        }
        facts = {"schema_version": SCHEMA_VERSION, "fps": FPS, "units": UNITS, "axes": AXES, "counts": counts, **info}
        text = orjson.dumps(orjson.loads(canonical_json(facts)), option=orjson.OPT_INDENT_2 | orjson.OPT_SORT_KEYS)
        (self.folder / "meta" / "info.json").write_bytes(text + b"\n")
        return counts

    def _write_table(self, name: str, rows: list[dict[str, Any]], schema: pa.Schema) -> None:
        pq.write_table(pa.Table.from_pylist(rows, schema), self.folder / "meta" / f"{name}.parquet", compression="zstd")


def _object_arrays(model: ObjectModel) -> tuple[dict[str, np.ndarray], str]:
    arrays = {
        f"{model.name}/vertices_m": np.ascontiguousarray(model.vertices_m, dtype=np.float64),
        f"{model.name}/faces": np.ascontiguousarray(model.faces, dtype=np.int32),
        f"{model.name}/part": np.ascontiguousarray(model.part, dtype=np.uint8),
    }
    hinge = (
        () if model.hinge is None else (model.hinge.axis.astype(np.float64), model.hinge.origin_m.astype(np.float64))
    )
    return arrays, sha256_bytes(b"".join(array.tobytes() for array in (*arrays.values(), *map(np.float64, hinge))))


def _empty_arrays() -> dict[str, np.ndarray]:
    """Arrays without rows, so that every shard has every member, in one order."""
    arrays: dict[str, np.ndarray] = {"source_frames": np.zeros(0, np.int32)}
    for side in SIDES:
        arrays |= {f"{side}_{name}": np.zeros((0, 3), np.float32) for name in ("wrist_m", "global_orient")}
        arrays[f"{side}_hand_pose"] = np.zeros((0, 45), np.float32)
        arrays[f"{side}_valid"] = np.zeros(0, bool)
        arrays[f"{side}_betas"] = np.zeros((0, 10), np.float32)
    for prefix in ("object", "other"):
        arrays |= {f"{prefix}_{name}": np.zeros((0, 3), np.float32) for name in ("rotvec", "translation_m")}
        arrays[f"{prefix}_hinge_rad"] = np.zeros(0, np.float32)
    return arrays
