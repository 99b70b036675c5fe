"""``hoidata import-checkpoint``: Text2HOI's published files become checkpoints like ours."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from pipelines.commands.project import current_profile, enter_project


def import_checkpoint(
    files: Annotated[list[Path], typer.Argument(help="Of PointNet, contact network and generator.", resolve_path=True)],
    out: Annotated[Path, typer.Option(help="Folder for contact/ and diffusion/.", resolve_path=True)],
    dataset: Annotated[Literal["h2o", "grab", "arctic"], typer.Option(help="They were trained on.")],
    profile: Annotated[str, typer.Option(help="Whose MANO files to use; the one in params.yaml if left out.")] = "",
) -> None:
    """Read published files, execute nothing in them, and write them as safetensors; the clips they saw are unknown."""
    enter_project()
    from models.text2hoi.released import import_released
    from pipelines.stages.base import load_hands

    for path in import_released(files, out, dataset, load_hands(profile or current_profile())):
        typer.echo(path)
