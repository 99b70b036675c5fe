"""``hoidata repro`` and ``hoidata up``: the graph, by hand or through Prefect."""

from typing import Annotated

import typer

from pipelines.commands.project import enter_project


def repro(
    targets: Annotated[list[str] | None, typer.Argument(help="Stages, e.g. annotate@embedded-arctic.")] = None,
) -> None:
    """Check that the raw files a run needs are there, then `dvc repro`."""
    enter_project()
    from pipelines.repro import reproduce

    raise typer.Exit(reproduce(targets or []))


def up() -> None:
    """Start a Prefect server and worker for this folder, with its deployments; Ctrl-C stops both.

    They listen on this machine alone, and only to who can read .prefect/api-key: `prefect` typed here finds it itself.
    """
    enter_project()
    from pipelines.prefect_server import serve

    raise typer.Exit(serve())
