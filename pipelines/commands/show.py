"""``hoidata show``: one clip, or one dataset, as a page to look at."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from hoidata.errors import BadInput, MissingResource
from pipelines.commands.project import current_profile, enter_project, hands_of

Data = Annotated[
    Path | None,
    typer.Option(
        help="An annotated dataset, such as data/embedded/grab, or a store, in place of those of a project.",
        exists=True,
        file_okay=False,
        resolve_path=True,
    ),
]


def show(
    what: Annotated[str, typer.Argument(metavar="[CLIP]", help="A clip's id, or a dataset's name.")] = "",
    out: Annotated[
        Path | None, typer.Option(help="Folder for the page; .hoidata/pages when left out.", resolve_path=True)
    ] = None,
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
    profile: Annotated[str, typer.Option(help="embedded, study or own; the one in params.yaml when left out.")] = "",
    data: Data = None,
) -> None:
    """Write a self-contained page of a clip (motion, contact, curves, words, evidence, origin) or of a dataset."""
    if data is not None:
        path = _of_folder(data, what, out or Path.cwd())
    elif what:
        project = enter_project()
        from pipelines.showing import write_shown

        path = write_shown(what, profile or current_profile(), out or project / ".hoidata" / "pages")
    else:
        raise BadInput("hoidata show", "a clip's id, a dataset's name, or --data FOLDER", "none", "name one")
    typer.echo(path)
    if open_page:
        typer.launch(path.resolve().as_uri())


def _of_folder(data: Path, clip_id: str, out: Path) -> Path:
    """No project is needed; where there is one, it knows the user's MANO files."""
    from hoidata.store.store import read_info
    from pipelines.showing import write_shown_of

    with suppress(MissingResource):
        enter_project()
    store = data if (data / "meta").is_dir() else data / "clips"
    return write_shown_of(data, clip_id, hands_of(read_info(store)["hand_model"]["digest"], str(data)), out)
