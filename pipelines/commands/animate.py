"""``hoidata animate``: fingers for trajectories of wrists and an object, or anew for frames of a clip."""

from os.path import isfile  # of a name that is too long it says no, where a Path raises
from pathlib import Path
from typing import Annotated, Literal

import typer

from pipelines.commands.project import current_profile, enter_project


def animate(
    what: Annotated[
        str,
        typer.Argument(
            metavar="TRAJECTORIES|CLIP",
            help="A .csv, .npz or ManipNet .txt file (docs/fingers.md), or a clip's id.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for motion.npz, motion.glb and index.html.", resolve_path=True)],
    object: Annotated[str, typer.Option("--object", help="A mesh file (OBJ, PLY, STL, GLB) of the trajectories.")] = "",
    fingers: Annotated[Literal["left", "right", "both"], typer.Option(help="Which hands.")] = "both",
    frames: Annotated[str, typer.Option(help="Of a clip, like 30:90; all when left out.")] = "",
    model: Annotated[str, typer.Option(help="Dataset whose network to use; the clip's own, or the first.")] = "",
    rule: Annotated[Literal["ours", "paper", "off"], typer.Option(help="Of post-processing.")] = "ours",
    trajectory_unit: Annotated[
        str, typer.Option(help="Of positions in .csv and .npz: m, cm, mm, dm, inch; metres when left out.")
    ] = "",
    wrist_axes: Annotated[
        Literal["model", "canonical"],
        typer.Option(help="Of wrists in .csv and .npz: the hand model's, or x to the fingers, y to the thumb."),
    ] = "model",
    world_up: Annotated[str, typer.Option(help="Axis of the world that points up: x, y or z; only shown.")] = "",
    unit: Annotated[
        str,
        typer.Option(help="Of a mesh file: m, cm, mm, dm or inch; when left out metres, dm beside a ManipNet .txt."),
    ] = "",
    hinge: Annotated[str, typer.Option(help="Of a two-piece mesh: 'px,py,pz dx,dy,dz', in the file's unit.")] = "",
    way: Annotated[
        Literal["auto", "network", "interpolate"],
        typer.Option(help="Frames of a clip; auto: interpolate up to 2 s between known poses, else the network."),
    ] = "auto",
    profile: Annotated[str, typer.Option(help="embedded, study or own; the one in params.yaml when left out.")] = "",
) -> None:
    """Wrists and object stay as they are given; writes arrays, an animated GLB and a page that plays it."""
    here = Path.cwd()
    project = enter_project()
    from hoidata.clips.clip import SIDES
    from pipelines.animation import AnimateWish, animate_files
    from pipelines.objects import MeshWish
    from pipelines.params import read_params

    paths = [str(here / name) if name and isfile(here / name) else name for name in (what, object)]
    sides = SIDES if fingers == "both" else (fingers,)
    wish = AnimateWish(
        sides, frames, model, rule, paths[1], trajectory_unit, wrist_axes, world_up, MeshWish(unit, "", hinge), way
    )
    datasets = tuple(read_params(project)["datasets"])
    for path in animate_files(paths[0], wish, profile or current_profile(), datasets, out):
        typer.echo(path)
