"""``hoidata doctor``, ``info`` and ``validate``: examine the installation, a store, or an output."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipelines.commands.project import enter_project

SHOWN_ROWS = 12


def doctor() -> None:
    """List installed packages, raw folders, hand models, text encoder and GPU; the exit code is 1 if one is broken."""
    enter_project()
    from pipelines.doctor import examine

    findings = examine()
    table = Table("part", "state", "detail")
    colours = {"ok": "green", "absent": "yellow", "broken": "red"}
    for finding in findings:
        table.add_row(finding.part, f"[{colours[finding.state]}]{finding.state}[/]", escape(finding.detail))
    Console().print(table)
    raise typer.Exit(1 if any(finding.state == "broken" for finding in findings) else 0)


def info(
    store: Annotated[
        Path, typer.Argument(help="Folder of a store of clips.", exists=True, file_okay=False, resolve_path=True)
    ],
    everything: Annotated[
        bool, typer.Option("--all", help="List all objects, verbs and quarantined sequences.")
    ] = False,
) -> None:
    """Describe a store: clips by object and verb, conventions, licence, and quarantined sequences with reasons."""
    from hoidata.store.store import open_store
    from pipelines.commands.store_facts import fact_rows, group_rows, quarantine_rows
    from pipelines.stages.base import empty_reason

    if reason := empty_reason(store):
        typer.echo(f"{store}: empty, {reason}")
        return
    opened, console = open_store(store), Console()
    shown = None if everything else SHOWN_ROWS
    _print_rows(console, ("property", "value"), fact_rows(opened), None)
    for column in ("object", "verb"):
        _print_rows(console, (column, "clips", "frames"), group_rows(opened, column), shown)
    _print_rows(console, ("quarantined", "source", "expected", "got"), quarantine_rows(opened), shown)


def validate(
    output: Annotated[
        Path,
        typer.Argument(help="A store, a checkpoint, or another output of a stage.", exists=True, resolve_path=True),
    ],
) -> None:
    """Check that an output has not changed since it was written, and that a store fits the schema.

    Compares files with dvc.lock and checkpoints with their checksums. The exit code is 1 if there is a problem.
    """
    from pipelines.validation import problems_of

    problems, sound = problems_of(output)
    for problem in problems:
        typer.echo(str(problem))
    if problems:
        typer.echo(f"{output}: {len(problems)} problem{'s' if len(problems) > 1 else ''}")
        raise typer.Exit(1)
    typer.echo(f"{output}: {sound}")


def _print_rows(console, heads: tuple[str, ...], rows: list[tuple[str, ...]], shown: int | None) -> None:
    """Print a table with at most ``shown`` rows, and the number of omitted rows."""
    if not rows:
        return
    table = Table()
    for head in heads:
        table.add_column(head, justify="right" if head in ("clips", "frames") else "left", overflow="fold")
    for values in rows[:shown]:
        table.add_row(*map(escape, values))
    console.print(table)
    if shown is not None and len(rows) > shown:
        console.print(f"and {len(rows) - shown:,} more (--all lists them)")
