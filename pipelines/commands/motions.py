"""``hoidata generate``, ``animate``, ``stream``, ``hands``: motions for sentences, trajectories, object motions."""

from collections.abc import Mapping
from functools import partial
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from hoidata.errors import BadInput
from pipelines.commands.project import enter_project, hands_of
from pipelines.params import read_params

if TYPE_CHECKING:
    from pipelines.command_inputs import WrittenFiles
    from pipelines.generation import Models

Out = Annotated[
    Path,
    typer.Option(help="Output folder for motion.npz, motion.glb and index.html.", resolve_path=True, file_okay=False),
]
Store = Annotated[
    Path | None, typer.Option(help="Also write a store of clips, a new folder (docs/export.md).", resolve_path=True)
]
Unit = Annotated[str, typer.Option(help="Unit of a mesh file: m, cm, mm, dm or inch. Default: m.")]
Up = Annotated[
    str, typer.Option(help="Axis of a mesh file that points up, such as y or -z. Default: guessed from the mesh.")
]
MeshHinge = Annotated[
    str,
    typer.Option(help="Hinge of a mesh of two pieces, 'px,py,pz dx,dy,dz': point and direction; a slide: direction."),
]
Moving = Annotated[str, typer.Option(help="What moves: joint of a URDF, or pieces of a mesh with --hinge.")]
TrajectoryUnit = Annotated[
    str, typer.Option(help="Unit of positions in .csv and .npz files: m, cm, mm, dm or inch. Default: m.")
]
WristAxes = Annotated[
    Literal["model", "canonical"],
    typer.Option(
        help="Wrist axes in .csv and .npz files: the hand model's, or canonical (x to the fingers, y to the thumb)."
    ),
]
LeftObject = Annotated[str, typer.Option(help="Another rigid object in the left hand (docs/fingers.md).")]
HandLength = Annotated[
    float | None,
    typer.Option(help="Own hand's length in cm, wrist joint to middle fingertip. Default: the mean.", min=12, max=26),
]
Calibration = Annotated[
    str, typer.Option(help="A recording of flat hands that calibrates trackers to the wrists (docs/fingers.md).")
]
Scale = Annotated[float, typer.Option(help="Factor on the size of a mesh file.", min=0.1, max=10)]
Profile = Annotated[str, typer.Option(help="Profile: embedded, study or own. Default: the one in params.yaml.")]
MESH = "A mesh file (OBJ, PLY, STL, GLB), a URDF or its folder, or a dataset's object."
Object = Annotated[str, typer.Option("--object", help=MESH)]
Fingers = Annotated[Literal["left", "right", "both"], typer.Option(help="Hands to animate.")]
MeshUnit = Annotated[
    str, typer.Option(help="Unit of a mesh file: m, cm, mm, dm or inch. Default: m, dm with ManipNet's .txt.")
]
WorldUp = Annotated[
    str, typer.Option(help="World axis that points up, x, y or z, for display and store. Default: from the file.")
]
# Options of `generate`.
Text = Annotated[str, typer.Argument(help="The sentence, such as 'Lift a box with the right hand.'")]
Seed = Annotated[int, typer.Option(help="Random seed; the same seed gives the same bytes.", min=0, max=2**63 - 1)]
PromptedHand = Annotated[
    Literal["left", "right", "both"] | None,
    typer.Option(help="Hands that act. Default: derived from the sentence, see --hand-by."),
]
PredictedLength = Annotated[
    float | None, typer.Option(help="Duration in seconds. Default: the length network's prediction.")
]
ModelFolder = Annotated[
    Path | None,
    typer.Option(
        help="Folder with the checkpoints of one dataset; works outside of a project. Default: the project's.",
        exists=True,
        file_okay=False,
    ),
]
Sampler = Annotated[
    Literal["ddim", "ddpm", "dpm++"] | None,
    typer.Option(help="Diffusion sampler. Default: params.yaml; without it ddim, ddpm for preset paper."),
]
Steps = Annotated[
    int | None,
    typer.Option(
        help="Number of denoising steps. Default: params.yaml; without it 20, 1000 for preset paper.", min=1, max=1000
    ),
]
Refine = Annotated[
    Literal["network", "contact", "none"] | None,
    typer.Option(
        help="What corrects the hands: the refiner network, contact optimisation, or nothing. "
        "Default: params.yaml; without it network."
    ),
]
Attempts = Annotated[
    int | None,
    typer.Option(help="Rejection sampling: the best of at most so many motions. Default: params.yaml, 1.", min=1),
]
HandBy = Annotated[
    Literal["rules", "similarity"] | None,
    typer.Option(
        help="How to choose the hands without --hand. rules: grammar rules; for other phrases the similarity of "
        "text features; for a sentence without a hand the most frequent one in training. similarity: Text2HOI's "
        "method, the most similar of three phrases. Default: rules; similarity for preset paper."
    ),
]
Encoder = Annotated[
    str,
    typer.Option(
        help="Text encoder for --models trained with CLIP: clip:FILE.safetensors or clip:openai. "
        "Default: the checkpoints' encoder."
    ),
]


