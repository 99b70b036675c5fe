"""``hoidata validate`` and ``hoidata migrate``: whether files are whole and sound, and bringing a store up to date."""

from pathlib import Path
from typing import Annotated

import typer

Store = Annotated[Path, typer.Argument(help="A store of clips.", exists=True, file_okay=False, resolve_path=True)]
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


def migrate(store: Store) -> None:
    """Rewrite a store of an earlier schema version in today's, whole or not at all; ids and arrays stay."""
    from hoidata.store.migrate import is_current, migrate_store
    from hoidata.store.store import SCHEMA_VERSION

    found = migrate_store(store)
    done = "nothing to do" if is_current(found) else f"rewritten as {SCHEMA_VERSION}"
    typer.echo(f"{store}: schema {found}, {done}")
