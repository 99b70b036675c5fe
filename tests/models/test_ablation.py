"""Every difference of `ours` from the paper that acts on motions is a row of the ablation; rows are comparable."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from bench import ablation
from bench.ablation import COLUMNS, LESS, ROWS, Row, Study, fill, parameters, show_rows
from models.common.training import Plan
from models.registry import load_network
from pipelines.params import laid_over, read_params

TRAIN = read_params(Path(__file__).parents[2])["train"]
# Lengths are the clips' own in all rows, and a hold takes the refiner's place in those of `ours`.
NETWORKS = ("contact", "diffusion")


def leaves(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def planned(row: Row, network: str) -> dict[str, Any]:
    plan = Plan.of(load_network(network), row.settings(TRAIN, network))
    return dict(leaves({name: asdict(getattr(plan, name)) for name in ("network", "training", "loss")}))


@pytest.mark.parametrize("network", NETWORKS)
def test_each_difference_from_the_paper_is_taken_back_by_some_row(network: str) -> None:
    ours, paper = planned(Row(), network), planned(Row("paper"), network)
    differences = {key: paper[key] for key in ours if ours[key] != paper[key]}
    rows = [planned(row, network) for row in LESS.values()]
    untold = {key for key, value in differences.items() if not any(row[key] == value for row in rows)}
    assert len(differences) > 2
    assert not untold


@pytest.mark.parametrize("name", LESS)
def test_a_row_differs_from_ours_in_its_switch_alone(name: str) -> None:
    changed = []
    for network in NETWORKS:
        ours, own = planned(Row(), network), planned(LESS[name], network)
        changed += [key for key in ours if ours[key] != own[key]]
    sampled, own_sampled = (dict(leaves(asdict(row.sampling()))) for row in (Row(), LESS[name]))
    changed += [key for key in sampled if sampled[key] != own_sampled[key]]
    assert 1 <= len(changed) <= 2
    together = "no splines", "norm after each half", "contact as a map", "object's size told"
    assert len(changed) == 1 or name in together


def test_all_rows_are_made_where_none_is_named(study: Study, monkeypatch, capsys) -> None:
    monkeypatch.setattr(Study, "here", lambda: study)
    monkeypatch.setenv("HOIDATA_BENCH_MINUTES", "-1")
    ablation.main()
    left_out = capsys.readouterr().out.rpartition("makes them: ")[2]
    assert all(f"{name} {seed}" in left_out for name in ROWS for seed in range(3))


@pytest.mark.parametrize("name", ROWS)
def test_a_row_has_as_many_parameters_within_a_quarter(name: str) -> None:
    assert 0.75 <= parameters(TRAIN, ROWS[name]) / parameters(TRAIN, Row()) <= 1.25


@pytest.fixture
def study(annotated_root: Path, tmp_path: Path, monkeypatch) -> Study:
    """A few steps on a small dataset, kept in an empty folder."""
    monkeypatch.setattr(ablation, "KEPT", tmp_path / "kept")
    short = {"training": {"steps": 2, "warmup": 0, "validate_every": 2}}
    small = {name: laid_over(TRAIN["small"][name], short) for name in ("contact", "diffusion", "refiner")}
    return Study(annotated_root, 2, {**TRAIN, "small": small}, "once")


def networks_in(folder: Path) -> list[str]:
    return sorted(path.name.rpartition("-")[0] for path in folder.iterdir() if path.is_dir())


@pytest.mark.long
def test_rows_share_what_they_have_in_common_and_are_made_once(study: Study, capsys) -> None:
    jobs = [("ours", 0), ("no gate", 0), ("contact by a latent", 0), ("released", 0), ("paper: a diffusion refiner", 0)]
    assert fill(study, jobs) == []
    assert networks_in(ablation.KEPT) == ["contact"] * 4 + ["diffusion"] * 4 + ["refiner"] * 2
    figures = [json.loads(study.figures_path(ROWS[name], 0).read_text()) for name, _ in jobs]
    assert [sorted(set(one) - set(COLUMNS)) for one in figures] == [[]] * 5
    assert all({"joint_error_mm", "jitter_m_s3"} <= set(one) for one in figures)
    made = {path: path.stat().st_mtime_ns for path in ablation.KEPT.glob("*.json")}
    assert fill(study, jobs) == []
    assert made == {path: path.stat().st_mtime_ns for path in ablation.KEPT.glob("*.json")}
    show_rows(study, [name for name, _ in jobs], [0, 1])
    assert "contact by a latent" in capsys.readouterr().out
    once = study.figures_path(ROWS["a motion drawn once"], 0)
    assert once != study.figures_path(ROWS["ours"], 0)
    assert replace(study, made_from="other").figures_path(ROWS["ours"], 0) != study.figures_path(ROWS["ours"], 0)


def test_a_row_that_another_run_makes_and_one_that_there_is_no_time_for_are_left(study: Study, monkeypatch) -> None:
    ablation.KEPT.mkdir()
    with FileLock(study.figures_path(ROWS["ours"], 0).with_suffix(".lock")):
        assert fill(study, [("ours", 0)]) == ["ours 0"]
    monkeypatch.setenv("HOIDATA_BENCH_MINUTES", "-1")
    assert fill(study, [("ours", 0)]) == ["ours 0"]
    assert networks_in(ablation.KEPT) == []


def test_a_project_without_clips_and_an_unknown_row_are_told(
    monkeypatch, tmp_path: Path, capsys, annotated_root
) -> None:
    monkeypatch.setenv("HOIDATA_BENCH_DATA", str(tmp_path))
    ablation.main()
    assert "run `hoidata repro` first" in capsys.readouterr().out
    monkeypatch.setenv("HOIDATA_BENCH_DATA", str(annotated_root))
    monkeypatch.setenv("HOIDATA_BENCH_ROWS", "ours,none")
    ablation.main()
    assert capsys.readouterr().out.startswith("no row none; there are ours")
