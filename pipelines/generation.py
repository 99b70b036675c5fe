"""A sentence and an object to motions, with the models of the dataset that knows its words best, as files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import add
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
from models.text2hoi.wording import Wording, understood_words
from pipelines.command_inputs import MeshWish, Written, mesh_notes, stored_object
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
    place of a project's. sampler: fields of a SamplerConfig, over those of the models. force: generate even where words
    of the sentence are unknown, and leave them as they are.
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
    force: bool = False


def generate_files(asked: Asked, out: Path) -> Written:
    """Generate, and write arrays, an animated GLB and a page that plays it into ``out``.

    Raises MissingResource or BadInput that says what is not there or cannot be meant.
    """
    read_sentence(asked.text)  # refuses what is no sentence before anything is loaded
    notes: list[str] = []
    user = None
    if isinstance(asked.object, Path):
        user = read_user_object(asked.object, asked.mesh.unit, asked.mesh.up, asked.mesh.hinge)
        notes += [*user.notes, *mesh_notes(user.model)]
    wording = _wording(asked)
    verb, thing = wording.verb, wording.noun
    models, why = (asked.models, "") if asked.models else _of_project(asked, verb, thing)
    notes += [*wording.notes, *([why] if why else [])]
    make_repeatable(threads=1)  # one motion is too small for two threads to agree on
    hands = models.hands
    model = user.model if user else _stored_object(str(asked.object), models)
    notes += _no_hinge(verb, asked.object, model)
    sampling = replace(models.sampling, sampler=replace(models.sampling.sampler, **asked.sampler))
    generator = Generator.load(models.checkpoints, hands, models.encoder, sampling=sampling, points=models.points)
    motions = generator.generate(wording.text, model, asked.wish, wording.noun if user else None)
    evidence, hand = motions[0].evidence, motions[0].evidence["hand"]
    if hand["source"] != "rule":
        notes.append(f"hand: {hand['hand']}, since {hand['evidence']} (--hand chooses another)")
    if evidence["read_as"] is None:  # networks that see the whole sentence
        notes += [f"never seen: {note}" for note in evidence["unseen"]]
    notes += _not_made(wording.text, evidence["read_as"], verb, generator.vocabulary)
    notes += [*_taken_for(verb, evidence), *_faults(motions)]
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


def _wording(asked: Asked) -> Wording:
    """What the sentence means to the models that may answer it. Raises BadInput for what they would have to guess."""
    if asked.models:
        known, encoder = _vocabulary(asked.models.checkpoints), asked.models.encoder
        return understood_words(asked.text, known, lambda: encoder, _names(asked), asked.force)
    known = reduce(add, (_vocabulary(paths.checkpoints) for paths in trained_runs(asked)))
    return understood_words(asked.text, known, lambda: _settings(asked.profile)[0], _names(asked), asked.force)


def _names(asked: Asked) -> tuple[str]:
    """What the object is called: words of a sentence that need not be English."""
    return (asked.object.stem if isinstance(asked.object, Path) else asked.object,)


def _not_made(text: str, read_as: tuple[str, float] | None, verb: str | None, known: Vocabulary) -> list[str]:
    """Which actions of a sentence are not made, since a motion is one; for a person."""
    made = read_as[0] if read_as else verb
    further = further_verbs(text, made, known)
    if made is None or not further:
        return []
    return [f"a motion is one action: of {made!r}, not of {', '.join(map(repr, further))}; ask for each alone"]


def _taken_for(verb: str | None, evidence: Mapping[str, Any]) -> list[str]:
    """That the motion is of another verb than the sentence has; for a person."""
    read_as = evidence["read_as"]
    return [f"the sentence is taken for {read_as[0]!r} ({read_as[1]:.0%})"] if read_as and read_as[0] != verb else []


def _faults(motions: Sequence[GeneratedMotion]) -> list[str]:
    """What a person would see to be wrong with samples."""
    each = (motion.evidence for motion in motions)
    return [f"sample {evidence['number'] + 1}: {fault}" for evidence in each for fault in evidence["faults"]]


def _of_project(asked: Asked, verb: str | None, thing: str | None) -> tuple[Models, str]:
    """The models of the project that know the words best, and why these, in words."""
    paths, why = chosen_model(asked, verb, thing)
    encoder, points, sampling = _settings(paths.profile)
    hands = load_hands(paths.profile)
    return Models(paths.checkpoints, hands, encoder, _clips_with(asked, paths), sampling, points), why


def _settings(profile: str) -> tuple[TextEncoder, int, SamplingConfig]:
    """Encoder, points on an object, and sampling of a profile, as params.yaml has them."""
    params = chosen_params({**read_file(Path("params.yaml")), "profile": profile})
    encoder = build_config(AnnotationSettings, params.get("annotate"), "params.yaml: annotate").encoder
    points = build_config(ContactSettings, params.get("contact"), "params.yaml: contact").points
    told = (params.get("sample") or {}).get("text2hoi")
    sampling = build_config(SamplingConfig, told, "params.yaml: sample.text2hoi")
    # Half precision is for GPUs, and this runs on the CPU.
    return load_encoder(encoder), points, replace(sampling, precision="float32")


def _clips_with(asked: Asked, paths: StagePaths) -> Path:
    """The clips among whose objects the one asked for by name is: of the models' own dataset, else of another."""
    runs = [paths, *(StagePaths(paths.profile, name) for name in asked.datasets)]
    return next((run.clips for run in runs if _has_object(run, asked.object)), paths.clips)