def generate(
    text: Text,
    object: Object,
    out: Out,
    store: Store = None,
    seed: Seed = 0,
    samples: Annotated[int, typer.Option(help="Number of motions to generate.", min=1, max=32)] = 1,
    hand: PromptedHand = None,
    length: PredictedLength = None,
    models: ModelFolder = None,
    model: Annotated[
        str,
        typer.Option(help="Dataset whose models to use. Default: the one whose vocabulary fits the sentence best."),
    ] = "",
    sampler: Sampler = None,
    steps: Steps = None,
    refine: Refine = None,
    attempts: Attempts = None,
    unit: Unit = "",
    up: Up = "",
    hinge: MeshHinge = "",
    moving: Moving = "",
    scale: Scale = 1.0,
    hand_by: HandBy = None,
    profile: Profile = "",
    encoder: Encoder = "",
    force: Annotated[bool, typer.Option("--force", help="Generate even if the sentence has unknown words.")] = False,
) -> None:
    """Generate hand-object motions for a sentence and an object; write arrays, an animated GLB and a web page."""
    from hoidata.objects.user_mesh import is_object_path

    mesh = Path(object).resolve() if is_object_path(object) else None
    of_mesh = {"--unit": unit, "--up": up, "--hinge": hinge, "--moving": moving, "--scale": scale != 1}
    _refuse_ineffective(
        {"--model": models and model, "--profile": models and profile, "--encoder": not models and encoder}
        | {"--hand-by": hand and hand_by}
        | ({} if mesh or Path(object).suffix else of_mesh)
    )
    project = ("", ()) if models else _project(profile)
    from hoidata.clips.clip import FPS
    from models.text2hoi.generation import MotionOptions
    from pipelines.command_inputs import MeshOptions
    from pipelines.generation import GenerationRequest, generate_files

    if length is not None and not isfinite(length * FPS):
        raise BadInput("--length", "seconds", f"{length:g}", "omit it for a length that the network predicts")
    given = {"kind": sampler, "steps": steps}, {"refine": refine, "attempts": attempts}
    of_sampler, of_sampling = ({name: value for name, value in one.items() if value is not None} for one in given)
    frames = None if length is None else round(length * FPS)
    request = GenerationRequest(
        text,
        mesh or object,
        *project,
        model=model,
        models=_models_in(models, encoder) if models else None,
        options=MotionOptions(seed=seed, samples=samples, hand=hand, frames=frames, hand_by=hand_by),
        mesh=MeshOptions(unit, up, hinge, moving, scale),
        sampler=of_sampler,
        sampling=of_sampling,
        force=force,
    )
    _print_written(generate_files(request, out, store))


def _refuse_ineffective(options: Mapping[str, Any]) -> None:
    """Raise BadInput for options that are set but have no effect in this call."""
    if ineffective := [name for name, value in options.items() if value]:
        expected = (
            "--model and --profile in a project, --encoder with --models, --hand-by without --hand, --unit, --up, "
            "--hinge, --moving and --scale with an existing mesh file"
        )
        raise BadInput(", ".join(ineffective), expected, "an option that has no effect here", "omit it")


