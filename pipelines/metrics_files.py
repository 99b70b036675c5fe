"""Reads metrics files; writes leading metrics and training curves for ``dvc metrics``, ``dvc plots``, ``dvc exp``."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files.written import NUMBER, NUMBER_OR_NONE, REMEDY, Facts, read_json
from hoidata.metrics.unmeasured import reasons_in_words
from pipelines.stages.base import write_json

LEADING = ("action_named", "contact_f1", "joint_error_mm", "deep_share", "jitter_m_s3")
DIGITS = 6


def write_leading_metrics(path: Path, metrics: Path, families: Sequence[str]) -> None:
    """Write the leading metrics of one dataset for ``dvc metrics``: by family; reasons under ``not measured``."""
    by_family = _read(metrics, families)
    unmeasured = _unmeasured(by_family)
    write_json(path, _leading(by_family) | ({"not measured": unmeasured} if unmeasured else {}))


def write_dvc_plots(out: Path, metrics: Path, checkpoints: Path, families: Mapping[str, Sequence[str]]) -> None:
    """Write the leading metrics and the validation losses of a profile as tables to the folder ``out``.

    Files: ``bars/<dataset>.csv`` (one line per family), ``losses/<dataset>-<network>.csv`` (validation loss by step).

    Args:
        checkpoints: folder with the networks of each dataset; untrained networks are skipped.
        families: by dataset, in the order of the lines.
    """
    leading = {dataset: _leading(_read(metrics / dataset, names)) for dataset, names in families.items()}
    for folder in ("bars", "losses"):
        (out / folder).mkdir()
    for dataset, by_family in leading.items():
        if by_family:
            names = [name for name in LEADING if any(name in values for values in by_family.values())]
            table = [{"family": family, **values} for family, values in by_family.items()]
            _write_csv(out / "bars" / f"{dataset}.csv", ["family", *names], table)
        for log in sorted((checkpoints / dataset).glob("*/log.csv")):
            with open(log, newline="") as stream:
                table = [entry for entry in csv.DictReader(stream) if entry.get("validation")]
            _write_csv(out / "losses" / f"{dataset}-{log.parent.name}.csv", ["step", "validation"], table)


def read_metrics(path: Path) -> Facts:
    """Read and check the metrics file of one family: ``figures``, or the reason ``empty``. Raises BadInput."""
    content = read_json(path)
    if "figures" not in content:
        return content.check({"empty": str})
    objects = dict.fromkeys(("figures", "intervals", "notes", "evaluators", "diagnostics", "unmeasured"), dict)
    content.check_present({"motions": int, "held_out_clips": int, "left_out": list, **objects})
    content["figures"].check(dict.fromkeys(content["figures"], NUMBER_OR_NONE))
    for name in ("intervals", "evaluators"):
        content.get(name, Facts(path, {})).check(dict.fromkeys(content.get(name, ()), dict))
    for intervals in content.get("intervals", {}).values():
        intervals.check(dict.fromkeys(intervals, (list, type(None))))
        for name, ends in intervals.items():
            if ends and not (len(ends) == 2 and all(isinstance(end, NUMBER) for end in ends)):
                raise BadInput(path, f"two numbers as the entry {intervals.key + name!r}", repr(ends)[:80], REMEDY)
    for evaluator in content.get("evaluators", {}).values():
        evaluator.check_present({"labels": list, "confusion": list, "digest": str})
    return content


def _read(folder: Path, families: Sequence[str]) -> dict[str, Facts]:
    """The metrics files of the evaluated families."""
    return {name: read_metrics(folder / f"{name}.json") for name in families if (folder / f"{name}.json").is_file()}


def _leading(measured: dict[str, Facts]) -> dict[str, dict[str, float]]:
    """The leading metrics of every family, rounded because the last bits differ between machines."""
    by_family = {family: _rounded(content.get("figures") or {}) for family, content in measured.items()}
    return {family: values for family, values in by_family.items() if values}


def _unmeasured(measured: dict[str, Facts]) -> dict[str, dict[str, str]]:
    """The leading metrics without a value, by family, with reasons and counts in words; ``empty``: no motions."""
    by_family = {}
    for family, content in measured.items():
        if "empty" in content:
            by_family[family] = {"empty": str(content["empty"])}
            continue
        reasons, values = content.get("unmeasured", {}), content.get("figures", {})
        by_family[family] = {
            name: reasons_in_words(reasons[name]) for name in LEADING if name in reasons and name not in values
        }
    return {family: words for family, words in by_family.items() if words}


def _rounded(values: dict[str, Any]) -> dict[str, float]:
    numbers = {name: values[name] for name in LEADING if isinstance(values.get(name), int | float)}
    return {name: float(f"{number:.{DIGITS}g}") for name, number in numbers.items()}


def _write_csv(path: Path, names: list[str], rows: list[dict[str, Any]]) -> None:
    with open(path, "w", newline="") as stream:
        writer = csv.DictWriter(stream, names, restval="", extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
