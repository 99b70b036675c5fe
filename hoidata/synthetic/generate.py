"""Generates the sequences of an embedded corpus: grasps for each action, then rejection sampling of motions."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hoidata.errors import HoidataError
from hoidata.hands import HandPair, load_embedded_hands
from hoidata.synthetic.actions import ACTIONS, DATASET_IDS, Entry, Size, plan, subjects
from hoidata.synthetic.catalogue import object_model, object_spec
from hoidata.synthetic.grasps import GRASPS_PER_PAIR, Grip, Scene, search_pool
from hoidata.synthetic.sequences import Person, make_person, make_sequence, sample_length
from hoidata.synthetic.soundness import is_sound
from hoidata.synthetic.truth import TruthSequence

_ATTEMPTS = 18
_PERSON_STREAM, _POOL_STREAM = 1_000_001, 1_000_002


class _Task(NamedTuple):
    dataset: str
    seed: int
    size: Size
    action: int
    entries: list[tuple[int, Entry]]


def tasks_of(dataset: str, seed: int, size: Size) -> list[_Task]:
    """Return one task per action of the plan. Tasks are independent, so processes can share them."""
    by_action: dict[int, list[tuple[int, Entry]]] = {}
    for position, entry in enumerate(plan(dataset, size)):
        by_action.setdefault(entry.action, []).append((position, entry))
    return [_Task(dataset, seed, size, action, entries=entries) for action, entries in by_action.items()]


def make_action(task: _Task) -> list[tuple[int, TruthSequence]]:
    """Generate the sequences of one action, with their positions in the plan."""
    pair, stream = load_embedded_hands(), [task.seed, DATASET_IDS[task.dataset]]
    order = subjects(task.dataset, task.size)
    names = sorted({entry.subject for _, entry in task.entries}, key=order.index)
    people = [
        make_person(task.dataset, name, pair, np.random.default_rng([*stream, _PERSON_STREAM, subject_number(name)]))
        for name in names
    ]
    action = ACTIONS[task.dataset][task.action]
    spec, model = object_spec(task.dataset, action.object_name), object_model(task.dataset, action.object_name)
    rng = np.random.default_rng([*stream, _POOL_STREAM, task.action])
    betas = np.stack([person.betas for person in people])
    pool = search_pool(Scene(spec, model, action.grasp.hinge_rad), action.grasp, pair, betas, rng)
    drawn = dict(zip(names, zip(people, pool, strict=True), strict=True))
    return [(position, _sound_sequence(task, entry, *drawn[entry.subject], pair)) for position, entry in task.entries]


def subject_number(subject: str) -> int:
    return int("".join(filter(str.isdigit, subject)))


def _sound_sequence(
    task: _Task, entry: Entry, person: Person, grips: list[tuple[Grip, ...]], pair: HandPair
) -> TruthSequence:
    """Sample start, path size and grasp until the action is plausible. Reserve grasps come last.

    Hands move less within the grasp in later attempts.
    """
    dataset, action = task.dataset, ACTIONS[task.dataset][task.action]
    spec, model = object_spec(dataset, action.object_name), object_model(dataset, action.object_name)
    rng = np.random.default_rng(
        [task.seed, DATASET_IDS[dataset], entry.action, subject_number(entry.subject), entry.number]
    )
    length = sample_length(dataset, action.verb, rng)
    grab_key = f"{entry.subject}/{action.object_name}_{action.intent}_{entry.number}"
    key = grab_key if dataset == "grab" else entry.subject
    usual = grips[:GRASPS_PER_PAIR]
    order = [*(usual[(entry.number + number) % len(usual)] for number in range(len(usual))), *grips[GRASPS_PER_PAIR:]]
    for attempt in range(_ATTEMPTS):
        grip = order[attempt % len(order)]
        play = 1 - attempt / (_ATTEMPTS - 1)
        truth = make_sequence(dataset, action, spec, model, grip, person, key, length, pair, play, rng)
        if is_sound(truth, pair):
            return truth
    action_words = f"{action.verb} {action.object_name} by {entry.subject}"
    raise HoidataError(f"{dataset}: {action_words} is not plausible after {_ATTEMPTS} attempts")


_ARCTIC_KINDS = ("use", "grab")
_H2O_ROOMS = ("h1", "h2", "k1", "k2", "o1", "o2")
_RUNS_PER_SEQUENCE = 3
GAP_FRAMES = 6


def place_in_raw_sequences(dataset: str, generated: list[tuple[int, TruthSequence]]) -> list[TruthSequence]:
    """Assign a raw sequence and a first frame to each action; returns the actions in the order of the plan.

    Raw sequences of H2O and ARCTIC have several actions. generated: actions with their positions in the plan.
    """
    sequences = [truth for _, truth in sorted(generated, key=lambda pair: pair[0])]
    if dataset == "grab":
        return sequences
    groups: dict[str, list[int]] = {}
    for index, truth in enumerate(sequences):
        owner = truth.subject if dataset == "h2o" else f"{truth.subject}/{truth.object_name}"
        groups.setdefault(owner, []).append(index)
    placed = list(sequences)
    for owner, members in groups.items():
        for chunk, start in enumerate(range(0, len(members), _RUNS_PER_SEQUENCE)):
            h2o_key = f"{owner}/{_H2O_ROOMS[chunk // 7]}/{chunk % 7}"
            key = h2o_key if dataset == "h2o" else f"{owner}_{_ARCTIC_KINDS[chunk % 2]}_{chunk // 2 + 1:02d}"
            frame = GAP_FRAMES
            for index in members[start : start + _RUNS_PER_SEQUENCE]:
                placed[index] = replace(sequences[index], source_key=key, raw_start=frame)
                frame += sequences[index].n_frames + GAP_FRAMES
    return placed
