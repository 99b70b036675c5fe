"""``hoidata hands``: both hands for any motion of an object."""

from os.path import isfile  # of a name that is too long it says no, where a Path raises
from pathlib import Path
from typing import Annotated, Literal

import typer

from pipelines.commands.project import current_profile, enter_project


def hands(
    out: Annotated[Path, typer.Option(help="Folder for motion.npz, motion.glb and index.html.", resolve_path=True)],
    object: Annotated[
        str,
        typer.Argument(metavar="[MESH]", help="A mesh file (OBJ, PLY, STL, GLB), or a dataset's object."),
    ] = "",
    keyframes: Annotated[str, typer.Option(help="A .csv or .json file of times, places, turns and angles.")] = "",
    clip: Annotated[str, typer.Option(help="A stored clip, whose object and motion are taken.")] = "",
    motion: Annotated[
        str, typer.Option(help="A motion.npz of `hoidata generate`, whose object's motion is taken.")
    ] = "",
    samples: Annotated[int, typer.Option(help="How many motions, side by side.", min=1, max=16)] = 1,
    seed: Annotated[int, typer.Option(help="Same seed, same bytes.")] = 0,
    hand: Annotated[Literal["left", "right", "both"], typer.Option(help="Which hands.")] = "both",
    length: Annotated[float | None, typer.Option(help="Seconds it is to last, instead of its own time.")] = None,
    unit: Annotated[str, typer.Option(help="Of a mesh file: m, cm, mm, dm or inch; metres when left out.")] = "",
    up: Annotated[str, typer.Option(help="Axis of a mesh file that points up, like y or -z; found if left out.")] = "",
    hinge: Annotated[str, typer.Option(help="Of a two-piece mesh: 'px,py,pz dx,dy,dz', in the file's unit.")] = "",
    hinge_range: Annotated[str, typer.Option(help="How far it opens, like 0:110 degrees; 0 is as drawn.")] = "",
    model: Annotated[str, typer.Option(help="Dataset whose networks to use; else the first that has them.")] = "",
    profile: Annotated[str, typer.Option(help="embedded, study or own; the one in params.yaml when left out.")] = "",
) -> None:
    """An object's motion -> contact maps, hands, refinement; writes arrays, animated GLBs and a page."""
    here = Path.cwd()
    project = enter_project()
    from pipelines.hands import HandsWish, hands_files
    from pipelines.objects import MeshWish
    from pipelines.params import read_params

    wish = HandsWish(
        str(here / object) if object and isfile(here / object) else object,
        str(here / keyframes) if keyframes else "",
        clip,
        str(here / motion) if motion else "",
        MeshWish(unit, up, hinge),
        hinge_range,
        hand,
        samples,
        seed,
        length,
        model,
    )
    written = hands_files(wish, profile or current_profile(), tuple(read_params(project)["datasets"]), out)
    for note in written.notes:
        typer.echo(note, err=True)
    for path in written.paths:
        typer.echo(path)
