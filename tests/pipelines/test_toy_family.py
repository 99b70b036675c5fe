"""A model family is a folder and a registry entry: the toy family is trained, sampled, measured and shown."""

import json
import re
import shutil
from pathlib import Path

import pytest

from hoidata.files.checksums import read_metadata
from pipelines.parallel_repro import CODE

pytestmark = pytest.mark.long
FOLDER = Path(__file__).with_name("toy_family")
OWN_STAGES = [
    name
    for dataset in ("grab", "arctic")
    for name in (
        f"models/toy/dvc.yaml:train@embedded-{dataset}",
        f"models/toy/dvc.yaml:sample@embedded-{dataset}",
        f"evaluate@embedded-{dataset}",
    )
]


def add_line(path: Path, before: str, line: str) -> None:
    """Insert a line before the first one that starts with ``before``."""
    lines = path.read_text().splitlines(keepends=True)
    at = next(number for number, text in enumerate(lines) if text.startswith(before))
    path.write_text("".join([*lines[:at], line + "\n", *lines[at:]]))


def test_a_family_of_one_folder_trains_samples_is_measured_and_shown(built: Path, project_tools) -> None:
    project, params = built, built / "params.yaml"
    shutil.copytree(FOLDER, project / "models" / "toy", ignore=shutil.ignore_patterns("__pycache__"))
    (project / "models" / "toy" / "__init__.py").touch()
    # Named dvc.yaml, DVC would read the file as part of this project.
    (project / "models" / "toy" / "stages.yaml").rename(project / "models" / "toy" / "dvc.yaml")
    typed = (
        (project / "models" / "registry.py", '    "nearest-clip"', '    "toy": "models.toy.family:TOY",'),
        (project / "models" / "registry.py", '    "contact"', '    "toy": "models.toy.family:NETWORK",'),
        (params, "- ground-truth", "- toy"),
    )
    for path, before, line in typed:
        add_line(path, before, line)
    print(f"lines typed outside the folder: {len(typed)}")
    assert len(typed) <= 3

    result = project_tools.run(project, "dvc", "repro", PYTHONPATH=str(project))
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    assert set(re.findall(r"Running stage '([^']+)'", result.stdout)) == {CODE, "report@embedded", *OWN_STAGES}

    metadata = read_metadata(project / "checkpoints/embedded/grab/toy/model.safetensors")
    assert metadata["provenance"]["datasets"] == {"grab": 4}
    figures = json.loads((project / "metrics/embedded/grab/toy.json").read_text())
    assert figures["motions"] == 2 * figures["held_out_clips"] > 0
    assert 0 < figures["figures"]["joint_error_mm"] < 1000
    page = (project / "report/embedded/index.html").read_text()
    assert "toy" in page

    again = project_tools.run(project, "dvc", "repro", PYTHONPATH=str(project))
    assert "Running stage 'models/toy" not in again.stdout
    lineage = project_tools.run(project, "hoidata", "lineage", "checkpoints/embedded/grab/toy", PYTHONPATH=str(project))
    assert lineage.returncode == 0, lineage.stdout + lineage.stderr
