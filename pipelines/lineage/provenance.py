"""What a checkpoint carries about its making: only what follows from content, so that equal inputs give equal bytes.

No time, host, user or commit is recorded; those would change the file's digest without changing what it is.
"""

from importlib.metadata import version
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files.sealed import read_metadata
from hoidata.files.written import read_json
from pipelines.lineage.digests import path_digest, value_digest
from pipelines.lineage.graph import Stage, look_up, producers, written_graph
from pipelines.params import read_params

SCHEMA = "hoidata.provenance/1"
LIBRARIES = ("torch", "numpy", "scipy", "pandas", "pyarrow", "trimesh", "libigl", "lemminflect", "safetensors")


def build_provenance(root: Path, stage_name: str, facts: dict[str, Any]) -> dict[str, Any]:
    """The provenance of what ``stage_name`` is about to make from the working tree at ``root``.

    facts: what the stage itself knows (model, config, seed, clips by split, synthetic). Every stage behind it is
    recorded with the values of its params and the digests of its code, inputs and outputs; of the clips, the raw files
    and frames they are.
    """
    graph = written_graph(root)
    if stage_name not in graph:
        raise BadInput("dvc.yaml", f"a stage named {stage_name}", f"{len(graph)} others", "check params.yaml")
    params, known = read_params(root), {}
    behind = _stages_behind(graph, stage_name)
    stages = {name: _record(root, graph[name], params, known) for name in behind}
    stages[stage_name].pop("outputs")
    return {
        "schema": SCHEMA,
        "stage": stage_name,
        **facts,
        "params_digest": value_digest({name: stages[name]["params"] for name in behind}),
        "code_digest": value_digest(stages[stage_name]["code"]),
        "libraries": library_versions(),
        "stages": stages,
        "raw": _raw_facts(root, facts, stages),
    }


def _raw_facts(root: Path, facts: dict[str, Any], stages: dict[str, Any]) -> dict[str, Any]:
    """The raw files and frames behind the clips, so that the header tells them where there is no store."""
    from pipelines.lineage.raw import clips_of, read_raw, stores_behind

    found = {path: read_raw(root, path, clips_of(facts)) for path in stores_behind({"stages": stages})}
    return {path: source.as_json() for path, source in found.items() if source is not None}


def _stages_behind(graph: dict[str, Stage], name: str) -> list[str]:
    """The stage and all whose outputs it is made from, nearest first, each once."""
    made_by, order = producers(graph), [name]
    for current in order:
        inputs = (made_by.get(path) for path in graph[current].data)
        order += [stage.name for stage in dict.fromkeys(filter(None, inputs)) if stage.name not in order]
    return order


def _record(root: Path, stage: Stage, params: dict[str, Any], known: dict[str, str | None]) -> dict[str, Any]:
    def digests(paths: tuple[str, ...]) -> dict[str, str | None]:
        for path in paths:
            if path not in known:
                known[path] = path_digest(root / path)
        return {path: known[path] for path in sorted(paths)}

    return {
        "params": {key: look_up(params, key) for key in sorted(stage.params)},
        "code": {path: digest for file in stage.code for path, digest in read_json(root / file).items()},
        "inputs": digests(stage.data),
        "outputs": digests(stage.outs),
    }


def library_versions() -> dict[str, str]:
    """Versions of the libraries whose results end up in a checkpoint."""
    return {name: version(name) for name in LIBRARIES}


def read_provenance(path: Path) -> dict[str, Any]:
    """The provenance a checkpoint carries. Raises BadInput when there is none of a schema known here."""
    if not path.is_file():
        raise BadInput(path, "a checkpoint", "no file", "make it with `dvc repro`")
    metadata = read_metadata(path)
    values = {**metadata.get("provenance", metadata), "seal": metadata.get("seal") or {}}
    if values.get("schema") != SCHEMA:
        raise BadInput(path, f"provenance of schema {SCHEMA}", str(values.get("schema")), "train it with `dvc repro`")
    return values