def _models_in(folder: Path, encoder: str) -> "Models":
    """The networks in a folder, with the hand model and, unless given, the text encoder that their headers name."""
    from hoidata.annotation.encoders import load_encoder
    from models.common.checkpoints import FILE_NAME, read_info
    from pipelines.generation import Models

    facts = read_info(folder / "contact" / FILE_NAME)["facts"]
    encoder = encoder or str(facts["encoder"]["name"])
    return Models(folder, hands_of(facts["hand_digest"], str(folder)), load_encoder(encoder))


def animate(
    source: Annotated[
        str,
        typer.Argument(
            metavar="TRAJECTORIES|CLIP",
            help="Trajectories in a .csv, .npz or ManipNet .txt file (docs/fingers.md), or the id of a stored clip.",
        ),
    ],
    out: Out,
    store: Store = None,
    object: Object = "",
    fingers: Fingers = "both",
    frames: Annotated[
        str, typer.Option(help="Frames of a clip to replace, FIRST:STOP such as 30:90. Default: all.")
    ] = "",
    model: Annotated[
        str,
        typer.Option(help="Dataset whose network to use. Default: the clip's dataset, else the first with a network."),
    ] = "",
    rule: Annotated[
        Literal["preset", "ours", "paper", "off"],
        typer.Option(help="Post-processing of predicted fingers: preset (the network's), ours, paper, off."),
    ] = "preset",
    trajectory_unit: TrajectoryUnit = "",
    wrist_axes: WristAxes = "model",
    left_object: LeftObject = "",
    calibration: Calibration = "",
    hand_length: HandLength = None,
    world_up: WorldUp = "",
    unit: MeshUnit = "",
    hinge: MeshHinge = "",
    moving: Moving = "",
    scale: Scale = 1.0,
    way: Annotated[
        Literal["auto", "network", "interpolate"],
        typer.Option(
            help="How to fill frames of a clip. auto: interpolate gaps up to 2 s between known poses, else network."
        ),
    ] = "auto",
    fps: Annotated[
        Literal["30", "60", "120"], typer.Option(help="Frames per second of motion.npz; other files have 30.")
    ] = "30",
    profile: Profile = "",
) -> None:
    """Generate finger motion for given wrist and object trajectories; write arrays, an animated GLB and a web page."""
    source, object, left_object, calibration = map(_absolute, (source, object, left_object, calibration))
    project = _project(profile)
    from hoidata.clips.clip import SIDES
    from pipelines.animation import AnimationOptions, animate_files
    from pipelines.command_inputs import MeshOptions

    options = AnimationOptions(
        sides=SIDES if fingers == "both" else (fingers,),
        frames=frames,
        model=model,
        rule=rule,
        object=object,
        left_object=left_object,
        unit=trajectory_unit,
        axes=wrist_axes,
        up=world_up,
        calibration=calibration,
        hand_length_cm=hand_length,
        mesh=MeshOptions(unit, "", hinge, moving, scale),
        fps=int(fps),
        method=way,
    )
    _print_written(animate_files(source, options, *project, out, store))


def stream(
    source: Annotated[
        str,
        typer.Option("--from", help="A file of trajectories, or udp://127.0.0.1:PORT for a tracker (docs/fingers.md)."),
    ],
    object: Object,
    out: Out,
    store: Store = None,
    to: Annotated[str, typer.Option(help="Also send poses to udp://127.0.0.1:PORT.")] = "",
    fast: Annotated[bool, typer.Option("--fast", help="Do not wait for the times of a file.")] = False,
    fingers: Fingers = "both",
    model: Annotated[str, typer.Option(help="Dataset whose network to use. Default: the first with a network.")] = "",
    trajectory_unit: TrajectoryUnit = "",
    wrist_axes: WristAxes = "model",
    left_object: LeftObject = "",
    calibration: Calibration = "",
    hand_length: HandLength = None,
    world_up: WorldUp = "",
    unit: MeshUnit = "",
    hinge: MeshHinge = "",
    moving: Moving = "",
    scale: Scale = 1.0,
) -> None:
    """Stream fingers live for a file, at its recorded speed, or for a tracker.

    Prints a pose per line: time_s, axis-angles (15, 3) of each hand. Then writes what `animate` does.
    """
    object, left_object, calibration = map(_absolute, (object, left_object, calibration))
    source = source if "://" in source else str(Path(source).absolute())
    project = _project("")
    from hoidata.clips.clip import SIDES
    from pipelines.animation import AnimationOptions, stream_files
    from pipelines.command_inputs import MeshOptions

    options = AnimationOptions(
        sides=SIDES if fingers == "both" else (fingers,),
        model=model,
        object=object,
        left_object=left_object,
        unit=trajectory_unit,
        axes=wrist_axes,
        up=world_up,
        calibration=calibration,
        hand_length_cm=hand_length,
        mesh=MeshOptions(unit, "", hinge, moving, scale),
    )

    report = partial(typer.echo, err=True)
    written = stream_files(source, options, *project, out, store, typer.echo, report, to=to, in_real_time=not fast)
    for line in (*written.verdict, *written.notes, *written.paths):
        report(line)


