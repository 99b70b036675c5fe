"""Statistics of the stored quantities over the training clips only, so that no held-out value reaches a model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from hoidata.clips.clip import SIDES, Clip, HandTrack, Side
from hoidata.geometry.rotations import rotmat_to_rot6d, rotvec_to_rotmat
from hoidata.store.store import Store

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
DIGITS = 9  # significant; the last bits of a sum depend on the processor
WORLD, ROT6D = "xyz, world axes", "R00 R01 R10 R11 R20 R21 of world_from_"


@dataclass(frozen=True)
class Quantity:
    """A measured quantity of clips."""

    name: str
    unit: str
    axes: str  # what the columns are
    of: Callable[[Clip], np.ndarray]  # clip to (row, column): one row per frame with a value, or one row per clip


def training_statistics(store: Store, train: Sequence[str], hand_types: pd.DataFrame) -> dict[str, Any]:
    """Compute count, mean, standard deviation, extremes and quantiles of each quantity over the training clips.

    Invalid frames of a hand and the hinge of rigid objects are skipped. A quantity without values has a count of 0.
    hand_types: the annotation's table under clip ids, for the closest approach of each hand.
    """
    quantities: dict[str, Any] = {}
    for group in (*(_hand_quantities(side) for side in SIDES), _object_quantities()):  # one group in memory at a time
        quantities |= _measure(group, store, train)
    for side in SIDES:
        nearest = hand_types.loc[list(train), f"min_{side}_m"].to_numpy(np.float64)
        facts = {"unit": "metre", "axes": "closest joint to sampled object point of each clip"}
        quantities[f"{side}_closest_m"] = facts | summary(nearest[np.isfinite(nearest)][:, None])
    n_frames = int(store.sequences.loc[list(train), "n_frames"].sum())
    return {"clips": len(train), "frames": n_frames, "quantiles": list(QUANTILES), "quantities": quantities}


def summary(values: np.ndarray) -> dict[str, Any]:
    """Summarise values (row, column): per statistic, a list with one number per column.

    Population standard deviation. Quantiles interpolate linearly between sorted values.
    """
    if not len(values):
        return {"count": 0}
    columns = [_column_summary(np.ascontiguousarray(column, dtype=np.float64)) for column in values.T]
    return {"count": len(values), **{name: [column[name] for column in columns] for name in columns[0]}}


def _column_summary(values: np.ndarray) -> dict[str, Any]:
    statistics = {"mean": values.mean(), "std": values.std(), "min": values.min(), "max": values.max()}
    quantiles = [_rounded(value) for value in np.quantile(values, QUANTILES)]
    return {**{name: _rounded(value) for name, value in statistics.items()}, "quantile_values": quantiles}


def _measure(group: Sequence[Quantity], store: Store, train: Sequence[str]) -> dict[str, Any]:
    rows: dict[str, list[np.ndarray]] = {quantity.name: [] for quantity in group}
    for clip_id in train:
        clip = store.clip(clip_id, motion_only=True)
        for quantity in group:
            rows[quantity.name].append(np.asarray(quantity.of(clip), dtype=np.float32))
    summaries = {}
    for quantity in group:
        values = np.concatenate(rows.pop(quantity.name)) if train else np.zeros((0, 1), np.float32)
        summaries[quantity.name] = {"unit": quantity.unit, "axes": quantity.axes} | summary(values)
    return summaries


def _hand_quantities(side: Side) -> list[Quantity]:
    def of_hand(rows: Callable[[HandTrack, Clip], np.ndarray]) -> Callable[[Clip], np.ndarray]:
        return lambda clip: rows(clip.hands[side], clip)[clip.hands[side].valid]

    def betas(clip: Clip) -> np.ndarray:
        track = clip.hands[side]
        return track.betas[track.valid] if len(track.betas) > 1 else track.betas[: int(track.valid.any())]

    return [
        Quantity(f"{side}_wrist_m", "metre", WORLD, of_hand(lambda hand, _: hand.wrist_m)),
        Quantity(f"{side}_wrist_from_object_m", "metre", f"{WORLD}, minus the object's origin", of_hand(_from_object)),
        Quantity(f"{side}_wrist_to_object_m", "metre", "distance from the object's origin", of_hand(_to_object)),
        Quantity(f"{side}_orient_6d", "1", f"{ROT6D}wrist", of_hand(lambda hand, _: _rot6d(hand.global_orient))),
        Quantity(f"{side}_hand_pose", "radian", "15 joints x axis-angle", of_hand(lambda hand, _: hand.hand_pose)),
        Quantity(f"{side}_betas", "1", "component; one row per clip, or per frame where they vary", betas),
    ]


def _object_quantities() -> list[Quantity]:
    def hinge(clip: Clip) -> np.ndarray:
        return np.zeros((0, 1)) if clip.object.hinge_rad is None else clip.object.hinge_rad[:, None]

    return [
        Quantity("object_translation_m", "metre", WORLD, lambda clip: clip.object.translation_m),
        Quantity("object_orient_6d", "1", f"{ROT6D}object", lambda clip: _rot6d(clip.object.rotvec)),
        Quantity("object_hinge_rad", "radian", "angle; articulated objects only", hinge),
        Quantity("n_frames", "frame", "length of each clip at 30 fps", lambda clip: np.array([[clip.n_frames]])),
    ]


def _from_object(hand: HandTrack, clip: Clip) -> np.ndarray:
    return hand.wrist_m.astype(np.float64) - clip.object.translation_m


def _to_object(hand: HandTrack, clip: Clip) -> np.ndarray:
    return np.linalg.norm(_from_object(hand, clip), axis=1, keepdims=True)


def _rot6d(rotvec: np.ndarray) -> np.ndarray:
    return rotmat_to_rot6d(rotvec_to_rotmat(rotvec.astype(np.float64)))


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
