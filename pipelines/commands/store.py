"""``hoidata validate``: whether a store, a checkpoint or another output is sound."""

from pathlib import Path
from typing import Annotated

import typer

Output = Annotated[
    Path, typer.Argument(help="A store, a checkpoint, or whatever a stage wrote.", exists=True, resolve_path=True)
]


def validate(output: Output) -> None:
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
