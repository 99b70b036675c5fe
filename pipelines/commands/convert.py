"""``hoidata convert``: a raw folder to a store of clips, without a project."""

from pathlib import Path
from typing import Annotated

import typer

from hoidata.errors import BadInput, MissingResource
from pipelines.commands.adapters import Name, Root, Setting, read_settings
from pipelines.commands.hands import chosen_hands

Out = Annotated[Path, typer.Option(help="The store to write; it must not be there yet.", resolve_path=True)]
Hand = Annotated[str, typer.Option(help="embedded, or the folder of the MANO files; by default HOIDATA_MANO.")]
Jobs = Annotated[int, typer.Option(help="Worker processes; 0: one per core.", min=0)]
Synthetic = Annotated[bool, typer.Option("--synthetic", help="The files were generated, and the store is to say so.")]


def convert(
    name: Name,
    root: Root,
    out: Out,
    hand: Hand = "",
    setting: Setting = None,
    jobs: Jobs = 0,
    synthetic: Synthetic = False,
) -> None:
    """Convert every sequence of a raw folder; what cannot be used is listed with its reason, in the store too.

    A killed run goes on where it was. Corpora made by `hoidata synth` are known as such.
    """
    from hoidata.conversion.convert import convert_dataset
    from hoidata.datasets.registry import get_adapter
    from pipelines.stages.base import HAND, own_root
    from pipelines.stages.base import jobs as cores

    if out.exists():
        raise BadInput(out, "a store that is not there yet", "something else", "choose another name, or remove it")
    adapter = get_adapter(name, **read_settings(setting or []))
    generated = synthetic or root.with_suffix(".recipe").is_file()
    if adapter.needs_mano and not hand and not generated and own_root(HAND) is None:
        without_mano = getattr(adapter, "without_mano", "")
        raise MissingResource(
            f"{name} holds MANO parameters; say where MANO_RIGHT.pkl and MANO_LEFT.pkl are: --hand FOLDER "
            "(register at https://mano.is.tue.mpg.de)" + (f", or give --setting {without_mano}" if without_mano else "")
        )
    hands = chosen_hands(hand or ("embedded" if generated else ""))
    found = convert_dataset(adapter, root, hands, out, jobs or cores(), synthetic=generated)
    typer.echo(out)
    raise typer.Exit(0 if found.clips else 1)
