"""Six real ARCTIC sequences through the whole graph. ``HOIDATA_ARCTIC`` names their folder; they are not included."""

import json
import os
import re
import shutil
from pathlib import Path

import pandas as pd
import pytest
import yaml

from hoidata.metrics.registry import METRICS

SEQUENCES = (
    *("s01/capsulemachine_use_02", "s01/mixer_grab_01", "s02/ketchup_use_02", "s02/box_grab_01"),
    *("s09/laptop_use_04", "s10/ketchup_use_02"),
)
FAMILIES = ["text2hoi", "ground-truth"]
SPLIT = {"by": "subject", "train": "rest", "validation": ["s09"], "test": ["s10"]}

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif("HOIDATA_ARCTIC" not in os.environ, reason="HOIDATA_ARCTIC is not set"),
]


def copy_sequences(source: Path, target: Path) -> Path:
    """Copy the raw files of ``SEQUENCES`` and the meshes of their objects."""
    for name in SEQUENCES:
        object_name = name.partition("/")[2].partition("_")[0]
        models = (f"meta/object_vtemplates/{object_name}/{file}" for file in ("mesh.obj", "parts.json"))
        for path in (f"raw_seqs/{name}.mano.npy", f"raw_seqs/{name}.object.npy", *models):
            (target / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / path, target / path)
    return target


def test_six_real_sequences_go_from_raw_files_to_a_report_and_a_second_run_does_nothing(
    project: Path, project_tools, tmp_path: Path
) -> None:
    source = Path(os.environ["HOIDATA_ARCTIC"])
    raw = copy_sequences(source, tmp_path / "arctic")
    project_tools.make_narrow(project, ["arctic"], FAMILIES)
    params = yaml.safe_load((project / "params.yaml").read_text())
    params["convert"]["adapters"]["arctic"] = {"clips": "segments"}
    params["split"]["arctic"] = SPLIT
    params["sample"]["samples"] = 1
    params["sample"]["text2hoi"]["attempts"] = 1
    params["controls"] = {"families": ["prompt-retrieval"]}
    project_tools.write_params(project, params)

    def hoidata(*words: str) -> str:
        result = project_tools.run(project, "hoidata", *words)
        assert result.returncode == 0, result.stdout + result.stderr
        return result.stdout + result.stderr

    for name, root in (("mano", source / "hand"), ("arctic", raw)):
        hoidata("raw", "scan", name, "--root", str(root))
    assert "report@own" in stages_run(hoidata("repro"))
    annotated = pd.read_parquet(project / "data/own/arctic/annotation/hand_type.parquet")
    assert {clip_id.rpartition("/")[0] for clip_id in annotated["clip_id"]} == {f"arctic/{name}" for name in SEQUENCES}
    assert annotated["verb"].notna().all()
    assert "text2hoi" in (project / "report/own/index.html").read_text()
    for name in (*FAMILIES, "controls/prompt-retrieval"):
        check_metrics(project / f"metrics/own/arctic/{name}.json")
    assert stages_run(hoidata("repro")) == []


def stages_run(output: str) -> list[str]:
    """The stages that ``hoidata repro`` reports as run; the stage ``code`` always runs and is not reported."""
    return re.findall(r"^\[\d+/\d+\] (\S+): ", output, re.MULTILINE)


def check_metrics(path: Path) -> None:
    """Each test clip has a value or a reason for each metric."""
    content = json.loads(path.read_text())
    assert content["held_out_clips"] >= 10
    assert (content["left_out"], content["synthetic"]) == ([], False)
    for metric in METRICS:
        measured = content["counts"].get(metric.name, {"clips": 0})["clips"]
        reasons = content["unmeasured"].get(metric.name, {})
        assert measured + sum(reasons.values()) == content["held_out_clips"], f"{path.stem}: {metric.name}: {reasons}"
        assert all(reasons), f"{path.stem}: {metric.name}"
        assert (metric.name in content["figures"]) == (measured > 0)
    assert content["counts"]["penetration_mm"]["clips"] == content["held_out_clips"]
