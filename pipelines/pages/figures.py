"""The illustrations of the Text2HOI paper (Cha et al. 2024), one page each, for a clip and its dataset's networks."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hoidata.annotation.hand_choice import HAND_TYPES
from hoidata.annotation.sentences import english_sentences
from hoidata.clips.clip import Clip, HandType
from hoidata.contact.maps import f1_score
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.geometry.transform import RigidTransform
from hoidata.metrics.evaluate import evaluate_store
from hoidata.metrics.registry import metric
from hoidata.metrics.unmeasured import reasons_in_words
from hoidata.metrics.verdict import summary
from hoidata.store.annotated import AnnotatedStore, load_annotated
from models.common.predicting import sample_family
from models.common.repeatable import make_repeatable
from models.registry import load_family
from models.text2hoi.generation import GeneratedMotion, Generator, MotionOptions
from pipelines.expected_orderings import RECORDED
from pipelines.generation import load_generator
from pipelines.pages.clip_page import page_name
from pipelines.pages.examples import first_motion, motion_contact, shown_subset, true_contact
from pipelines.pages.generation_page import shown_motion
from pipelines.pages.metrics_table import METHODS, number
from pipelines.pages.motion_files import simplified_for_page
from pipelines.pages.player import Player, motion_player, write_page
from pipelines.pages.report import touch_words
from pipelines.pages.surface import ContactPaint
from pipelines.params import read_params
from pipelines.show_pages import dataset_of_clip
from pipelines.stages.base import StagePaths, empty_reason
from pipelines.stages.families import families_of

PROMPTS, SAMPLES = 4, 4
SIZES = (0.6, 1.0, 1.6)  # of the object, relative to the original; the contact network is trained on .5 to 2
PERTURBED = ("noise", "noise-refined", "pressed", "pressed-refined")
REFINED_CLIPS = 40  # test clips that are perturbed and refined
REFINER_METRICS = tuple(map(metric, ("realism_si", "realism_released", "penetration_mm", "deep_share")))


@dataclass(frozen=True)
class Panel:
    """One motion of a page."""

    caption: str
    players: list[Player]  # one, or a contact map and the motion
    note: str = ""


@dataclass(frozen=True)
class Figure:
    """The content of one page."""

    name: str  # of the file
    source: str  # number in the paper
    title: str
    words: str  # what it shows
    panels: list[Panel]
    head: Sequence[str] = ()  # of the table
    rows: Sequence[tuple[str, ...]] = ()


@dataclass(frozen=True)
class Subject:
    """The clip whose prompt and object the pages use, and the networks."""

    annotated: AnnotatedStore
    clip_id: str
    generator: Generator
    paths: StagePaths  # of the dataset
    families: Sequence[str]  # whose motions are compared

    @property
    def clip(self) -> Clip:
        return self.annotated.clip(self.clip_id)

    @property
    def prompt(self) -> str:
        return self.annotated.sentences(self.clip_id)[0]

    def prompt_of(self, clip_id: str, hand: HandType) -> str:
        """The imperative of another clip's verb with this object."""
        verb = self.annotated.hand_types.to_dict("index")[clip_id]["verb"]
        return english_sentences(verb, self.clip.object_words, hand)[0]

    def generate(self, prompt: str, samples: int = 1, size: float = 1.0) -> list[GeneratedMotion]:
        """Motions of seed 0 for a prompt; ``size``: of the object, relative to the original."""
        model = self.clip.object.model
        hinge = model.hinge and replace(model.hinge, origin_m=model.hinge.origin_m * size)
        model = replace(model, vertices_m=(model.vertices_m * size).astype(model.vertices_m.dtype), hinge=hinge)
        options = MotionOptions(samples=samples)
        return self.generator.generate(prompt, model, options, self.clip.object_words, up=None)

    def panel(self, caption: str, clip: Clip, paint: ContactPaint | None = None, note: str = "") -> Panel:
        """A panel with one player; ``paint``: a contact map."""
        words, shown = touch_words(self.annotated), simplified_for_page(clip)
        return Panel(caption, [motion_player(shown, self.generator.hands, caption, "", paint, words)], note)

    def sampled_panel(self, family: str, folder: Path, note: str = "") -> list[Panel]:
        """The panel of the motion in a family's folder for the clip; empty if there is none."""
        motion = first_motion(folder, self.clip_id, self.generator.hands)
        if motion is None:
            return []
        paint = motion_contact(self.annotated, self.clip_id, motion, self.generator.hands)
        return [self.panel(load_family(family).title, motion, paint, note)]


