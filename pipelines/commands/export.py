"""``hoidata export``: write a store in the formats of other projects."""

from pathlib import Path
from typing import Annotated

import typer

Data = Annotated[
    Path,
    typer.Argument(
        metavar="STORE",
        help="A store of clips, or an annotated dataset such as data/embedded/grab, with sentences and splits.",
        exists=True,
        file_okay=False,
        resolve_path=True,
    ),
]
To = Annotated[
    str,
    typer.Option(help="Format: croissant, lerobot, huggingface, webdataset, glb, usd, bvh or spider (docs/export.md)."),
]
Out = Annotated[Path, typer.Option(help="Output folder; must not exist.", resolve_path=True)]
ClipIds = Annotated[
    list[str] | None, typer.Option("--clip", help="Id of a clip to export; can be repeated. Default: all.")
]
OwnUse = Annotated[
    bool,
    typer.Option(
        "--for-own-use", help="Also export data that must not be shared; the output is marked as not to be shared."
    ),
]


def export(data: Data, to: To, out: Out, clip: ClipIds = None, for_own_use: OwnUse = False) -> None:
    """Write the clips of a store in the format of another project, with the licence of each array.

    Refuses data that its licence forbids to share, unless --for-own-use is given.
    """
    from contextlib import suppress

    from hoidata.errors import MissingResource
    from hoidata.store.store import open_store, read_info
    from pipelines.commands.project import enter_project, hands_of
    from pipelines.exports.export import export_store

    folder = data if (data / "meta").is_dir() else data / "clips"
    info = read_info(folder)
    with suppress(MissingResource):
        enter_project()  # the project's hoidata.toml names the user's MANO files
    hands = hands_of(info["hand_model"]["digest"], str(data))
    facts = export_store(open_store(folder, hands), to, out, tuple(clip or ()), for_own_use)
    for clip_id, reason in facts["left_out"].items():
        typer.echo(f"skipped {clip_id}: {reason}", err=True)
    typer.echo(out)
