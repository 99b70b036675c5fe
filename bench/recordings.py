"""Benchmark on real recordings: trains, samples and measures every method on ARCTIC, and writes the tables.

``python -m bench recordings``. HOIDATA_ARCTIC: folder of the raw files; HOIDATA_MANO: folder of the MANO files;
HOIDATA_BENCH_OUT: the project folder (.hoidata/recordings). The project is an ordinary one with the settings of
``recordings.yaml``: an interrupted run continues where it stopped, and a finished run measures nothing again. The
tables are in ``benchmark.md`` of the project.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hoidata.errors import MissingResource
from hoidata.metrics.unmeasured import reasons_in_words
from hoidata.settings import merge_settings
from pipelines.params import load_yaml

SETTINGS = Path(__file__).with_name("recordings.yaml")
METRICS = Path("metrics/own/arctic")
DIGITS = 3
# Column, then its metric.
TEXT_COLUMNS = {
    "verb success": "action_followed",
    "verb accuracy": "action_named",
    "contact F1": "contact_f1",
    "adherence": "adherence",
    "deep": "deep_share",
    "slip, cm/s": "slip_cm_s",
    "realism": "realism_si",
    "jitter, m/s³": "jitter_m_s3",
    "joints, mm": "joint_error_mm",
}
TRAJECTORY_COLUMNS = {
    "contact F1": "contact_f1",
    "deep": "deep_share",
    "Con, %": "bimart_con_corrected",
    "Art, %": "bimart_art_corrected",
    "deeper than 1 cm, %": "bimart_pen_1cm_corrected",
    "slip, cm/s": "slip_cm_s",
    "realism": "realism_si",
    "jitter, m/s³": "jitter_m_s3",
    "joints, mm": "joint_error_mm",
}
# Table title, its columns, and its methods: title and name of the family.
TABLES: dict[str, tuple[Mapping[str, str], Mapping[str, str]]] = {
    "Motion from text": (
        TEXT_COLUMNS,
        {
            "recorded": "ground-truth",
            "Text2HOI, networks alone": "text2hoi-coarse",
            "Text2HOI, refined": "text2hoi",
            "prompt retrieval": "prompt-retrieval",
            "prompt retrieval, refined": "prompt-retrieval-refined",
            "verb retrieval": "verb-retrieval",
            "nearest sentence": "nearest-clip",
            "mean motion": "mean-motion",
            "mean pose": "mean-pose",
            "other prompt": "other-prompt",
            "random training clip": "random-clip",
            "hands swapped": "swapped-hands",
            "first frame, repeated": "static",
            "played backwards": "reversed",
            "object moved away": "object-moved",
            "hands moved away": "hands-away",
            "hands pressed in": "pressed",
            "noise on hands": "noise",
        },
    ),
    "Hands from recorded trajectories": (
        TRAJECTORY_COLUMNS,
        {
            "recorded": "ground-truth",
            "ManipNet (wrists given)": "manipnet",
            "BimArt": "bimart",
            "BimArt, unrefined": "bimart-unrefined",
            "nearest training window": "nearest-window",
            "nearest training window, refined": "nearest-window-refined",
            "mean pose at the object": "mean-pose-at-object",
        },
    ),
}


def main() -> None:
    """Make or continue the project, and write ``benchmark.md``. Raises MissingResource if a variable is not set."""
    raw = {name: os.environ.get(f"HOIDATA_{name.upper()}") for name in ("mano", "arctic")}
    if missing := [name.upper() for name, root in raw.items() if not root]:
        raise MissingResource(f"set HOIDATA_{missing[0]} to the folder of these files, as docs/own-data.md says")
    project = Path(os.environ.get("HOIDATA_BENCH_OUT", ".hoidata/recordings")).resolve()
    if not (project / "dvc.yaml").is_file():
        _hoidata("init", str(project), folder=Path.cwd())
        _merge(project / "params.yaml")
    for name, root in raw.items():
        _hoidata("raw", "scan", name, "--root", str(root), folder=project)
    _hoidata("repro", folder=project)
    measured = read_metrics(project / METRICS)
    text = "\n\n".join(
        f"## {title}\n\n{markdown_table(measured, columns, methods)}\n\n{unmeasured(measured, columns, methods)}"
        for title, (columns, methods) in TABLES.items()
    )
    text += f"\n\n## Time and memory of each stage\n\n{stage_table(project)}"
    (project / "benchmark.md").write_text(text + "\n")
    print(text)


def _hoidata(*words: str, folder: Path) -> None:
    subprocess.run([sys.executable, "-m", "hoidata", *words], cwd=folder, check=True)


def _merge(path: Path) -> None:
    """Merge the settings of the benchmark into a project's params.yaml."""
    values = merge_settings(load_yaml(path.read_bytes()), load_yaml(SETTINGS.read_bytes()))
    path.write_text(json.dumps(values, indent=1, ensure_ascii=False))  # JSON is YAML


def read_metrics(folder: Path) -> dict[str, dict[str, Any]]:
    """The metrics files below a folder, by the name of their family."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.rglob("*.json"))}


def markdown_table(
    measured: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str], methods: Mapping[str, str]
) -> str:
    """A Markdown table: per method and metric the value, its 95 % interval over clips, and the measured clips."""
    rows = [["method", *columns], ["---"] * (len(columns) + 1)]
    for title, family in methods.items():
        cells = ["not measured", *[""] * (len(columns) - 1)]
        if family in measured:
            cells = [_cell(measured[family], metric) for metric in columns.values()]
        rows.append([title, *cells])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows)


def _cell(result: Mapping[str, Any], metric: str) -> str:
    value = result["figures"].get(metric)
    if value is None:
        return "–"
    interval = result["intervals"].get(metric, {}).get("clips")
    text = f"{value:.{DIGITS}g}" + (f" ({interval[0]:.{DIGITS}g} to {interval[1]:.{DIGITS}g})" if interval else "")
    clips = result["counts"][metric]["clips"]
    return text if clips == result["held_out_clips"] else f"{text} n={clips}"


def unmeasured(
    measured: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str], methods: Mapping[str, str]
) -> str:
    """Per metric that a method has no value of for some clips: the share of these clips, and the reasons."""
    lines = []
    for title, metric in columns.items():
        for method, family in methods.items():
            if reasons := measured.get(family, {}).get("unmeasured", {}).get(metric):
                unmeasured_fraction = sum(reasons.values()) / measured[family]["held_out_clips"]
                words = f"no value for {unmeasured_fraction:.0%} of the clips ({reasons_in_words(reasons)})"
                lines.append(f"- {title}, {method}: {words}")
    return "\n".join(lines)


def stage_table(project: Path) -> str:
    """A Markdown table: per stage of the project the wall time and processor time, seconds, the peak memory."""
    rows = ["| stage | wall, s | processor, s | memory, MiB |", "|---|---|---|---|"]
    runs = [json.loads(path.read_text()) for path in (project / ".hoidata/runs").glob("*.json")]
    for run in sorted(runs, key=lambda run: run["began_at"]):
        rows.append(f"| {run['stage']} | {run['seconds']:.0f} | {run['processor_seconds']:.0f} | {run['peak_mib']} |")
    return "\n".join(rows)
