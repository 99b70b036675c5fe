"""LeRobot's dataset layout v3.0 (huggingface/lerobot, docs "LeRobotDataset v3"): an episode per clip, without video.

``observation.state`` and ``action`` are the 2 x 21 joints of this and of the next frame,
``observation.environment_state`` the object: position, quaternion xyzw, joint position. ``observation.hand_valid`` and
``next.hand_valid`` are the masks of state and action; statistics count only valid values. Tasks are the sentences; a
frame's task is the clip's first sentence.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from hoidata.clips.clip import FPS, SIDES
from hoidata.hands import JOINT_NAMES
from hoidata.store.annotated import SUBSETS
from pipelines.exports.motion import Column, ExportedClip, frames_array, row_type, write_json

VERSION = "v3.0"
FRAMES_PER_FILE = 60_000  # about 100 MB, LeRobot's default size of a data file
FILES_PER_CHUNK = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
STATE, ACTION, OBJECT = "observation.state", "action", "observation.environment_state"
# Without the prefix "action.": LeRobot's policies predict all features with that prefix.
VALID, NEXT_VALID = "observation.hand_valid", "next.hand_valid"
_OBJECT_NAMES = [*(f"object.{axis}" for axis in "xyz"), *(f"object.q{axis}" for axis in "xyzw"), "object.hinge"]
_HAND_NAMES = [f"{side}.{joint}.{axis}" for side in SIDES for joint in JOINT_NAMES for axis in "xyz"]
_NAMES = {STATE: _HAND_NAMES, ACTION: _HAND_NAMES, OBJECT: _OBJECT_NAMES, VALID: list(SIDES), NEXT_VALID: list(SIDES)}
_POSE = "origin of the object frame, quaternion xyzw of world_from_object, joint position from the mesh as stored"
_TRACKED = (
    "whether left and right hand are tracked; untracked frames repeat the last tracked pose, or before the first "
    "tracked frame the first; zeros if a hand is never tracked in the clip"
)
COLUMNS = (
    Column(STATE, "float32", (126,), "21 joints of the left, then of the right hand; world frame, metre"),
    Column(ACTION, "float32", (126,), "observation.state of the next frame; the last frame repeats its state"),
    Column(OBJECT, "float32", (8,), f"{_POSE}: hinge angle in radian, slide in metre, 0 if rigid; world frame, metre"),
    Column(VALID, "bool", (2,), _TRACKED),
    Column(NEXT_VALID, "bool", (2,), f"{VALID} of the next frame, so of {ACTION}; False in the last frame"),
    Column("timestamp", "float32", (), "since the clip's first frame, second"),
    Column("frame_index", "int64", (), "frame of the episode, from 0"),
    Column("episode_index", "int64", (), "the clip, from 0"),
    Column("index", "int64", (), "frame of the data set, from 0"),
    Column("task_index", "int64", (), "row of meta/tasks.parquet: the clip's first sentence"),
)
_SCHEMA = pa.schema([(column.name, row_type(column)) for column in COLUMNS])


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
        self.statistics: dict[str, list[dict[str, np.ndarray]]] = {column.name: [] for column in COLUMNS}
        self.tasks: dict[str, int] = {}
        self.ranges: dict[str, list[int]] = {}
        self.frames, self.file, self.in_file = 0, 0, 0
        self._parquet = self._open_file()

    def add(self, item: ExportedClip) -> None:
        """Add an episode: a row group of the data file, and a row of meta/episodes."""
        task_indices = [self.tasks.setdefault(sentence, len(self.tasks)) for sentence in item.sentences]
        n_frames, frame = item.clip.n_frames, np.arange(item.clip.n_frames)
        arrays = _frames(item) | {"timestamp": frame / FPS, "frame_index": frame, "index": frame + self.frames}
        arrays["episode_index"] = np.full(n_frames, len(self.episodes))
        arrays["task_index"] = np.full(n_frames, task_indices[0])
        if self.in_file and self.in_file + n_frames > FRAMES_PER_FILE:
            self._parquet.close()
            self.file, self.in_file = self.file + 1, 0
            self._parquet = self._open_file()
        data = [frames_array(arrays[column.name], column) for column in COLUMNS]
        self._parquet.write_table(pa.Table.from_arrays(data, schema=_SCHEMA))
        self.episodes.append(self._episode(item))
        masks = _valid_values(item, arrays)
        for name, episodes in self.statistics.items():
            episodes.append(_statistics(arrays[name], masks.get(name, True)))
        self.ranges.setdefault(item.subset, [len(self.episodes) - 1, 0])[1] = len(self.episodes)
        self.frames += n_frames
        self.in_file += n_frames

    def _open_file(self) -> pq.ParquetWriter:
        chunk, file = divmod(self.file, FILES_PER_CHUNK)
        path = self.folder / DATA_PATH.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        return pq.ParquetWriter(path, _SCHEMA)

    def _episode(self, item: ExportedClip) -> dict[str, Any]:
        chunk, file = divmod(self.file, FILES_PER_CHUNK)
        return {
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
            "gravity": item.clip_arrays()["gravity"].tolist(),
            "gravity_note": item.clip.gravity_note,
        }

    def finish(self) -> None:
        """Write the files of meta/."""
        self._parquet.close()
        path = self.folder / EPISODES_PATH
        path.parent.mkdir(parents=True)
        totals = {name: _total(episodes) for name, episodes in self.statistics.items()}
        for column, statistics_of_episodes in self.statistics.items():
            for episode, statistics in zip(self.episodes, statistics_of_episodes, strict=True):
                facts = _as_written(statistics, totals[column])
                episode |= {f"stats/{column}/{name}": value for name, value in facts.items()}
        pq.write_table(pa.Table.from_pylist(self.episodes), path)
        tasks = pd.DataFrame({"task_index": list(self.tasks.values())}, pd.Index(list(self.tasks), name="task"))
        tasks.to_parquet(self.folder / "meta" / "tasks.parquet")
        statistics = {name: _as_written(total, total) for name, total in totals.items()}
        write_json(self.folder / "meta" / "stats.json", statistics)
        splits = {name: "{}:{}".format(*self.ranges[name]) for name in SUBSETS if name in self.ranges}
        info = {
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
            "features": {
                c.name: {"dtype": c.dtype, "shape": list(c.shape or (1,)), "names": _NAMES.get(c.name), "fps": FPS}
                for c in COLUMNS
            },
        }
        write_json(self.folder / "meta" / "info.json", info)


def _frames(item: ExportedClip) -> dict[str, np.ndarray]:
    arrays = item.arrays()
    n_frames = item.clip.n_frames
    valid = np.stack([arrays[f"{side}_valid"] for side in SIDES], axis=1)
    state = np.concatenate([arrays[f"{side}_joints_m"].reshape(n_frames, 63) for side in SIDES], axis=1)
    pose = (arrays["object_translation_m"], arrays["object_quaternion_xyzw"], arrays["object_hinge_rad"][:, None])
    return {
        STATE: state,
        ACTION: np.concatenate([state[1:], state[-1:]]),
        OBJECT: np.concatenate(pose, axis=1),
        VALID: valid,
        NEXT_VALID: np.concatenate([valid[1:], np.zeros((1, 2), bool)]),
    }


def _valid_values(item: ExportedClip, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """(frame, value) masks of the columns that have placeholders: poses of untracked hands, angles of no hinge."""
    has_hinge = np.ones((item.clip.n_frames, 8), bool)
    has_hinge[:, 7] = item.clip.object.is_articulated
    masks = {STATE: arrays[VALID], ACTION: arrays[NEXT_VALID]}
    return {OBJECT: has_hinge, **{name: mask.repeat(63, axis=1) for name, mask in masks.items()}}


def _statistics(values: np.ndarray, valid: np.ndarray | bool) -> dict[str, np.ndarray]:
    """Statistics of each value over its valid frames; NaN and a count of 0 if it has none."""
    frames = values.reshape(len(values), -1).astype(np.float64)
    frames = np.ma.array(frames, mask=~np.broadcast_to(valid, frames.shape))
    statistics = {name: getattr(frames, name)(axis=0) for name in ("min", "max", "mean", "std")}
    return {name: value.filled(np.nan) for name, value in statistics.items()} | {"count": frames.count(axis=0)}


def _total(episodes: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Statistics of all frames, from those of the episodes (the law of total variance)."""
    stacked = {name: np.stack([statistics[name] for statistics in episodes]) for name in episodes[0]}
    count = stacked["count"].sum(axis=0)
    with np.errstate(invalid="ignore"):  # 0 / 0 for a value that is valid in no episode
        weight = stacked["count"] / count
    mean = _sum(weight * stacked["mean"], count)
    variance = _sum(weight * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2), count)
    total = {"min": np.fmin.reduce(stacked["min"]), "max": np.fmax.reduce(stacked["max"]), "mean": mean}
    return total | {"std": np.sqrt(variance), "count": count}


def _sum(values: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Sums over the episodes in which a value is valid; NaN if it is valid in none."""
    return np.where(count > 0, np.nansum(values, axis=0), np.nan)


def _as_written(statistics: dict[str, np.ndarray], total: dict[str, np.ndarray]) -> dict[str, list]:
    """Statistics in LeRobot's format: finite numbers, and one count for all values of a column.

    A value that is valid in no frame of an episode gets the statistics of all episodes, so that merging episodes does
    not change them. A value that is valid in no episode gets 0.
    """
    names = ("min", "max", "mean", "std")
    filled = {name: np.where(statistics["count"] > 0, statistics[name], total[name]) for name in names}
    written = {name: np.nan_to_num(values, nan=0.0).tolist() for name, values in filled.items()}
    return written | {"count": [int(statistics["count"].max())]}
