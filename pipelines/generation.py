"""`hoidata generate`: motions for a sentence and an object, with the models that fit the sentence best."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.actions.action import written_limits
from hoidata.annotation.encoders import TextEncoder, load_encoder, not_clip_note
from hoidata.annotation.prompts import further_verbs, read_sentence
from hoidata.annotation.settings import AnnotationSettings
from hoidata.annotation.vocabulary import Vocabulary
from hoidata.annotation.wording import Wording, understood_words
from hoidata.contact.settings import ContactSettings
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from hoidata.metrics.verdict import verdict_lines
from hoidata.object_paths.mesh_frame import Z, axis_turned_back, opening_upwards
from hoidata.objects.model import ObjectModel
from hoidata.objects.urdf import find_urdf
from hoidata.objects.user_mesh import piece_names, read_user_object
from hoidata.settings import build_config
from hoidata.store.store import open_store
from models.common.checkpoints import FILE_NAME, read_info
from models.common.repeatable import make_repeatable
from models.text2hoi.generation import GeneratedMotion, Generator, MotionOptions
from models.text2hoi.sampler import SamplingConfig
from pipelines.command_inputs import (
    MeshOptions,
    WrittenFiles,
    check_new_store,
    mesh_notes,
    object_name,
    stored_object,
    write_motion_store,
)
from pipelines.pages.generation_page import write_generation
from pipelines.pages.motion_files import older_motion_notes
from pipelines.params import chosen_params, read_file
from pipelines.stages.base import StagePaths, empty_reason, load_hands


@dataclass(frozen=True)
class Models:
    """Trained networks of one dataset, with the hand model and text encoder they were trained with."""

    checkpoints: Path  # the folder with one subfolder per network
    hands: HandPair
    encoder: TextEncoder
    clips: Path | None = None  # the store whose objects can be requested by name
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    points: int = ContactSettings.points  # sampled on the object's surface
    # If ``clips`` are another dataset's: what is up for each of its training objects, (3,) in their frames.
    object_ups: Mapping[str, Sequence[float]] | None = None


@dataclass(frozen=True)
class GenerationRequest:
    """The arguments of ``hoidata generate``."""

    text: str
    object: str | Path  # a mesh file, or the name of an object of a dataset
    profile: str = ""
    datasets: tuple[str, ...] = ()
    model: str = ""  # the dataset whose models to use; "" chooses it by the words of the sentence
    models: Models | None = None  # used instead of the project's models
    options: MotionOptions = field(default_factory=MotionOptions)
    mesh: MeshOptions = field(default_factory=MeshOptions)
    sampler: Mapping[str, Any] = field(default_factory=dict)  # fields of SamplerConfig that replace the models' own
    sampling: Mapping[str, Any] = field(default_factory=dict)  # likewise of SamplingConfig
    force: bool = False  # generate even if the sentence has unknown words, and keep those words


def generate_files(request: GenerationRequest, out: Path, store: Path | None = None) -> WrittenFiles:
    """Generate motions; write arrays, an animated GLB and a page with a player into ``out``, and clips to ``store``.

    Raises MissingResource for missing models or files, BadInput for an unusable sentence, object or option.
    """
    check_new_store(store)
    read_sentence(request.text)  # refuses other text before anything is loaded
    request, notes = _with_object_name(request)
    user = None
    if isinstance(request.object, Path):
        user = read_user_object(request.object, *astuple(request.mesh))
        notes += [*user.notes, *mesh_notes(user.model), *_slide_notes(user.model)]
    wording = _wording(request)
    verb, noun = wording.verb, wording.noun
    models, reason = (request.models, "") if request.models else _project_models(request, verb, noun)
    notes += [*wording.notes, *([reason] if reason else []), *_preset_notes(models.checkpoints, _networks(request))]
    make_repeatable(threads=1)  # one motion is too small to gain from two threads
    hands = models.hands
    if user:
        model = user.model
    elif models.clips:
        model = stored_object(str(request.object), models.clips, hands)
    else:
        remedy = "correct the path; a dataset's objects are available only in a project"
        raise BadInput("--object", "a mesh file (.obj, .ply, .stl, .glb)", str(request.object), remedy)
    notes += _missing_hinge_notes(verb, request.object, model)
    up, up_notes = (Z, []) if user else _stored_up(model.name, models)
    notes += up_notes
    generator = _generator(models, replace(models.sampling, **request.sampling))
    generator = replace(generator, model=generator.model.with_sampler(**request.sampler))
    words = noun if user else None
    opening, limits = opening_upwards(model, user.joint_limits if user else None)
    motions = generator.generate(wording.text, opening, request.options, words, up, limits)
    notes += _limit_notes(motions, limits)
    if opening is not model:
        motions = [
            replace(one, clip=axis_turned_back(one.clip, model), coarse=axis_turned_back(one.coarse, model))
            for one in motions
        ]
    evidence, hand = motions[0].evidence, motions[0].evidence["hand"]
    if hand["source"] != "rule":
        notes.append(f"hand: {hand['hand']}, since {hand['evidence']} (--hand chooses another)")
    if generator.model.is_paper and (note := not_clip_note(str(generator.encoder.identity["name"]))):
        notes.append(note)
    if evidence["verb"] is None:
        notes += [f"never seen: {note}" for note in evidence["unseen"]]
    notes += _further_verb_notes(request, wording)
    verdicts = [line for motion in motions for line in verdict_lines(motion.evidence["number"], motion.verdict)]
    paths = write_generation(out, motions, hands, str(models.checkpoints), notes)
    clips = [replace(motion.clip, verb=evidence["verb"]) for motion in motions]
    paths += write_motion_store(store, clips, hands, generator.model.facts)
    return WrittenFiles(paths, [*notes, *older_motion_notes(out, paths)], verdicts)


def _stored_up(name: str, models: Models) -> tuple[Sequence[float] | None, list[str]]:
    """What is up for an object of another dataset than the networks'; None if it is not, or if that is not known."""
    if models.object_ups is None:
        return None, []
    up = models.object_ups.get(name)
    unknown = f"{name!r} is of another dataset, without networks that know what is up for it: it may not stand upright"
    return up, [] if up else [unknown]


