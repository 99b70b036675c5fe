"""What a store keeps at hand for quick reading: the rows of the clips, and the mapped arrays of each shard."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from hoidata.clips.clip import SIDES, Side
from hoidata.store.mapped import map_npz

_POSE = ("rotvec", "translation_m", "hinge_rad")
_FACTS = ("clip_id", "dataset", "subject", "sequence", "verb", "object_words", "labelled_hand", "source_fps")
_FURTHER_FACTS = ("synthetic", "gravity_note", "hands_from", "fit_error_m")


def clip_rows(sequences: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """The row of every clip by its id, as Python values; a row of a pandas table costs more than reading the clip.

    Added: ``frames``, the rows of its shard; ``hands``, per side the rows of its betas and its template; ``facts``, the
    fields of ``Clip`` that stand in the row as they are. gravity (3,) and source_from_world (4, 4) become arrays.
    """
    rows = {}
    for row in pa.Table.from_pandas(sequences, preserve_index=False).to_pylist():
        row["frames"] = slice(row["first_row"], row["first_row"] + row["n_frames"])
        row["hands"] = {side: _hand_rows(row, side) for side in SIDES}
        row["facts"] = {name: row[name] for name in (*_FACTS, *_FURTHER_FACTS)}
        row["gravity"] = None if row["gravity"] is None else np.array(row["gravity"])
        row["source_from_world"] = np.array(row["source_from_world"]).reshape(4, 4)
        rows[row["clip_id"]] = row
    return rows


def _hand_rows(row: dict[str, Any], side: Side) -> tuple[slice, str | None]:
    first = row[f"{side}_betas_row"]
    return slice(first, first + row[f"{side}_betas_count"]), row[f"{side}_template"]


@dataclass(frozen=True)
class FrameShard:
    """The mapped members of one ``frames-*.npz``.

    hands: per side wrist_m, global_orient, hand_pose, betas, valid. object, other: rotvec, translation_m, hinge_rad.
    camera: rotvec, position_m, images; none in stores before 1.1.
    """

    source_frames: np.ndarray
    hands: Mapping[Side, tuple[np.ndarray, ...]]
    object: tuple[np.ndarray, ...]
    other: tuple[np.ndarray, ...]
    camera: tuple[np.ndarray, ...]

    @classmethod
    def open(cls, path: Path) -> "FrameShard":
        arrays = map_npz(path)
        names = ("wrist_m", "global_orient", "hand_pose", "betas", "valid")
        camera = [f"camera_{name}" for name in ("rotvec", "position_m", "images")]
        return cls(
            arrays["source_frames"],
            {side: tuple(arrays[f"{side}_{name}"] for name in names) for side in SIDES},
            tuple(arrays[f"object_{name}"] for name in _POSE),
            tuple(arrays[f"other_{name}"] for name in _POSE),
            tuple(arrays[name] for name in camera if name in arrays),
        )
