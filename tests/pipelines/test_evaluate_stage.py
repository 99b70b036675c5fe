"""Evaluation as a stage, as a command, and of a store that a script of the docs wrote."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hoidata.errors import BadInput
from hoidata.store.annotated import load_annotated
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from models.evaluator.settings import EvaluatorSettings
from models.evaluator.stage import train_evaluators
from pipelines.cli import app
from pipelines.stages import evaluate
from pipelines.stages.base import StagePaths, write_empty
from pipelines.stages.families import families_of
from tests.builders.annotated import write_annotated_dataset
from tests.builders.stores import write_two_verbs

PROJECT = Path(__file__).parents[2]
PATHS = StagePaths("embedded", "grab", family="ours")
METRICS = PATHS.metrics / "ours.json"


@pytest.fixture
def clips(stage_folder, make_clip):
    """An annotated dataset where the stage looks for it; its test clips."""
    stage_folder(families=["ours"])
    return write_annotated_dataset(PATHS.data, make_clip)[1]


def write_samples(clips, family="ours"):
    folder = replace(PATHS, family=family).samples
    predicted = [replace(clip, clip_id=f"{clip.clip_id}~0") for clip in clips.values()]
    write_store(folder / "clips", predicted, generated_info(family))
    (folder / "diagnostics.json").write_text(json.dumps({"length": {"mae_frames": 3.5}}))


def test_the_stage_writes_metrics_and_the_diagnostics_of_the_family(clips):
    write_samples(clips)
    evaluate.run(PATHS)
    evaluation = json.loads(METRICS.read_text())
    assert evaluation["figures"]["contact_f1"] == 1
    assert evaluation["held_out_clips"] == evaluation["motions"] == 2
    assert evaluation["diagnostics"] == {"length": {"mae_frames": 3.5}}


def test_optional_metrics_are_computed_if_params_name_them(clips):
    write_samples(clips)
    Path("params.yaml").write_text(
        "{profile: embedded, datasets: [grab], families: [ours], evaluate: {metrics: [bimart]}}"
    )
    evaluate.run(PATHS)
    figures = json.loads(METRICS.read_text())["figures"]
    assert (figures["contact_f1"], figures["bimart_con_paper"], figures["bimart_pen_1cm_corrected"]) == (1, 100, 0)
    Path("params.yaml").write_text(
        "{profile: embedded, datasets: [grab], families: [ours], evaluate: {metrics: [omomo]}}"
    )
    with pytest.raises(BadInput, match=r"evaluate.metrics: expected names of bimart, got omomo"):
        evaluate.run(PATHS)


def test_an_added_family_is_evaluated_alone_and_a_removed_one_is_deleted(clips, stage_folder, monkeypatch):
    write_samples(clips)
    evaluate.run(PATHS)
    before, measured = METRICS.read_bytes(), []
    monkeypatch.setattr(evaluate, "_measured", lambda paths, settings: measured.append(paths.family) or {"empty": ""})
    stage_folder(families=["ours", "theirs"])
    with pytest.raises(BadInput, match="samples/embedded/grab/theirs: expected motions of every family"):
        evaluate.run(PATHS)
    write_samples(clips, "theirs")
    evaluate.run(PATHS)
    assert (measured, METRICS.read_bytes()) == (["theirs"], before)
    assert (PATHS.metrics / "theirs.json").is_file()
    stage_folder(families=["ours"])
    evaluate.run(PATHS)
    assert [path.name for path in PATHS.metrics.iterdir()] == ["ours.json"]
    assert measured == ["theirs"]


@pytest.mark.parametrize("changed", ["settings", "code", "data", "motions", "record"])
def test_metrics_are_recomputed_after_each_change_they_depend_on(clips, stage_folder, monkeypatch, changed):
    measured = []
    monkeypatch.setattr(evaluate, "_measured", lambda paths, settings: measured.append(paths.family) or {"empty": ""})
    write_samples(clips)
    for _ in range(2):
        evaluate.run(PATHS)
    assert measured == ["ours"]
    files = {
        "code": evaluate.CODE,
        "data": PATHS.contact / "more.json",
        "motions": PATHS.samples / "diagnostics.json",
        "record": PATHS.measured,
    }
    if changed == "settings":
        stage_folder(families=["ours"], evaluate={"metrics": ["bimart"]})
    else:
        files[changed].parent.mkdir(exist_ok=True)
        files[changed].write_text("{")
    evaluate.run(PATHS)
    assert measured == ["ours"] * 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"families": ["bimart"]}, "families: .*family_datasets.bimart instead"),
        ({"family_datasets": {"bimart": ["taco"]}}, "family_datasets.bimart: .*taco"),
        ({"family_datasets": {"toy": ["grab"]}}, "family_datasets: expected keys among: manipnet, bimart, .*got toy"),
    ],
)
def test_an_optional_family_is_chosen_by_its_datasets_alone(settings, message):
    params = {"datasets": ["grab", "h2o"], "families": ["ours"], "family_datasets": {}}
    with pytest.raises(BadInput, match=message):
        families_of(params | settings, "grab")
    chosen = params | {"family_datasets": {"manipnet": ["grab"], "bimart": None}}
    assert [families_of(chosen, name) for name in ("grab", "h2o")] == [["ours", "manipnet"], ["ours"]]


def test_a_subset_no_split_has_is_refused_and_not_empty(clips):
    with pytest.raises(BadInput, match="train, validation, test"):
        load_annotated(PATHS.data).ids("dev")


def test_without_motions_the_reason_is_written(clips):
    write_empty(PATHS.samples, "not trained: length")
    evaluate.run(PATHS)
    assert json.loads(METRICS.read_text()) == {"empty": "not trained: length", "held_out_clips": 0}


def test_the_tutorial_for_a_method_of_your_own_runs_as_typed(stage_folder):
    stage_folder(families=["ours"])
    write_two_verbs(PATHS.data)
    page = (PROJECT / "docs/measure.md").read_text()
    (script,) = re.findall(r"```python\n(# Your method.*?)```", page, re.DOTALL)
    (commands,) = re.findall(r"```console\n(.*?)```", page, re.DOTALL)
    plain, with_bimart = commands.splitlines()
    assert sum(1 for line in script.splitlines() if line and not line.startswith("#")) <= 20
    train_evaluators(PATHS.data, PATHS.evaluators, EvaluatorSettings(networks=("paper",), most_steps=2))
    exec(compile(script, "measure.md", "exec"), {})
    for command in (plain, f"{with_bimart.partition('#')[0]} --out mine.json"):
        name, *words = shlex.split(command)
        done = CliRunner().invoke(app, words)
        assert (name, done.exit_code) == ("hoidata", 0), done.output
        assert "joint error of the best sample" in done.output
        assert "top-3 accuracy, paper" in done.output
    evaluation = json.loads(Path("mine.json").read_text())
    assert evaluation["figures"]["joint_error_mm"] == pytest.approx(10.0, abs=0.01)
    assert evaluation["motions"] == 4
    assert evaluation["figures"]["bimart_accel_paper"] > 0
    info = json.loads((PATHS.evaluators / "info.json").read_text())
    assert evaluation["evaluators"]["paper"]["digest"] == info["evaluators"]["paper"]["digest"]


def test_motions_skipped_for_one_reason_are_printed_in_one_line(clips):
    done = CliRunner().invoke(app, ["evaluate", "--store", str(PATHS.clips), "--reference", str(PATHS.data)])
    lines = [line for line in done.output.splitlines() if line.startswith("skipped: ")]
    recorded = load_annotated(PATHS.data)
    others = len(recorded.ids()) - len(recorded.ids("test"))
    assert len(lines) == 1
    assert f" and {others - 1} more: no clip of this part of the split is its reference" in lines[0]
