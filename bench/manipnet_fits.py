"""How well fitted hands keep what ManipNet recorded: joint errors, and finger tips at lifted objects."""

from pathlib import Path

import numpy as np
import pandas as pd

from hoidata.clips.clip import SIDES, Clip
from hoidata.datasets.base import Quarantined, RawTree, SequenceKey
from hoidata.datasets.manipnet.adapter import ManipNetAdapter, Recording, read_recording, surface_distances
from hoidata.datasets.manipnet.segments import LIFTED_M, TOUCH_M
from hoidata.errors import BadInput
from hoidata.hands import HandPair, track_joints

FIRST_TIP = 16


def measure_fits(root: Path, hands: HandPair) -> pd.DataFrame:
    """One row per two-hand sequence below ``root``; sequences that cannot be read are left out.

    Columns: sequence, frames (30 fps), usable_frames, left_out (stretches), clips, clip_frames; mean_error_mm over the
    16 joints and 5 tips of both hands and tip_error_mm over the tips, in all clip frames; lifted_frames (in clips) and
    lifted_near_share, the share of them with a fitted finger tip within 2 cm of the object's surface.
    """
    adapter, rows = ManipNetAdapter(), []
    for key in adapter.sequences(root):
        try:
            rows.append(_measure_sequence(adapter, RawTree(Path(root)), key, hands))
        except BadInput:
            continue
    return pd.DataFrame(rows)


def _measure_sequence(adapter: ManipNetAdapter, raw: RawTree, key: SequenceKey, hands: HandPair) -> dict:
    recording = read_recording(raw, key.name)
    results = adapter.load(raw, key, hands)
    clips = [item for item in results if isinstance(item, Clip)]
    measured = [_measure_clip(clip, recording, hands) for clip in clips]
    error_m = np.concatenate([error for error, _ in measured]) if measured else np.full((1, 21), np.nan)
    near = np.concatenate([lifted_near for _, lifted_near in measured]) if measured else np.zeros(0)
    return {
        "sequence": key.name,
        "frames": len(recording.source_frames),
        "usable_frames": int(recording.usable().sum()),
        "left_out": sum(isinstance(item, Quarantined) for item in results),
        "clips": len(clips),
        "clip_frames": sum(clip.n_frames for clip in clips),
        "mean_error_mm": error_m.mean() * 1e3,
        "tip_error_mm": error_m[:, FIRST_TIP:].mean() * 1e3,
        "lifted_frames": len(near),
        "lifted_near_share": near.mean() if len(near) else np.nan,
    }


def _measure_clip(clip: Clip, recording: Recording, hands: HandPair) -> tuple[np.ndarray, np.ndarray]:
    """Errors (2 x frame, 21) in metres, and for each lifted frame whether a fitted tip is at the object."""
    frames = np.searchsorted(recording.source_frames, clip.source_frames)
    pose = recording.rotation[frames], recording.translation_m[frames]
    errors, tip_distances = [], []
    for side in SIDES:
        joints = track_joints(clip.hands[side], hands[side]).astype(np.float64)
        errors.append(np.linalg.norm(joints - recording.keypoints_m[side][frames], axis=-1))
        tip_distances.append(surface_distances(recording.model, *pose, joints[:, FIRST_TIP:]).min(axis=1))
    lifted = recording.lift_m()[frames] > LIFTED_M
    return np.concatenate(errors), (np.minimum(*tip_distances) < TOUCH_M)[lifted]
