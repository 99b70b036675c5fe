"""What Prefect is offered, made from the graph: a deployment per work and dataset, one for the whole."""

from pathlib import Path
from typing import Any

import yaml

from hoidata.beside import FOLDER, IS_INSTALLED
from hoidata.files.atomic import write_whole
from pipelines.lineage.graph import Stage, read_graph
from pipelines.params import read_params

FILE = Path(".hoidata/deployments.yaml")
WHOLE_GRAPH = "full-graph"
ENTRYPOINT = f"{FOLDER / 'pipelines/flows.py' if IS_INSTALLED else 'pipelines/flows.py'}:bring_up_to_date"
# Stages a person asks for by themselves; what comes before each of them is brought up to date with it.
WORK = ("convert", "annotate", "contact", "evaluate")
SCHEDULE = {"cron": "0 3 * * 1", "timezone": "UTC", "active": False}
Targets = dict[str, list[str]]


def deployment_targets(graph: dict[str, Stage], profile: str, datasets: list[str]) -> Targets:
    """DVC targets by deployment name, such as annotate-arctic, train-grab-text2hoi or evaluate-h2o.

    ``{profile}`` stands for the profile, which is chosen when a run starts.
    """
    found: Targets = {WHOLE_GRAPH: []}
    for dataset in datasets:
        at = f"@{profile}-{dataset}"
        for name in graph:
            address, sign, rest = name.partition(at)
            if not sign or rest[:1] not in ("", "-"):
                continue  # of another dataset, or of no dataset
            if key := _deployment_name(address, dataset):
                found.setdefault(key, []).append(f"{address}@{{profile}}-{dataset}{rest}")
    return found


def _deployment_name(address: str, dataset: str) -> str:
    """The deployment a stage belongs to; empty for stages nobody asks for by themselves."""
    work = address.rpartition(":")[2]
    if work in WORK:
        return f"{work}-{dataset}"
    return f"train-{dataset}-{Path(address).parent.name}" if work.split("-")[0] == "train" else ""


def write_deployments(project: Path) -> Path:
    """Write the deployments of this project in the form `prefect deploy` takes; the file's path."""
    params = read_params(project)
    targets = deployment_targets(read_graph(project), params["profile"], params["datasets"])
    rows = [_deployment(name, targets[name]) for name in sorted(targets)]
    return write_whole(project / FILE, yaml.safe_dump({"name": "hoidata", "deployments": rows}, sort_keys=False))


def _deployment(name: str, targets: list[str]) -> dict[str, Any]:
    what = ", ".join(targets) or "the report"
    return {
        "name": name,
        "description": f"Brings {what}, and all it is made from, up to date.",
        "entrypoint": ENTRYPOINT,
        "parameters": {"targets": targets, "profile": "", "jobs": 0, "force": False},
        "work_pool": {"name": "local"},
        "concurrency_limit": 1,
        "schedules": [SCHEDULE],
    }
