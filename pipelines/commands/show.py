"""``hoidata show``: one clip, or one dataset, as a page to look at."""

from pathlib import Path
from typing import Annotated

import typer

from pipelines.commands.project import current_profile, enter_project


def show(
    what: Annotated[str, typer.Argument(metavar="CLIP", help="A clip's id, or a dataset's name.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the page; .hoidata/pages when left out.", resolve_path=True)
    ] = None,
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
    profile: Annotated[str, typer.Option(help="embedded, study or own; the one in params.yaml when left out.")] = "",
) -> None:
    """Write a self-contained page of a clip (motion, contact, curves, words, evidence, origin) or of a dataset."""
    project = enter_project()
    from pipelines.showing import write_shown

    path = write_shown(what, profile or current_profile(), out or project / ".hoidata" / "pages")
    typer.echo(path)
    if open_page:
        typer.launch(path.resolve().as_uri())
