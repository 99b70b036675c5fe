"""A change of the text encoder to a tiny random CLIP runs text and training stages again, but no motion stages."""

import json
import os
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from hoidata.files.checksums import read_metadata

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("open_clip") is None, reason="hoidata[clip] is not installed"),
]
ENCODER = "clip:tiny.safetensors?quick_gelu=true"
MOTION = ("raw", "convert", "quality", "contact")
GENERATE = ("hoidata", "generate", "Lift it with the left hand.", "--object")


def write_tiny_clip(path: Path) -> None:
    """Write a random text tower of two layers with the names of open_clip."""
    import torch
    from safetensors.torch import save_file

    from hoidata.annotation.clip_encoder import ARCHITECTURE, import_open_clip

    open_clip = import_open_clip()
    size = {**open_clip.get_model_config(ARCHITECTURE)["text_cfg"], "width": 64, "heads": 1, "layers": 2}
    torch.manual_seed(0)
    tower = open_clip.model._build_text_tower(512, size, quick_gelu=True)
    save_file({name: value.contiguous() for name, value in tower.state_dict().items()}, path)


def lock(folder: Path) -> dict[str, dict]:
    locks = [folder / "dvc.lock", *folder.glob("models/*/dvc.lock")]
    return {name: stage for path in locks for name, stage in yaml.safe_load(path.read_text())["stages"].items()}


def outputs(stage: dict) -> dict[str, str]:
    return {out["path"]: out["md5"] for out in stage["outs"]}


@pytest.fixture(scope="module")
def before_and_after(built: Path, project_tools) -> tuple[Path, dict, dict, str]:
    """The project, its locks before and after the change of encoder, and the output of the second run."""
    folder = built
    before = lock(folder)
    write_tiny_clip(folder / "tiny.safetensors")
    values = yaml.safe_load((folder / "params.yaml").read_text())
    values["annotate"]["encoder"] = ENCODER
    project_tools.write_params(folder, values)
    second = project_tools.run(folder, "dvc", "repro", PYTHONPATH=os.environ.get("PYTHONPATH", ""))
    assert second.returncode == 0, second.stdout + second.stderr
    return folder, before, lock(folder), second.stdout


def test_motion_stages_do_not_run_again(before_and_after) -> None:
    _, before, after, said = before_and_after
    for name in before:
        if name.startswith(MOTION):
            assert after[name] == before[name]
            assert f"Running stage '{name}'" not in said


def test_text_and_training_stages_run_again_and_the_subsets_stay_the_same(before_and_after) -> None:
    _, before, after, _ = before_and_after
    changed = {path for name in before for path, digest in outputs(after[name]).items()
               if outputs(before[name])[path] != digest}  # fmt: skip
    models = ("contact", "length", "diffusion", "refiner")
    assert changed >= {"data/embedded/grab/annotation", *(f"checkpoints/embedded/grab/{model}" for model in models)}
    assert changed <= {"data/embedded/grab/annotation", *(f"checkpoints/embedded/grab/{model}" for model in models),
                       "samples/embedded/grab/text2hoi", "metrics/embedded/grab",
                       "report/embedded"}  # fmt: skip


def test_features_and_checkpoints_name_the_encoder_clip(before_and_after) -> None:
    folder, _, _, _ = before_and_after
    identity = json.loads((folder / "data/embedded/grab/annotation/info.json").read_text())["encoder"]
    assert (identity["name"], identity["quick_gelu"], identity["dims"]) == ("clip-text-64x2", True, 512)
    features = np.load(folder / "data/embedded/grab/annotation/embeddings.npz")["features"]
    assert features.shape[1] == 512
    assert np.ptp(features, axis=0).max() > 0
    metadata = read_metadata(folder / "checkpoints/embedded/grab/contact/model.safetensors")
    assert metadata["facts"]["encoder"] == identity


def test_all_stages_are_up_to_date_and_the_models_generate_only_with_their_encoder(
    before_and_after, project_tools, tmp_path: Path
) -> None:
    folder, *_ = before_and_after
    assert project_tools.run(folder, "dvc", "repro").stdout.count("Running stage") == 1  # code, which always runs
    params = (folder / "params.yaml").read_text()
    object_name = str(pd.read_parquet(folder / "data/embedded/grab/clips/meta/objects.parquet")["object"][0])
    generate = (*GENERATE, object_name, "--model", "grab")
    result = project_tools.run(folder, *generate, "--out", str(tmp_path / "made"))
    assert result.returncode == 0, result.stdout + result.stderr
    assert "left (decided by rule" in (tmp_path / "made" / "index.html").read_text()
    plain = project_tools.run(folder, *generate, "--hand-by", "similarity", "--out", str(tmp_path / "plain"))
    assert plain.returncode == 0, plain.stdout + plain.stderr
    assert "(decided by embedding" in (tmp_path / "plain" / "index.html").read_text()
    values = yaml.safe_load(params)
    values["annotate"]["encoder"] = "hash"
    project_tools.write_params(folder, values)
    refused = project_tools.run(folder, *generate, "--out", str(tmp_path / "refused"))
    (folder / "params.yaml").write_text(params)
    assert refused.returncode == 1
    assert "annotate.encoder back" in " ".join((refused.stdout + refused.stderr).split())
