"""``hoidata doctor``, ``info`` and ``validate``: what is here, and whether it is sound."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipelines.commands.project import enter_project

SHOWN_ROWS = 12


def doctor() -> None:
    """Say what is installed and which raw folders, hand, encoder and GPU were found; exit code 1 if one is broken."""
    enter_project()
    from pipelines.doctor import examine

    findings = examine()
    table = Table("part", "state", "found")
    colours = {"ok": "green", "absent": "yellow", "broken": "red"}
    for finding in findings:
        table.add_row(finding.part, f"[{colours[finding.state]}]{finding.state}[/]", escape(finding.found))
    Console().print(table)
    raise typer.Exit(1 if any(finding.state == "broken" for finding in findings) else 0)


def info(
    store: Annotated[Path, typer.Argument(help="A store of clips.", exists=True, file_okay=False, resolve_path=True)],
    everything: Annotated[bool, typer.Option("--all", help="List all objects, verbs and what was left out.")] = False,
) -> None:
    """Describe a store: clips by object and verb, conventions, licence, and what was left out and why."""
    from hoidata.store.store import open_store
    from pipelines.commands.store_facts import fact_rows, group_rows, left_out_rows
    from pipelines.stages.base import empty_reason

    if reason := empty_reason(store):
        typer.echo(f"{store}: empty, {reason}")
        return
    opened, console = open_store(store), Console()
    shown = None if everything else SHOWN_ROWS
    _print_rows(console, ("what", "value"), fact_rows(opened), None)
    for column in ("object", "verb"):
        _print_rows(console, (column, "clips", "frames"), group_rows(opened, column), shown)
    _print_rows(console, ("left out", "where", "expected", "got"), left_out_rows(opened), shown)


def validate(
    output: Annotated[
        Path, typer.Argument(help="A store, a checkpoint, or whatever a stage wrote.", exists=True, resolve_path=True)
    ],
) -> None:
    """Check that files are those that were written (dvc.lock, seals, checksums), and a store against the schema.

    Exit code 1 when something is wrong.
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
    """A table with at most ``shown`` rows; says how many more there are."""
    if not rows:
        return
    table = Table()
    for head in heads:
        table.add_column(head, justify="right" if head in ("clips", "frames") else "left", overflow="fold")
    for row in rows[:shown]:
        table.add_row(*map(escape, row))
    console.print(table)
    if shown is not None and len(rows) > shown:
        console.print(f"and {len(rows) - shown:,} more (--all lists them)")
