"""Promises of the stage table_rows: a run that was stopped goes on after its last row, and with nothing outdated."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from models.bimart_tables.rows import ROWS, Row
from pipelines.stages import table_rows
from pipelines.stages.base import StagePaths, write_empty
from tests.builders.annotated import write_annotated_dataset

PATHS = StagePaths("embedded", "arctic", family="part-0")
FIRST, SECOND, *LATER = ROWS["part"]
SAMPLE = {"samples": 4, "bimart": {"refined": True}}
FILES = {
    "code": Path("code/table_rows.json"),
    "clips": PATHS.clips / "meta/info.json",
    "annotation": PATHS.annotation / "text.parquet",
    "contact": PATHS.contact / "points.npz",
    "split": PATHS.splits / "splits.parquet",
    "network": PATHS.table_networks / "bimart-motion/model.safetensors",
}


class Stopped(Exception):
    """In place of what ends a run: a kill, Ctrl-C, a full disk."""


class Measuring:
    """In place of what measures a row. names: of the rows it was called for; stop: the one that stops everything."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.stop: str | None = None

    def __call__(self, paths: StagePaths, name: str, row: Row, settings: Any, sample: Any) -> dict[str, Any]:
        self.names.append(name)
        if name == self.stop:
            raise Stopped
        return {"title": row.title, "figures": {"a": 0.1 + 0.2}, "counts": {10: 1, 9: 2}}

    def run(self, stop: str | None = None, paths: StagePaths = PATHS) -> list[str]:
        """Run the stage, which stops at a row where one is named; the rows it began to measure."""
        self.names, self.stop = [], stop
        if stop is None:
            table_rows.run(paths)
        else:
            with pytest.raises(Stopped):
                table_rows.run(paths)
        return self.names


def set_tables(sample: dict[str, Any] = SAMPLE, **tables: Any) -> None:
    values = {"profile": "embedded", "sample": sample, "tables": {"samples": 2, "clips": 4} | tables}
    Path("params.yaml").write_text(yaml.safe_dump(values))


def rewrite(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{path.read_text() if path.is_file() else ''}another time")


def written(paths: StagePaths = PATHS) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in paths.table_rows.iterdir()}


@pytest.fixture
def measuring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Measuring:
    """In a folder that has a file of everything rows come from."""
    monkeypatch.chdir(tmp_path)
    set_tables()
    for path in FILES.values():
        rewrite(path)
    measuring = Measuring()
    monkeypatch.setattr(table_rows, "_measured", measuring)
    return measuring


def test_a_stopped_run_goes_on_after_its_last_row_to_the_same_files(measuring: Measuring) -> None:
    assert measuring.run() == [FIRST, SECOND, *LATER]
    undisturbed = written()
    assert measuring.run(stop=SECOND) == [FIRST, SECOND]
    assert measuring.run(stop=LATER[0]) == [SECOND, LATER[0]]
    assert written() == undisturbed  # of the run before, whole
    assert measuring.run() == LATER
    assert written() == undisturbed


def test_a_run_that_ends_well_keeps_nothing_and_the_next_one_measures_everything(measuring: Measuring) -> None:
    measuring.run(stop=SECOND)
    set_tables(samples=3)
    measuring.run(stop=LATER[0])
    measuring.run()
    assert not table_rows.measured_in(PATHS).exists()
    assert measuring.run() == [FIRST, SECOND, *LATER]


CHANGES: dict[str, Callable[[], None]] = {
    "motions": lambda: set_tables(samples=3),
    "test clips": lambda: set_tables(clips=0),
    "sampling": lambda: set_tables({"samples": 4, "bimart": {"refined": False}}),
    **{name: lambda path=path: rewrite(path) for name, path in FILES.items()},
    "a network more": lambda: rewrite(PATHS.table_networks / "bimart-contact/model.safetensors"),
}


@pytest.mark.parametrize("what", CHANGES)
def test_what_rows_come_from_has_changed_so_that_all_are_measured_anew(measuring: Measuring, what: str) -> None:
    measuring.run(stop=SECOND)
    CHANGES[what]()
    assert measuring.run() == [FIRST, SECOND, *LATER]


def test_neither_which_runs_there_are_nor_another_run_changes_what_was_measured(measuring: Measuring) -> None:
    measuring.run(stop=SECOND)
    set_tables(runs=["part-0", "part-1"])
    other = StagePaths("embedded", "arctic", family="part-1")
    assert measuring.run(paths=other) == [FIRST, SECOND, *LATER]
    assert measuring.run() == [SECOND, *LATER]


def test_a_kept_row_that_cannot_be_read_is_measured_again(measuring: Measuring) -> None:
    measuring.run(stop=SECOND)
    (kept,) = table_rows.measured_in(PATHS).rglob("*.json")
    kept.write_text("")
    assert measuring.run() == [FIRST, SECOND, *LATER]


def test_of_a_dataset_without_clips_the_reason_alone_is_written_and_nothing_kept(measuring: Measuring) -> None:
    measuring.run(stop=SECOND)
    write_empty(PATHS.clips, "no files")
    assert measuring.run() == []
    assert written() == {"empty.json": b'{"reason":"no files"}\n'}
    assert not table_rows.measured_in(PATHS).exists()


@pytest.mark.slow
def test_figures_of_a_stopped_run_are_those_of_an_undisturbed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_clip: Callable
) -> None:
    monkeypatch.chdir(tmp_path)
    rivals, names = StagePaths("embedded", "arctic", family="rivals-0"), ["ground-truth", "hands-shifted"]
    write_annotated_dataset(rivals.data, make_clip)
    set_tables({})
    monkeypatch.setattr(table_rows, "ROWS", {"rivals": {name: ROWS["rivals"][name] for name in names}})
    table_rows.run(rivals)
    undisturbed, measure = written(rivals), table_rows._measured

    def measure_only(chosen: str) -> None:
        def measured(paths: StagePaths, name: str, *more: Any) -> dict[str, Any]:
            if name != chosen:
                raise Stopped
            return measure(paths, name, *more)

        monkeypatch.setattr(table_rows, "_measured", measured)

    measure_only(names[0])
    with pytest.raises(Stopped):
        table_rows.run(rivals)
    measure_only(names[1])
    table_rows.run(rivals)
    assert written(rivals) == undisturbed
    assert b"contact_f1" in undisturbed[f"{names[1]}.json"]