def hands(
    out: Out,
    store: Store = None,
    object: Annotated[str, typer.Argument(metavar="[MESH]", help=MESH)] = "",
    keyframes: Annotated[
        str, typer.Option(help="The object's motion as keyframes: a .csv or .json file (docs/hands.md).")
    ] = "",
    clip: Annotated[str, typer.Option(help="Id of a stored clip whose object and motion to use.")] = "",
    motion: Annotated[str, typer.Option(help="A motion.npz of `hoidata generate` whose object motion to use.")] = "",
    samples: Annotated[int, typer.Option(help="Number of motions to generate.", min=1, max=16)] = 1,
    keep: Annotated[
        int | None, typer.Option(help="Keep this many samples, those that fail the fewest checks. Default: all.", min=1)
    ] = None,
    seed: Seed = 0,
    hand: Annotated[Literal["left", "right", "both"], typer.Option(help="Hands that act.")] = "both",
    length: Annotated[
        float | None, typer.Option(help="Duration in seconds. Default: the duration of the object's motion.")
    ] = None,
    unit: Unit = "",
    up: Up = "",
    hinge: MeshHinge = "",
    moving: Moving = "",
    scale: Scale = 1.0,
    hinge_range: Annotated[
        str,
        typer.Option(
            help="Lowest and highest hinge angle in degrees, or slide in cm, such as 0:110; 0 is the mesh as stored. "
            "Default: the URDF's or the dataset's, else unlimited."
        ),
    ] = "",
    model: Annotated[str, typer.Option(help="Dataset whose networks to use. Default: the first that has them.")] = "",
    profile: Profile = "",
) -> None:
    """Generate hands for an object's motion, with networks of bimart, which `make demo` does not train."""
    object = _absolute(object)
    keyframes, motion = (name and str(Path(name).absolute()) for name in (keyframes, motion))
    project = _project(profile)
    from pipelines.command_inputs import MeshOptions
    from pipelines.hands import HandsOptions, hands_files

    options = HandsOptions(
        object=object,
        keyframes=keyframes,
        clip=clip,
        motion=motion,
        mesh=MeshOptions(unit, up, hinge, moving, scale),
        hinge_range=hinge_range,
        hand=hand,
        samples=samples,
        keep=keep,
        seed=seed,
        length_s=length,
        model=model,
    )
    _print_written(hands_files(options, *project, out, store))


def _absolute(name: str) -> str:
    """The absolute path of a file or folder, since commands change into the project; else the name.

    The name of a dataset's object may also be that of a folder. Such a folder counts if it has a URDF.
    """
    from hoidata.objects.user_mesh import is_object_path

    path = str(Path(name).absolute())
    is_folder = Path(name).name != name and Path(name).is_dir()
    return path if name and (is_folder or is_object_path(path)) else name


def _project(profile: str) -> tuple[str, tuple[str, ...]]:
    """Enter the project. Returns the profile, by default the chosen one, and the datasets."""
    params = read_params(enter_project())
    return profile or params["profile"], tuple(params["datasets"])


def _print_written(written: "WrittenFiles") -> None:
    for line in [*written.notes, *written.verdict]:
        typer.echo(line, err=True)
    for path in written.paths:
        typer.echo(path)
