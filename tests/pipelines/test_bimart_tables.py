"""Promises of BimArt's tables as a page: controls that lose are told from those that do not, seed by seed."""

import json
from pathlib import Path

import pytest

from pipelines.stages.base import StagePaths
from pipelines.stages.tables import controls_lines, maps_lines, read_rows

PATHS = StagePaths("embedded", "arctic")


@pytest.fixture
def rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two runs of BimArt, told its maps and told zeros, and the truth with hands held still."""
    monkeypatch.chdir(tmp_path)
    for seed, zeros in ((0, 0.30), (1, 0.41)):
        folder = PATHS.table_rows / f"part-{seed}"
        write(folder / "bimart.json", contact_f1=0.42, maps={"map_error_mm": 30.0 + seed})
        write(folder / "zero-map.json", contact_f1=zeros)
        write(folder / "map.json", contact_f1=0.01)  # the same family otherwise sampled: no row of its own
    write(PATHS.table_rows / "rivals-0" / "ground-truth.json", bimart_con_corrected=1.0)
    write(PATHS.table_rows / "rivals-0" / "hands-still.json", bimart_con_corrected=0.4)
    return PATHS.table_rows


def write(path: Path, maps: dict[str, float] | None = None, motions: int = 2, **figures: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    intervals = {name: {"clips": [value - 0.05, value + 0.05]} for name, value in figures.items()}
    row = {"title": path.stem, "figures": figures, "intervals": intervals, "motions": motions}
    inside = {"diagnostics": {"bimart-contact": maps} if maps else {}}
    path.write_text(json.dumps(row | inside))


def cells(lines: list[str], start: str) -> list[str]:
    (line,) = (line for line in lines if line.startswith(f"| {start} "))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_control_within_the_interval_of_its_row_is_counted_as_not_losing(rows: Path) -> None:
    lines = controls_lines(PATHS)
    assert cells(lines, "bimart-zero-map") == [
        "bimart-zero-map", "contact_f1", "fall, beside bimart", "0.42 (0)", "0.355 (0.078)", "1 of 2",
    ]  # fmt: skip
    assert cells(lines, "hands-still")[2:] == ["fall, beside ground-truth", "1", "0.4", "1 of 1"]


def test_the_best_of_few_motions_is_not_held_against_the_best_of_many(rows: Path) -> None:
    for motions, told in ((2, True), (1, False)):
        write(rows / "part-0" / "bimart.json", motions=2, joint_error_mm=60.0, contact_f1=0.42)
        write(rows / "part-0" / "zero-map.json", motions=motions, joint_error_mm=90.0, contact_f1=0.3)
        lines = [line for line in controls_lines(PATHS) if "bimart-zero-map" in line]
        assert any("joint_error_mm" in line for line in lines) == told
        assert any("contact_f1" in line for line in lines)


def test_errors_of_maps_are_means_over_the_runs_that_drew_some(rows: Path) -> None:
    assert cells(maps_lines(read_rows(PATHS)), "map_error_mm") == ["map_error_mm", "30.5 (0.71)"]


def test_without_rows_there_is_nothing_to_promise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert (controls_lines(PATHS), maps_lines(read_rows(PATHS))) == ([], [])
