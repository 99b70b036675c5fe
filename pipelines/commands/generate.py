"""``hoidata generate``: a sentence and a mesh become a motion."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from pipelines.commands.project import current_profile, enter_project


def generate(
    text: Annotated[str, typer.Argument(help="E.g. 'Lift a box with the right hand.'")],
    object: Annotated[str, typer.Option("--object", help="A mesh file in metres, or an object's name in the dataset.")],
    out: Annotated[Path, typer.Option(help="Folder for motion.npz, motion.glb and index.html.", resolve_path=True)],
    seed: Annotated[int, typer.Option(help="Same seed, same bytes.")] = 0,
    dataset: Annotated[str, typer.Option(help="Whose trained models to use.")] = "grab",
    hand_by: Annotated[
        Literal["rules", "similarity"],
        typer.Option(
            help="rules: what the words say, else what is most common in training, named as such. "
            "similarity: Text2HOI's own way, the most similar of three phrases, whatever the words say."
        ),
    ] = "rules",
    profile: Annotated[str, typer.Option(help="embedded, study or own; the one in params.yaml when left out.")] = "",
) -> None:
    """Text -> hands, length, contact, motion, refinement; writes arrays, an animated GLB and a page that plays it."""
    mesh = Path(object).resolve() if Path(object).is_file() else None
    enter_project()
    from pipelines.generation import generate_files
    from pipelines.stages.base import Place

    place = Place(profile or current_profile(), dataset)
    for path in generate_files(text, mesh or object, seed, out, place, hand_by):
        typer.echo(path)
