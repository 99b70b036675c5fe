"""The folder of the stage surface: hands against the exact surface of the object, frame by frame. Writer and reader.

clips.parquet     clip_id, object, reason (why a clip is not measured), n_frames, shard, row (its first frame there);
                  per side: <side>_touching_frames, <side>_inside_frames, <side>_deepest_m (null where nothing can be
                  inside), <side>_deepest_volume_m3 (shared with the object in the frame of the deepest vertex; null
                  as well where the object is too large for it), <side>_nearest_joint_m (null where the hand is never
                  valid), and <side>_map_row, <side>_map_first, <side>_map_stop: rows of the shard's map from
                  <side>_map_row on are the frames first to stop (exclusive); in all others the hand is beyond reach
                  of every point
objects.parquet   object, solid (whether anything can be inside), note (what was repaired or left out, or null)
surface-*.npz     stored, so that they can be mapped into memory; of both sides and of all frames of its clips
                  <side>_touched  (frame, 98) uint8: the 778 hand vertices closer than touch_m to the surface, packed
                                  bits, first vertex in the highest bit; none in frames where the hand is not valid
                  <side>_depth_m  (frame,) float32: the deepest hand vertex inside the object, 0 where none is; NaN
                                  where the hand is not valid or nothing can be inside the object
                  <side>_joint_m  (frame,) float32: distance of the nearest of 21 joints to the surface; infinite
                                  where the hand is not valid
                  <side>_map      (row, point) uint8: BimArt's map (``hoidata.surface.bimart_maps``): distance of each
                                  sampled point to the nearest hand vertex in steps of map_step_m, 255 beyond
                                  map_reach_m; the points are ``sample_points(model, points)``, those of the stage
                                  contact where it samples as many
info.json         surface_version, touch_m, points, map_step_m, map_reach_m, vertices, counts
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa

from hoidata.clips.clip import SIDES, Side
from hoidata.errors import BadInput
from hoidata.files import canonical_json
from hoidata.files.arrays import write_npz
from hoidata.files.tables import write_table
from hoidata.files.written import NUMBER, read_json, read_table, require_output
from hoidata.hands.model import N_VERTICES
from hoidata.store.hand_evidence import HandEvidence
from hoidata.store.mapped import map_npz
from hoidata.surface.bimart_maps import BEYOND, REACH_M, STEP_M, unpacked_map

VERSION = 1
FRAMES_PER_SHARD = 1 << 15
REMEDY = "run the stage 'surface' of this dataset again"
_TEXT, _COUNT, _NUMBER = pa.string(), pa.int32(), pa.float64()
_SIDE_COLUMNS = [
    ("touching_frames", _COUNT),
    ("inside_frames", _COUNT),
    ("deepest_m", _NUMBER),
    ("deepest_volume_m3", _NUMBER),
    ("nearest_joint_m", _NUMBER),
    ("map_row", _COUNT),
    ("map_first", _COUNT),
    ("map_stop", _COUNT),
]
CLIPS = pa.schema(
    [
        *(("clip_id", _TEXT), ("object", _TEXT), ("reason", _TEXT)),
        *(("n_frames", _COUNT), ("shard", _COUNT), ("row", _COUNT)),
        *((f"{side}_{name}", kind) for side in SIDES for name, kind in _SIDE_COLUMNS),
    ]
)
OBJECTS = pa.schema([("object", _TEXT), ("solid", pa.bool_()), ("note", _TEXT)])


class SideSurface(NamedTuple):
    """One hand of one clip: touched (frame, 778) bool; depth_m, joint_m (frame,); map (frame, point) uint8, packed;
    deepest_volume_m3: shared with the object in the frame of the deepest vertex, NaN where nothing can be inside.
    """

    touched: np.ndarray
    depth_m: np.ndarray
    joint_m: np.ndarray
    map: np.ndarray
    deepest_volume_m3: float


class ClipSurface(NamedTuple):
    """One clip; sides is empty where ``reason`` says why it was not measured."""

    clip_id: str
    object: str
    n_frames: int
    reason: str | None
    sides: dict[Side, SideSurface]


class SurfaceWriter:
    """Collects clips in their order; writes a shard whenever enough frames are in memory."""

    def __init__(self, folder: Path, points: int, touch_m: float) -> None:
        self._folder, self._points, self._touch_m = folder, points, touch_m
        self._rows: list[dict[str, Any]] = []
        self._shard = 0
        self._start_shard()

    def _start_shard(self) -> None:
        self._frames = 0
        self._map_rows: dict[Side, int] = dict.fromkeys(SIDES, 0)
        self._pending: dict[str, list[np.ndarray]] = {name: [none] for name, none in _no_frames(self._points).items()}

    def add(self, clip: ClipSurface) -> None:
        row: dict[str, Any] = dict.fromkeys(CLIPS.names)
        row |= {"clip_id": clip.clip_id, "object": clip.object, "reason": clip.reason, "n_frames": clip.n_frames}
        if clip.sides:
            row |= {"shard": self._shard, "row": self._frames}
            for side, found in clip.sides.items():
                row |= {f"{side}_{name}": value for name, value in self._add_side(side, found).items()}
            self._frames += clip.n_frames
        self._rows.append(row)
        if self._frames >= FRAMES_PER_SHARD:
            self._write_shard()

    def _add_side(self, side: Side, found: SideSurface) -> dict[str, Any]:
        near = np.flatnonzero((found.map != BEYOND).any(axis=1))
        first, stop = (int(near[0]), int(near[-1]) + 1) if len(near) else (0, 0)
        row = self._map_rows[side]
        self._map_rows[side] += stop - first
        self._pending[f"{side}_touched"].append(np.packbits(found.touched, axis=1))
        self._pending[f"{side}_depth_m"].append(found.depth_m.astype(np.float32))
        self._pending[f"{side}_joint_m"].append(found.joint_m.astype(np.float32))
        self._pending[f"{side}_map"].append(found.map[first:stop])
        return {**_summary(found), "map_row": row, "map_first": first, "map_stop": stop}

    def _write_shard(self) -> None:
        arrays = {name: np.concatenate(pieces) for name, pieces in self._pending.items()}
        write_npz(self._folder / _shard_name(self._shard), arrays)
        self._shard += 1
        self._start_shard()

    def finish(self, objects: Iterable[dict[str, Any]]) -> dict[str, int]:
        """Write what is left and the tables; the counts. objects: rows of objects.parquet."""
        if self._frames or not self._shard:
            self._write_shard()
        objects = list(objects)
        measured = [row for row in self._rows if row["shard"] is not None]
        counts = {
            "clips": len(self._rows),
            "left_out": len(self._rows) - len(measured),
            "frames": sum(row["n_frames"] for row in measured),
            "touching": sum(any(row[f"{side}_touching_frames"] for side in SIDES) for row in measured),
            "objects": len(objects),
            "objects_not_solid": sum(not row["solid"] for row in objects),
        }
        write_table(self._folder / "clips.parquet", self._rows, CLIPS)
        write_table(self._folder / "objects.parquet", objects, OBJECTS)
        info = {
            **{"surface_version": VERSION, "touch_m": self._touch_m, "points": self._points, "vertices": N_VERTICES},
            **{"map_step_m": STEP_M, "map_reach_m": REACH_M, "counts": counts},
        }
        (self._folder / "info.json").write_text(canonical_json(info) + "\n", encoding="utf-8")
        return counts


def _summary(found: SideSurface) -> dict[str, Any]:
    depth, nearest = found.depth_m[np.isfinite(found.depth_m)], float(found.joint_m.min(initial=np.inf))
    return {
        "touching_frames": int(found.touched.any(axis=1).sum()),
        "inside_frames": int((depth > 0).sum()) if len(depth) else None,
        "deepest_m": float(depth.max()) if len(depth) else None,
        "deepest_volume_m3": found.deepest_volume_m3 if np.isfinite(found.deepest_volume_m3) else None,
        "nearest_joint_m": nearest if np.isfinite(nearest) else None,
    }


def _no_frames(points: int) -> dict[str, np.ndarray]:
    kinds = {
        "touched": np.zeros((0, -(-N_VERTICES // 8)), np.uint8),
        "depth_m": np.zeros(0, np.float32),
        "joint_m": np.zeros(0, np.float32),
        "map": np.zeros((0, points), np.uint8),
    }
    return {f"{side}_{name}": array for side in SIDES for name, array in kinds.items()}


def _shard_name(number: int) -> str:
    return f"surface-{number:05d}.npz"


def open_surface(folder: str | Path) -> "SurfaceStore":
    """Open what the stage surface wrote.

    Raises MissingResource where it has not run, BadInput for another version or a damaged folder.
    """
    folder = Path(folder)
    require_output(folder, "surface")
    info = read_json(folder / "info.json")
    version = info["surface_version"]
    tables = {name: read_table(folder / f"{name}.parquet") for name in ("clips", "objects")}
    if version != VERSION:
        raise BadInput(folder / "info.json", f"surface_version {VERSION}", repr(version)[:80], REMEDY)
    info.check({"touch_m": NUMBER, "points": int, "vertices": int, "map_step_m": NUMBER, "map_reach_m": NUMBER})
    for name, schema in (("clips", CLIPS), ("objects", OBJECTS)):
        if missing := sorted(set(schema.names) - set(tables[name].columns)):
            raise BadInput(folder / f"{name}.parquet", "all columns", f"none named {', '.join(missing)}", REMEDY)
    return SurfaceStore(folder, info, tables["clips"], tables["objects"])


class SurfaceStore:
    """Exact contact, depth, joint distances and BimArt maps of a dataset's clips. clips, objects: its tables."""

    def __init__(self, folder: Path, info: dict[str, Any], clips: pd.DataFrame, objects: pd.DataFrame) -> None:
        self.folder, self.info, self.objects = folder, info, objects
        self.clips = clips.set_index("clip_id", drop=False).rename_axis(None)
        self._rows: dict[str, dict[str, Any]] = {row["clip_id"]: row for row in clips.to_dict("records")}
        self._solid: dict[str, bool] = dict(zip(objects["object"].tolist(), objects["solid"].tolist(), strict=True))
        self._shards: dict[int, dict[str, np.ndarray]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Workers map the arrays anew: a pickled memory map would carry all of them."""
        return {**self.__dict__, "_shards": {}}

    @property
    def ids(self) -> list[str]:
        """Clips that were measured, in the store's order."""
        return [clip_id for clip_id, row in self._rows.items() if not pd.isna(row["shard"])]

    def touched(self, clip_id: str, side: Side) -> np.ndarray:
        """(frame, 778) bool: hand vertices closer than ``info["touch_m"]`` to the surface."""
        return np.unpackbits(self._frames(clip_id, f"{side}_touched"), axis=1, count=self.info["vertices"]).astype(bool)

    def depth_m(self, clip_id: str, side: Side) -> np.ndarray:
        """(frame,) the deepest hand vertex inside the object; NaN without the hand, or where nothing can be inside."""
        return self._frames(clip_id, f"{side}_depth_m").astype(np.float64)

    def joint_m(self, clip_id: str, side: Side) -> np.ndarray:
        """(frame,) distance of the nearest of 21 joints to the surface; infinite without the hand."""
        return self._frames(clip_id, f"{side}_joint_m").astype(np.float64)

    def hand_evidence(self, clip_id: str, threshold_m: float) -> HandEvidence:
        """The hand test of Text2HOI with the exact surface in place of sampled points, at any threshold.

        Per-frame distances are rounded to float32; the hand type rests on the exact smallest ones.
        """
        distance: dict[Side, np.ndarray] = {side: self.joint_m(clip_id, side) for side in SIDES}
        row, smallest = self._row(clip_id), {}
        for side in SIDES:
            value = row[f"{side}_nearest_joint_m"]
            smallest[side] = np.inf if pd.isna(value) else float(value)
        return HandEvidence(None, distance, threshold_m, smallest).at_threshold(threshold_m)

    def hand(self, clip_id: str, side: Side) -> SideSurface:
        """All of one hand, as the stage measured it."""
        frames = self.touched(clip_id, side), self.depth_m(clip_id, side), self.joint_m(clip_id, side)
        volume = self._row(clip_id)[f"{side}_deepest_volume_m3"]
        return SideSurface(*frames, self.packed_map(clip_id, side), np.nan if volume is None else float(volume))

    def bimart_map(self, clip_id: str, side: Side) -> np.ndarray:
        """(frame, point) float32 metres, see ``hoidata.surface.bimart_maps``: at most half a step off."""
        return unpacked_map(self.packed_map(clip_id, side))

    def packed_map(self, clip_id: str, side: Side) -> np.ndarray:
        """(frame, point) uint8: the same in steps of ``info["map_step_m"]``, 255 beyond the reach."""
        row = self._row(clip_id)
        packed = np.full((int(row["n_frames"]), self.info["points"]), BEYOND, np.uint8)
        start, first, stop = (int(row[f"{side}_map_{name}"]) for name in ("row", "first", "stop"))
        packed[first:stop] = self._shard(int(row["shard"]))[f"{side}_map"][start : start + stop - first]
        return packed

    def is_solid(self, clip_id: str) -> bool:
        """Whether anything can be inside the clip's object."""
        return self._solid[self._row(clip_id)["object"]]

    def _frames(self, clip_id: str, name: str) -> np.ndarray:
        row = self._row(clip_id)
        start = int(row["row"])
        return self._shard(int(row["shard"]))[name][start : start + int(row["n_frames"])]

    def _row(self, clip_id: str) -> dict[str, Any]:
        row = self._rows.get(clip_id)
        if row is None:
            raise KeyError(f"no clip {clip_id!r} in {self.folder}, which has {len(self._rows)} clips")
        if pd.isna(row["shard"]):
            raise KeyError(f"{clip_id} was not measured: {row['reason']}")
        return row

    def _shard(self, number: int) -> dict[str, np.ndarray]:
        if number not in self._shards:
            path = self.folder / _shard_name(number)
            arrays = map_npz(path)
            for name, none in _no_frames(self.info["points"]).items():
                if name not in arrays or arrays[name].shape[1:] != none.shape[1:] or arrays[name].dtype != none.dtype:
                    got = f"{arrays[name].dtype} {arrays[name].shape}" if name in arrays else "no such array"
                    raise BadInput(f"{path}: {name}", f"{none.dtype} rows of {none.shape[1:]}", got, REMEDY)
            self._shards[number] = arrays
        return self._shards[number]
