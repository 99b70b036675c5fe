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
    from hoidata.store.store import open_store
    from pipelines.commands.project import hands_of_data, store_in
    from pipelines.exports.export import export_store

    store = open_store(store_in(data), hands_of_data(data))
    facts = export_store(store, to, out, tuple(clip or ()), for_own_use)
    for clip_id, reason in facts["left_out"].items():
        typer.echo(f"skipped {clip_id}: {reason}", err=True)
    typer.echo(out)
