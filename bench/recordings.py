"""Benchmark on real recordings: trains, samples and measures every method on ARCTIC, and writes the tables.

``python -m bench recordings``. HOIDATA_ARCTIC: folder of the raw files; HOIDATA_MANO: folder of the MANO files;
HOIDATA_BENCH_OUT: the project folder (.hoidata/recordings). It becomes an ordinary project with the settings of
``recordings.yaml``; `hoidata repro` continues an interrupted run. The tables are in ``benchmark.md`` of the project.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

from hoidata.errors import MissingResource
from hoidata.settings import merge_settings
from pipelines.pages.metrics_table import markdown_table
from pipelines.params import load_yaml

SETTINGS = Path(__file__).with_name("recordings.yaml")
METRICS = Path("metrics/own/arctic")
# Title of a table, and its metrics.
TABLES = {
    "Motion from text": (
        "action_followed action_named contact_f1 adherence deep_share slip_cm_s realism_si jitter_m_s3 joint_error_mm"
    ),
    "Hands from recorded trajectories": (
        "contact_f1 bimart_con_corrected bimart_art_corrected bimart_pen_1cm_corrected bimart_accel_corrected "
        "slip_cm_s realism_si jitter_m_s3 joint_error_mm"
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
    merge_params(project / "params.yaml")
    for name, root in raw.items():
        _hoidata("raw", "scan", name, "--root", str(root), folder=project)
    _hoidata("repro", folder=project)
    text = "\n".join(f"## {title}\n\n{table(project / METRICS, names.split())}" for title, names in TABLES.items())
    text += f"\n## Time and memory of each stage\n\n{stage_table(project)}\n"
    (project / "benchmark.md").write_text(text)
    print(text)


def _hoidata(*words: str, folder: Path) -> None:
    subprocess.run([sys.executable, "-m", "hoidata", *words], cwd=folder, check=True)


def merge_params(path: Path) -> None:
    """Merge the settings of the benchmark into a project's params.yaml; a second time changes nothing."""
    values = merge_settings(load_yaml(path.read_bytes()), load_yaml(SETTINGS.read_bytes()))
    path.write_text(json.dumps(values, indent=1, ensure_ascii=False))  # JSON is YAML


def table(metrics: Path, names: list[str]) -> str:
    """The Markdown table of `hoidata table` for all methods of a dataset."""
    return markdown_table(metrics, sorted(path.stem for path in metrics.glob("*.json")), names)


def stage_table(project: Path) -> str:
    """A Markdown table: per stage of the project the wall time and processor time, seconds, the peak memory."""
    rows = ["| stage | wall, s | processor, s | memory, MiB |", "|---|---|---|---|"]
    runs = [json.loads(path.read_text()) for path in (project / ".hoidata/runs").glob("*.json")]
    for run in sorted(runs, key=lambda run: run["began_at"]):
        rows.append(f"| {run['stage']} | {run['seconds']:.0f} | {run['processor_seconds']:.0f} | {run['peak_mib']} |")
    return "\n".join(rows)
