"""``hoidata compare``: statistics of the motion of one corpus next to those of another."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from pipelines.commands.project import hands_of_data

if TYPE_CHECKING:
    import numpy as np


def compare(
    corpus: Annotated[
        Path, typer.Argument(help="An annotated dataset, such as data/embedded/grab.", exists=True, resolve_path=True)
    ],
    reference: Annotated[
        Path, typer.Argument(help="The annotated dataset to compare with.", exists=True, resolve_path=True)
    ],
    clips: Annotated[int, typer.Option(min=1, help="Clips of each corpus, evenly chosen, at most.")] = 400,
    out: Annotated[Path | None, typer.Option(help="Also write all values as JSON.", resolve_path=True)] = None,
) -> None:
    """Compare the recorded motion of two corpora: fingers, slip, jitter, contact, grasps, speeds, hinges."""
    from rich import box
    from rich.table import Table

    from hoidata.files import write_whole
    from hoidata.metrics.corpus_statistics import STATISTICS, compare_corpora, corpus_statistics
    from hoidata.store.annotated import load_annotated

    values, others = (
        corpus_statistics(load_annotated(folder, hands_of_data(folder)), clips) for folder in (corpus, reference)
    )
    rows = compare_corpora(values, others)
    table = Table(title=f"{corpus} compared with {reference}", box=box.SIMPLE)
    for name in ("statistic", "unit", "mean", "10-90 %", "reference", "10-90 %", "ratio", "KS distance"):
        table.add_column(name, justify="left" if name in ("statistic", "unit") else "right")
    for row in rows:
        shown = (_mean(row.values), _spread(row.values), _mean(row.reference), _spread(row.reference))
        table.add_row(row.name, row.unit, *shown, f"{row.ratio:.2f}", f"{row.distance:.2f}")
    Console(width=None if sys.stdout.isatty() else 140).print(table)
    typer.echo(f"{len(values['frames with contact'])} and {len(others['frames with contact'])} clips with contact")
    if out is not None:
        written = {
            name: {
                "meaning": meaning,
                "unit": unit,
                "values": values[name].tolist(),
                "reference": others[name].tolist(),
            }
            for name, (unit, meaning) in STATISTICS.items()
        }
        write_whole(out, json.dumps(written, indent=1, sort_keys=True, allow_nan=False) + "\n")


def _mean(values: "np.ndarray") -> str:
    return f"{values.mean():.3g}" if len(values) else "not measured"


def _spread(values: "np.ndarray") -> str:
    import numpy as np

    return "{:.3g}-{:.3g}".format(*np.percentile(values, [10, 90])) if len(values) else ""
