"""A sentence and an object to motions, with the models of the dataset that knows its words best, as files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hoidata.actions.action import written_limits
from hoidata.annotation.encoders import TextEncoder, load_encoder
from hoidata.annotation.settings import AnnotationSettings
from hoidata.contact.settings import ContactSettings
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.user_mesh import read_user_object, two_pieces
from hoidata.settings import build_config
from hoidata.store.store import open_store
from models.common.checkpoints import FILE_NAME, read_info
from models.common.repeatable import make_repeatable
from models.common.vocabulary import Vocabulary
from models.text2hoi.family import NAMES
from models.text2hoi.generation import GeneratedMotion, Generator, Wish
from models.text2hoi.sampler import SamplingConfig
from models.text2hoi.sentences import further_verbs, read_sentence
from pipelines.objects import MeshWish, stored_object
from pipelines.pages.generation_page import write_generation
from pipelines.params import chosen_params, read_file
from pipelines.stages.base import StagePaths, empty_reason, load_hands


@dataclass(frozen=True)
class Models:
    """Trained networks and what they were trained with. clips: the store whose objects may be asked for by name.

    sampling: how motions are made. points: sampled on an object.
    """

    checkpoints: Path
    hands: HandPair
    encoder: TextEncoder
    clips: Path | None = None
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    points: int = ContactSettings.points


@dataclass(frozen=True)
class Asked:
    """Everything ``hoidata generate`` is told. object: a mesh file, or the name of an object of the dataset.

    model: the dataset whose models to use, or "" for the one that knows the sentence's words best. models: these, in
    place of a project's. sampler: fields of a SamplerConfig, over those of the models.
    """

    text: str
    object: str | Path
    profile: str = ""
    datasets: tuple[str, ...] = ()
    model: str = ""
    models: Models | None = None
    wish: Wish = field(default_factory=Wish)
    mesh: MeshWish = field(default_factory=MeshWish)
    sampler: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Written:
    """paths of the files; notes: what was assumed, chosen or never seen in training, for the person who asked."""

    paths: list[Path]
    notes: list[str]


def generate_files(asked: Asked, out: Path) -> Written:
    """Generate, and write arrays, an animated GLB and a page that plays it into ``out``.

    Raises MissingResource or BadInput that says what is not there or cannot be meant.
    """
    verb, thing = read_sentence(asked.text)
    notes: list[str] = []
    user = None
    if isinstance(asked.object, Path):
        user = read_user_object(asked.object, asked.mesh.unit, asked.mesh.up, asked.mesh.hinge)
        notes += user.notes
    models, why = (asked.models, "") if asked.models else _of_project(asked, verb, thing)
    notes += [why] if why else []
    make_repeatable(threads=1)  # one motion is too small for two threads to agree on
    hands = models.hands
    model = user.model if user else _stored_object(str(asked.object), models)
    notes += _no_hinge(verb, asked.object, model)
    sampling = replace(models.sampling, sampler=replace(models.sampling.sampler, **asked.sampler))
    generator = Generator.load(models.checkpoints, hands, models.encoder, sampling=sampling, points=models.points)
    motions = generator.generate(asked.text, model, asked.wish, thing if user else None)
    notes += [f"never seen: {note}" for note in motions[0].evidence["unseen"]]
    notes += _not_made(asked.text, motions[0].evidence["read_as"], verb, generator.vocabulary)
    notes += [*_taken_for(verb, motions[0].evidence), *_moved_otherwise(motions)]
    return Written(write_generation(out, motions, hands, str(models.checkpoints), notes), notes)


def _no_hinge(verb: str | None, object: str | Path, model: ObjectModel) -> list[str]:
    """That the verb turns a hinge and the object has none, and what to add; for a person."""
    least, most = written_limits().get(verb or "", {}).get("hinge_net_deg", (0.0, 0.0))
    if model.is_articulated or least <= 0 <= most:
        return []
    says = f"{verb!r} turns a hinge, but the object has none"
    if not isinstance(object, Path):
        return [f"{says}: choose one that has"]
    pieces = two_pieces(object)
    if pieces is None:
        return [f"{says}: it needs a mesh of two objects or nodes, the second of which moves, and --hinge"]
    named = f" ({pieces[0]!r} and {pieces[1]!r})" if all(pieces) else ""
    add = '--hinge "px,py,pz dx,dy,dz", a point and the direction of the axis about which the second turns'
    return [f"{says}: the mesh has two pieces{named}; add {add}"]


def _not_made(text: str, read_as: tuple[str, float] | None, verb: str | None, known: Vocabulary) -> list[str]:
    """Which actions of a sentence are not made, since a motion is one; for a person."""
    made = read_as[0] if read_as else verb
    further = further_verbs(text, made, known)
    if made is None or not further:
        return []
    return [f"a motion is one action: of {made!r}, not of {', '.join(map(repr, further))}; ask for each alone"]


def _taken_for(verb: str | None, evidence: Mapping[str, Any]) -> list[str]:
    """That the motion is of another verb than the sentence has, or what the networks were told; for a person."""
    read_as = evidence["read_as"]
    if read_as is None:
        return []
    if read_as[0] != verb:
        return [f"the sentence is taken for {read_as[0]!r} ({read_as[1]:.0%})"]
    if evidence["told"] == evidence["text"]:
        return []
    plainly = evidence["plainly_read_as"][0]
    return [f"the networks are told {evidence['told']!r}: the sentence as it is they would take for {plainly!r}"]


def _moved_otherwise(motions: Sequence[GeneratedMotion]) -> list[str]:
    """Which samples move object or hands otherwise than training clips of the verb that was read; for a person."""
    found = []
    for evidence in (motion.evidence for motion in motions):
        read_as, moved_as, number = evidence["read_as"], evidence["moved_as"], evidence["number"] + 1
        if read_as and moved_as and moved_as != read_as[0]:
            found.append(f"sample {number}: the object moves most like training's {moved_as!r}, not {read_as[0]!r}")
        elif read_as and evidence["unusual"]:
            found.append(f"sample {number}: not as training's {read_as[0]!r}: {', '.join(evidence['unusual'])}")
    return found


def _of_project(asked: Asked, verb: str | None, thing: str | None) -> tuple[Models, str]:
    """The models of the project that know the words best, and why these, in words."""
    paths, why = chosen_model(asked, verb, thing)
    params = chosen_params({**read_file(Path("params.yaml")), "profile": paths.profile})
    encoder = build_config(AnnotationSettings, params.get("annotate"), "params.yaml: annotate").encoder
    points = build_config(ContactSettings, params.get("contact"), "params.yaml: contact").points
    told = (params.get("sample") or {}).get("text2hoi")
    # Half precision is for GPUs, and this runs on the CPU.
    sampling = replace(build_config(SamplingConfig, told, "params.yaml: sample.text2hoi"), precision="float32")
    hands, encoder = load_hands(paths.profile), load_encoder(encoder)
    return Models(paths.checkpoints, hands, encoder, paths.clips, sampling, points), why


def _stored_object(name: str, models: Models) -> ObjectModel:
    if models.clips is not None:
        return stored_object(name, models.clips, models.hands)
    expected = "a mesh file (.obj, .ply, .stl, .glb)"
    raise BadInput("--object", expected, name, "correct the path; objects by name are known in a project alone")


def chosen_model(asked: Asked, verb: str | None, thing: str | None) -> tuple[StagePaths, str]:
    """The dataset whose models to use, and why, in words. Raises MissingResource where none is trained."""
    names = (asked.model,) if asked.model else asked.datasets
    runs = [StagePaths(asked.profile, name) for name in names]
    reasons = {paths: why_not_trained(paths) for paths in runs}
    trained = [paths for paths in runs if not reasons[paths]]
    if not trained:
        reason = "; ".join(f"{paths}: {reasons[paths]}" for paths in runs)
        others = [name for name in asked.datasets if not why_not_trained(StagePaths(asked.profile, name))]
        instead = f"; models are there of {', '.join(others)}" if others else ""
        raise MissingResource(f"no models that can generate: {reason}{instead}")
    if asked.model:
        return trained[0], f"models: {trained[0]}, as asked for"
    found = [(_vocabulary(paths).knows(verb, thing) + 8 * _has_object(paths, asked.object), paths) for paths in trained]
    score, best = max(found, key=lambda item: item[0])
    known = (", ".join(filter(None, (verb, thing))) or str(asked.object)) if score else "none of the words"
    return best, f"models: {best}, which know best of {len(trained)}: {known} (--model chooses another)"


def _vocabulary(paths: StagePaths) -> Vocabulary:
    return Vocabulary.read(read_info(paths.checkpoints / "contact" / FILE_NAME)["facts"])


def _has_object(paths: StagePaths, name: str | Path) -> bool:
    """Whether the dataset has the object that was asked for by name; a mesh file is nobody's."""
    return isinstance(name, str) and name in list(open_store(paths.clips, load_hands(paths.profile)).objects["object"])


def why_not_trained(paths: StagePaths) -> str | None:
    """What is missing of the four models of a dataset, or None when all are there."""
    for name in NAMES:
        folder = paths.checkpoints / name
        if reason := empty_reason(folder):
            return f"{name} is empty, {reason}"
        if not (folder / FILE_NAME).is_file():
            return f"{folder} is not there; run `dvc repro`"
    return None
