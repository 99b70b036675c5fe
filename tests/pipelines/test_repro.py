"""The whole graph, with GRAB present and ARCTIC absent, small corpora and a few steps per network."""

import json
import re
from pathlib import Path

import pytest
import trimesh
import yaml
from typer.testing import CliRunner

from hoidata.errors import BadInput
from hoidata.files.checksums import read_metadata
from pipelines.cli import app
from pipelines.parallel_repro import CODE
from tests.builders.folders import kept, moved

pytestmark = [pytest.mark.slow, pytest.mark.first]
RAW = ".hoidata/raw/embedded/grab"
MODELS = ("contact", "length", "diffusion", "refiner")


def stages_run(output: str) -> list[str]:
    """The stages that ``dvc repro`` reports as run, except ``code``, which always runs."""
    return re.findall(r"Running stage '([^']+)'", output)


@pytest.mark.long
def test_all_models_of_the_present_dataset_are_trained_and_those_of_the_others_are_empty(built):
    for model in MODELS:
        assert (built / "checkpoints/embedded/grab" / model / "model.safetensors").is_file()
        reason = json.loads((built / "checkpoints/embedded/arctic" / model / "empty.json").read_text())["reason"]
        assert reason == "arctic is not present in the profile embedded"


def test_each_checkpoint_records_its_training_data(built):
    for model in MODELS:
        metadata = read_metadata(built / "checkpoints/embedded/grab" / model / "model.safetensors")
        provenance = metadata["provenance"]
        assert provenance["synthetic"] is True
        assert provenance["datasets"] == {"grab": 4}
        assert len(provenance["clips"]["train"]) == 4
        assert all(clip.startswith(("grab/s1/", "grab/s2/")) for clip in provenance["clips"]["train"])


def test_metrics_and_report_exist_and_say_synthetic(built, project_tools):
    """The outputs for DVC: leading metrics of all families, a bar chart, and the losses of each network."""
    shown = json.loads(project_tools.run(built, "dvc", "metrics", "show", "--json").stdout)
    of_grab = shown[""]["data"]["metrics/embedded/grab.json"]["data"]
    assert of_grab.keys() == {"text2hoi", "ground-truth"}
    assert of_grab["ground-truth"]["contact_f1"] == 1.0
    plots = json.loads(project_tools.run(built, "dvc", "plots", "show", "--json", "-o", "plots").stdout)["data"]
    networks = {Path(name).stem for name in plots if "losses" in name}
    assert networks == {f"grab-{model}" for model in MODELS}
    assert any(name.endswith("bars/grab.csv") for name in plots)
    assert all(item["content"] for drawn in plots.values() for item in drawn)
    assert "synthetic" in (built / "report/embedded/index.html").read_text().lower()


def test_lineage_lists_all_inputs_of_each_checkpoint(built, monkeypatch):
    monkeypatch.chdir(built)
    for model in MODELS:
        result = CliRunner().invoke(app, ["lineage", f"checkpoints/embedded/grab/{model}", "--json"])
        assert result.exit_code == 0, result.output
        for name in (
            "manifests/embedded/grab.json",
            "raw@embedded-grab",
            "convert@embedded-grab",
            f"train.ours.{model}",
            f"train.small.{model}",
        ):
            assert f'"name": "{name}"' in result.stdout


def test_lineage_check_finds_all_outputs_unchanged(built, project_tools):
    result = project_tools.run(built, "hoidata", "lineage", "check")
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.endswith(", 0 not as written\n")


@pytest.mark.long
def test_lineage_rerun_trains_the_same_weights_in_a_clean_clone(built, project_tools):
    identity = ("-c", "user.name=t", "-c", "user.email=t@example.org")
    for words in (("add", "-A"), ("commit", "--quiet", "-m", "run")):
        assert project_tools.run(built, "git", *identity, *words).returncode == 0
    try:
        result = project_tools.run(built, "hoidata", "lineage", "rerun", "checkpoints/embedded/grab/length")
        assert result.stdout.endswith("\nsame weights\n"), result.stdout + result.stderr
    finally:
        assert project_tools.run(built, "git", "update-ref", "-d", "HEAD").returncode == 0


