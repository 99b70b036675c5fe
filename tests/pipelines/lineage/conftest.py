"""A small project after a run, with real stores, checkpoints, dvc.lock and one commit; no network is trained."""

import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from dvc.repo import Repo
from safetensors.numpy import save

from hoidata.clips.clip import SourceFile
from hoidata.files import canonical_json, sha256_bytes
from hoidata.files.checksums import EMPTY_CHECKSUMS, sealed
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from pipelines.lineage.graph import Stage, look_up, written_graph
from pipelines.lineage.locks import dvc_digest
from pipelines.lineage.provenance import build_provenance
from pipelines.params import read_params
from pipelines.stages.code import write_code
from tests.builders.clips import clip_of, still_object
from tests.builders.folders import write_text
from tests.builders.objects import box_model

RAW, CLIPS, SPLITS = (f"data/embedded/grab/{name}" for name in ("raw.json", "clips", "splits"))
GRAPH = f"""
stages:
  code:
    cmd: python -m pipelines.stages code
    outs: [{{code: {{cache: false}}}}]
  raw:
    matrix: &runs {{profile: ["${{profile}}"], dataset: "${{datasets}}"}}
    cmd: raw ${{item.dataset}}
    deps: ["code/raw/${{item.dataset}}.json", "manifests/${{item.profile}}/${{item.dataset}}.json"]
    outs: ["{RAW}"]
  convert:
    matrix: *runs
    cmd: convert ${{item.dataset}}
    deps: ["code/convert/${{item.dataset}}.json", "{RAW}"]
    params: [convert.margin_frames]
    outs: ["{CLIPS}"]
  split:
    matrix: *runs
    cmd: split
    deps: ["{CLIPS}"]
    outs: ["{SPLITS}"]
  evaluate:
    matrix: *runs
    cmd: evaluate
    deps: ["{CLIPS}", samples/embedded/grab]
    metrics: [metrics/embedded/grab/text2hoi.json: {{cache: false}}]
"""
FAMILY = f"""
vars: [../../params.yaml]
stages:
  train:
    wdir: ../..
    matrix: {{profile: ["${{profile}}"], dataset: "${{datasets}}", model: [contact, length]}}
    cmd: train
    deps: ["code/train/${{item.model}}.json", "{CLIPS}", "{SPLITS}"]
    params: [train.seed, "train.${{train.size}}.${{item.model}}"]
    outs: ["checkpoints/${{item.profile}}/${{item.dataset}}/${{item.model}}"]
  sample:
    wdir: ../..
    cmd: sample
    deps: ["{CLIPS}", checkpoints/embedded/grab/contact]
    params: [sample]
    outs: [samples/embedded/grab/text2hoi]
"""
PARAMS = {
    "profile": "embedded",
    "datasets": ["grab"],
    "families": [],
    "convert": {"margin_frames": 2},
    "train": {"size": "demo", "seed": 0, "demo": {"contact": {"lr": 0.1}, "length": {"lr": 0.2}}},
    "sample": {"seed": 0},
}
CODE = {
    "hoidata/datasets/registry.py": "",
    "hoidata/datasets/grab/adapter.py": "SCALE = 1",
    "models/text2hoi/contact.py": "WIDTH = 8",
    "models/text2hoi/unused.py": "",
    "pipelines/stages/raw.py": "",
    "pipelines/stages/convert.py": "import hoidata.datasets.registry",
    "pipelines/stages/train.py": "from models.text2hoi import contact",
}
TRAINING_CLIPS = {"contact": ("grab/s1/mug_lift", "grab/s1/cup_pour"), "length": ("grab/s2/mug_pass",)}
ALL_CLIPS = (*TRAINING_CLIPS["contact"], *TRAINING_CLIPS["length"], "grab/s3/box_lift")


def recorded_clip(clip_id: str):
    _, subject, sequence = clip_id.split("/")
    object_name = sequence.partition("_")[0]
    files = (f"grab/{subject}/{sequence}.npz", f"tools/{object_name}.ply")
    sources = tuple(SourceFile(name, len(name), sha256_bytes(name.encode())) for name in files)
    model = replace(box_model(), name=object_name)
    return clip_of(clip_id, still_object(model, 3), sources=sources, source_frames=np.array([60, 64, 68], np.int32))


