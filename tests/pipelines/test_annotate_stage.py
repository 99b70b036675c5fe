"""Stage annotate in the pipeline: every setting of params.yaml reaches the library."""

from dataclasses import replace

import orjson
import pandas as pd
import pytest
from typer.testing import CliRunner

from hoidata.annotation.sentences import reference_sentences
from hoidata.errors import BadInput, MissingResource
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from pipelines.commands.adapters import app
from pipelines.stages import annotate, contact, quality
from pipelines.stages.base import StagePaths

PATHS = StagePaths("embedded", "grab")


@pytest.fixture
def clips(stage_folder, make_clip):
    """A clip with a verb and one without in the current folder."""
    clips = [make_clip(40, seed=3, clip_id=f"test/s1/{number}") for number in range(2)]
    write_store(PATHS.clips, [clips[0], replace(clips[1], verb=None)], generated_info("grab"))
    quality.run(PATHS)
    return clips


@pytest.fixture
def annotated_with(clips, stage_folder):
    """Call it with settings: hand types and sentences by clip, and the facts, of a run with them."""

    def run(of_contact: dict | None = None, **settings) -> tuple[pd.DataFrame, pd.DataFrame, dict]:
        stage_folder(annotate={"encoder": "hash", **settings}, contact=of_contact or {})
        contact.run(PATHS)
        annotate.run(PATHS)
        hands, text = (pd.read_parquet(PATHS.annotation / f"{name}.parquet") for name in ("hand_type", "text"))
        return hands.set_index("clip_id"), text, orjson.loads((PATHS.annotation / "info.json").read_bytes())

    return run


def test_threshold_and_points_of_the_contact_stage_decide_which_hand_acts(annotated_with) -> None:
    hands, _, info = annotated_with({"threshold_m": 1e-6, "points": 64})
    assert (info["threshold_m"], info["points"]) == (1e-6, 64)
    assert hands["hand_type"].isna().all()


def test_hand_types_may_have_a_threshold_of_their_own(annotated_with) -> None:
    hands, _, info = annotated_with({"threshold_m": 1e-6}, threshold_m=0.02)
    assert info["threshold_m"] == 0.02
    assert hands["hand_type"].notna().all()


def test_the_contact_stage_has_to_run_first(clips) -> None:
    with pytest.raises(MissingResource, match="run the stage 'contact'"):
        annotate.run(PATHS)


def test_forms_are_those_asked_for(clips, annotated_with) -> None:
    hands, text, info = annotated_with(forms="reference")
    clip = clips[0]
    found = text[text["clip_id"] == clip.clip_id]["sentence"].tolist()
    assert found == list(reference_sentences(clip.verb, clip.object_words, hands.at[clip.clip_id, "hand_type"]))
    assert info["forms"] == "reference"
    with pytest.raises(BadInput, match="forms"):
        annotated_with(forms="poem")


def test_whose_word_counts_for_the_hand_is_written_down_where_it_is_not_the_distances(annotated_with) -> None:
    rule = "annotated-else-proximity"
    assert [annotated_with(**chosen)[2].get("hand") for chosen in ({}, {"hand": rule})] == [None, rule]
    with pytest.raises(BadInput, match="hand"):
        annotated_with(hand="nearest")


def test_verbs_from_motion_can_be_turned_off(annotated_with) -> None:
    with_them, _, _ = annotated_with()
    assert with_them["verb_source"].tolist() == ["source", "derived"]
    without, plain, info = annotated_with(derive_verbs=False)
    assert without["verb_source"].isna().tolist() == [False, True]
    assert plain[plain["clip_id"] == "test/s1/1"]["sentence"].iloc[0].startswith("Move ")
    assert info["counts"]["derived_verbs"] == 0


def test_the_sentences_of_a_dataset_are_printed_by_a_command() -> None:
    def printed(*arguments: str) -> str:
        return CliRunner().invoke(app, ["sentences", *arguments], catch_exceptions=False).output

    whole = printed().splitlines()
    assert len(whole) == 3 + 202 + 36 + 91
    assert whole[0] == "grab: 202 pairs of verb and object"
    assert "  see, binoculars: Look through a pair of binoculars in both hands. " in printed("grab", "--hand", "both")
    with pytest.raises(BadInput, match="grab or h2o or arctic"):
        printed("taco")
