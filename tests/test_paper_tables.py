"""Text2HOI's tables in bench/: settings, cells, differences, the negative control, and a whole run."""

import json
import os
import subprocess
import sys
from itertools import product
from pathlib import Path
from statistics import stdev

import pytest

from bench import paper_tables
from bench.paper_tables import METRIC, PaperTable, Row, cell, difference, make
from bench.project import TEXT2HOI, sample_only, write_params
from hoidata.errors import BadInput
from hoidata.metrics.intervals import t_interval
from hoidata.package_paths import FOLDER
from hoidata.settings import build_config, merge_settings
from models.common.training import TrainingConfig
from models.registry import NETWORKS, load_family, load_network
from models.text2hoi.sampler import SamplingConfig
from pipelines.expected_orderings import RECORDED
from pipelines.params import load_yaml, read_params
from pipelines.stages.families import families_of
from pipelines.stages.train import TrainParams

ALL = [
    *(PaperTable(*pair) for pair in product(("table1", "table2", "presets"), ("embedded", "study", "arctic"))),
    PaperTable("presets", "composition"),
    PaperTable("presets", "object"),
]
ACCURACY, FID = METRIC["accuracy_top1_paper"], METRIC["fid_paired_paper"]


@pytest.mark.parametrize("table", ALL, ids=lambda table: f"{table.name} {table.corpus}")
def test_settings_of_every_run_fit_a_project_and_its_rows_are_sampled(table, tmp_path):
    sampled = {}
    for name, settings in table.runs().items():
        write_params(tmp_path / "params.yaml", settings)
        params = read_params(tmp_path)
        train = build_config(TrainParams, params["train"], "params.yaml: train")
        for network in map(load_network, NETWORKS):
            parts = {"network": network.config, "loss": network.loss, "training": TrainingConfig}
            for part, kind in parts.items():
                chosen = train.of(network.name).get(part, {})
                assert kind is None or build_config(kind, chosen, f"{network.name}.{part}")
                assert kind is not None or not chosen
        build_config(SamplingConfig, params["sample"]["text2hoi"], "sample")
        assert train.seed == int(name.split()[-1])
        sampled[name.rpartition(" ")[0]] = {*families_of(params, table.dataset), *params["controls"]["families"]}
    titles = [line.title for line in table.rows]
    assert all(line.family in sampled[line.run] and load_family(line.family) for line in table.rows)
    assert all(line.reference in titles for line in table.rows if line.reference)
    assert {line.family for line in table.rows} >= {RECORDED, "static"}
    assert table.metrics <= set(METRIC)


def test_a_project_samples_only_its_families(tmp_path):
    stages, shipped = tmp_path / "models/text2hoi/dvc.yaml", FOLDER / "models/text2hoi/dvc.yaml"
    stages.parent.mkdir(parents=True)
    stages.write_text(shipped.read_text().replace("python -m", "python3 -m"))
    for families in (["text2hoi-coarse", "ground-truth"], ["text2hoi", "text2hoi-coarse"], []):
        sample_only(tmp_path, families)
        sample = load_yaml(stages.read_bytes())["stages"]["sample"]
        assert sample["matrix"]["family"] == [name for name in TEXT2HOI if name in families or not families]
        assert sample["cmd"].startswith("python3 -m")
    assert stages.read_text() == shipped.read_text().replace("python -m", "python3 -m")


@pytest.mark.parametrize("corpus", ["embedded", "study", "arctic"])
def test_all_generators_of_table_1_take_equally_many_steps(corpus):
    networks = PaperTable("table1", corpus).settings["train"]["small"]
    steps = {name: networks[name]["training"]["steps"] for name in networks}
    assert steps["diffusion"] == steps["mdm"] == steps["imos"] == steps["t2m-movement"] + steps["t2m"]


