"""The settings of the benchmark on real recordings fit a project, and its metrics exist."""

from bench.project import write_params
from bench.recordings import SETTINGS, TABLES, stage_table
from hoidata.settings import merge_settings
from models.registry import load_family
from pipelines.pages.metrics_table import ALL_METRICS
from pipelines.params import load_yaml, read_params


def test_merged_settings_are_those_of_the_chosen_profile_whatever_the_file_had(tmp_path):
    path, settings = tmp_path / "params.yaml", load_yaml(SETTINGS.read_bytes())
    path.write_text("profile: study\nsample: {samples: 7}\n")
    write_params(path, settings)
    params = read_params(tmp_path)
    assert params["profile"] == "own"
    for section in ("split", "sample", "train", "controls", "evaluate"):
        assert merge_settings(params[section], settings[section]) == params[section]


def test_the_overlay_of_the_profile_comes_before_the_settings(tmp_path):
    write_params(tmp_path / "params.yaml", {"profile": "study", "sample": {"samples": 3}})
    params = read_params(tmp_path)
    assert params["sample"]["samples"] == 3
    assert params["convert"]["adapters"]["grab"] == {"margin_frames": 15}


def test_every_control_is_a_family_and_every_metric_exists():
    settings = load_yaml(SETTINGS.read_bytes())
    assert all(load_family(name).name == name for name in settings["controls"]["families"])
    assert {name for names in TABLES.values() for name in names.split()} <= {metric.name for metric in ALL_METRICS}


def test_stages_are_listed_in_the_order_in_which_they_ran(tmp_path):
    runs = tmp_path / ".hoidata/runs"
    runs.mkdir(parents=True)
    for stage, began_at in (("split", "2026-01-01T10:00:00"), ("convert", "2026-01-01T09:00:00")):
        run = (
            f'{{"stage": "{stage}", "began_at": "{began_at}", "seconds": 2.4, "processor_seconds": 3.6, "peak_mib": 5}}'
        )
        (runs / f"{stage}.json").write_text(run)
    assert stage_table(tmp_path).splitlines()[2:] == ["| convert | 2 | 4 | 5 |", "| split | 2 | 4 | 5 |"]