def write_figures(name: str, profile: str, out: Path) -> list[Path]:
    """Write the pages of a clip, or of a held-out clip of a dataset, below ``out``; returns their paths.

    Raises BadInput for an unknown name or a clip without a sentence, and MissingResource if a stage has not run.
    """
    params = read_params(Path())
    datasets = [str(dataset) for dataset in params["datasets"]]
    paths = StagePaths(profile, name) if name in datasets else dataset_of_clip(name, profile, datasets)
    make_repeatable(threads=1)
    generator = load_generator(profile, paths.dataset)
    annotated = load_annotated(paths.data, generator.hands)
    clip_id = default_clip(annotated) if name in datasets else name
    if clip_id not in annotated.ids():
        raise BadInput(clip_id, "a clip with a sentence", "none", "choose another clip; its page has the reason")
    subject = Subject(annotated, clip_id, generator, paths, families_of(params, paths.dataset))
    return write_pages(out / f"{Path(page_name(name)).stem}-figures", subject)


def write_pages(folder: Path, subject: Subject) -> list[Path]:
    """Write all pages; equal inputs give equal bytes."""
    figures = [_methods(subject), *_generated(subject), _refined(subject), _frames(subject)]
    values = {
        "links": [(figure.name, f"{figure.source}: {figure.name}") for figure in figures],
        "facts": [("prompt", subject.prompt), ("object", subject.clip.object_words), ("clip", subject.clip_id)],
        "synthetic": subject.clip.synthetic,
        "has_players": True,
    }
    return [
        write_page(folder / f"{figure.name}.html", "figures.html", title=figure.title, figure=figure, **values)
        for figure in figures
    ]


def default_clip(annotated: AnnotatedStore) -> str:
    """The first held-out clip among those whose object has the most verbs in training."""
    verbs = annotated.hand_types["verb"].to_dict()
    pairs = {(annotated.object_key(name), verbs[name]) for name in annotated.ids("train")}
    count = Counter(key for key, _ in pairs)
    return max(annotated.ids(shown_subset(annotated)), key=lambda name: count[annotated.object_key(name)])


def _methods(subject: Subject) -> Figure:
    recorded = replace(subject.clip, other_objects=())  # no method generates a table
    panels = [subject.panel("recorded", recorded, true_contact(subject.annotated, subject.clip_id))]
    for family in subject.families:
        if family != RECORDED:
            samples = replace(subject.paths, family=family).samples
            panels += subject.sampled_panel(family, samples, METHODS.get(family, ""))
    words = "All methods on one prompt; coloured: the points that a hand touches. Only test clips have sampled motions."
    return Figure("methods", "Fig. 4", "Methods side by side", words, _same_camera(panels))


def _generated(subject: Subject) -> list[Figure]:
    """The pages that compare generated motions."""
    hand_prompts = [subject.prompt_of(subject.clip_id, hand) for hand in HAND_TYPES]
    by_prompt = {text: subject.generate(text)[0] for text in _prompts(subject)}
    by_hand = {text: subject.generate(text)[0] for text in hand_prompts}
    by_size = {f"{size:g} times the size": subject.generate(subject.prompt, size=size)[0] for size in SIZES}
    by_sample = {f"sample {number}": one for number, one in enumerate(subject.generate(subject.prompt, SAMPLES), 1)}
    maps = "The predicted contact map and the motion for"
    training, sizes = "the prompts of training clips with the same object", "smaller or larger copies of the object"
    hands = "one verb and object with the left hand, the right hand and both"
    pages = (
        ("prompts", "Fig. 5, S4", "Contact map and motion by prompt", f"{maps} {training}.", by_prompt),
        ("sizes", "Fig. S5", "Contact map and motion by size of the object", f"{maps} {sizes}.", by_size),
        ("samples", "Fig. S8", "Diversity: samples of one prompt", f"{maps} several samples of one prompt.", by_sample),
        ("hands", "Fig. S10", "Left hand, right hand, both", f"{maps} {hands}.", by_hand),
    )
    return [_of_motions(subject, *page) for page in pages]


def _prompts(subject: Subject) -> list[str]:
    """The clip's prompt and those of training clips with its object: other verbs first, then other hands."""
    annotated, train = subject.annotated, subject.annotated.ids("train")
    verbs, key = annotated.hand_types["verb"].to_dict(), annotated.object_key(subject.clip_id)
    same_object = [name for name in train if annotated.object_key(name) == key] or train
    texts = {name: subject.prompt_of(name, annotated.hand_type(name)) for name in same_object}
    by_verb = {verbs[name]: text for name, text in texts.items()} | {verbs[subject.clip_id]: subject.prompt}
    return list(dict.fromkeys([subject.prompt, *by_verb.values(), *texts.values()]))[:PROMPTS]