@pytest.mark.parametrize("corpus", ["study", "arctic"])
def test_the_presets_are_trained_as_in_table_1(corpus):
    runs = [PaperTable(name, corpus).runs() for name in ("presets", "table1")]
    assert all(runs[0][name]["train"] == runs[1][name]["train"] for name in ("ours 0", "paper 0"))
    assert runs[0]["best-of-5 0"]["train"] == runs[0]["ours 0"]["train"]


def test_every_run_of_table_2_changes_another_part():
    table = PaperTable("table2", "study")
    changes = [json.dumps(settings["train"], sort_keys=True) for settings in table.runs().values()]
    assert len(set(changes)) == len(changes)
    assert {line.run for line in table.rows} == set(table.content["runs"])


def test_an_unknown_corpus_is_refused():
    with pytest.raises(BadInput, match="one of arctic, study, embedded, got no corpus"):
        _ = PaperTable("table1", "").settings


REPETITIONS = {0: [0.4, 0.5, 0.6], 1: [0.7, 0.8, 0.6]}  # accuracies by seed


def method(values: list[float], **parts: dict) -> dict:
    """A method's metrics with a top-1 accuracy of these repetitions."""
    name = ACCURACY.name
    intervals = {name: {"repetitions": list(t_interval(values) or ()), "clips": [0.1, 0.9]}}
    content = {"figures": {name: sum(values) / len(values)}, "intervals": intervals, "notes": {}, "unmeasured": {}}
    return content | parts


def results(**methods: dict) -> dict:
    """Two seeds of the run `ours` with the methods, and those of ``REPETITIONS`` for mdm."""
    return {
        f"ours {seed}": {"seconds": {}, "methods": {"mdm": method(values), **methods}}
        for seed, values in REPETITIONS.items()
    }


def test_a_cell_has_the_mean_the_spread_over_seeds_and_the_interval_over_clips():
    text = cell(Row("MDM", "ours", "mdm"), results(), ACCURACY)
    assert text == f"0.600±{stdev([0.5, 0.7]):.3f} (0.100–0.900)"


def test_a_cell_of_one_training_has_the_interval_over_repetitions():
    half = 4.302653 * 0.1 / 3**0.5  # Student's t for three repetitions, standard deviation .1
    one = {"ours 0": results()["ours 0"]}
    assert cell(Row("MDM", "ours", "mdm"), one, ACCURACY) == f"0.500±{half:.3f} (0.100–0.900)"


def test_a_cell_without_repetitions_has_the_interval_over_clips_and_one_without_value_the_reason():
    single = {"figures": {FID.name: 2.0}, "intervals": {FID.name: {"clips": [1.0, 3.0]}}}
    missing = {"figures": {}, "intervals": {}, "notes": {FID.name: "N too small"}}
    line = Row("static", "ours", "static")
    assert cell(line, results(static=single), FID) == "2.00±0.00 (1.00–3.00)"
    assert cell(line, results(static=missing), FID) == "N too small"
    assert cell(line, results(static={"empty": "not trained"}), FID) == "not trained"
    assert cell(line, results(), FID) == "not measured"


def test_hidden_metrics_have_no_column_and_the_processor_time_is_in_the_first_table():
    table, content = PaperTable("table1", "study"), results()
    whole, short = table.markdown(content), table.markdown(content, [ACCURACY.name])
    assert "| MDM | 0.600" in whole
    assert "0.600" not in short
    assert whole.count("processor minutes, training") == 1
    reason = "They cannot be compared"
    assert reason in whole
    assert reason not in table.markdown(content, ["texts"])


@pytest.mark.parametrize(
    ("metric", "value", "word"), [(ACCURACY, 0.3, ", worse"), (FID, 0.3, ", better"), (FID, 0.54, "")]
)
def test_a_difference_counts_if_it_exceeds_both_intervals(metric, value, word):
    seeds, others = (
        [{"value": value, "repetitions": (value - 0.03, value + 0.03)}],
        [{"value": 0.5, "repetitions": (0.46, 0.54)}],
    )
    assert difference(metric, seeds, others, []) == f"{value - 0.5:+.3f}±0.050{word}"


