"""Windows of whole clips: which ones, their motion and contact, and their evaluation."""

import os
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hoidata.actions.action import training_actions
from hoidata.batches.dataset import HoiDataset, contact_of
from hoidata.clips.clip import SIDES
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.metrics.evaluate import evaluate_store
from hoidata.metrics.optional_metrics import select_metrics
from hoidata.metrics.target_contact import read_target_contact
from hoidata.settings import build_config
from hoidata.store.annotated import AnnotatedStore, WindowedStore, WindowProtocol, load_annotated
from hoidata.store.store import open_store
from models.common.predicting import PredictionConfig, sample_family
from models.registry import load_family

PROTOCOL = WindowProtocol(start=2, stride=3, frames=6, trimmed_end=1)
HANDS = load_embedded_hands()
SECTION: dict[str, Any] = {
    "samples": 2,
    "windows": {"start": 2, "stride": 3, "frames": 6, "trimmed_end": 1},
}


@pytest.mark.parametrize("n_frames", [327, 328, 329, 392, 393, 700, 1023])
def test_the_default_windows_are_those_of_the_released_loop(n_frames: int) -> None:
    """Start at 100; as long as start + 64 < T - 164, take 64 frames and go on by 64."""
    starts, start = [], 100
    while start + 64 < n_frames - 164:
        starts.append(start)
        start += 64
    assert list(WindowProtocol().starts(n_frames)) == starts


def test_the_windows_of_the_published_sequences_are_the_published_list(arctic_files: Path) -> None:
    published = defaultdict(list)
    for line in (arctic_files / "bimart" / "test_filenames.txt").read_text().split():
        name, subject, first = line.rsplit("_", 2)
        published[subject, name].append(int(first))
    compared = 0
    for (subject, name), starts in published.items():
        path = arctic_files / "raw_seqs" / subject / f"{name}.object.npy"
        if path.is_file():
            assert sorted(starts) == list(WindowProtocol().starts(len(np.load(path, allow_pickle=False))))
            compared += len(starts)
    assert compared == 254


@pytest.fixture
def arctic_files() -> Path:
    root = os.environ.get("HOIDATA_ARCTIC")
    if not root:
        pytest.skip("set HOIDATA_ARCTIC to the folder of ARCTIC's files")
    return Path(root)


def test_a_window_has_the_frames_and_contact_of_its_clip(annotated: AnnotatedStore) -> None:
    windowed = WindowedStore(annotated, PROTOCOL)
    assert windowed.ids("train") == annotated.ids("train")
    ids = [f"{i}@{s}" for i in annotated.ids("test") for s in PROTOCOL.starts(annotated.clip(i).n_frames)]
    assert windowed.ids("test") == ids
    assert len(ids) > 2
    for sample in HoiDataset(windowed, "test"):
        clip_id, _, first = sample.clip_id.partition("@")
        whole, frames = HoiDataset(annotated, "test").whole(clip_id), slice(int(first), int(first) + 6)
        expected = whole.crop(frames.start, 6)
        for name in ("hands", "object", "joints_m", "world_from_model"):
            np.testing.assert_allclose(getattr(sample, name), getattr(expected, name), atol=1e-6)
        np.testing.assert_array_equal(sample.contact, expected.contact)
        assert (sample.hand_type, sample.sentences) == (whole.hand_type, whole.sentences)
        clip, recorded = windowed.clip(sample.clip_id), annotated.clip(clip_id)
        np.testing.assert_array_equal(clip.source_frames, recorded.source_frames[frames])
        for side in SIDES:
            entries = windowed.distances(sample.clip_id, side)
            touched = contact_of(entries, len(sample.points.points_m), annotated.contact_threshold_m).any(axis=0)
            np.testing.assert_array_equal(windowed.contact_of(sample.clip_id, side), touched)


@pytest.mark.parametrize(("name", "value"), [("start", -1), ("stride", 0), ("frames", 2), ("trimmed_end", -1)])
def test_windows_that_cannot_be_are_refused(name: str, value: int) -> None:
    with pytest.raises(BadInput, match=f"windows.{name}"):
        build_config(PredictionConfig, {"windows": {name: value}}, "params.yaml: sample")


def test_recorded_windows_are_measured_as_perfect_each_by_itself(
    annotated: AnnotatedStore, annotated_root: Path, tmp_path: Path
) -> None:
    family = load_family("ground-truth")
    sample_family(family, annotated_root, tmp_path, tmp_path / "out", SECTION, HANDS)
    result = evaluate_store(tmp_path / "out" / "clips", annotated_root, HANDS, metrics=select_metrics(["bimart"]))
    count = len(WindowedStore(annotated, PROTOCOL).ids("test"))
    assert (result["held_out_clips"], result["motions"], result["left_out"]) == (count, 2 * count, [])
    figures = result["figures"]
    assert (figures["joint_error_mm"], figures["contact_f1"], figures["bimart_mul_cm"]) == (0, 1, 0)
    assert set(read_target_contact(tmp_path / "out" / "clips")) == set(open_store(tmp_path / "out" / "clips").ids)


def test_verbs_of_windows_are_compared_with_training_windows(
    annotated: AnnotatedStore, annotated_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sample_family(load_family("ground-truth"), annotated_root, tmp_path, tmp_path / "out", SECTION, HANDS)
    learnt = []
    monkeypatch.setattr(
        "hoidata.metrics.evaluate.training_actions", lambda store: learnt.append(store) or training_actions(store)
    )
    evaluate_store(tmp_path / "out" / "clips", annotated_root, HANDS)
    assert learnt[0].ids("train") == WindowedStore(annotated, PROTOCOL, "train").ids("train")
    assert all("@" in clip_id for clip_id in learnt[0].ids("train"))


def test_without_a_window_nothing_is_sampled(annotated_root: Path, tmp_path: Path) -> None:
    section = {"samples": 1, "windows": {}}  # the toy clips are shorter than 328 frames
    counts = sample_family(load_family("ground-truth"), annotated_root, tmp_path, tmp_path / "out", section, HANDS)
    assert counts == {"clips": 0}


def test_the_windowed_dataset_of_a_project_is_read(annotated_root: Path) -> None:
    windowed = WindowedStore(load_annotated(annotated_root), PROTOCOL)
    assert all(len(windowed.text_embedding(name)) == len(windowed.sentences(name)) for name in windowed.ids())
