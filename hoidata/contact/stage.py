"""Stage contact: sampled points of each object, touched points and joint-point distances of each clip.

``hoidata.store.annotated`` describes the output folder.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from hoidata.clips import SIDES, Side
from hoidata.contact.maps import distance_entries, touched_frames
from hoidata.contact.proximity import ENTRY, ProximityIndex
from hoidata.contact.settings import ContactSettings
from hoidata.files import atomic_folder, canonical_json
from hoidata.files.arrays import write_npz
from hoidata.files.written import write_table
from hoidata.hands import HandPair
from hoidata.objects.sampling import SampledPoints, sample_points
from hoidata.store.store import Store, open_store
from hoidata.workers import in_order, map_in_workers

ENTRIES_PER_SHARD = 1 << 23
# Below this a second process costs more to start than it saves.
FRAMES_PER_JOB = 50_000
POINT_SHAPES = {
    "points_m": ((3,), np.float32),
    "normals": ((3,), np.float32),
    "face": ((), np.int32),
    "barycentric": ((3,), np.float32),
    "part": ((), np.uint8),
}
OBJECTS = pa.schema([("object", pa.string()), ("row", pa.int32()), ("method", pa.string())])
CLIPS = pa.schema(
    [
        ("clip_id", pa.string()),
        ("row", pa.int32()),
        ("shard", pa.int32()),
        *((f"{side}_{end}", pa.int64()) for side in SIDES for end in ("start", "stop")),
    ]
)


def contact_store(
    clips_folder: str | Path,
    out_folder: str | Path,
    settings: ContactSettings | None = None,
    *,
    hands: HandPair | None = None,
    jobs: int = 1,
    **changes: Any,
) -> dict[str, int]:
    """Write contact and distance maps of each clip of the store; the folder appears whole or not at all.

    Args:
        hands: as in ``open_store``.
        jobs: maximum number of worker processes; the result does not depend on it.
        changes: fields that replace those of ``settings``.

    Returns counts: clips, objects, entries, clips_without_contact.
    """
    settings = replace(settings or ContactSettings(), **changes)
    store, points = open_store(clips_folder, hands), settings.points
    sampled = sample_objects(store, points)
    with atomic_folder(out_folder) as partial:
        _write_points(partial, sampled, points)
        writer = _Writer(partial, points)
        store.hand_pair()
        jobs = min(jobs, 1 + sum(store.sequences["n_frames"].tolist()) // FRAMES_PER_JOB)
        measured = map_in_workers(_Measurer(store, sampled, settings.threshold_m), store.ids, jobs)
        for clip_id, entries in in_order(measured, store.ids):
            writer.add(clip_id, entries)
        counts = writer.finish() | {"objects": len(sampled)}
        info = {"threshold_m": settings.threshold_m, "points": points, "counts": counts}
        (partial / "info.json").write_text(canonical_json(info) + "\n", encoding="utf-8")
    return counts


@dataclass
class _Measurer:
    """Computes the entries of both hands of a clip, in a worker process."""

    store: Store
    sampled: dict[str, SampledPoints]
    threshold_m: float
    _indices: dict[str, ProximityIndex] = field(default_factory=dict, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the indices: building them again is faster than sending them to workers."""
        return {**self.__dict__, "_indices": {}}

    def __call__(self, clip_id: str) -> dict[Side, np.ndarray]:
        clip = self.store.clip(clip_id)
        name = clip.object.model.name
        if name not in self._indices:
            self._indices[name] = ProximityIndex(self.sampled[name])
        joints: dict[Side, np.ndarray] = {side: self.store.joints(clip_id, side) for side in SIDES}
        return distance_entries(clip, joints, self._indices[name], self.threshold_m)


def sample_objects(store: Store, points: int) -> dict[str, SampledPoints]:
    """Sample points on each object of a store. Keys are object names in the store's order."""
    return {name: sample_points(store.object_model(name), points) for name in store.objects["object"]}


def _write_points(folder: Path, sampled: dict[str, SampledPoints], points: int) -> None:
    arrays = {}
    for name, (shape, dtype) in POINT_SHAPES.items():
        rows = [getattr(cloud, name) for cloud in sampled.values()]
        arrays[name] = np.stack(rows).astype(dtype) if rows else np.zeros((0, points, *shape), dtype)
    write_npz(folder / "points.npz", arrays)
    names = enumerate(sampled.items())
    objects = [{"object": name, "row": number, "method": cloud.method} for number, (name, cloud) in names]
    write_table(folder / "objects.parquet", objects, OBJECTS)


class _Writer:
    """Collects clips, and writes a shard of distances whenever enough entries are in memory."""

    def __init__(self, folder: Path, points: int) -> None:
        self.folder, self.points = folder, points
        self.rows: list[dict] = []
        self.touched: dict[Side, list[np.ndarray]] = {side: [] for side in SIDES}
        self.pending: list[np.ndarray] = []
        self.pending_rows = self.written_rows = self.shard = self.untouched = 0

    def add(self, clip_id: str, entries: dict[Side, np.ndarray]) -> None:
        clip: dict = {"clip_id": clip_id, "row": len(self.rows), "shard": self.shard}
        for side in SIDES:
            self.touched[side].append(touched_frames(entries[side], self.points))
            clip[f"{side}_start"] = self.pending_rows
            self.pending.append(entries[side])
            self.pending_rows += len(entries[side])
            clip[f"{side}_stop"] = self.pending_rows
        self.rows.append(clip)
        self.untouched += clip["left_start"] == clip["right_stop"]
        if self.pending_rows >= ENTRIES_PER_SHARD:
            self._write_shard()

    def _write_shard(self) -> None:
        columns = {
            name: np.concatenate([np.zeros(0, ENTRY[name]), *(entries[name] for entries in self.pending)])
            for name in ENTRY.names or ()
        }
        write_npz(self.folder / f"distances-{self.shard:05d}.npz", columns)
        self.written_rows += self.pending_rows
        self.pending, self.pending_rows, self.shard = [], 0, self.shard + 1

    def finish(self) -> dict[str, int]:
        if self.pending or not self.shard:
            self._write_shard()
        empty = np.zeros((0, self.points), np.uint16)
        write_npz(
            self.folder / "contact.npz",
            {f"{side}_frames": np.stack(maps) if maps else empty for side, maps in self.touched.items()},
        )
        write_table(self.folder / "clips.parquet", self.rows, CLIPS)
        return {"clips": len(self.rows), "entries": self.written_rows, "clips_without_contact": int(self.untouched)}
