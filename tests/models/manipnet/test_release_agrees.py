"""A check of features, not of the released network: four of its matrices are missing.

The blocks are residual, so with those four at zero the released encoders, biases and decoder still predict something:
the distances of the next frame, if the features are in the release's order, axes, units and signs.
"""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hoidata.clips.clip import SIDES
from hoidata.datasets.base import RawTree, SequenceKey
from hoidata.datasets.manipnet.adapter import read_hand_recording
from hoidata.objects.surface_index import surface_index
from hoidata.physics.scene import LIFTED_M
from hoidata.sensors import OURS
from models.manipnet.control import recording_control
from models.manipnet.features import (
    FeatureSettings,
    hand_inputs,
    object_from_wrist,
    outputs,
    released_inputs,
    released_outputs,
)
from models.manipnet.released_files import read_released

ROOT = os.environ.get("HOIDATA_MANIPNET", "")
pytestmark = pytest.mark.skipif(
    not ROOT, reason="HOIDATA_MANIPNET is not set: the data are not part of this repository"
)

SETTINGS = FeatureSettings(step_s=1 / 30, velocity_axes="object", sensors=OURS)
FRAMES, MARGIN = 80, 80  # per recording and hand; source frames left out at the ends, so that no window is clamped
BLOCKS = {
    "trajectory": (192, 528),
    "ambient": (528, 1528),
    "proximity": (1528, 2152),
    "distance": (2152, 2284),
    "normal": (2284, 2350),
}
AGREED = {"trajectory": 0.97, "ambient": 0.9, "proximity": 0.94, "distance": 0.97, "normal": 0.92}
Change = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def weights() -> dict[str, np.ndarray]:
    return {name: array.astype(np.float64) for name, array in read_released(Path(ROOT) / "weights").arrays.items()}


@pytest.fixture(scope="module")
def measured() -> tuple[np.ndarray, np.ndarray]:
    """Inputs (320, 2350) and the next frame's outputs (320, 214), released layout, lifted frames of two recordings."""
    rows = [_rows(name) for name in ("cyl_med3", "cube_med2")]
    inputs, targets = (np.concatenate(column) for column in zip(*rows, strict=True))
    return inputs, targets


def _rows(name: str) -> tuple[np.ndarray, np.ndarray]:
    recording = read_hand_recording(RawTree(Path(ROOT)), SequenceKey("manipnet", "manipnet", name))
    control, track = recording_control(recording), recording.object
    lowest = (track.model.vertices_m @ track.world_from_object.rotation[:, 1].T + track.translation_m[:, 1]).min(axis=0)
    kept = recording.usable & (lowest - np.percentile(lowest, 3) > LIFTED_M)
    kept[:MARGIN] = kept[-MARGIN:] = False
    frames = np.flatnonzero(kept)[np.linspace(0, kept.sum() - 1, FRAMES).astype(int)]
    later, surface = frames + round(SETTINGS.step_s * recording.fps), surface_index(track.model)
    inputs, targets = [], []
    for side in SIDES:
        hand, time_s = recording.tracked_hand(side), recording.time_s
        found = hand_inputs(control, side, hand, recording.state(side, frames), time_s[frames], surface, SETTINGS)
        state = recording.state(side, later)
        seen, _ = object_from_wrist(control, side, time_s[later], SETTINGS)
        distance_m = surface.nearest(seen[:, 0] @ state.point_m, None).distance_m
        inputs.append(released_inputs(hand, SETTINGS)(np.concatenate(found, axis=1)))
        targets.append(released_outputs(hand)(outputs(hand, state, distance_m, SETTINGS)))
    return np.concatenate(inputs), np.concatenate(targets)


def predicted(weights: dict[str, np.ndarray], inputs: np.ndarray) -> np.ndarray:
    """(frame, 214) normalised outputs with the four absent matrices at zero."""
    z = np.split((inputs - weights["Xmean"]) / weights["Xstd"], [192, 528], axis=1)
    e = np.concatenate([part @ weights[f"Encoder{i}_w0"].T + weights[f"Encoder{i}_b0"] for i, part in enumerate(z)], 1)
    a = np.maximum(e, 0)
    a = np.maximum(weights["DenseRes1_b0"] + np.maximum(weights["DenseRes0_b0"] + a, 0) + a, 0)
    a = weights["DenseRes3_b0"] + np.maximum(weights["DenseRes2_b0"] + a, 0) + a
    return a @ weights["Decoder_w0"].T + weights["Decoder_b0"]


def agreement(said: np.ndarray, targets: np.ndarray, rows: np.ndarray | slice = slice(None)) -> float:
    """Mean correlation of the distances that vary, over rows."""
    x, y = said[rows, 192:], targets[rows, 192:]
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    scale = np.sqrt((x**2).sum(axis=0) * (y**2).sum(axis=0))
    varies = targets[:, 192:].std(axis=0) > 1e-3
    return float(((x * y).sum(axis=0)[varies] / scale[varies]).mean())


def changed(inputs: np.ndarray, block: str, change: Change) -> np.ndarray:
    first, last = BLOCKS[block]
    other = inputs.copy()
    other[:, first:last] = change(inputs[:, first:last])
    return other


def of_other_frames(values: np.ndarray) -> np.ndarray:
    return values[np.random.default_rng(0).permutation(len(values))]


def mirrored(axis: int) -> Change:
    return lambda cells: np.flip(cells.reshape(-1, 10, 10, 10), axis + 1).reshape(len(cells), -1)


def test_the_mean_of_every_block_follows_the_released_mean(measured, weights):
    mean = measured[0].mean(axis=0)
    np.testing.assert_allclose(mean[66:90], weights["Xmean"][66:90], atol=1e-5)  # the palm is rigid
    for block, (first, last) in BLOCKS.items():
        found = np.corrcoef(mean[first:last], weights["Xmean"][first:last])[0, 1]
        assert found >= AGREED[block], (block, found)


def test_the_released_ends_predict_the_next_frames_distances_from_our_features(measured, weights):
    inputs, targets = measured
    right = agreement(predicted(weights, inputs), targets)
    assert right >= 0.55
    others = inputs.copy()
    others[:, 528:] = of_other_frames(inputs[:, 528:])
    assert agreement(predicted(weights, others), targets) <= 0.2
    wrong = {
        "proximity of other frames": changed(inputs, "proximity", of_other_frames),
        "normals inward": changed(inputs, "normal", np.negative),
        "ambient mirrored in x": changed(inputs, "ambient", mirrored(0)),
        "ambient mirrored in z": changed(inputs, "ambient", mirrored(2)),
    }
    for name, features in wrong.items():
        assert agreement(predicted(weights, features), targets) < right - 0.05, name


def test_mirroring_ambient_in_y_lowers_it_in_a_paired_bootstrap(measured, weights):
    inputs, targets = measured
    right, wrong = (predicted(weights, features) for features in (inputs, changed(inputs, "ambient", mirrored(1))))
    random, losses = np.random.default_rng(0), []
    for _ in range(1000):
        rows = random.integers(0, len(inputs), len(inputs))
        losses.append(agreement(right, targets, rows) - agreement(wrong, targets, rows))
    assert np.percentile(losses, 2.5) > 0
