"""Projects of benchmarks: `hoidata init`, settings laid over the default params.yaml, `hoidata repro`, and results."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hoidata.errors import MissingResource
from hoidata.package_paths import FOLDER
from hoidata.settings import merge_settings
from pipelines.expected_orderings import read_methods
from pipelines.params import chosen_params, load_yaml

BY_METRIC = ("figures", "intervals", "counts", "notes", "unmeasured")  # parts of a metrics file, each by metric
TEXT2HOI = ("text2hoi", "text2hoi-coarse", "other-prompt")  # families of models/text2hoi/dvc.yaml
Methods = dict[str, dict[str, Any]]  # metrics files by family or control


def open_project(folder: Path, settings: Mapping[str, Any]) -> None:
    """Create or continue the project of a benchmark; register the raw files of profile `own`.

    Raises MissingResource if HOIDATA_MANO, or HOIDATA_<DATASET> of a dataset, is not set.
    """
    names = ("mano", *settings["datasets"]) if settings["profile"] == "own" else ()
    raw = {name: os.environ.get(f"HOIDATA_{name.upper()}") for name in names}
    if missing := [name.upper() for name, root in raw.items() if not root]:
        raise MissingResource(f"set HOIDATA_{missing[0]} to the folder of these files, as docs/own-data.md says")
    if not (folder / "dvc.yaml").is_file():
        _hoidata("init", str(folder), folder=Path.cwd())
    write_params(folder / "params.yaml", settings)
    sample_only(folder, settings.get("families", ()))
    for name, root in raw.items():
        _hoidata("raw", "scan", name, "--root", str(root), folder=folder)


def reproduce(folder: Path, *targets: str) -> None:
    """Run the stages of a project whose inputs have changed; without targets all."""
    _hoidata("repro", *targets, folder=folder)


def _hoidata(*words: str, folder: Path) -> None:
    subprocess.run([sys.executable, "-m", "hoidata", *words], cwd=folder, check=True)


def sample_only(folder: Path, families: Collection[str]) -> None:
    """Let the project's stage `sample` of Text2HOI sample only those in ``families``; all if there are none."""
    path = folder / "models/text2hoi/dvc.yaml"
    chosen = [name for name in TEXT2HOI if name in families] or TEXT2HOI
    path.write_text(re.sub(r"family: \[.*?\]", f"family: [{', '.join(chosen)}]", path.read_text()))


def write_params(path: Path, settings: Mapping[str, Any]) -> None:
    """Write a params.yaml: the defaults with the overlay of the settings' profile, then the settings."""
    defaults = load_yaml((FOLDER / "params.yaml").read_bytes())
    values = merge_settings(chosen_params({**defaults, "profile": settings["profile"]}), settings)
    path.write_text(json.dumps({**values, "profiles": {}}, indent=1, ensure_ascii=False))  # JSON is YAML


def results_of(metrics: Path, names: Collection[str]) -> Methods:
    """The metrics ``names`` of every method of a dataset, with their intervals, counts and reasons."""
    methods = {}
    for family, content in read_methods(metrics).items():
        methods[family] = {key: content[key] for key in ("empty", "motions", "held_out_clips") if key in content}
        for part in BY_METRIC if "figures" in content else ():
            methods[family][part] = {name: content[part][name] for name in names if name in content.get(part, {})}
    return methods


def stage_runs(project: Path) -> list[dict[str, Any]]:
    """The last run of each stage, oldest first: its name, wall and processor seconds, peak memory."""
    runs = [json.loads(path.read_text()) for path in (project / ".hoidata/runs").glob("*.json")]
    return sorted(runs, key=lambda run: run["began_at"])


def markdown_lines(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    heading = f"| {' | '.join(head)} |\n{'|---' * len(head)}|"
    return "\n".join([heading, *(f"| {' | '.join(line)} |" for line in lines)])