def _stored_object(name: str, models: Models) -> ObjectModel:
    if models.clips is not None:
        return stored_object(name, models.clips, models.hands)
    expected = "a mesh file (.obj, .ply, .stl, .glb)"
    raise BadInput("--object", expected, name, "correct the path; objects by name are known in a project alone")


def trained_runs(asked: Asked) -> list[StagePaths]:
    """The datasets that may answer, those with models. Raises MissingResource where there is none."""
    names = (asked.model,) if asked.model else asked.datasets
    runs = [StagePaths(asked.profile, name) for name in names]
    reasons = {paths: why_not_trained(paths) for paths in runs}
    trained = [paths for paths in runs if not reasons[paths]]
    if not trained:
        reason = "; ".join(f"{paths}: {reasons[paths]}" for paths in runs)
        others = [name for name in asked.datasets if not why_not_trained(StagePaths(asked.profile, name))]
        instead = f"; models are there of {', '.join(others)}" if others else ""
        raise MissingResource(f"no models that can generate: {reason}{instead}")
    return trained


def chosen_model(asked: Asked, verb: str | None, thing: str | None) -> tuple[StagePaths, str]:
    """The dataset whose models to use, and why, in words. Raises MissingResource where none is trained.

    One that was trained on the verb goes before all others; then the one that has an object asked for by name, then the
    one that knows the sentence's object, then the one with more clips of the verb.
    """
    trained = trained_runs(asked)
    if asked.model:
        return trained[0], f"models: {trained[0]}, as asked for"
    known = {paths: _vocabulary(paths.checkpoints) for paths in trained}

    def fits(paths: StagePaths) -> tuple[bool, bool, int, int]:
        own = known[paths]
        return verb in own.verbs, _has_object(paths, asked.object), own.knows(verb, thing), own.verbs[verb or ""]

    best = max(trained, key=fits)
    clips = known[best].verbs[verb] if verb else 0
    why = f", trained on {clips} clips of {verb!r}" if clips else ""
    return best, f"models: {best}{why} (--model chooses another)"


def _vocabulary(checkpoints: Path) -> Vocabulary:
    return Vocabulary.read(read_info(checkpoints / "contact" / FILE_NAME)["facts"])


def _has_object(paths: StagePaths, name: str | Path) -> bool:
    """Whether the dataset has the object that was asked for by name; a mesh file is nobody's."""
    if not isinstance(name, str) or not paths.clips.is_dir() or empty_reason(paths.clips):
        return False
    return name in list(open_store(paths.clips, load_hands(paths.profile)).objects["object"])


def why_not_trained(paths: StagePaths) -> str | None:
    """What is missing of the four models of a dataset, or None when all are there."""
    for name in NAMES:
        folder = paths.checkpoints / name
        if reason := empty_reason(folder):
            return f"{name} is empty, {reason}"
        if not (folder / FILE_NAME).is_file():
            return f"{folder} is not there; run `dvc repro`"
    return None
