"""``hoidata repro``, ``hoidata up`` and ``hoidata down``: the graph, by hand or through Prefect."""

from typing import Annotated

import typer

from pipelines.commands.project import enter_project


def repro(
    targets: Annotated[list[str] | None, typer.Argument(help="Stages, e.g. annotate@embedded-arctic.")] = None,
    jobs: Annotated[int, typer.Option(help="Stages at once; 0: one per core, at most 4.", min=0)] = 0,
    force: Annotated[bool, typer.Option("--force", help="Run the targets even where nothing changed.")] = False,
) -> None:
    """Check that the raw files a run needs are there, then bring the graph up to date, stages side by side."""
    enter_project()
    from pipelines.repro import reproduce
    from pipelines.side_by_side import describe_run

    run = reproduce(targets or [], jobs, force=force)
    print(describe_run(run))
    raise typer.Exit(1 if run.failed else 0)


def up() -> None:
    """Start a Prefect server for this folder and serve the flows of its graph; Ctrl-C stops both.

    They listen on this machine alone, and only to who can read .prefect/api-key: `prefect` typed here finds it itself.
    """
    enter_project()
    from pipelines.prefect_server import serve

    raise typer.Exit(serve())


def down() -> None:
    """Stop the server that `hoidata up` started for this folder, and what they run."""
    enter_project()
    from pipelines.prefect_server import stop_running

    typer.echo("stopped" if stop_running() else "nothing was running")
