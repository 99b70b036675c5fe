"""The summary of a run in Markdown: counts of clips, leading metrics of all methods, address of the report."""

from pathlib import Path
from typing import Any

from hoidata.files.written import read_json
from pipelines.metrics_files import LEADING, read_metrics
from pipelines.pages.metrics_table import markdown_table
from pipelines.params import read_params
from pipelines.stages.families import families_of


def describe_results(project: Path, profile: str) -> str:
    """Markdown with counts per dataset, a table of leading metrics per measured dataset, and the report's address."""
    params = read_params(project)
    notes: list[str] = []
    lines = ["| dataset | clips | quarantined | train | validation | test |", "|---|---|---|---|---|---|"]
    tables: list[str] = []
    for dataset in params["datasets"]:
        data, metrics = project / "data" / profile / dataset, project / "metrics" / profile / dataset
        if (data / "clips/meta/info.json").is_file():
            lines.append(_counts(dataset, data))
            notes += [f"{dataset}: {note}." for note in _splits(data).get("missing", {}).values()]
        families = [name for name in families_of(params, dataset) if _measured(metrics / f"{name}.json")]
        if families:
            tables += [f"### {dataset}", markdown_table(metrics, families, LEADING)]
    report = project / "report" / profile / "index.html"
    address = f"Report: {report.resolve()}" if report.is_file() else "There is no report yet."
    return "\n\n".join(["\n".join(lines), *notes, *tables, address])


def _counts(dataset: str, data: Path) -> str:
    counts = read_json(data / "clips/meta/info.json", {"counts": {"clips": int, "quarantined": int}})["counts"]
    parts = _splits(data).get("chosen", {}).get("clips", {})
    numbers = [parts.get(name, "") for name in ("train", "validation", "test")]
    return f"| {' | '.join(map(str, (dataset, counts['clips'], counts['quarantined'], *numbers)))} |"


def _splits(data: Path) -> dict[str, Any]:
    """The facts of the stage split of a dataset; empty before its first run."""
    path = data / "splits/info.json"
    if not path.is_file():
        return {}
    facts = read_json(path, {"chosen": {"clips": {}}})
    facts.check_present({"missing": dict})
    return facts


def _measured(path: Path) -> bool:
    return path.is_file() and "figures" in read_metrics(path)
