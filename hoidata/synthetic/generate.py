"""Making the sequences of one corpus: grasps per action, then actions until each is sound. Any number of jobs."""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from hoidata.errors import HoidataError
from hoidata.hands import HandPair, load_embedded_hands
from hoidata.synthetic.actions import ACTIONS
from hoidata.synthetic.catalogue import object_model, object_spec
from hoidata.synthetic.grasps import Scene
from hoidata.synthetic.plan import DATASET_IDS, Entry, Size, plan, subjects
from hoidata.synthetic.pools import GRASPS_PER_PAIR, GraspPool, search_pool
from hoidata.synthetic.sequences import Person, draw_length, make_person, make_sequence
from hoidata.synthetic.soundness import measure
from hoidata.synthetic.truth import TruthSequence

_ATTEMPTS = 18
_PERSON_STREAM, _POOL_STREAM = 1_000_001, 1_000_002


class _Task(NamedTuple):
    dataset: str
    seed: int
    size: Size
    action: int
    entries: list[tuple[int, Entry]]


def generate_sequences(dataset: str, seed: int, size: Size = "full", jobs: int = 1) -> list[TruthSequence]:
    """All actions of a corpus as truth, in plan order; equal for equal arguments, whatever ``jobs`` is.

    Raises HoidataError where an action cannot be made sound.
    """
    with worker_pool(jobs) as run:
        return place_in_raw_sequences(dataset, [truth for _, truth in _generated(dataset, seed, size, run)])


def _generated(dataset: str, seed: int, size: Size, run) -> list[tuple[int, TruthSequence]]:
    tasks = tasks_of(dataset, seed, size)
    return sorted((pair for made in run(make_action, tasks) for pair in made), key=lambda pair: pair[0])


def tasks_of(dataset: str, seed: int, size: Size) -> list[_Task]:
    """One task per action of the plan: they share nothing, so any process may do any of them."""
    by_action: dict[int, list[tuple[int, Entry]]] = {}
    for position, entry in enumerate(plan(dataset, size)):
        by_action.setdefault(entry.action, []).append((position, entry))
    return [_Task(dataset, seed, size, action, entries) for action, entries in by_action.items()]


def make_action(task: _Task) -> list[tuple[int, TruthSequence]]:
    """Every sequence of one action, with its position in the plan."""
    pair = load_embedded_hands()
    names = subjects(task.dataset, task.size)
    people = {name: _person(task.dataset, task.seed, name, pair) for name in names}
    used = sorted({entry.subject for _, entry in task.entries}, key=names.index)
    pool = _pool(task, [people[name] for name in used], pair)
    return [
        (position, _sound_sequence(task, entry, people[entry.subject], pool.grips[used.index(entry.subject)], pair))
        for position, entry in task.entries
    ]


def _person(dataset: str, seed: int, subject: str, pair: HandPair) -> Person:
    number = int("".join(filter(str.isdigit, subject)))
    return make_person(
        dataset, subject, pair, np.random.default_rng([seed, DATASET_IDS[dataset], _PERSON_STREAM, number])
    )


def _pool(task: _Task, people: list[Person], pair: HandPair) -> GraspPool:
    action = ACTIONS[task.dataset][task.action]
    scene = Scene(
        object_spec(task.dataset, action.object_name),
        object_model(task.dataset, action.object_name),
        action.hold.hinge_rad,
    )
    rng = np.random.default_rng([task.seed, DATASET_IDS[task.dataset], _POOL_STREAM, task.action])
    return search_pool(scene, action.hold, pair, np.stack([person.betas for person in people]), rng)


def _sound_sequence(task: _Task, entry: Entry, person: Person, grips, pair: HandPair) -> TruthSequence:
    """Draw until the whole action is sound: start, size of the path, the grasp (usual ones first, then reserves)."""
    dataset, action = task.dataset, ACTIONS[task.dataset][task.action]
    spec, model = object_spec(dataset, action.object_name), object_model(dataset, action.object_name)
    number = int("".join(filter(str.isdigit, entry.subject)))
    rng = np.random.default_rng([task.seed, DATASET_IDS[dataset], entry.action, number, entry.number])
    length = draw_length(dataset, action.verb, rng)
    usual = grips[:GRASPS_PER_PAIR]
    order = [*(usual[(entry.number + turn) % len(usual)] for turn in range(len(usual))), *grips[GRASPS_PER_PAIR:]]
    for attempt in range(_ATTEMPTS):
        grip = order[attempt % len(order)]
        truth = make_sequence(dataset, action, spec, model, grip, person, _key(task, entry), length, rng)
        if measure(truth, pair).is_sound:
            return truth
    raise HoidataError(
        f"{dataset}: {action.verb} {action.object_name} by {entry.subject} is not sound after {_ATTEMPTS} draws"
    )


def _key(task: _Task, entry: Entry) -> str:
    action = ACTIONS[task.dataset][task.action]
    return (
        f"{entry.subject}/{action.object_name}_{action.intent}_{entry.number}"
        if task.dataset == "grab"
        else entry.subject
    )


_PLACES = ("h1", "h2", "k1", "k2", "o1", "o2")
_RUNS_PER_SEQUENCE = 3
GAP_FRAMES = 6


def place_in_raw_sequences(dataset: str, sequences: list[TruthSequence]) -> list[TruthSequence]:
    """Give every action its raw sequence and its first frame there: H2O and ARCTIC sequences hold several actions."""
    if dataset == "grab":
        return sequences
    groups: dict[str, list[int]] = {}
    for index, truth in enumerate(sequences):
        owner = truth.subject if dataset == "h2o" else f"{truth.subject}/{truth.object_name}"
        groups.setdefault(owner, []).append(index)
    placed = list(sequences)
    for owner, members in groups.items():
        for chunk, start in enumerate(range(0, len(members), _RUNS_PER_SEQUENCE)):
            key = f"{owner}/{_PLACES[chunk // 7]}/{chunk % 7}" if dataset == "h2o" else _arctic_key(owner, chunk)
            frame = GAP_FRAMES
            for index in members[start : start + _RUNS_PER_SEQUENCE]:
                placed[index] = replace(sequences[index], source_key=key, raw_start=frame)
                frame += sequences[index].n_frames + GAP_FRAMES
    return placed


def _arctic_key(owner: str, chunk: int) -> str:
    return f"{owner}_{'use' if chunk % 2 == 0 else 'grab'}_{chunk // 2 + 1:02d}"


@contextmanager
def worker_pool(jobs: int) -> Iterator:
    """A function that maps a task function over tasks, results in order: here, or in ``jobs`` fresh processes."""
    if jobs <= 1:
        yield lambda function, tasks: map(function, tasks)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_one_thread) as executor:
        yield executor.map


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)