def _of_motions(
    subject: Subject, name: str, source: str, title: str, words: str, motions: Mapping[str, GeneratedMotion]
) -> Figure:
    """A page of generated motions by caption: contact map and motion of each, and a table."""
    panels, rows, first = [], [], next(iter(motions.values()))
    for caption, motion in motions.items():
        shown = shown_motion(motion, subject.generator.hands, caption)
        contact_map = replace(shown["maps"][0], caption="predicted contact map", contact_label="")
        players = [contact_map, replace(shown["player"], caption="motion")]
        panels.append(Panel(caption, players, summary(motion.verdict)))
        agreement = f"{f1_score(motion.contact, first.contact):.2f}"
        rows.append((caption, f"{100 * motion.contact.mean():.0f}", agreement, str(motion.clip.n_frames)))
    head = ("motion", "points in the contact map, %", "F1 with the first map", "frames")
    return Figure(name, source, title, words, _same_camera(panels), head, rows)


def _same_camera(panels: list[Panel]) -> list[Panel]:
    """Give all motions one camera that sees them all, so that they can be compared."""
    views = [panel.players[-1].view for panel in panels]
    ground_m = min((view.ground_m for view in views if view.ground_m is not None), default=None)
    reach_m = [math.dist(view.centre, views[0].centre) + view.radius_m for view in views]
    for panel, view in zip(panels, views, strict=True):
        shared = replace(views[0], radius_m=round(max(reach_m), 4), ground_m=ground_m, frames=view.frames)
        panel.players[-1] = replace(panel.players[-1], view=shared)
    return panels


def _refined(subject: Subject) -> Figure:
    panels, rows, hands = [], [], subject.generator.hands
    with TemporaryDirectory() as folder:
        for family in (RECORDED, *PERTURBED):
            out, data, title = Path(folder, family), subject.annotated.root, load_family(family).title
            sampling = {"samples": 1, "clips": REFINED_CLIPS}
            sample_family(load_family(family), data, subject.paths.checkpoints, out, sampling, hands)
            if reason := empty_reason(out):
                rows.append((title, f"none: {reason}", *[""] * (len(REFINER_METRICS) - 1)))
                continue
            results = evaluate_store(out / "clips", data, hands, metrics=REFINER_METRICS)
            rows.append((title, *(_cell(results, one.name) for one in REFINER_METRICS)))
            panels += subject.sampled_panel(family, out)
    measured = f"means and 95 % intervals of up to {REFINED_CLIPS} test clips"
    words = f"The refiner network on perturbed recordings; {measured}."
    head = ("motion", *(f"{one.title}, {one.unit}" if one.unit else one.title for one in REFINER_METRICS))
    return Figure("refiner", "Fig. S6", "The refiner on perturbed recordings", words, _same_camera(panels), head, rows)


def _cell(results: Mapping[str, Any], name: str) -> str:
    """A metric with its interval over clips, or why it was not measured."""
    if name not in results["figures"]:
        return reasons_in_words(results["unmeasured"].get(name, {}))
    ends = results["intervals"].get(name, {}).get("clips")
    return number(results["figures"][name]) + (f" ({number(ends[0])} to {number(ends[1])})" if ends else "")


def _frames(subject: Subject) -> Figure:
    clip = subject.generate(subject.prompt)[0].clip
    # Relative to the first frame, so that the object stands as it does there.
    object_frame = clip.object.world_from_object[:1] @ clip.object.world_from_object.inverse()
    in_object_frame = subject.panel("in the object's frame", seen_from(clip, object_frame))
    panels = [subject.panel("in the world", clip), in_object_frame]
    without_up = replace(clip, gravity=None)
    for side, track in clip.hands.items():
        if track.valid.any():
            wrist = RigidTransform.from_rotvec(*(x.astype(np.float64) for x in (track.global_orient, track.wrist_m)))
            panels.append(subject.panel(f"in the {side} wrist's frame", seen_from(without_up, wrist.inverse())))
    words = "A generated motion in the world, and as seen from the object and from each wrist (MANO's canonical frame)."
    return Figure("frames", "Fig. S9", "Hands in the object's and in MANO's frame", words, panels)


def seen_from(clip: Clip, frame_from_world: RigidTransform) -> Clip:
    """The clip in a frame that moves: ``frame_from_world`` has one transform per frame."""

    def moved(track: Any, rotation: str, position: str) -> Any:
        rotvec, position_m = (getattr(track, name).astype(np.float64) for name in (rotation, position))
        pose = frame_from_world @ RigidTransform.from_rotvec(rotvec, position_m)
        values = {rotation: rotmat_to_rotvec(pose.rotation), position: pose.translation}
        return replace(track, **{name: array.astype(np.float32) for name, array in values.items()})

    hands = {side: moved(track, "global_orient", "wrist_m") for side, track in clip.hands.items()}
    return replace(clip, hands=hands, object=moved(clip.object, "rotvec", "translation_m"))
