"""The summary of a run in Markdown: counts of clips, leading metrics of all methods, address of the report."""

from pathlib import Path
from typing import Any

from hoidata.files.written import Facts, read_json
from pipelines.metrics_files import LEADING, read_metrics
from pipelines.pages.metrics_table import markdown_table
from pipelines.params import read_params
from pipelines.stages.families import families_of


def describe_results(project: Path, profile: str) -> str:
    """Markdown with counts per dataset, a table of leading metrics per measured dataset, and the report's address."""
    params = read_params(project)
    notes: list[str] = []
    lines = [
        "| dataset | quarantined | clips | annotated | train | validation | test |",
        "|---|---|---|---|---|---|---|",
    ]
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
    annotated = _facts(data / "annotation/info.json", {"counts": {"annotated": int}}).get("counts", {})
    parts = _splits(data).get("chosen", {}).get("clips", {})
    numbers = [annotated.get("annotated", ""), *(parts.get(name, "") for name in ("train", "validation", "test"))]
    return f"| {' | '.join(map(str, (dataset, counts['quarantined'], counts['clips'], *numbers)))} |"


def _splits(data: Path) -> Facts:
    """The facts of the stage split of a dataset; empty before its first run."""
    return _facts(data / "splits/info.json", {"chosen": {"clips": {}}}).check_present({"missing": dict})


def _facts(path: Path, keys: dict[str, Any]) -> Facts:
    """The content of a JSON file with these keys; empty if its stage has not run."""
    return read_json(path, keys) if path.is_file() else Facts(path, {})


def _measured(path: Path) -> bool:
    return path.is_file() and "figures" in read_metrics(path)
