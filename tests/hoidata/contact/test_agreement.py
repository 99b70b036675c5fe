"""How far contact maps agree, what the stage keeps, and the settings an output was made with."""

import json
from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips import Clip
from hoidata.contact.maps import contact_maps, f1_score, touched_frames
from hoidata.contact.proximity import ENTRY
from hoidata.contact.settings import ContactSettings, read_contact_settings
from hoidata.contact.stage import contact_store
from hoidata.errors import BadInput, MissingResource
from hoidata.files.arrays import read_npz
from tests.builders.clips import build_clip
from tests.builders.stores import write_clips


@pytest.mark.parametrize(
    ("predicted", "true", "score"),
    [([1, 1, 0, 0], [1, 0, 1, 0], 0.5), ([0, 0], [0, 0], 1.0), ([1, 1], [0, 0], 0.0), ([1, 0, 1], [1, 1, 1], 0.8)],
)
def test_f1_is_the_harmonic_mean_of_precision_and_recall(predicted, true, score):
    assert f1_score(np.array(predicted, dtype=bool), np.array(true, dtype=bool)) == pytest.approx(score)


def test_the_settings_of_an_output_are_read_from_it(tmp_path):
    (tmp_path / "info.json").write_text(json.dumps({"points": 64, "threshold_m": 0.015, "other": 1}))
    assert read_contact_settings(tmp_path) == ContactSettings(64, 0.015)
    with pytest.raises(MissingResource, match="contact"):
        read_contact_settings(tmp_path / "absent")
    (tmp_path / "info.json").write_text(json.dumps({"points": 0, "threshold_m": 0.015}))
    with pytest.raises(BadInput, match="at least 1 point"):
        read_contact_settings(tmp_path)


def test_maps_are_bytes_that_are_one_where_any_frame_touches():
    entries = {"left": np.zeros(0, ENTRY), "right": np.zeros(3, ENTRY)}
    entries["right"]["frame"], entries["right"]["point"] = (0, 2, 2), (1, 1, 3)
    maps = contact_maps(entries, 5)
    assert {side: (array.dtype, array.tolist()) for side, array in maps.items()} == {
        "left": (np.uint8, [0, 0, 0, 0, 0]),
        "right": (np.uint8, [0, 1, 0, 1, 0]),
    }
    assert touched_frames(entries["right"], 5).tolist() == [0, 2, 0, 1, 0]
    assert touched_frames(entries["left"], 5).dtype == np.uint16


def test_one_point_and_any_length_above_zero_are_settings_and_nothing_less_is():
    assert ContactSettings(points=1, threshold_m=1e-6).points == 1
    for values in ({"points": 0}, {"threshold_m": 0.0}, {"threshold_m": -0.01}, {"threshold_m": float("nan")}):
        with pytest.raises(BadInput, match=r"contact\."):
            ContactSettings(**values)


def test_the_store_keeps_entries_below_its_threshold_and_says_which_that_was(tmp_path):
    """Of the two clips that no hand touches, each counts."""
    acting = build_clip(n_frames=6, clip_id="test/s1/box_lift_1")
    apart = [still(build_clip(n_frames=6, clip_id=f"test/s1/box_lift_{number}")) for number in (2, 3)]
    clips = write_clips(tmp_path / "clips", [acting, *apart])
    found = {}
    for threshold_m in (0.02, 0.01):
        out = tmp_path / f"{threshold_m}"
        settings = ContactSettings(points=512, threshold_m=0.02)
        counts = contact_store(clips, out, settings, threshold_m=threshold_m)
        assert counts == {"clips": 3, "clips_without_contact": 2, "objects": 1, "entries": counts["entries"]}
        written = json.loads((out / "info.json").read_text())
        assert written == {"threshold_m": threshold_m, "points": 512, "counts": counts}
        distances = read_npz(out / "distances-00000.npz")["distance_m"]
        assert len(distances) == counts["entries"]
        assert 0 < distances.max() < threshold_m
        found[threshold_m] = distances
    assert len(found[0.01]) == (found[0.02] < 0.01).sum()


def test_entries_are_counted_over_all_shards(tmp_path, monkeypatch):
    monkeypatch.setattr("hoidata.contact.stage.ENTRIES_PER_SHARD", 1)
    clips = [build_clip(n_frames=6, clip_id=f"test/s1/box_lift_{number}") for number in range(3)]
    counts = contact_store(write_clips(tmp_path / "clips", clips), tmp_path / "out", ContactSettings(points=512))
    shards = [len(read_npz(path)["distance_m"]) for path in sorted((tmp_path / "out").glob("distances-*.npz"))]
    assert len(shards) == 3
    assert counts["entries"] == sum(shards) > max(shards)


def still(clip: Clip) -> Clip:
    """No hand is valid."""
    hands = {side: replace(track, valid=np.zeros_like(track.valid)) for side, track in clip.hands.items()}
    return replace(clip, hands=hands)