@pytest.mark.parametrize(("accuracy", "code"), [([0.1, 0.2], 0), ([0.5, 0.6], 1)])
def test_the_command_fails_if_the_static_control_is_as_good_as_the_recordings(
    accuracy, code, tmp_path, monkeypatch, capsys
):
    recorded = method([0.5, 0.52]) | {"intervals": {ACCURACY.name: {"clips": [0.4, 0.6]}}}
    content = results(static=method(accuracy), **{RECORDED: recorded})
    monkeypatch.setattr(PaperTable, "fill", lambda table, project: content)
    monkeypatch.setenv("HOIDATA_BENCH_OUT", str(tmp_path))
    assert make("table1", "embedded") == code
    assert ("static does not fall in accuracy_top1_paper" in capsys.readouterr().err) == bool(code)
    text = (tmp_path / "table1.md").read_text()
    assert "| MDM | 0.600±0.141" in text
    assert "| Text2HOI | 0.9218 |" in text


def test_runs_that_are_in_the_results_with_the_same_settings_are_not_made_again(tmp_path, monkeypatch):
    seeds, table = [], PaperTable("table1", "embedded")
    monkeypatch.setattr(paper_tables, "open_project", lambda folder, settings: seeds.append(settings["train"]["seed"]))
    monkeypatch.setattr(paper_tables, "reproduce", lambda folder, target: None)
    monkeypatch.setattr(paper_tables, "results_of", lambda folder, names: {})
    first = table.fill(tmp_path)
    assert list(first) == ["ours 0", "paper 0", "ours 1", "paper 1"]
    assert table.fill(tmp_path) == first
    table.content["runs"]["paper"]["device"] = "cpu"
    table.fill(tmp_path)
    assert seeds == [0, 0, 1, 1, 0, 1]


@pytest.mark.long
def test_a_table_is_made_from_a_whole_run(tmp_path, monkeypatch):
    project = tmp_path / "project"
    subprocess.run([sys.executable, "-m", "hoidata", "init", str(project)], check=True)
    for path in (project / "manifests/embedded").glob("*.json"):
        path.write_text(path.read_text().replace('"size": "full"', '"size": "small"'))
    table = PaperTable("table1", "embedded")
    budget = {"training": {"steps": 2, "batch": 4, "validate_every": 1}}
    tiny = {name: budget for name in table.content["settings"]["train"]["small"]}
    settings = {
        "annotate": {"encoder": "hash"},
        "evaluator": {"networks": ["paper"], "most_steps": 2},
        "train": {"small": tiny},
        "sample": {"samples": 2, "text2hoi": {"sampler": {"kind": "ddim", "steps": 2}}},
        "family_datasets": {"imos": [], "t2m": []},
    }
    table.content["settings"] = merge_settings(table.content["settings"], settings)
    table.content["corpora"]["embedded"] = {
        "profile": "embedded",
        "datasets": ["grab"],
        "family_datasets": {"mdm": ["grab"]},
    }
    table.content["seeds"]["embedded"] = [0]
    del table.content["runs"]["paper"]
    for name in [name for name in os.environ if name.startswith("HOIDATA_")]:
        monkeypatch.delenv(name)
    finished = table.fill(project)
    methods = finished["ours 0"]["methods"]
    assert all(methods[family]["figures"] for family in ("text2hoi", "text2hoi-coarse", "mdm", "static", RECORDED))
    assert methods["mdm"]["intervals"]["multimodality_released_paper"]["repetitions"]
    assert table.fill(project) == finished
    lines = table.markdown(finished).splitlines()
    assert next(line for line in lines if line.startswith("| MDM |")).split(" | ")[-1] != "– |"


def test_a_column_without_values_is_a_line_below_the_table():
    table = PaperTable("table1", "study")
    text = table.markdown(json.loads((Path(__file__).parents[1] / "docs/results/table1-study.json").read_text()))
    head = next(line for line in text.splitlines() if line.startswith("| method"))
    assert "Fréchet" not in head
    assert "Measured in no row: FID, Fréchet, from training clips: N too small." in text
