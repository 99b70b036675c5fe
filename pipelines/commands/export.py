"""``hoidata export``: a store in the forms other projects read."""

from pathlib import Path
from typing import Annotated

import typer

Data = Annotated[
    Path,
    typer.Argument(
        metavar="STORE",
        help="A store of clips, or an annotated dataset such as data/embedded/grab: sentences and splits go along.",
        exists=True,
        file_okay=False,
        resolve_path=True,
    ),
]
To = Annotated[
    str, typer.Option(help="croissant, lerobot, huggingface, webdataset, glb, usd, bvh or spider: docs/export.md.")
]
Out = Annotated[Path, typer.Option(help="The folder to write; it must not be there yet.", resolve_path=True)]
ClipIds = Annotated[list[str] | None, typer.Option("--clip", help="A clip's id, as often as wanted; all without it.")]
OwnUse = Annotated[
    bool, typer.Option("--for-own-use", help="Export what may not be passed on too; what is written says so.")
]


def export(data: Data, to: To, out: Out, clip: ClipIds = None, for_own_use: OwnUse = False) -> None:
    """Write the clips of a store as another project reads them, with licence per array.

    Refused where a licence forbids passing on what the format holds.
    """
    from contextlib import suppress

    from hoidata.errors import MissingResource
    from hoidata.store.store import open_store, read_info
    from pipelines.commands.project import enter_project, hands_of
    from pipelines.exports.export import export_store

    folder = data if (data / "meta").is_dir() else data / "clips"
    info = read_info(folder)
    with suppress(MissingResource):
        enter_project()  # where there is a project, it knows the user's MANO files
    hands = hands_of(info["hand_model"]["digest"], str(data))
    facts = export_store(open_store(folder, hands), to, out, tuple(clip or ()), for_own_use)
    for clip_id, reason in facts["left_out"].items():
        typer.echo(f"left out {clip_id}: {reason}", err=True)
    typer.echo(out)