def write_data(root: Path) -> None:
    """Write raw files that contain their names, their manifest, a store, a table, a sample and a metric file."""
    clips = [recorded_clip(clip_id) for clip_id in ALL_CLIPS]
    raw = {source.path: source for clip in clips for source in clip.sources}
    write_text(root, {f".hoidata/raw/embedded/grab/{path}": path for path in raw})
    listed = {"schema": "hoidata.manifest/1", "dataset": "grab", "present": True, "source": "generated"}
    listed |= {"licence": "CC0-1.0", "where_to_register": "https://grab.example"}
    write_text(root, {RAW: json.dumps(listed | {"files": [asdict(source) for source in raw.values()]})})
    write_store(root / CLIPS, clips, generated_info("grab"))
    write_text(root, {f"{SPLITS}/splits.csv": "s3 test", "metrics/embedded/grab/text2hoi.json": "{}"})
    motion = replace(recorded_clip(ALL_CLIPS[-1]), clip_id=f"{ALL_CLIPS[-1]}~0", sequence=ALL_CLIPS[-1], sources=())
    write_store(root / "samples/embedded/grab/text2hoi/clips", [motion], generated_info("generated"))


def train(root: Path, weights: float = 0.0, **facts: object) -> None:
    """Write both checkpoints as the stage does, with the provenance of the files at ``root``."""
    for model, clips in TRAINING_CLIPS.items():
        facts_of_stage = {"model": model, "seed": read_params(root)["train"]["seed"], "clips": {"train": list(clips)}}
        stage = f"models/text2hoi/dvc.yaml:train@embedded-grab-{model}"
        provenance = build_provenance(root, stage, facts_of_stage | {"synthetic": True, "device": "cpu"} | facts)
        values = {"weight": np.full(4, weights, np.float32)}
        data = sealed(save(values, {"hoidata": canonical_json({"provenance": provenance, "seal": EMPTY_CHECKSUMS})}))
        path = root / f"checkpoints/embedded/grab/{model}/model.safetensors"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def write_locks(root: Path) -> None:
    """Write dvc.lock as DVC does; test_repro compares the digests with those of a real run."""
    params, files = read_params(root), {"dvc.lock": {}, "models/text2hoi/dvc.lock": {}}

    def entries(paths: tuple[str, ...]) -> list[dict]:
        return [{"path": path, "hash": "md5", "md5": dvc_digest(root / path)} for path in paths]

    def run(stage: Stage) -> dict:
        params_read = {"params.yaml": {key: look_up(params, key) for key in stage.params}} if stage.params else {}
        return {"cmd": "run", "deps": entries(stage.deps), "params": params_read, "outs": entries(stage.outs)}

    for stage in written_graph(root).values():
        file, _, name = stage.name.rpartition(":")
        files[file.replace("yaml", "lock") or "dvc.lock"][name] = run(stage)
    for file, stages in files.items():
        values = json.loads(json.dumps({"schema": "2.0", "stages": stages}))  # plain dictionaries, which PyYAML writes
        (root / file).write_text(yaml.safe_dump(values, sort_keys=False))


def git(root: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "commit.gpgsign=false")
    return subprocess.run(["git", *identity, *arguments], cwd=root, check=True, capture_output=True, text=True).stdout


def commit(root: Path, message: str = "run") -> str:
    git(root, "add", "-A")
    git(root, "commit", "--quiet", "-m", message)
    return git(root, "rev-parse", "HEAD").strip()


def build_project(root: Path, code: dict[str, str]) -> None:
    ignored = "/.hoidata/\n/data/\n/checkpoints/\n/samples/\n/metrics/\n/code/\n.dvc/tmp\n"
    files = {"dvc.yaml": GRAPH, "models/text2hoi/dvc.yaml": FAMILY, ".gitignore": ignored, **code}
    write_text(root, files | {"params.yaml": yaml.safe_dump(PARAMS), "manifests/embedded/grab.json": "{}"})
    git(root, "init", "--quiet", ".")
    Repo.init(str(root)).close()
    write_data(root)
    write_code(root)
    train(root)
    write_locks(root)
    commit(root)


@pytest.fixture(scope="module")
def ran_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("lineage") / "project"
    root.mkdir()
    build_project(root, CODE)
    return root


@pytest.fixture
def ran(ran_once: Path, tmp_path: Path) -> SimpleNamespace:
    """A copy of the project after a run, and functions that change it."""
    root = Path(shutil.copytree(ran_once, tmp_path / "project"))

    def run_again(**facts: object) -> None:
        write_code(root)
        train(root, **facts)
        write_locks(root)

    def with_root(function: Callable) -> Callable:
        return lambda *words, **named: function(root, *words, **named)

    return SimpleNamespace(
        root=root, run_again=run_again, commit=with_root(commit), git=with_root(git), write=with_root(write_text)
    )


@pytest.fixture
def project_builder() -> SimpleNamespace:
    """The functions above, for test modules, which cannot import a conftest."""
    return SimpleNamespace(
        build=build_project, code=CODE, clips=ALL_CLIPS, training_clips=TRAINING_CLIPS, recorded_clip=recorded_clip
    )
