"""``hoidata corpus``: how much of an annotated dataset its inputs give away, and how much its clips differ."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

NO_VALUE = "-: the figure compares with training clips, or there are no clips of which it can be said"
Folders = Annotated[
    list[Path],
    typer.Argument(
        help="Annotated datasets, such as data/embedded/grab; several are pooled.",
        exists=True,
        file_okay=False,
        resolve_path=True,
    ),
]


def corpus(
    folders: Folders,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Print what a corpus can tell: verbs and contact that object and hand give away, crossings, ends, idle hands."""
    from rich.console import Console
    from rich.table import Table

    from hoidata.metrics.corpus_facts import COLUMNS, corpus_facts

    found = corpus_facts(folders)
    if as_json:
        typer.echo(json.dumps(found, indent=2, allow_nan=False))
        return
    table = Table(title="shares are of 1; parts are those of the chosen split", caption=NO_VALUE)
    table.add_column("figure", overflow="fold")
    for column in COLUMNS:
        table.add_column(column, justify="right")
    for figure in found["figures"].values():
        table.add_row(figure["words"], *(_text(figure[column]) for column in COLUMNS))
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def _text(value: float | None) -> str:
    """Counts as they are, all else with two decimals; "-" as ``NO_VALUE`` says."""
    if value is None:
        return "-"
    return f"{value:,}" if isinstance(value, int) else f"{value:.2f}"