def load_generator(profile: str, dataset: str) -> Generator:
    """The networks of a dataset, with the settings of params.yaml. Raises MissingResource if one is not trained."""
    models, _ = _project_models(GenerationRequest("", "", profile, (dataset,), dataset), None, None)
    return _generator(models, models.sampling)


def _generator(models: Models, sampling: SamplingConfig) -> Generator:
    return Generator.load(models.checkpoints, models.hands, models.encoder, sampling=sampling, points=models.points)


def _preset_notes(checkpoints: Path, networks: Sequence[str]) -> list[str]:
    """A note if the networks were trained with different presets or sizes."""
    presets = {}
    for name in networks:
        record = read_info(checkpoints / name / FILE_NAME).get("provenance") or {}
        params = record.get("stages", {}).get(record.get("stage"), {}).get("params", {})
        presets[name] = " ".join(key.split(".")[1] for key in sorted(params) if key.endswith(f".{name}"))
    if len(set(presets.values())) == 1:
        return []
    listed = ", ".join(f"{name} {preset or 'unknown'}" for name, preset in presets.items())
    return [f"networks of different presets or sizes: {listed}; `hoidata repro` trains them alike"]


def _missing_hinge_notes(verb: str | None, object: str | Path, model: ObjectModel) -> list[str]:
    """A note for a verb that turns a hinge and an object without one, with the remedy."""
    first_verb = (verb or "").partition(" and ")[0]  # of "open and close"
    lowest_deg, highest_deg = written_limits().get(first_verb, {}).get("hinge_net_deg", (0.0, 0.0))
    if model.is_articulated or lowest_deg <= 0 <= highest_deg:
        return []
    problem = f"{verb!r} turns a hinge, but the object has none"
    if not isinstance(object, Path):
        return [f"{problem}: choose one that has"]
    if find_urdf(object):
        return [f"{problem}: its URDF has no movable joint"]
    pieces = piece_names(object)
    if pieces is None:
        return [f"{problem}: it needs a mesh of two objects or nodes, the second of which moves, and --hinge"]
    names = f" ({pieces[0]!r} and {pieces[1]!r})" if all(pieces) else ""
    option = '--hinge "px,py,pz dx,dy,dz", a point and the direction of the axis about which the second turns'
    return [f"{problem}: the mesh has two pieces{names}; add {option}"]


