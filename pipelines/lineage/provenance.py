"""The provenance record in the header of a checkpoint: params, code, inputs and libraries.

It contains no time, host, user or commit, so that equal inputs give equal bytes.
"""

from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files.checksums import read_metadata
from hoidata.files.written import read_json
from pipelines.lineage.digests import path_digest, value_digest
from pipelines.lineage.graph import Stage, look_up, producers, written_graph
from pipelines.params import read_params

SCHEMA = "hoidata.provenance/1"
LIBRARIES = ("torch", "numpy", "scipy", "pandas", "pyarrow", "trimesh", "libigl", "lemminflect", "safetensors")


def build_provenance(root: Path, stage_name: str, facts: dict[str, Any]) -> dict[str, Any]:
    """The provenance of the output that a stage is about to write.

    It has params and digests of code, inputs and outputs of all stages upstream, and raw files and frames of the clips.

    Args:
        facts: of the stage itself: model, config, seed, clips by subset, synthetic.
    """
    graph = written_graph(root)
    if stage_name not in graph:
        raise BadInput("dvc.yaml", f"a stage named {stage_name}", f"{len(graph)} others", "check params.yaml")
    params, digest = read_params(root), cache(lambda path: path_digest(root / path))
    upstream = _upstream_stages(graph, stage_name)
    stages = {name: _record(root, graph[name], params, digest) for name in upstream}
    stages[stage_name].pop("outputs")
    return {
        "schema": SCHEMA,
        "stage": stage_name,
        **facts,
        "params_digest": value_digest({name: stages[name]["params"] for name in upstream}),
        "code_digest": value_digest(stages[stage_name]["code"]),
        "libraries": library_versions(),
        "stages": stages,
        "raw": _raw_facts(root, facts, stages),
    }


def _raw_facts(root: Path, facts: dict[str, Any], stages: dict[str, Any]) -> dict[str, Any]:
    """The raw files and frames of the clips; the header has them for readers without the store."""
    from pipelines.lineage.raw import clips_of, read_raw, upstream_stores

    sources = {path: read_raw(root, path, clips_of(facts)) for path in upstream_stores({"stages": stages})}
    return {path: source.as_json() for path, source in sources.items() if source is not None}


def _upstream_stages(graph: dict[str, Stage], name: str) -> list[str]:
    """The stage and all upstream stages, in breadth-first order."""
    producer_of, order = producers(graph), [name]
    for current in order:
        inputs = (producer_of.get(path) for path in graph[current].data)
        order += [stage.name for stage in dict.fromkeys(filter(None, inputs)) if stage.name not in order]
    return order


def _record(root: Path, stage: Stage, params: dict[str, Any], digest: Callable[[str], str | None]) -> dict[str, Any]:
    return {
        "params": {key: look_up(params, key) for key in sorted(stage.params)},
        "code": {path: digest for file in stage.code for path, digest in read_json(root / file).items()},
        "inputs": {path: digest(path) for path in sorted(stage.data)},
        "outputs": {path: digest(path) for path in sorted(stage.outs)},
    }


def library_versions() -> dict[str, str]:
    """Versions of the libraries that affect the bytes of a checkpoint."""
    return {name: version(name) for name in LIBRARIES}


def read_provenance(path: Path) -> dict[str, Any]:
    """The provenance in the header of a checkpoint. Raises BadInput if it is missing or has another schema."""
    if not path.is_file():
        raise BadInput(path, "a checkpoint", "no file", "make it with `dvc repro`")
    metadata = read_metadata(path)
    values = {**metadata.get("provenance", metadata), "seal": metadata.get("seal") or {}}
    if values.get("schema") != SCHEMA:
        raise BadInput(path, f"provenance of schema {SCHEMA}", str(values.get("schema")), "train it with `dvc repro`")
    return values