def test_lineage_reports_changed_inputs(built, project_tools):
    with kept(built / "params.yaml") as params:
        values = yaml.safe_load(params)
        values["annotate"]["threshold_m"] = 0.03
        project_tools.write_params(built, values)
        result = project_tools.run(built, "hoidata", "lineage", "checkpoints/embedded/grab/contact")
        assert result.returncode == 1
        assert "annotate changed threshold_m: None -> 0.03" in result.stdout


def test_removing_the_raw_data_afterwards_neither_deletes_nor_retrains_anything(built, project_tools):
    with moved(built / RAW, built / "moved"):
        result = project_tools.run(built, "dvc", "repro")
        assert result.returncode == 0, result.stderr
        assert stages_run(result.stdout) == [CODE]


def test_a_failing_conversion_leaves_the_clips_in_place(built, project_tools):
    code = built / "pipelines/stages/convert.py"
    with moved(built / RAW, built / "moved"), kept(code) as text:
        code.write_bytes(text + b"\n# edited\n")
        result = project_tools.run(built, "dvc", "repro", "convert@embedded-grab")
        assert result.returncode != 0
        assert "hoidata synth write grab" in result.stdout + result.stderr
        assert (built / "data/embedded/grab/clips/meta/sequences.parquet").is_file()
    assert project_tools.run(built, "dvc", "repro", CODE).returncode == 0


@pytest.mark.long
def test_switching_profiles_back_and_forth_runs_nothing_again(built, project_tools):
    with kept(built / "params.yaml") as params:
        project_tools.write_params(built, {**yaml.safe_load(params), "profile": "own"})
        other = project_tools.run(built, "dvc", "repro", "models/text2hoi/dvc.yaml:train-contact@own-grab")
    assert other.returncode == 0, other.stderr
    assert (built / "checkpoints/own/grab/contact/empty.json").is_file()
    assert stages_run(project_tools.run(built, "dvc", "repro").stdout) == [CODE]


def test_a_dataset_that_becomes_present_runs_only_its_stages(built, project_tools):
    with kept(built / "manifests/embedded/arctic.json"):
        project_tools.set_present(built, {"grab", "arctic"})
        status = json.loads(project_tools.run(built, "dvc", "status", "--json").stdout)
        assert "raw@embedded-arctic" in status
        assert not [stage for stage in status if "grab" in stage]


@pytest.mark.long
def test_the_same_seed_generates_the_same_bytes_for_a_mesh_file(built, project_tools, tmp_path):
    trimesh.creation.box((0.06, 0.08, 0.1)).export(tmp_path / "box.obj")
    for out in ("first", "second"):
        result = project_tools.run(
            built, "hoidata", "generate", "Lift a box with the right hand.", "--object", str(tmp_path / "box.obj"),
            "--seed", "3", "--out", str(tmp_path / out),
        )  # fmt: skip
        assert result.returncode == 0, result.stdout + result.stderr
    for name in ("motion.npz", "motion.glb", "index.html"):
        first, second = (tmp_path / out / name for out in ("first", "second"))
        assert first.read_bytes() == second.read_bytes()


def test_generation_refuses_unknown_objects_and_unusable_meshes(built, tmp_path, monkeypatch):
    monkeypatch.chdir(built)
    trimesh.creation.box((60, 80, 100)).export(tmp_path / "millimetres.obj")
    for object_name, message in ((str(tmp_path / "millimetres.obj"), "--unit mm makes it 10 cm"), ("ufo", "one of:")):
        arguments = ["generate", "Lift it.", "--object", object_name, "--out", str(tmp_path / "out")]
        refused = CliRunner().invoke(app, arguments).exception
        assert isinstance(refused, BadInput)
        assert message in str(refused)