def _slide_notes(model: ObjectModel) -> list[str]:
    if model.hinge is None or not model.hinge.is_prismatic:
        return []
    slide = f"{100 * model.joint_scale:.0f} cm"
    return [f"the networks were trained on hinges: one radian of a network slides this part by {slide}"]


def _limit_notes(motions: Sequence[GeneratedMotion], limits: tuple[float, float] | None) -> list[str]:
    """A note on the motions whose joint reaches its highest position, beyond which the networks' motion was cut."""
    angles_rad = {one.evidence["number"] + 1: one.clip.object.hinge_rad for one in motions}
    cut = [
        str(number)
        for number, angle_rad in angles_rad.items()
        if limits is not None and angle_rad is not None and angle_rad.max() >= np.float32(limits[1])
    ]
    note = f"sample {', '.join(cut)}: the joint stops at the limit of its URDF, beyond which the networks moved it"
    return [note] if cut else []


def _wording(request: GenerationRequest) -> Wording:
    """The sentence in words of the training vocabulary. Raises BadInput for unknown words."""
    models = request.models

    def encoder() -> TextEncoder:
        return models.encoder if models else _profile_settings(request.profile)[0]

    # A sentence may contain the words of the object's name although they are not English.
    name = request.object.stem if isinstance(request.object, Path) else request.object
    return understood_words(request.text, _trained_vocabulary(request), encoder, (name,), request.force)


def _trained_vocabulary(request: GenerationRequest) -> Vocabulary:
    """The words of all models that a request may use."""
    models = request.models
    folders = [models.checkpoints] if models else [paths.checkpoints for paths in trained_runs(request)]
    return reduce(add, map(_vocabulary, folders))


def _further_verb_notes(request: GenerationRequest, wording: Wording) -> list[str]:
    """A note that names the verbs of the sentence which the motion does not show: a motion has one verb."""
    further = further_verbs(wording.text, wording.verb, _trained_vocabulary(request))
    if wording.verb is None or not further:
        return []
    others = ", ".join(map(repr, further))
    return [f"a motion shows one action: this one shows {wording.verb!r}, not {others}; generate each alone"]


def _project_models(request: GenerationRequest, verb: str | None, noun: str | None) -> tuple[Models, str]:
    """The models of the project that fit the sentence best, and the reason in words."""
    paths, reason = chosen_model(request, verb, noun)
    encoder, points, sampling = _profile_settings(paths.profile)
    hands, owner = load_hands(paths.profile), _dataset_with_object(request, paths)
    object_ups = None if owner == paths else _object_ups(owner)
    return Models(paths.checkpoints, hands, encoder, owner.clips, sampling, points, object_ups), reason


def _profile_settings(profile: str) -> tuple[TextEncoder, int, SamplingConfig]:
    """Text encoder, number of object points, and sampling settings of a profile in params.yaml."""
    params = chosen_params({**read_file(Path("params.yaml")), "profile": profile})
    encoder = build_config(AnnotationSettings, params.get("annotate"), "params.yaml: annotate").encoder
    points = build_config(ContactSettings, params.get("contact"), "params.yaml: contact").points
    return load_encoder(encoder), points, _sampling_settings(params)


def _sampling_settings(params: Mapping[str, Any]) -> SamplingConfig:
    section = (params.get("sample") or {}).get("text2hoi")
    return build_config(SamplingConfig, section, "params.yaml: sample.text2hoi")


def _dataset_with_object(request: GenerationRequest, paths: StagePaths) -> StagePaths:
    """The first dataset that has the requested object: the models', else another one."""
    runs = [paths, *(StagePaths(paths.profile, name) for name in request.datasets)]
    return next((run for run in runs if _has_object(run, request.object)), paths)


