"""``hoidata generate``, ``animate`` and ``hands``: motions for a sentence, trajectories, or an object's motion."""

from collections.abc import Mapping
from math import isfinite
from os.path import isfile  # of a name that is too long it says no, where a Path raises
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pipelines.commands.project import current_profile, enter_project, hands_of

if TYPE_CHECKING:
    from pipelines.command_inputs import Written
    from pipelines.generation import Models

Out = Annotated[
    Path, typer.Option(help="Folder for motion.npz, motion.glb and index.html.", resolve_path=True, file_okay=False)
]
Unit = Annotated[str, typer.Option(help="Of a mesh file: m, cm, mm, dm or inch; metres when left out.")]
Up = Annotated[str, typer.Option(help="Axis of a mesh file that points up, like y or -z; found if left out.")]
MeshHinge = Annotated[str, typer.Option(help="Of a two-piece mesh: 'px,py,pz dx,dy,dz', in the file's unit.")]
Profile = Annotated[str, typer.Option(help="embedded, study or own; the one in params.yaml when left out.")]


def generate(
    text: Annotated[str, typer.Argument(help="E.g. 'Lift a box with the right hand.'")],
    object: Annotated[str, typer.Option("--object", help="A mesh file (OBJ, PLY, STL, GLB), or a dataset's object.")],
    out: Out,
    seed: Annotated[int, typer.Option(help="Same seed, same bytes.", min=0, max=2**63 - 1)] = 0,
    samples: Annotated[int, typer.Option(help="How many motions, side by side.", min=1, max=32)] = 1,
    hand: Annotated[Literal["left", "right", "both"] | None, typer.Option(help="Whatever the words say.")] = None,
    length: Annotated[float | None, typer.Option(help="Seconds, instead of the length network's answer.")] = None,
    models: Annotated[
        Path | None,
        typer.Option(
            help="Checkpoints of one dataset, such as checkpoints/embedded/grab: no project is needed.",
            exists=True,
            file_okay=False,
        ),
    ] = None,
    model: Annotated[str, typer.Option(help="Dataset whose models to use; else what knows the words.")] = "",
    sampler: Annotated[
        Literal["ddim", "ddpm", "dpm++"] | None,
        typer.Option(help="How noise becomes motion; else params.yaml's, ddim."),
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Denoiser calls; else params.yaml's, 20.", min=1, max=1000)] = None,
    scale: Annotated[
        float | None, typer.Option(help="Classifier-free guidance; 1 is none; else params.yaml's.")
    ] = None,
    unit: Unit = "",
    up: Up = "",
    hinge: MeshHinge = "",
    hand_by: Annotated[
        Literal["rules", "similarity"],
        typer.Option(
            help="rules: what the words say; if they name hand and side as no rule knows, the similarity of text "
            "features; else what is most common in training, named as such. "
            "similarity: Text2HOI's own way, the most similar of three phrases, whatever the words say."
        ),
    ] = "rules",
    profile: Profile = "",
    encoder: Annotated[
        str, typer.Option(help="Of --models that read CLIP's features: clip:FILE.safetensors or clip:openai.")
    ] = "",
    force: Annotated[
        bool, typer.Option("--force", help="Generate even where words of the sentence are unknown.")
    ] = False,
) -> None:
    """Text -> hands, length, contact, motion, refinement; writes arrays, an animated GLB and a page that plays it."""
    mesh = Path(object).resolve() if isfile(object) else None
    _refuse_what_is_not_asked(
        {"--model": models and model, "--profile": models and profile, "--encoder": not models and encoder}
        | {"--hand-by": hand and hand_by != "rules"}
        | ({} if mesh or Path(object).suffix else {"--unit": unit, "--up": up, "--hinge": hinge})
    )
    root = enter_project() if models is None else None
    from hoidata.clips.clip import FPS
    from hoidata.errors import BadInput
    from models.text2hoi.generation import Wish
    from pipelines.command_inputs import MeshWish
    from pipelines.generation import Asked, generate_files
    from pipelines.params import read_params

    where: dict[str, Any] = {"models": _given_models(models, encoder)} if models else {}
    if root is not None:
        where = {"profile": profile or current_profile(), "datasets": tuple(read_params(root)["datasets"])}
    if length is not None and not isfinite(length * FPS):
        raise BadInput("--length", "seconds", f"{length:g}", "leave it out for a length that the network chooses")
    told = {"kind": sampler, "steps": steps, "guidance": scale}
    wish = Wish(seed, samples, hand, None if length is None else round(length * FPS), hand_by)
    written = generate_files(
        Asked(
            text,
            mesh or object,
            model=model,
            wish=wish,
            mesh=MeshWish(unit, up, hinge),
            sampler={name: value for name, value in told.items() if value is not None},
            force=force,
            **where,
        ),
        out,
    )
    _tell(written)


def _refuse_what_is_not_asked(given: Mapping[str, Any]) -> None:
    """Raise BadInput for an option that would change nothing, in the place it was given."""
    if idle := [name for name, value in given.items() if value]:
        from hoidata.errors import BadInput

        expected = (
            "--model and --profile in a project, --encoder with --models, --hand-by without --hand, --unit, --up and "
            "--hinge with a mesh file that is there"
        )
        raise BadInput(", ".join(idle), expected, "an option that changes nothing here", "leave it out")


def _given_models(folder: Path, encoder: str) -> "Models":
    """Networks of a folder, with the hand and the text encoder their headers name, or the encoder that was told."""
    from hoidata.annotation.encoders import load_encoder
    from models.common.checkpoints import FILE_NAME, read_info
    from pipelines.generation import Models

    facts = read_info(folder / "contact" / FILE_NAME)["facts"]
    encoder = encoder or str(facts["encoder"]["name"])
    return Models(folder, hands_of(facts["hand_digest"], str(folder)), load_encoder(encoder))


def animate(
    what: Annotated[
        str,
        typer.Argument(
            metavar="TRAJECTORIES|CLIP",
            help="A .csv, .npz or ManipNet .txt file (docs/fingers.md), or a clip's id.",
        ),
    ],
    out: Out,
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
    hinge: MeshHinge = "",
    way: Annotated[
        Literal["auto", "network", "interpolate"],
        typer.Option(help="Frames of a clip; auto: interpolate up to 2 s between known poses, else the network."),
    ] = "auto",
    profile: Profile = "",
) -> None:
    """Wrists and object stay as they are given; writes arrays, an animated GLB and a page that plays it."""
    here = Path.cwd()
    project = enter_project()
    from hoidata.clips.clip import SIDES
    from pipelines.animation import AnimateWish, animate_files
    from pipelines.command_inputs import MeshWish
    from pipelines.params import read_params

    paths = [str(here / name) if name and isfile(here / name) else name for name in (what, object)]
    sides = SIDES if fingers == "both" else (fingers,)
    wish = AnimateWish(
        sides, frames, model, rule, paths[1], trajectory_unit, wrist_axes, world_up, MeshWish(unit, "", hinge), way
    )
    datasets = tuple(read_params(project)["datasets"])
    for path in animate_files(paths[0], wish, profile or current_profile(), datasets, out):
        typer.echo(path)


def hands(
    out: Out,
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
    unit: Unit = "",
    up: Up = "",
    hinge: MeshHinge = "",
    hinge_range: Annotated[str, typer.Option(help="How far it opens, like 0:110 degrees; 0 is as drawn.")] = "",
    model: Annotated[str, typer.Option(help="Dataset whose networks to use; else the first that has them.")] = "",
    profile: Profile = "",
) -> None:
    """An object's motion -> contact maps, hands, refinement; writes arrays, animated GLBs and a page."""
    here = Path.cwd()
    project = enter_project()
    from pipelines.command_inputs import MeshWish
    from pipelines.hands import HandsWish, hands_files
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
    _tell(written)


def _tell(written: "Written") -> None:
    for note in written.notes:
        typer.echo(note, err=True)
    for path in written.paths:
        typer.echo(path)
