"""``hoidata repro``, ``hoidata up`` and ``hoidata down``: run the graph from the command line or with Prefect."""

from typing import Annotated

import typer

from pipelines.commands.project import enter_project


def repro(
    targets: Annotated[
        list[str] | None, typer.Argument(help="Stages to update, such as annotate@embedded-arctic. Default: all.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Number of parallel stages; 0 means one per core, at most 4.", min=0)] = 0,
    force: Annotated[bool, typer.Option("--force", help="Run the targets even if nothing has changed.")] = False,
    dry: Annotated[bool, typer.Option("--dry", help="Only list these stages with likely minutes.")] = False,
) -> None:
    """Run all stages whose inputs have changed, in parallel; first check that the raw files exist."""
    enter_project()
    from pipelines.parallel_repro import describe_plan, describe_run
    from pipelines.repro import default_jobs, plan, reproduce

    if dry:
        print(describe_plan(plan(targets or [], force), jobs or default_jobs()))
        return
    run = reproduce(targets or [], jobs, force=force)
    print(describe_run(run))
    raise typer.Exit(1 if run.failed else 0)


def up() -> None:
    """Start a Prefect server for this folder and serve the flows of its graph; Ctrl-C stops both.

    The server listens on this machine only and requires the key in .prefect/api-key. The command `prefect` in this
    folder reads the key itself.
    """
    enter_project()
    from pipelines.prefect_server import serve

    raise typer.Exit(serve())


def down() -> None:
    """Stop the server that `hoidata up` started for this folder, and its runs."""
    enter_project()
    from pipelines.prefect_server import stop_running

    typer.echo("stopped" if stop_running() else "nothing was running")