def _object_ups(paths: StagePaths) -> Mapping[str, Sequence[float]]:
    """What is up for each training object of a dataset; empty if its network is not trained."""
    if why_not_trained(paths, ["diffusion"]):
        return {}
    return read_info(paths.checkpoints / "diffusion" / FILE_NAME)["results"]["object_ups"]


def _with_object_name(request: GenerationRequest) -> tuple[GenerationRequest, list[str]]:
    """The request with the full name of a dataset's object, and a note if it was typed in another way."""
    if isinstance(request.object, Path) or request.models:
        return request, []
    names = [name for dataset in request.datasets for name in _object_names(StagePaths(request.profile, dataset))]
    name = object_name(request.object, list(dict.fromkeys(names)))
    note = [f"--object {request.object!r} is taken for {name!r}"] if name != request.object else []
    return replace(request, object=name), note


def trained_runs(request: GenerationRequest) -> list[StagePaths]:
    """The requested datasets that have models. Raises MissingResource if none has."""
    names = (request.model,) if request.model else request.datasets
    networks = _networks(request)
    runs = (StagePaths(request.profile, name) for name in names)
    reasons = {paths: why_not_trained(paths, networks) for paths in runs}
    trained = [paths for paths, reason in reasons.items() if not reason]
    if not trained:
        reason = "; ".join(f"{paths}: {reason}" for paths, reason in reasons.items())
        others = [name for name in request.datasets if not why_not_trained(StagePaths(request.profile, name), networks)]
        alternative = f"; these datasets have models: {', '.join(others)}" if others else ""
        raise MissingResource(f"no models that can generate: {reason}{alternative}")
    return trained


def chosen_model(request: GenerationRequest, verb: str | None, noun: str | None) -> tuple[StagePaths, str]:
    """The dataset whose models to use, and the reason in words. Raises MissingResource if none is trained.

    Datasets are ranked by four criteria, in this order: the verb is in their vocabulary; they have the requested
    object; the noun is in their vocabulary; the number of clips with the verb.
    """
    trained = trained_runs(request)
    if request.model:
        return trained[0], f"models: {trained[0]}, as requested"
    vocabularies = {paths: _vocabulary(paths.checkpoints) for paths in trained}

    def rank_key(paths: StagePaths) -> tuple[bool, bool, int, int]:
        words, has_object = vocabularies[paths], _has_object(paths, request.object)
        return verb in words.verbs, has_object, words.knows(verb, noun), words.verbs[verb or ""]

    best = max(trained, key=rank_key)
    n_clips = vocabularies[best].verbs[verb] if verb else 0
    reason = f", trained on {n_clips} clips of {verb!r}" if n_clips else ""
    return best, f"models: {best}{reason} (--model chooses another)"


def _vocabulary(checkpoints: Path) -> Vocabulary:
    return Vocabulary.read(read_info(checkpoints / "contact" / FILE_NAME)["facts"])


def _has_object(paths: StagePaths, name: str | Path) -> bool:
    """Whether the dataset has an object of this name; False for the path of a mesh file."""
    return isinstance(name, str) and name in _object_names(paths)


def _object_names(paths: StagePaths) -> list[str]:
    """The objects of a dataset; none if it is not converted."""
    if not paths.clips.is_dir() or empty_reason(paths.clips):
        return []
    return list(open_store(paths.clips, load_hands(paths.profile)).objects["object"])


def _networks(request: GenerationRequest) -> list[str]:
    """The networks that a request needs: the refiner and the length network only if they are used."""
    params = chosen_params({**read_file(Path("params.yaml")), "profile": request.profile})
    refine = request.sampling.get("refine", _sampling_settings(params).refine)
    used = {"length": request.options.frames is None, "refiner": refine == "network"}
    return [name for name in ("contact", "diffusion", "length", "refiner") if used.get(name, True)]


def why_not_trained(paths: StagePaths, networks: Sequence[str]) -> str | None:
    """The first of ``networks`` that is missing for a dataset, in words; None if all are present."""
    for name in networks:
        folder = paths.checkpoints / name
        if reason := empty_reason(folder):
            return f"{name} is empty, {reason}"
        if not (folder / FILE_NAME).is_file():
            return f"{folder} is not there; run `dvc repro`"
    return None
