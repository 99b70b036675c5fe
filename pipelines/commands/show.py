"""``hoidata show``: a web page about one clip or one dataset."""

from pathlib import Path
from typing import Annotated

import typer

from hoidata.errors import BadInput
from pipelines.commands.project import current_profile, enter_project, hands_of_data

Data = Annotated[
    Path | None,
    typer.Option(
        help="An annotated dataset such as data/embedded/grab, or a store. Default: the project's.",
        exists=True,
        file_okay=False,
        resolve_path=True,
    ),
]


def show(
    clip_or_dataset: Annotated[str, typer.Argument(metavar="[CLIP]", help="Id of a clip, or a dataset.")] = "",
    out: Annotated[Path | None, typer.Option(help="Output folder. Default: .hoidata/pages.", resolve_path=True)] = None,
    profile: Annotated[
        str, typer.Option(help="Profile: embedded, study or own. Default: the one in params.yaml.")
    ] = "",
    data: Data = None,
    figures: Annotated[bool, typer.Option("--figures", help="The illustrations of Text2HOI instead.")] = False,
) -> None:
    """Write a self-contained web page about a clip or a dataset."""
    if data is not None and not figures:
        from pipelines.show_pages import write_page_from

        out = out or Path.cwd()  # before the project is entered
        pages = [write_page_from(data, clip_or_dataset, hands_of_data(data), out)]
    elif clip_or_dataset and data is None:
        project = enter_project()
        from pipelines.show_pages import write_named_page

        folder, profile = out or project / ".hoidata" / "pages", profile or current_profile()
        if figures:
            from pipelines.pages.figures import write_figures

            pages = write_figures(clip_or_dataset, profile, folder)
        else:
            pages = [write_named_page(clip_or_dataset, profile, folder)]
    else:
        expected = "a clip's id, a dataset's name, or (without --figures) --data FOLDER"
        raise BadInput("hoidata show", expected, clip_or_dataset or "none", "name one")
    typer.echo("\n".join(map(str, pages)))
