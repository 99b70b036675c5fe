"""``hoidata validate``, ``migrate``, ``push`` and ``pull``: stores sound, up to date, and elsewhere."""

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


def push(store: Store, address: Annotated[str, typer.Argument(help="Such as s3://bucket/grab.")]) -> None:
    """Send a store to an object store or another disk; mind the licence: `hoidata info` says what may be shared."""
    from hoidata.store.remote import push_store

    typer.echo(f"{address}: {push_store(store, address):,} bytes sent")


def pull(
    address: Annotated[str, typer.Argument(help="Such as s3://bucket/grab.")],
    store: Annotated[Path, typer.Argument(help="The folder to make.", resolve_path=True)],
) -> None:
    """Fetch a store that was sent, whole or not at all, each file held against its digest."""
    from hoidata.store.remote import pull_store

    typer.echo(f"{store}: {pull_store(address, store):,} bytes fetched")
