"""``hoidata controls``: whether the rows that must lose do."""

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from pipelines.promises import Kept

Metrics = Annotated[
    Path, typer.Argument(help="Metrics of one dataset or more, such as metrics/study.", exists=True, file_okay=False)
]
WORDS = {True: "yes", False: "NO", None: "not measured"}


def controls(
    folder: Metrics,
    every: Annotated[bool, typer.Option("--all", help="Also list each that was not measured.")] = False,
) -> None:
    """Check what every control must lose against the truth or a model; exit code 1 where one does not."""
    from rich.console import Console

    from pipelines.promises import datasets_below, kept, read_rows

    console, broken = Console(width=None if sys.stdout.isatty() else 160), 0
    for dataset in datasets_below(folder):
        found = kept(read_rows(dataset))
        console.print(_table(str(dataset), [item for item in found if every or item.holds is not None]))
        counts = {holds: sum(item.holds is holds for item in found) for holds in WORDS}
        typer.echo(f"{counts[True]} hold, {counts[False]} do not, {counts[None]} were not measured")
        for why, count in sorted(Counter(item.why for item in found if item.holds is None).items()):
            typer.echo(f"  not measured: {count}: {why}")
        broken += counts[False]
    raise typer.Exit(bool(broken))


def _table(title: str, found: "list[Kept]") -> "Table":
    from rich import box
    from rich.table import Table

    from pipelines.pages.metrics_table import number

    table = Table("control", "metric", "beside", title=title, box=box.SIMPLE)
    for name in ("figure there", "control"):
        table.add_column(name, justify="right")
    table.add_column("must")
    table.add_column("holds")
    for item in found:
        promise, figures = item.promise, (number(item.reference), number(item.value))
        table.add_row(promise.control, promise.metric, promise.beside, *figures, promise.must, WORDS[item.holds])
    return table
