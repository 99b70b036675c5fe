"""Promises of BimArt's tables as a page: controls that lose are told from those that do not, clip by clip."""

import json
import shutil
from pathlib import Path

import pytest

from pipelines.promises import Promise
from pipelines.stages import tables
from pipelines.stages.base import StagePaths
from pipelines.stages.tables import compared, controls_lines, maps_lines, read_rows, unmeasured_lines

PATHS = StagePaths("embedded", "arctic")
F1 = "contact_f1"
HARD_TO_EASY = (0.2, 0.3, 0.5, 0.6)  # contact F1 of four clips, which differ more than any two rows on one of them


def write(path: Path, maps: dict[str, float] | None = None, motions: int = 1, **values: tuple[float, ...]) -> None:
    """A row: of each figure its value in every clip, each from a sequence of its own."""
    path.parent.mkdir(parents=True, exist_ok=True)
    clips = range(len(next(iter(values.values()))))
    by_clip = {
        f"clip {number}": {
            "group": f"sequence {number}",
            "parts": {name: [motions * own[number], motions] for name, own in values.items()},
        }
        for number in clips
    }
    figures = {name: sum(own) / len(own) for name, own in values.items()}
    inside = {"bimart-contact": maps} if maps else {}
    row = {"title": path.stem, "figures": figures, "motions": motions * len(clips), "by_clip": by_clip}
    path.write_text(json.dumps(row | {"diagnostics": inside}))


def less(values: tuple[float, ...], *by: float) -> tuple[float, ...]:
    return tuple(value - own for value, own in zip(values, by, strict=True))


@pytest.fixture
def rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two runs of BimArt, told its maps and told zeros, and the truth with hands held still."""
    monkeypatch.chdir(tmp_path)
    for seed, lost in ((0, (0.06, 0.05, 0.04, 0.05)), (1, (0.06, -0.05, 0.04, -0.05))):
        folder = PATHS.table_rows / f"part-{seed}"
        write(folder / "bimart.json", contact_f1=HARD_TO_EASY, maps={"map_error_mm": 30.0 + seed})
        write(folder / "zero-map.json", contact_f1=less(HARD_TO_EASY, *lost))
        write(folder / "map.json", contact_f1=(0.0,) * 4)  # the same family otherwise sampled: no row of its own
    truth = PATHS.table_rows / "rivals-0"
    write(truth / "ground-truth.json", bimart_con_corrected=(1.0, 1.0), bimart_con_paper=(1.0, 1.0))
    write(truth / "pressed-deep.json", bimart_con_corrected=(0.0, 0.1), bimart_con_paper=(1.0, 1.0))
    return PATHS.table_rows


def cells(lines: list[str], *start: str) -> list[str]:
    (line,) = (line for line in lines if line.startswith(f"| {' | '.join(start)} "))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_control_that_loses_on_every_clip_loses_however_clips_differ(rows: Path) -> None:
    found = cells(controls_lines(PATHS), "bimart-zero-map", F1)
    assert found[2:4] == ["fall, beside bimart", "0.4 (0)"]
    assert found[-1] == "1 of 2"
    low, high = (float(end) for end in found[5].split(", ")[0].split(" to "))
    assert -0.06 <= low < high <= -0.04


def test_a_figure_that_must_stay_does_and_one_that_must_fall_does(rows: Path) -> None:
    lines = controls_lines(PATHS)
    assert cells(lines, "pressed-deep", "bimart_con_paper")[-1] == "1 of 1"
    assert cells(lines, "pressed-deep", "bimart_con_corrected")[-1] == "1 of 1"
    (PATHS.table_rows / "rivals-0" / "pressed-deep.json").unlink()
    write(PATHS.table_rows / "rivals-0" / "pressed-deep.json", bimart_con_paper=(0.1, 0.2))
    assert cells(controls_lines(PATHS), "pressed-deep", "bimart_con_paper")[-1] == "0 of 1"


def test_the_nearest_window_is_the_row_of_one_window_and_not_that_of_many(
    rows: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "PROMISES", (Promise("nearest-window", F1, "fall"),))
    write(rows / "rivals-0" / "ground-truth.json", contact_f1=(1.0, 1.0))
    write(rows / "rivals-0" / "nearest-windows.json", contact_f1=(0.1, 0.2))
    write(rows / "rivals-0" / "nearest-window.json", contact_f1=(0.4, 0.6))
    assert cells(controls_lines(PATHS), "nearest-window", F1)[4] == "0.5"


def test_rows_that_a_killed_run_left_count_nowhere(rows: Path) -> None:
    found = controls_lines(PATHS), read_rows(PATHS)
    shutil.copytree(rows / "part-0", rows / ".part-0.abc.part")
    assert (controls_lines(PATHS), read_rows(PATHS)) == found


def test_clips_of_one_row_alone_are_not_compared(rows: Path) -> None:
    promise = Promise("a", F1, "fall", "b")
    own = {name: {"group": name, "parts": {F1: [value, 1]}} for name, value in (("x", 0.9), ("y", 0.8), ("z", 0.7))}
    other = {name: {"group": name, "parts": {F1: [value, 1]}} for name, value in (("y", 0.5), ("z", 0.4))}
    found = compared(promise, {"b": {"by_clip": own, "motions": 3}, "a": {"by_clip": other, "motions": 2}})
    assert found is not None
    assert (found.beside, found.control) == pytest.approx((0.75, 0.45))
    assert (found.low, found.high) == pytest.approx((-0.3, -0.3))


def test_the_best_of_few_motions_is_not_held_against_the_best_of_many(rows: Path) -> None:
    for motions, told in ((2, True), (1, False)):
        write(rows / "part-0" / "bimart.json", motions=2, joint_error_mm=(60.0, 70.0), contact_f1=(0.4, 0.5))
        write(rows / "part-0" / "zero-map.json", motions=motions, joint_error_mm=(90.0, 95.0), contact_f1=(0.3, 0.3))
        lines = [line for line in controls_lines(PATHS) if "bimart-zero-map" in line]
        assert any("joint_error_mm" in line for line in lines) == told
        assert any(F1 in line for line in lines)


def test_errors_of_maps_are_means_over_the_runs_that_drew_some(rows: Path) -> None:
    assert cells(maps_lines(read_rows(PATHS)), "map_error_mm") == ["map_error_mm", "30.5 (0.71)"]


def test_without_rows_there_is_nothing_to_promise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert (controls_lines(PATHS), maps_lines(read_rows(PATHS))) == ([], [])


def test_rows_without_a_figure_say_why_below_the_table_once_for_all_seeds() -> None:
    seed = {"title": "BimArt", "unmeasured": {"bimart_pen_1cm_corrected": {"the object has no inside": 14}}}
    assert unmeasured_lines([seed, seed, {"title": "truth"}]) == [
        "",
        "- BimArt: bimart_pen_1cm_corrected not measured, the object has no inside: 14 clips",
    ]
    assert unmeasured_lines([{"title": "truth"}]) == []
