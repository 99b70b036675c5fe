"""Pairs of clips that differ in a known way, and an annotated dataset to evaluate stores against."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hoidata.annotation.stage import annotate_store
from hoidata.clips import SIDES, Clip
from hoidata.contact.maps import contact_maps, distance_entries
from hoidata.contact.proximity import ProximityIndex
from hoidata.contact.stage import contact_store
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.metrics.pair import Motion, Pair, TrueContact, acting_sides
from hoidata.objects.sampling import sample_points
from hoidata.splits import split_store
from hoidata.store.info import generated_info
from hoidata.store.store import write_store

RULE = {"by": "subject", "train": ["s1"], "validation": ["s2"], "test": ["s3"]}


@pytest.fixture
def pair_of() -> Callable[..., Pair]:
    return build_pair


def build_pair(
    predicted: Clip, reference: Clip, hand_type: str = "right", threshold_m: float = 0.02, table_m: float | None = None
) -> Pair:
    """A prediction beside its reference, as ``evaluate_store`` would make it. table_m: None leaves gravity out."""
    hands = load_embedded_hands()
    motions = [
        Motion(clip, {side: track_joints(clip.hands[side], hands[side]) for side in SIDES}, hands)
        for clip in (predicted, reference)
    ]
    index, sides = ProximityIndex(sample_points(reference.object.model, 256)), acting_sides(hand_type)
    entries = distance_entries(reference, motions[1].joints_m, index, threshold_m)
    maps = contact_maps(entries, index.count)
    touched = np.logical_or.reduce([maps[side] > 0 for side in sides])
    return Pair(*motions, sides, TrueContact(index, touched, threshold_m), table_m)


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

    def write(threshold_m: float = 0.02, points: int = 256) -> tuple[Path, dict[str, Clip]]:
        root = tmp_path / "annotated"
        plans = (("s1", "right"), ("s2", "left"), ("s3", "right"), ("s3", "both"))
        clips = [
            make_clip(12, hand, seed=seed, clip_id=f"toy/{subject}/{seed}", subject=subject)
            for seed, (subject, hand) in enumerate(plans)
        ]
        write_store(root / "clips", clips, generated_info("toy"))
        annotate_store(root / "clips", root / "annotation", encoder="hash", threshold_m=0.02)
        contact_store(root / "clips", root / "contact", points=points, threshold_m=threshold_m)
        split_store(root / "clips", root / "annotation", root / "splits", RULE)
        return root, {clip.clip_id: clip for clip in clips[2:]}

    return write
