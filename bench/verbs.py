"""Does what is typed act on a mug that no training clip shows?

``python -m bench verbs`` in a project that has trained the study corpus (``hoidata profile study``, ``hoidata repro``).
A generated mug, whose shape is new and whose word is not; every verb that the evaluator tells apart is typed with
either hand (those for two hands: with both), several seeds each (HOIDATA_BENCH_SEEDS). Counted: how often the
evaluator names the verb that was typed, how often training's clips of that verb move their objects most alike, how
often the object does what the verb says, and how often the hand of the words comes within 2 cm. Beside it guessing,
and the same motions taken for those of the next verb, which must fail. At the end what each verb did, in the mean, for
a person to compare.
"""

import os
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import trimesh

from bench.harness import show
from hoidata.actions.action import Actions, action_numbers, training_actions
from hoidata.annotation.encoders import load_encoder
from hoidata.annotation.hand_choice import PHRASES
from hoidata.annotation.settings import AnnotationSettings
from hoidata.clips.clip import SIDES, Clip, HandType, Side
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import HandPair, track_joints
from hoidata.metrics.pair import Motion
from hoidata.objects.model import ObjectModel
from hoidata.store.annotated import AnnotatedStore, load_annotated
from models.common.repeatable import make_repeatable
from models.evaluator.encoders import load_evaluator
from models.text2hoi.generation import GeneratedMotion, Generator, Wish
from pipelines.stages.base import StagePaths, load_hands, load_settings

SEEDS = int(os.environ.get("HOIDATA_BENCH_SEEDS", "5"))
NEAR_M = 0.02
SHOWN = ("rise_m", "sideways_m", "tilt_deg", "end_turn_deg", "reversals_per_s", "hand_changes")


class Made(NamedTuple):
    """One motion: the verb and hands that were typed, what it did in numbers, and the motion."""

    verb: str
    hand: HandType
    numbers: dict[str, float]
    clip: Clip
    near: dict[Side, bool]


def main() -> None:
    paths = StagePaths("study", "grab")
    if not (paths.evaluators / "info.json").is_file():
        print("no evaluators/study/grab here: type this in a project after hoidata profile study and hoidata repro")
        return
    make_repeatable(threads=1)
    hands = load_hands(paths.profile)
    encoder = load_encoder(load_settings(AnnotationSettings, "annotate").encoder)
    generator = Generator.load(paths.checkpoints, hands, encoder)
    annotated = load_annotated(paths.data, hands)
    judge = load_evaluator(paths.evaluators / "corrected")
    start = time.process_time()
    made = [one for verb in judge.labels for one in typed(verb, generator, annotated)]
    took = time.process_time() - start
    encoding = judge.encode([motion_of(one.clip, hands) for one in made], [acting(one.hand) for one in made])
    judged = [judge.labels[best] for best in encoding.logits.argmax(axis=1)]
    show_shares(made, judged, judge.labels, training_actions(annotated))
    means = [
        [verb, *(f"{np.mean([one.numbers[name] for one in made if one.verb == verb]):.2f}" for name in SHOWN)]
        for verb in judge.labels
    ]
    show("What the mug did, in the mean", ["typed", *SHOWN], means)
    print(f"{took / len(made):.2f} s of processor time a motion")


def show_shares(made: Sequence[Made], judged: Sequence[str], labels: Sequence[str], actions: Actions) -> None:
    """A row for every verb and one for all; judged: the verb that the evaluator takes each motion for."""
    following = dict(zip(labels, (*labels[1:], labels[0]), strict=True))
    rows = []
    for verb in (*labels, ""):
        mine = [pair for pair in zip(made, judged, strict=True) if verb in ("", pair[0].verb)]
        ones = [one for one, _ in mine]
        figures = [
            share(taken == one.verb for one, taken in mine),
            share(actions.named(one.numbers) == one.verb for one in ones),
            share(actions.followed(one.verb, one.numbers) is True for one in ones),
            share(taken == following[one.verb] for one, taken in mine),
            share(all(one.near[side] for side in acting(one.hand)) for one in ones),
            share(any(one.near[side] for side in SIDES if side not in acting(one.hand)) for one in ones),
        ]
        wrong = Counter(taken for one, taken in mine if taken != one.verb)
        others = ", ".join(f"{name} {count}" for name, count in wrong.most_common(3)) if verb else ""
        rows.append([verb or "all", str(len(mine)), *figures, others])
    rows.append(["by guessing", "", *[f"{1 / len(labels):.2f}"] * 2, "", "", "", "", ""])
    heads = [
        "typed",
        "motions",
        "evaluator",
        "object's motion",
        "follows",
        "next verb's",
        "hand within 2 cm",
        "other hand",
    ]
    show("What was typed for a mug nobody trained on", [*heads, "taken for"], rows)


def typed(verb: str, generator: Generator, annotated: AnnotatedStore) -> list[Made]:
    """The motions of one verb: with either hand, or with both where training's clips of it mostly have both."""
    types = annotated.hand_types
    usual = Counter(types.loc[(types["verb"] == verb) & types.index.isin(annotated.ids("train")), "hand_type"])
    hands: Sequence[HandType] = ("both",) if usual.most_common(1)[0][0] == "both" else ("right", "left")
    mug = generated_mug()
    found = []
    for hand in hands:
        sentence = f"{verb.capitalize()} a mug {PHRASES[hand]}."
        wishes = (Wish(seed) for seed in range(SEEDS * (3 - len(hands))))
        found += [
            measured(verb, hand, own, generator.hands, annotated.contact_threshold_m)
            for wish in wishes
            for own in generator.generate(sentence, mug, wish, "mug")
        ]
    return found


def measured(verb: str, hand: HandType, made: GeneratedMotion, hands: HandPair, threshold_m: float) -> Made:
    clip, index = made.clip, ProximityIndex(made.points)
    touching, near = np.zeros((len(SIDES), clip.n_frames), bool), {}
    for row, side in enumerate(SIDES):
        joints, valid = track_joints(clip.hands[side], hands[side]), clip.hands[side].valid
        touching[row, index.entries(joints, valid, clip.object, threshold_m)["frame"]] = True
        near[side] = bool((index.closest_m(joints, clip.object)[valid] <= NEAR_M).any())
    return Made(verb, hand, action_numbers(clip.object, clip.gravity, touching), clip, near)


def acting(hand: HandType) -> tuple[Side, ...]:
    return tuple(side for side in SIDES if hand in (side, "both"))


def motion_of(clip: Clip, hands: HandPair) -> Motion:
    return Motion(clip, {side: track_joints(clip.hands[side], hands[side]) for side in SIDES}, hands)


def generated_mug() -> ObjectModel:
    """8 cm wide, 9.5 cm high, walls of 4 mm, with a handle; upright, its middle at the origin."""
    outline = np.array([[0, 0], [0.04, 0], [0.04, 0.095], [0.036, 0.095], [0.036, 0.004], [0, 0.004]])
    cup = trimesh.creation.revolve(outline, sections=48)
    handle = trimesh.creation.torus(0.025, 0.005, major_sections=32, minor_sections=16)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    handle.apply_translation([0.052, 0, 0.048])
    mesh = trimesh.util.concatenate([cup, handle])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return ObjectModel("mug", np.array(mesh.vertices), np.array(mesh.faces), np.zeros(len(mesh.vertices), np.uint8))


def share(found: Iterable[bool]) -> str:
    values = list(found)
    return f"{np.mean(values):.2f}" if values else "-"


if __name__ == "__main__":
    main()
