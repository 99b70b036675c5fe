"""The released recordings themselves; skipped unless HOIDATA_MANIPNET names their folder."""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hoidata.clips.clip import SIDES, Clip
from hoidata.datasets.base import RawTree, SequenceKey
from hoidata.datasets.manipnet.adapter import ManipNetAdapter, Recording, read_recording, surface_distances
from hoidata.datasets.manipnet.segments import LIFTED_M, TOUCH_M
from hoidata.errors import BadInput
from hoidata.hands import HandPair, load_embedded_hands, track_joints

ROOT = os.environ.get("HOIDATA_MANIPNET", "")
FIRST_TIP = 16


@pytest.mark.long
@pytest.mark.skipif(not ROOT, reason="HOIDATA_MANIPNET is not set: the recordings are not part of this repository")
def test_fitted_hands_keep_joints_tips_and_touch_in_all_five_sequences() -> None:
    figures = measure_fits(Path(ROOT), load_embedded_hands())
    assert list(figures["sequence"]) == ["cube_med2", "cup1", "cyl_med3", "mug1", "teapot2"]
    assert (figures["mean_error_mm"] <= 6).all(), figures.to_string()
    assert (figures["tip_error_mm"] <= 3).all(), figures.to_string()
    assert (figures["lifted_near_share"] >= 0.95).all(), figures.to_string()
    assert (figures["clips"] >= 5).all(), figures.to_string()


@pytest.mark.long
@pytest.mark.skipif(not ROOT, reason="HOIDATA_MANIPNET is not set: the recordings are not part of this repository")
@pytest.mark.parametrize("name", ["cup1", "teapot2"])
def test_segments_of_a_recording_cover_its_contact_and_are_stable(name: str) -> None:
    hands, raw, key = load_embedded_hands(), RawTree(Path(ROOT)), SequenceKey("manipnet", "manipnet", name)
    clips, again = (
        [item for item in ManipNetAdapter(clips="segments").load(raw, key, hands) if isinstance(item, Clip)]
        for _ in range(2)
    )
    assert [clip.clip_id for clip in clips] == [clip.clip_id for clip in again]
    assert max(clip.n_frames for clip in clips) <= 150
    recording = read_recording(raw, name)
    near = np.minimum(*(distance.min(axis=1) for distance in recording.distances_m().values())) < TOUCH_M
    covered = np.isin(recording.source_frames, np.concatenate([clip.source_frames for clip in clips]))
    near &= recording.usable()
    assert (near & covered).sum() >= 0.9 * near.sum() > 0


def measure_fits(root: Path, hands: HandPair) -> pd.DataFrame:
    """One row per two-hand sequence below ``root``: errors of joints and tips in all clip frames, and the fraction of
    lifted frames with a fitted finger tip within 2 cm of the surface. Unreadable sequences are skipped."""
    adapter, rows, raw = ManipNetAdapter(), [], RawTree(root)
    for key in adapter.sequences(root):
        try:
            recording = read_recording(raw, key.name)
            clips = [item for item in adapter.load(raw, key, hands) if isinstance(item, Clip)]
        except BadInput:
            continue
        measured = [_measure(one, recording, hands) for one in clips]
        errors_m, near = (np.concatenate(columns) for columns in zip(*measured, strict=True))
        tips_mm = 1000 * errors_m[:, FIRST_TIP:].mean()
        rows.append((key.name, len(clips), 1000 * errors_m.mean(), tips_mm, near.mean()))
    return pd.DataFrame(rows, columns=["sequence", "clips", "mean_error_mm", "tip_error_mm", "lifted_near_share"])


def _measure(clip: Clip, recording: Recording, hands: HandPair) -> tuple[np.ndarray, np.ndarray]:
    """Errors (2 x frame, 21) in metres, and per lifted frame whether a fitted tip touches the object."""
    frames = np.searchsorted(recording.source_frames, clip.source_frames)
    pose = recording.rotation[frames], recording.translation_m[frames]
    errors, tip_distances = [], []
    for side in SIDES:
        joints = track_joints(clip.hands[side], hands[side]).astype(np.float64)
        errors.append(np.linalg.norm(joints - recording.keypoints_m[side][frames], axis=-1))
        tip_distances.append(surface_distances(recording.model, *pose, joints[:, FIRST_TIP:]).min(axis=1))
    lifted = recording.lift_m()[frames] > LIFTED_M
    return np.concatenate(errors), (np.minimum(*tip_distances) < TOUCH_M)[lifted]
