"""The benchmark on real recordings: its settings fit its tables, and a table hides no missing value."""

from bench.recordings import SETTINGS, TABLES, markdown_table, unmeasured
from hoidata.metrics.optional_metrics import BIMART_METRICS
from hoidata.metrics.registry import METRICS
from hoidata.package_paths import FOLDER
from hoidata.settings import merge_settings
from models.registry import load_family
from pipelines.params import load_yaml
from pipelines.stages.families import OPTIONAL_FAMILIES


def _result(value, clips, reasons=None):
    return {
        "held_out_clips": 4,
        "figures": {"contact_f1": value},
        "intervals": {"contact_f1": {"clips": [0.25, 0.75]}},
        "counts": {"contact_f1": {"clips": clips}},
        "unmeasured": {"contact_f1": reasons or {}},
    }


def test_the_benchmark_samples_every_method_of_its_tables():
    params = merge_settings(load_yaml((FOLDER / "params.yaml").read_bytes()), load_yaml(SETTINGS.read_bytes()))
    sampled = {*params["families"], *params["controls"]["families"], *params["family_datasets"], "bimart-unrefined"}
    sampled |= {"nearest-window", "mean-pose-at-object"}  # stages of models/bimart/dvc.yaml
    names = {name for _, methods in TABLES.values() for name in methods.values()}
    assert names <= sampled
    assert all(load_family(name).name == name for name in names)
    assert set(params["family_datasets"]) == set(OPTIONAL_FAMILIES)


def test_the_metrics_of_the_tables_exist():
    registered = {metric.name for metric in (*METRICS, *BIMART_METRICS)}
    assert {name for columns, _ in TABLES.values() for name in columns.values()} <= registered


def test_a_table_shows_the_interval_and_the_number_of_clips_if_some_are_missing():
    measured = {"a": _result(0.5, 4), "b": _result(0.5, 3, {"no hinge": 1}), "c": _result(None, 0, {"no hinge": 4})}
    table = markdown_table(measured, {"F1": "contact_f1"}, {"A": "a", "B": "b", "C": "c", "absent": "d"})
    assert table.splitlines()[2:] == [
        "| A | 0.5 (0.25 to 0.75) |",
        "| B | 0.5 (0.25 to 0.75) n=3 |",
        "| C | – |",
        "| absent | not measured |",
    ]


def test_missing_values_are_listed_with_share_and_reason():
    measured = {"a": _result(0.5, 4), "b": _result(0.5, 3, {"no hinge": 1})}
    lines = unmeasured(measured, {"F1": "contact_f1"}, {"A": "a", "B": "b"})
    assert lines == "- F1, B: no value for 25% of the clips (no hinge: 1 clip)"
