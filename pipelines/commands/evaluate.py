"""``hoidata evaluate``: how near the motions of any store come to the recorded ones."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from hoidata.hands import HandPair

Store = Annotated[
    Path,
    typer.Argument(
        help="A store of predicted clips, <reference id>~<k>.", exists=True, file_okay=False, resolve_path=True
    ),
]
Reference = Annotated[
    Path,
    typer.Option(
        help="An annotated dataset, such as data/embedded/grab.", exists=True, file_okay=False, resolve_path=True
    ),
]


def evaluate(
    store: Store,
    reference: Reference,
    out: Annotated[Path | None, typer.Option(help="Also write the figures as JSON.", resolve_path=True)] = None,
    split: Annotated[str, typer.Option(help="Part of the chosen split: train, validation or test.")] = "test",
) -> None:
    """Measure every clip of a store against the clip it was made for, and print the table of metrics."""
    from rich.console import Console

    from hoidata.files import atomic_file
    from hoidata.metrics.evaluate import evaluate_store
    from pipelines.pages.metrics_table import printed_table
    from pipelines.stages.base import jobs

    found = evaluate_store(store, reference, _hands(reference), split=split, jobs=jobs(), progress=True)
    Console(width=None if sys.stdout.isatty() else 120).print(printed_table(found))
    for item in found["left_out"]:
        typer.echo(f"left out: {item['clip_id']}: {item['reason']}")
    if out is not None:
        with atomic_file(out) as part:
            part.write_text(json.dumps(found, indent=2, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")


def _hands(reference: Path) -> "HandPair":
    """The hand model the dataset was converted with: the embedded one, or the user's MANO files."""
    from hoidata.hands import load_embedded_hands
    from hoidata.store.store import read_info
    from pipelines.commands.project import enter_project
    from pipelines.stages.base import load_hands

    embedded = load_embedded_hands()
    if read_info(reference / "clips")["hand_model"]["digest"] == embedded.digest:
        return embedded
    enter_project()
    return load_hands("own")
