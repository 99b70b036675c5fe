"""Inputs and results that `hoidata generate`, `animate` and `hands` share: mesh options, objects, trained networks."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

from hoidata.clips.clip import Clip, WorldFrame
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.objects.user_mesh import is_object_path, unknown_object_words
from hoidata.store.info import generated_info
from hoidata.store.store import open_store, write_store
from models.common.checkpoints import FILE_NAME, read_info
from pipelines.stages.base import StagePaths


class ProjectData(NamedTuple):
    """The profile, datasets and hand model that a command works with."""

    profile: str
    datasets: tuple[str, ...]  # of params.yaml
    hands: HandPair


@dataclass(frozen=True)
class MeshOptions:
    """How to read the user's mesh file, as in ``read_user_object``; "" uses the default or a guess."""

    unit: str = ""
    up: str = ""
    hinge: str = ""
    moving: str = ""
    scale: float = 1.0  # factor on the mesh

    def check_for(self, name: str) -> None:
        """Raise BadInput for options that are set although ``name`` is not the path of a file."""
        chosen = [option.name for option in fields(self) if getattr(self, option.name) != option.default]
        if chosen and not (is_object_path(name) or Path(name).suffix):
            options = ", ".join(f"--{option}" for option in chosen)
            expected = "a mesh file, without which they have no effect"
            raise BadInput(options, expected, name or "none", "omit what has no effect, or give a mesh file")


@dataclass(frozen=True)
class WrittenFiles:
    """The result of a command that writes motions."""

    paths: list[Path]
    notes: list[str]  # assumptions, choices and unknown words, to print for the user
    verdict: list[str]  # lines on each motion, likewise


def stored_object(name: str, clips: Path, hands: HandPair) -> ObjectModel:
    """An object of a store of clips. Raises BadInput that lists the store's objects."""
    store = open_store(clips, hands)
    names = list(store.objects["object"])
    if name not in names:
        expected = f"a mesh file (.obj, .ply, .stl, .glb) or one of: {', '.join(names)}"
        remedy = nearest_name(name, names) or "correct the name or path"
        raise BadInput("--object", expected, unknown_object_words(name), remedy)
    return store.object_model(name)


def object_name(name: str, names: Sequence[str]) -> str:
    """The only one of ``names`` that ``name`` is, or ends, apart from blanks and case: "bottle" is "waterbottle".

    ``name`` itself if there is none, or several.
    """
    if name in names:
        return name
    plain = {one: "".join(filter(str.isalnum, one.lower())) for one in (*names, name)}
    equal = [one for one in names if plain[one] == plain[name]]
    fitting = equal or [one for one in names if plain[name] and plain[one].endswith(plain[name])]
    return fitting[0] if len(fitting) == 1 else name


def check_new_store(folder: Path | None) -> None:
    """Raise BadInput if ``--store`` names something that exists: no recorded store is ever replaced."""
    if folder is not None and folder.exists():
        raise BadInput(folder, "a path that does not exist for --store", "an existing file or folder", "choose another")


def write_motion_store(
    folder: Path | None, clips: Sequence[Clip], hands: HandPair, networks: Mapping[str, Any], **source: Any
) -> list[Path]:
    """Write the motions of a command as a clip store; return its path, or nothing for the folder None.

    The licence is that of ``source``, else that of the networks: only networks of generated clips may be shared.

    Args:
        networks: the facts in the header of a checkpoint, if any.
        source: facts of the store of the clip that the motions replace; see ``hoidata.store.info.store_info``.
    """
    if folder is None:
        return []
    check_new_store(folder)
    gravity = clips[0].gravity
    note = "z up, metres" if gravity is not None and gravity[2] < -1 + 1e-6 else "the world of the input"
    frame = WorldFrame("+z" if note.startswith("z") else None, "unknown" if gravity is None else "stated", note)
    facts = {"frame": {"handedness": "right", **asdict(frame)}, "synthetic": clips[0].synthetic}
    if networks and not networks["synthetic"]:
        facts |= {"licence": f"that of {', '.join(networks['datasets'])}, training data", "may_be_shared": False}
    source_facts = {name: source[name] for name in ("frame", "hand_convention", "dataset_version") if name in source}
    if source and not source["may_be_shared"]:
        source_facts |= {name: source[name] for name in ("licence", "licences", "may_be_shared") if name in source}
    write_store(folder, clips, generated_info(clips[0].dataset, hands, **facts | source_facts))
    return [folder]


def nearest_name(name: str, names: Sequence[str]) -> str:
    """A question that suggests the most similar of ``names``; empty if none is similar."""
    matches = get_close_matches(name, names, 1)
    return f"did you mean {matches[0]!r}?" if matches else ""


def mesh_notes(model: ObjectModel) -> list[str]:
    """Notes on repairs of a mesh, and on parts without an inside, where penetration is not prevented."""
    index = surface_index(model)
    note = [] if index.repair_note is None else [f"mesh: {index.repair_note}"]
    risk = "; hands are attracted to its surface, but penetration is not prevented"
    return note if index.is_solid else [note[0] + risk]


def trained_run(
    family: str, networks: Sequence[str], model: str, project: ProjectData
) -> tuple[StagePaths, Mapping[str, Any]]:
    """The dataset ``model``, or for "" the first one that has these networks; facts of the last network's header.

    Raises MissingResource if none has them, BadInput if they were trained with another hand model than the project's.
    """
    check_dataset(model, project)
    runs = [StagePaths(project.profile, name) for name in ((model,) if model else dict.fromkeys(project.datasets))]
    trained = [run for run in runs if all((run.checkpoints / name / FILE_NAME).is_file() for name in networks)]
    if not trained:
        remedy = f"name a dataset under family_datasets.{family} in params.yaml, then `hoidata repro`"
        raise MissingResource(f"no networks of {family} ({', '.join(map(str, runs))}): {remedy}")
    facts = {name: read_info(trained[0].checkpoints / name / FILE_NAME)["facts"] for name in networks}
    for name, header in facts.items():
        if header["hand_digest"] != project.hands.digest:
            remedy = "train it with the hand of this profile"
            raise BadInput(trained[0].checkpoints / name, f"hand {header['hand']}", project.hands.name, remedy)
    return trained[0], facts[networks[-1]]


def check_dataset(name: str, project: ProjectData) -> None:
    """Raise BadInput that lists the datasets of params.yaml if ``name`` is unknown; "" is accepted."""
    paths = StagePaths(project.profile, name)
    if name and name not in project.datasets and not paths.data.is_dir() and not paths.checkpoints.is_dir():
        names = list(dict.fromkeys(project.datasets))
        remedy = nearest_name(name, names) or "name one of them, or omit the option"
        raise BadInput("--model", f"a dataset of params.yaml: {', '.join(names)}", name, remedy)


def trained_on(facts: Mapping[str, Any]) -> str:
    """The number of training clips of a network per dataset, in words."""
    kind = "SYNTHETIC" if facts["synthetic"] else "recorded"
    return ", ".join(f"{count} {kind} {name} clips" for name, count in facts["datasets"].items())
