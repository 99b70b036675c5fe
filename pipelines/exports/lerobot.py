"""LeRobot's dataset layout v3.0 (huggingface/lerobot, docs "LeRobotDataset v3"): an episode per clip, without video.

``observation.state`` and ``action`` are the 2 x 21 joints of this and of the next frame,
``observation.environment_state`` the object: position, quaternion xyzw, hinge. Tasks are the sentences; a frame's task
is the clip's first one.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from hoidata.clips.clip import FPS, SIDES
from hoidata.store.annotated import SUBSETS
from pipelines.exports.motion import Column, ExportedClip, state_names
from pipelines.exports.tables import frames_array, row_type

VERSION = "v3.0"
FRAMES_PER_FILE = 60_000  # about 100 MB, LeRobot's own size of a data file
FILES_PER_CHUNK = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
STATE, ACTION, OBJECT, VALID = "observation.state", "action", "observation.environment_state", "observation.hand_valid"
_OBJECT_NAMES = [*(f"object.{axis}" for axis in "xyz"), *(f"object.q{axis}" for axis in "xyzw"), "object.hinge"]
_HAND_NAMES = [name for side in SIDES for name in state_names(side)]
_NAMES = {STATE: _HAND_NAMES, ACTION: _HAND_NAMES, OBJECT: _OBJECT_NAMES, VALID: list(SIDES)}
COLUMNS = (
    Column(STATE, "float32", (126,), "world joints of both hands, metres"),
    Column(ACTION, "float32", (126,), "the joints of the next frame"),
    Column(OBJECT, "float32", (8,), "object position, quaternion xyzw, hinge angle"),
    Column(VALID, "bool", (2,), "whether the numbers of a hand mean something"),
    Column("timestamp", "float32", (), "seconds"),
    *(Column(name, "int64", (), "") for name in ("frame_index", "episode_index", "index", "task_index")),
)


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write meta/ and data/ below ``folder``."""
    writer = _Writer(folder)
    for clip in clips:
        writer.add(clip)
    writer.finish()


