"""Pairs of clips with known differences, and an annotated dataset to evaluate stores against."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hoidata.clips import SIDES, Clip
from hoidata.contact.maps import contact_maps, distance_entries
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.metrics.pair import Motion, Pair, TrueContact, acting_sides
from hoidata.objects.sampling import sample_points
from tests.builders.annotated import write_annotated_dataset


@pytest.fixture
def pair_of() -> Callable[..., Pair]:
    return build_pair


def build_pair(
    predicted: Clip, reference: Clip, hand_type: str = "right", threshold_m: float = 0.02, table_m: float | None = None
) -> Pair:
    """A prediction paired with its reference as in ``evaluate_store``; table_m None: without gravity."""
    hands = load_embedded_hands()
    motions = [
        Motion(clip, {side: track_joints(clip.hands[side], hands[side]) for side in SIDES}, hands)
        for clip in (predicted, reference)
    ]
    points, sides = sample_points(reference.object.model, 256), acting_sides(hand_type)
    index = ProximityIndex(points)
    entries = distance_entries(reference, motions[1].joints_m, index, threshold_m)
    maps = contact_maps(entries, index.count)
    touched = np.logical_or.reduce([maps[side] > 0 for side in sides])
    return Pair(*motions, sides, TrueContact(index, points.part, touched, threshold_m), table_m)


@pytest.fixture
def moved() -> Callable[..., Clip]:
    return move_hands


def move_hands(clip: Clip, shift_m: np.ndarray | tuple[float, ...], sides=SIDES) -> Clip:
    """The clip with some hands moved in the world."""
    hands = dict(clip.hands)
    for side in sides:
        wrist = hands[side].wrist_m + np.asarray(shift_m, np.float32)
        hands[side] = replace(hands[side], wrist_m=wrist.astype(np.float32))
    return replace(clip, hands=hands)


@pytest.fixture
def write_annotated(make_clip, tmp_path: Path) -> Callable[..., tuple[Path, dict[str, Clip]]]:
    """Call it with threshold_m and points: an annotated dataset, and its two test clips (right hand, and both)."""
    return lambda **settings: write_annotated_dataset(tmp_path / "annotated", make_clip, **settings)
