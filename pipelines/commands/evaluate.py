"""``hoidata evaluate``, ``compare``, ``table`` and ``controls``: metrics of stores, corpora and negative controls."""

import json
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.commands.project import hands_of_data, table_console

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from pipelines.expected_orderings import OrderingResult

_FOLDER: Any = {"exists": True, "file_okay": False, "resolve_path": True}
Store = Annotated[Path, typer.Option(help="A store of predicted clips with ids <reference id>~<k>.", **_FOLDER)]
Reference = Annotated[
    Path, typer.Option(help="The annotated dataset with the recorded clips, such as data/embedded/grab.", **_FOLDER)
]

Metrics = Annotated[
    Path,
    typer.Argument(help="Folder with the metrics of datasets, such as metrics/study.", exists=True, file_okay=False),
]
WORDS = {True: "yes", False: "NO", None: "not measured"}


def evaluate(
    store: Store,
    reference: Reference,
    out: Annotated[
        Path | None, typer.Option(help="Also write the metrics to this JSON file.", resolve_path=True)
    ] = None,
    split: Annotated[str, typer.Option(help="Subset of the chosen split: train, validation or test.")] = "test",
    metrics: Annotated[str, typer.Option(help="Additional lists of metrics, separated by commas: bimart.")] = "",
) -> None:
    """Compare the predicted clips of a store with the recorded clips they stand for, and print a table of metrics."""
    from hoidata.files import write_whole
    from hoidata.metrics.evaluate import evaluate_store
    from hoidata.metrics.optional_metrics import select_metrics
    from pipelines.pages.metrics_table import printed_table, unmeasured_lines
    from pipelines.stages.base import StagePaths, jobs
    from pipelines.stages.evaluate import trained_encoders

    # Of a dataset data/<profile>/<dataset>; the folder may not exist.
    encoders = trained_encoders(reference.parents[2] / StagePaths(reference.parent.name, reference.name).evaluators)
    hands, chosen_metrics = hands_of_data(reference), select_metrics(filter(None, map(str.strip, metrics.split(","))))
    results = evaluate_store(
        store, reference, hands, split=split, metrics=chosen_metrics, encoders=encoders, jobs=jobs(), progress=True
    )
    table_console().print(printed_table(results))
    for line in unmeasured_lines(results):
        typer.echo(line)
    skipped: dict[str, list[str]] = {}
    for item in results["left_out"]:
        skipped.setdefault(item["reason"], []).append(item["clip_id"])
    for reason, clips in skipped.items():
        others = f" and {len(clips) - 1:,} more" if len(clips) > 1 else ""
        typer.echo(f"skipped: {clips[0]}{others}: {reason}")
    if out is not None:
        write_whole(out, json.dumps(results, indent=2, sort_keys=True, allow_nan=False) + "\n")


def compare(
    corpus: Annotated[
        Path, typer.Argument(help="An annotated dataset, such as data/embedded/grab.", exists=True, resolve_path=True)
    ],
    reference: Annotated[
        Path, typer.Argument(help="The annotated dataset to compare with.", exists=True, resolve_path=True)
    ],
    out: Annotated[Path | None, typer.Option(help="Also write all values as JSON.", resolve_path=True)] = None,
) -> None:
    """Compare the recorded motion of two corpora: fingers, slip, jitter, contact, grasps, speeds, hinges."""
    from rich import box
    from rich.table import Table

    from hoidata.files import write_whole
    from hoidata.metrics.corpus_statistics import STATISTICS, compare_corpora, corpus_statistics
    from hoidata.store.annotated import load_annotated

    values, others = (
        corpus_statistics(load_annotated(folder, hands_of_data(folder))) for folder in (corpus, reference)
    )
    rows = compare_corpora(values, others)
    table = Table(title=f"{corpus} compared with {reference}", box=box.SIMPLE)
    for name in ("statistic", "unit", "mean", "10-90 %", "reference", "10-90 %", "ratio", "KS distance"):
        table.add_column(name, justify="left" if name in ("statistic", "unit") else "right")
    for row in rows:
        shown = (*_mean_and_spread(row.values), *_mean_and_spread(row.reference))
        table.add_row(row.name, row.unit, *shown, f"{row.ratio:.2f}", f"{row.distance:.2f}")
    table_console().print(table)
    typer.echo(f"{len(values['frames with contact'])} and {len(others['frames with contact'])} clips with contact")
    if out is not None:
        both = {name: {"values": values[name].tolist(), "reference": others[name].tolist()} for name in STATISTICS}
        written = {
            name: {"meaning": meaning, "unit": unit, **both[name]} for name, (unit, meaning) in STATISTICS.items()
        }
        write_whole(out, json.dumps(written, indent=1, sort_keys=True, allow_nan=False) + "\n")


def table(
    folder: Annotated[
        Path, typer.Argument(help="Folder with the metrics of one dataset, such as metrics/study/grab.", exists=True)
    ],
    metrics: Annotated[str, typer.Option(help="Names of metrics (hoidata/metrics/README.md), separated by commas.")],
) -> None:
    """Print metrics of all methods as a Markdown table; mark stale ones and those worse than retrieval."""
    from pipelines.lineage.locks import outdated_samples
    from pipelines.pages.metrics_table import markdown_table

    families = sorted(path.stem for path in folder.glob("*.json"))
    of_project = (path := folder.resolve()).parent.parent.name == "metrics"
    stale = outdated_samples(path.parents[2], path.parent.name, path.name) if of_project else {}
    typer.echo(markdown_table(folder, families, [name.strip() for name in metrics.split(",")], stale), nl=False)


def controls(folder: Metrics) -> None:
    """Check that each negative control has worse metrics than the recorded clips or a model.

    The exit code is 1 if one has not.
    """
    from pipelines.expected_orderings import check_orderings, datasets_below, read_methods

    console, broken = table_console(160), 0
    for dataset in datasets_below(folder):
        results = check_orderings(read_methods(dataset))
        console.print(_table(str(dataset), [item for item in results if item.holds is not None]))
        counts = {holds: sum(item.holds is holds for item in results) for holds in WORDS}
        typer.echo(f"{counts[True]} hold, {counts[False]} do not, {counts[None]} were not measured")
        for reason, count in sorted(Counter(item.reason for item in results if item.holds is None).items()):
            typer.echo(f"  not measured: {count}: {reason}")
        broken += counts[False]
    raise typer.Exit(bool(broken))


def _table(title: str, results: "list[OrderingResult]") -> "Table":
    from rich import box
    from rich.table import Column, Table

    from pipelines.pages.metrics_table import number

    values = (Column(name, justify="right") for name in ("its value", "control"))
    table = Table("control", "metric", "compared with", *values, "must", "holds", title=title, box=box.SIMPLE)
    for item in results:
        ordering, values = item.ordering, (number(item.reference), number(item.value))
        table.add_row(ordering.control, ordering.metric, ordering.reference, *values, ordering.must, WORDS[item.holds])
    return table


def _mean_and_spread(values: "np.ndarray") -> tuple[str, str]:
    import numpy as np

    if not len(values):
        return "not measured", ""
    return f"{values.mean():.3g}", "{:.3g}-{:.3g}".format(*np.percentile(values, [10, 90]))