class _Writer:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.episodes: list[dict[str, Any]] = []
        self.tasks: dict[str, int] = {}
        self.ranges: dict[str, list[int]] = {}
        self.frames, self.file, self.in_file = 0, 0, 0
        self._parquet: pq.ParquetWriter | None = None

    def add(self, item: ExportedClip) -> None:
        """One episode: a row group of the data file, and its row of meta/episodes."""
        numbers = [self.tasks.setdefault(sentence, len(self.tasks)) for sentence in item.sentences]
        arrays = _frames(item) | self._indices(item.clip.n_frames, numbers[0])
        if self._parquet is None or self.in_file + item.clip.n_frames > FRAMES_PER_FILE:
            self._next_file()
        assert self._parquet is not None
        data = [frames_array(arrays[column.name], column) for column in COLUMNS]
        self._parquet.write_table(pa.Table.from_arrays(data, schema=_schema()))
        self.episodes.append(self._episode(item, arrays))
        self.ranges.setdefault(item.subset, [len(self.episodes) - 1, 0])[1] = len(self.episodes)
        self.frames += item.clip.n_frames
        self.in_file += item.clip.n_frames

    def _indices(self, n_frames: int, task: int) -> dict[str, np.ndarray]:
        frame = np.arange(n_frames)
        return {
            "timestamp": frame / FPS,
            "frame_index": frame,
            "episode_index": np.full(n_frames, len(self.episodes)),
            "index": frame + self.frames,
            "task_index": np.full(n_frames, task),
        }

    def _next_file(self) -> None:
        if self._parquet is not None:
            self._parquet.close()
            self.file += 1
        chunk, file = divmod(self.file, FILES_PER_CHUNK)
        path = self.folder / DATA_PATH.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._parquet, self.in_file = pq.ParquetWriter(path, _schema()), 0

    def _episode(self, item: ExportedClip, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
        chunk, file = divmod(self.file, FILES_PER_CHUNK)
        row: dict[str, Any] = {
            "episode_index": len(self.episodes),
            "tasks": list(item.sentences),
            "length": item.clip.n_frames,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.frames,
            "dataset_to_index": self.frames + item.clip.n_frames,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "clip_id": item.clip.clip_id,
            "subject": item.clip.subject,
            "object": item.clip.object.model.name,
        }
        for column in COLUMNS:
            for name, value in _statistics(arrays[column.name]).items():
                row[f"stats/{column.name}/{name}"] = value.tolist()
        return row

    def finish(self) -> None:
        """The files of meta/."""
        assert self._parquet is not None
        self._parquet.close()
        path = self.folder / EPISODES_PATH
        path.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self.episodes), path)
        tasks = pd.DataFrame({"task_index": list(self.tasks.values())}, pd.Index(list(self.tasks), name="task"))
        tasks.to_parquet(self.folder / "meta" / "tasks.parquet")
        _write_json(self.folder / "meta" / "info.json", self._info())
        _write_json(self.folder / "meta" / "stats.json", {c.name: self._total(c.name) for c in COLUMNS})

    def _info(self) -> dict[str, Any]:
        splits = {name: "{}:{}".format(*self.ranges[name]) for name in SUBSETS if name in self.ranges}
        return {
            "codebase_version": VERSION,
            "robot_type": "human_hands",
            "total_episodes": len(self.episodes),
            "total_frames": self.frames,
            "total_tasks": len(self.tasks),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": FPS,
            "splits": splits or {"train": f"0:{len(self.episodes)}"},
            "data_path": DATA_PATH,
            "video_path": None,
            "features": {c.name: _feature(c) for c in COLUMNS},
        }

    def _total(self, name: str) -> dict[str, Any]:
        """Statistics of all frames, from those of the episodes (the law of total variance)."""
        part = {key: _column(self.episodes, f"stats/{name}/{key}") for key in ("min", "max", "mean", "std", "count")}
        share = part["count"] / part["count"].sum()
        mean = (share * part["mean"]).sum(axis=0)
        variance = (share * (part["std"] ** 2 + (part["mean"] - mean) ** 2)).sum(axis=0)
        total = {"min": part["min"].min(axis=0), "max": part["max"].max(axis=0), "mean": mean, "std": np.sqrt(variance)}
        return {key: value.tolist() for key, value in total.items()} | {"count": [int(part["count"].sum())]}


def _frames(item: ExportedClip) -> dict[str, np.ndarray]:
    arrays = item.arrays()
    n_frames = item.clip.n_frames
    state = np.concatenate([arrays[f"{side}_joints_m"].reshape(n_frames, 63) for side in SIDES], axis=1)
    pose = (arrays["object_translation_m"], arrays["object_quaternion_xyzw"], arrays["object_hinge_rad"][:, None])
    return {
        STATE: state,
        ACTION: np.concatenate([state[1:], state[-1:]]),
        OBJECT: np.concatenate(pose, axis=1),
        VALID: np.stack([arrays[f"{side}_valid"] for side in SIDES], axis=1),
    }


def _statistics(values: np.ndarray) -> dict[str, np.ndarray]:
    rows = values.reshape(len(values), -1).astype(np.float64)
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([len(rows)]),
    }


def _column(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([row[name] for row in rows], np.float64)


def _schema() -> pa.Schema:
    return pa.schema([(column.name, row_type(column)) for column in COLUMNS])


def _feature(column: Column) -> dict[str, Any]:
    return {"dtype": column.dtype, "shape": list(column.shape or (1,)), "names": _NAMES.get(column.name), "fps": FPS}


def _write_json(path: Path, value: dict[str, Any]) -> None:
    path.write_bytes(orjson.dumps(value, option=orjson.OPT_INDENT_2) + b"\n")
