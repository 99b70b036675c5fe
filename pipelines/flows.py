"""Prefect flows: each brings one DVC target up to date. Which stages there are, and their order, is dvc.yaml's."""

from pathlib import Path

from prefect import flow

from pipelines.params import read_params
from pipelines.repro import reproduce
from pipelines.side_by_side import log_of


class GraphError(RuntimeError):
    """``dvc repro`` ended with an error; its own output says which stage and why."""


def run_target(targets: list[str]) -> None:
    """Preflight and ``dvc repro``. Raises GraphError so that the flow run counts as failed."""
    run = reproduce(targets)
    if run.failed:
        raise GraphError("\n".join(f"{name} failed; see {log_of(name)}" for name in run.failed))


@flow(name="annotate-arctic")
def annotate_arctic() -> None:
    """Bring ARCTIC's annotation up to date, in the profile params.yaml chooses."""
    run_target([f"annotate@{read_params(Path())['profile']}-arctic"])


@flow(name="full-graph")
def full_graph() -> None:
    """Bring everything up to date."""
    run_target([])
