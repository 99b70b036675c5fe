"""The settings of the benchmark on real recordings fit a project, and its metrics exist."""

from bench.recordings import SETTINGS, TABLES, merge_params, stage_table
from hoidata.package_paths import FOLDER
from hoidata.settings import merge_settings
from models.registry import load_family
from pipelines.pages.metrics_table import ALL_METRICS
from pipelines.params import load_yaml, read_params


def test_merged_settings_are_those_of_the_chosen_profile_and_a_second_merge_changes_nothing(tmp_path):
    path = tmp_path / "params.yaml"
    path.write_bytes((FOLDER / "params.yaml").read_bytes())
    merge_params(path)
    once, params, settings = path.read_bytes(), read_params(tmp_path), load_yaml(SETTINGS.read_bytes())
    merge_params(path)
    assert path.read_bytes() == once
    assert params["profile"] == "own"
    for section in ("split", "sample", "train", "controls", "evaluate"):
        assert merge_settings(params[section], settings[section]) == params[section]


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
