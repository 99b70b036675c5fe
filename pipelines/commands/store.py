"""``hoidata validate`` and ``hoidata migrate``: whether a store is sound, and bringing an older one up to date."""

from pathlib import Path
from typing import Annotated

import typer

Store = Annotated[Path, typer.Argument(help="A store of clips.", exists=True, file_okay=False, resolve_path=True)]


def validate(store: Store) -> None:
    """Check every file, table and array of a store against the schema; exit code 1 when something is wrong."""
    from hoidata.store.store import open_store
    from hoidata.store_check.check import check_store
    from pipelines.stages.base import empty_reason

    if reason := empty_reason(store):
        typer.echo(f"{store}: empty, {reason}")
        return
    problems = check_store(store)
    for problem in problems:
        typer.echo(str(problem))
    if problems:
        typer.echo(f"{store}: {len(problems)} problem{'s' if len(problems) > 1 else ''}")
        raise typer.Exit(1)
    opened = open_store(store)
    typer.echo(f"{store}: sound, {len(opened)} clips, schema {opened.info['schema_version']}")


def migrate(store: Store) -> None:
    """Rewrite a store of an earlier schema version in today's, whole or not at all; ids and arrays stay."""
    from hoidata.store.migrate import is_current, migrate_store
    from hoidata.store.store import SCHEMA_VERSION

    found = migrate_store(store)
    done = "nothing to do" if is_current(found) else f"rewritten as {SCHEMA_VERSION}"
    typer.echo(f"{store}: schema {found}, {done}")
