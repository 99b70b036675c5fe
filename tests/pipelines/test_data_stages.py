"""The data stages as dvc.yaml runs them: all settings of params.yaml reach the library."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import orjson
import pandas as pd
import pytest
import yaml
from typer.testing import CliRunner

from hoidata.annotation.sentences import reference_sentences
from hoidata.annotation.stage import annotate_store
from hoidata.clips.clip import SourceFile
from hoidata.datasets import RawTree, get_adapter
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.errors import BadInput, MissingResource
from hoidata.quality.thresholds import DEFAULT_LIMITS
from hoidata.splits.definitions import choose
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from pipelines.commands.adapters import app
from pipelines.lineage.closure import SourceTree
from pipelines.lineage.graph import producers, read_graph
from pipelines.lineage.locks import dvc_digest
from pipelines.lineage.manifests import Manifest, read_manifest, scan_files, write_manifest
from pipelines.params import read_file
from pipelines.stages import annotate, contact, quality, split
from pipelines.stages.adapters import ConvertSettings, ensure_manifests, raw_files
from pipelines.stages.base import StagePaths, empty_reason, load_settings, write_empty
from pipelines.stages.code import choices_of_stages, dataset_settings
from tests.builders import hoi4d
from tests.builders.clips import jumping

PROJECT = Path(__file__).parents[2]


def params_of(folder: Path, text: str) -> ConvertSettings:
    path = folder / "params.yaml"
    path.write_text(text)
    return load_settings(ConvertSettings, "convert", path)


def test_the_committed_settings_are_the_defaults_of_all_adapters_but_for_embedded_margins(tmp_path):
    path = PROJECT / "params.yaml"
    licensed = params_of(tmp_path, path.read_text().replace("profile: embedded", "profile: own", 1))
    assert licensed.adapter("grab") == GrabAdapter()
    assert load_settings(ConvertSettings, "convert", path).adapter("grab") == GrabAdapter(margin_frames=10)


def test_a_dataset_may_set_its_margin(tmp_path):
    params = params_of(tmp_path, "convert: {margin_frames: 5, adapters: {arctic: {margin_frames: 2}, h2o: null}}")
    assert [params.adapter(name).margin_frames for name in ("grab", "arctic", "h2o")] == [5, 2, 5]


def test_a_variant_has_the_adapter_and_raw_files_of_its_source_and_separate_settings(tmp_path, monkeypatch):
    params = params_of(tmp_path, "convert: {adapters: {arctic-whole: {clips: whole}}}")
    assert (params.adapter("arctic").clips, params.adapter("arctic-whole").clips) == ("described", "whole")
    with pytest.raises(MissingResource, match="no adapter 'kitchen'"):
        params.adapter("kitchen-whole")
    monkeypatch.chdir(tmp_path)
    scanned = Manifest("arctic", True, "files", "some", files=(SourceFile("raw_seqs/s01/box.mano.npy", 9, "ab" * 32),))
    write_manifest(StagePaths("own", "arctic").manifest, scanned)
    ensure_manifests("own", ["arctic", "arctic-whole"])
    assert read_manifest(StagePaths("own", "arctic-whole").manifest) == scanned
    (tmp_path / "files").mkdir()
    monkeypatch.setenv("HOIDATA_ARCTIC", str(tmp_path / "files"))
    assert raw_files(StagePaths("own", "arctic-whole")) == raw_files(StagePaths("own", "arctic")) == tmp_path / "files"
    # A generated corpus is written per variant, since its manifest may have another recipe.
    with pytest.raises(MissingResource, match=r"\.hoidata/raw/embedded/arctic-whole"):
        raw_files(StagePaths("embedded", "arctic-whole"))


def test_a_folder_with_a_file_per_frame_is_one_entry_of_a_manifest(tmp_path):
    """HOI4D has 2,971 recordings of 900 such files."""
    adapter, root = get_adapter("hoi4d"), hoi4d.write_two(tmp_path)
    listed = {entry.path: entry for entry in scan_files(root, adapter.parts)}
    assert f"HOI4D_annotations/{hoi4d.SAFE}/objpose" in listed
    assert len(listed) < 30
    assert adapter.load(RawTree(root, listed), hoi4d.key_of(hoi4d.SAFE), hoi4d.HANDS)
    (root / f"HOI4D_annotations/{hoi4d.SAFE}/objpose/7.json").write_text("{}")
    with pytest.raises(BadInput, match="SHA-256"):
        adapter.load(RawTree(root, listed), hoi4d.key_of(hoi4d.SAFE), hoi4d.HANDS)


def test_a_variant_has_the_code_of_its_source_and_its_settings_concern_it_alone():
    plain = read_file(PROJECT / "params.yaml")
    params = plain | {
        "datasets": ["arctic", "arctic-whole"],
        "convert": {"adapters": {"arctic-whole": {"clips": "whole"}}},
    }
    choices = choices_of_stages(params, SourceTree(PROJECT))
    for stage in ("raw", "convert", "split"):
        assert choices[f"{stage}/arctic"] == choices[f"{stage}/arctic-whole"]
    assert dataset_settings(params, "convert/arctic") == {"params.yaml convert.adapters.arctic": "null"}
    assert "whole" in dataset_settings(params, "convert/arctic-whole")["params.yaml convert.adapters.arctic-whole"]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("convert: {margin: 5}", "keys among: margin_frames, adapters, got margin"),
        ("convert: {margin_frames: -1}", "margin_frames"),
        ("convert: {adapters: {grab: {margin: 1}}}", "settings of the adapter grab.*margin_frames.*got margin"),
    ],
)
def test_an_unknown_setting_is_refused_with_a_list_of_the_known_ones(tmp_path, text, problem):
    with pytest.raises(BadInput, match=problem):
        params_of(tmp_path, text).adapter("grab")


PATHS = StagePaths("embedded", "grab")


def test_a_clip_that_fails_quality_control_is_listed_with_its_reason_and_not_annotated(stage_folder, make_clip):
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


def test_params_set_the_quality_limits(stage_folder, make_clip):
    write_store(PATHS.clips, [make_clip(40, seed=3)], generated_info("grab"))
    stage_folder(quality={"limits": {"size_m": {"leave_out": 0.05}}})
    quality.run(PATHS)
    rows = pd.read_parquet(PATHS.quality / "clips.parquet")
    limits = orjson.loads((PATHS.quality / "info.json").read_bytes())["thresholds"]["limits"]
    assert limits["size_m"] == {"warn": 1.0, "leave_out": 0.05}
    assert limits["hand_jump_m"] == asdict(DEFAULT_LIMITS["hand_jump_m"])
    assert rows["reasons"].tolist() == ["object box: longest side of the bounding box: 0.1 m, above 0.05 m"]


def test_a_dataset_without_clips_passes_on_its_reason(stage_folder):
    write_empty(PATHS.clips, "grab is not present")
    for stage, out in ((quality, PATHS.quality), (annotate, PATHS.annotation), (split, PATHS.splits)):
        stage.run(PATHS)
        assert empty_reason(out) == "grab is not present"


@pytest.mark.parametrize(
    ("settings", "name"),
    [({"too_deep_mm": 10}, "too_deep_mm"), ({"limits": {"jerk": {"warn": 1, "leave_out": 2}}}, "jerk")],
)
def test_an_unknown_setting_and_an_unknown_measure_are_refused(stage_folder, settings, name):
    stage_folder(quality=settings)
    with pytest.raises(BadInput, match=name):
        quality.run(PATHS)


@pytest.fixture
def clips(stage_folder, make_clip):
    """A store with a clip with and a clip without a verb, in the current folder."""
    clips = [make_clip(40, seed=3, clip_id=f"test/s1/{number}") for number in range(2)]
    write_store(PATHS.clips, [clips[0], replace(clips[1], verb=None)], generated_info("grab"))
    quality.run(PATHS)
    return clips


@pytest.fixture
def annotated_with(clips, stage_folder):
    """A function that annotates with some settings; returns hand types and sentences by clip, and the facts."""

    def run(of_contact: dict | None = None, **settings) -> tuple[pd.DataFrame, pd.DataFrame, dict]:
        stage_folder(annotate={"encoder": "hash", **settings}, contact=of_contact or {})
        contact.run(PATHS)
        annotate.run(PATHS)
        hands, text = (pd.read_parquet(PATHS.annotation / f"{name}.parquet") for name in ("hand_type", "text"))
        return hands.set_index("clip_id"), text, orjson.loads((PATHS.annotation / "info.json").read_bytes())

    return run


def test_the_contact_stage_decides_the_active_hands_but_for_another_threshold_of_hand_types(annotated_with) -> None:
    hands, _, info = annotated_with({"threshold_m": 1e-6, "points": 64})
    assert (info["threshold_m"], info["points"]) == (1e-6, 64)
    assert hands["hand_type"].isna().all()
    hands, _, info = annotated_with({"threshold_m": 1e-6}, threshold_m=0.02)
    assert info["threshold_m"] == 0.02
    assert hands["hand_type"].notna().all()


def test_the_contact_stage_has_to_run_first(clips) -> None:
    with pytest.raises(MissingResource, match="run the stage 'contact'"):
        annotate.run(PATHS)


def test_sentences_have_the_requested_forms(clips, annotated_with) -> None:
    hands, text, info = annotated_with(forms="reference")
    clip = clips[0]
    sentences = text[text["clip_id"] == clip.clip_id]["sentence"].tolist()
    assert sentences == list(reference_sentences(clip.verb, clip.object_words, hands.at[clip.clip_id, "hand_type"]))
    assert info["forms"] == "reference"
    with pytest.raises(BadInput, match="forms"):
        annotated_with(forms="poem")


def test_a_rule_for_hands_that_changes_no_hand_writes_the_same_bytes(annotated_with) -> None:
    """So that DVC runs no stage after it: the clips have no label of the hand."""
    digests = []
    for chosen in ({}, {"hand": "annotated-else-proximity"}):
        annotated_with(**chosen)
        digests.append(dvc_digest(PATHS.annotation))
    assert digests[0] == digests[1]
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


@pytest.fixture
def folder(make_clip, tmp_path, monkeypatch):
    """A project folder with four annotated clips, one per subject, as the current folder."""
    monkeypatch.chdir(tmp_path)
    names = ("s1", "s2", "s9", "s10")
    clips = [
        replace(make_clip(seed=seed, clip_id=f"grab/{name}/box_lift_1", subject=name), sequence=f"{name}/box_lift_1")
        for seed, name in enumerate(names)
    ]
    write_store(PATHS.clips, clips, generated_info("grab"))
    annotate_store(PATHS.clips, PATHS.annotation, encoder="hash")
    return tmp_path


def choose_split(folder, value) -> None:
    (folder / "params.yaml").write_text(yaml.safe_dump({"split": {"grab": value}}))


def test_a_split_is_a_name_or_a_rule_in_params(folder):
    choose_split(folder, "text2hoi")
    split.run(PATHS)
    assert pd.read_parquet(PATHS.splits / "splits.parquet")["split"].tolist() == [
        "train",
        "train",
        "validation",
        "test",
    ]
    (folder / "params.yaml").write_text("split: {}")  # then the default of the dataset: text2hoi
    split.run(PATHS)
    assert json.loads((PATHS.splits / "info.json").read_text())["chosen"]["name"] == "text2hoi"
    choose_split(folder, {"by": "subject", "train": ["s2"], "validation": ["s1"], "test": ["s9"]})
    split.run(PATHS)
    parts = pd.read_parquet(PATHS.splits / "splits.parquet")["split"]
    assert parts.tolist()[:3] == ["validation", "train", "test"]
    assert pd.isna(parts[3])
    assert json.loads((PATHS.splits / "info.json").read_text())["chosen"]["name"] == "params.yaml"


def test_subsets_without_clips_are_reported_with_the_setting(folder, capsys):
    choose_split(folder, {"by": "subject", "train": "rest", "validation": ["s7"], "test": ["s10"]})
    split.run(PATHS)
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith("embedded-grab: no validation clips: ")
    assert "split.grab of params.yaml" in said[0]


def test_an_unknown_split_is_refused_with_a_list_of_the_known_ones(folder):
    choose_split(folder, "text2hio")
    with pytest.raises(BadInput, match=r"params.yaml: split.grab: expected one of: composition, .*official, text2hoi"):
        split.run(PATHS)
    assert not PATHS.splits.exists()


def test_all_stages_that_open_the_annotated_store_depend_on_its_split(pytestconfig):
    graph = read_graph(pytestconfig.rootpath)
    producer_of = producers(graph)
    for name in ("h2o", "grab", "arctic", "manipnet"):
        out = f"data/embedded/{name}/splits"
        assert producer_of[out].name == f"split@embedded-{name}"
        readers = {stage.name.rpartition(":")[2].split("@")[0] for stage in graph.values() if out in stage.deps}
        networks = {f"train-{network}" for network in ("contact", "length", "diffusion", "refiner")}
        assert readers == {*networks, "sample", "evaluate", "evaluator", "controls"}


def test_the_project_chooses_a_split_each_dataset_has(pytestconfig):
    params = yaml.safe_load((pytestconfig.rootpath / "params.yaml").read_text())
    for dataset in params["datasets"]:
        assert choose(dataset, params["split"][dataset]).rule
