"""Benchmark on real recordings: trains, samples and measures every method on ARCTIC, and writes the tables.

``python -m bench recordings``. HOIDATA_ARCTIC: folder of the raw files; HOIDATA_MANO: folder of the MANO files;
HOIDATA_BENCH_OUT: the project folder (.hoidata/recordings). It becomes an ordinary project with the settings of
``recordings.yaml``; `hoidata repro` continues an interrupted run. The tables are in ``benchmark.md`` of the project.
"""

import os
from pathlib import Path

from bench.project import markdown_lines, open_project, reproduce, stage_runs
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
    project = Path(os.environ.get("HOIDATA_BENCH_OUT", ".hoidata/recordings")).resolve()
    open_project(project, load_yaml(SETTINGS.read_bytes()))
    reproduce(project)
    text = "\n".join(f"## {title}\n\n{table(project / METRICS, names.split())}" for title, names in TABLES.items())
    text += f"\n## Time and memory of each stage\n\n{stage_table(project)}\n"
    (project / "benchmark.md").write_text(text)
    print(text)


def table(metrics: Path, names: list[str]) -> str:
    """The Markdown table of `hoidata table` for all methods of a dataset."""
    return markdown_table(metrics, sorted(path.stem for path in metrics.glob("*.json")), names)


def stage_table(project: Path) -> str:
    """A Markdown table: per stage of the project the wall time and processor time, seconds, the peak memory."""
    return markdown_lines(
        ["stage", "wall, s", "processor, s", "memory, MiB"],
        [
            [run["stage"], f"{run['seconds']:.0f}", f"{run['processor_seconds']:.0f}", str(run["peak_mib"])]
            for run in stage_runs(project)
        ],
    )
