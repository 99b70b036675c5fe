"""Stage quality in the pipeline: its settings are the library's, and what fails is not annotated."""

from dataclasses import asdict

import orjson
import pandas as pd
import pytest

from hoidata.errors import BadInput
from hoidata.quality.thresholds import DEFAULT_LIMITS
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from pipelines.stages import annotate, contact, quality
from pipelines.stages.base import StagePaths, empty_reason, write_empty
from tests.builders.clips import jumping

PATHS = StagePaths("embedded", "grab")


def test_clip_that_fails_is_listed_with_its_reason_and_not_annotated(stage_folder, make_clip):
    clips = [make_clip(40, seed=3, clip_id=f"test/s1/{number}") for number in range(2)]
    clips[1] = jumping(clips[1], 20, 0.5)
    write_store(PATHS.clips, clips, generated_info("grab"))
    quality.run(PATHS)
    contact.run(PATHS)
    annotate.run(PATHS)
    words = pd.read_parquet(PATHS.annotation / "text.parquet")
    hands = pd.read_parquet(PATHS.annotation / "hand_type.parquet").set_index("clip_id")
    assert set(words["clip_id"]) == {"test/s1/0"}
    assert hands.at["test/s1/1", "reason"].startswith("left out by quality control: largest sudden step of a corner")


def test_params_decide_what_is_left_out(stage_folder, make_clip):
    write_store(PATHS.clips, [make_clip(40, seed=3)], generated_info("grab"))
    stage_folder(quality={"limits": {"size_m": {"leave_out": 0.05}}})
    quality.run(PATHS)
    rows = pd.read_parquet(PATHS.quality / "clips.parquet")
    limits = orjson.loads((PATHS.quality / "info.json").read_bytes())["thresholds"]["limits"]
    assert limits["size_m"] == {"warn": 1.0, "leave_out": 0.05}
    assert limits["hand_jump_m"] == asdict(DEFAULT_LIMITS["hand_jump_m"])
    assert rows["reasons"].tolist() == ["object box: longest side of the bounding box: 0.1 m, above 0.05 m"]


def test_empty_dataset_passes_through(stage_folder):
    write_empty(PATHS.clips, "grab is not present")
    quality.run(PATHS)
    assert empty_reason(PATHS.quality) == "grab is not present"
    annotate.run(PATHS)
    assert empty_reason(PATHS.annotation) == "grab is not present"


def test_unknown_setting_and_unknown_measure_are_named(stage_folder, make_clip):
    write_store(PATHS.clips, [make_clip(40)], generated_info("grab"))
    stage_folder(quality={"too_deep_mm": 10})
    with pytest.raises(BadInput, match="too_deep_mm"):
        quality.run(PATHS)
    stage_folder(quality={"limits": {"jerk": {"warn": 1, "leave_out": 2}}})
    with pytest.raises(BadInput, match="jerk"):
        quality.run(PATHS)
