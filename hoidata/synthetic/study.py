"""Making the corpus ``study``: grasps per object and region, shared by all verbs; then clips, drawn until sound."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from hoidata.errors import HoidataError
from hoidata.hands import HandPair, load_embedded_hands
from hoidata.synthetic.actions import DATASET_IDS
from hoidata.synthetic.catalogue import model_of
from hoidata.synthetic.grasps import Grip, PosedHands, Scene
from hoidata.synthetic.pools import search_pool
from hoidata.synthetic.sequences import Person, make_person
from hoidata.synthetic.soundness import measure
from hoidata.synthetic.study_objects import STUDY_OBJECTS, Region, StudyObject
from hoidata.synthetic.study_plan import HANDOVER, SCREWING, VERBS, StudyEntry, StudySize, choices, shares, study_plan
from hoidata.synthetic.study_sequences import Scenario, draw_hold, make_study_sequence, mirrored_grip
from hoidata.synthetic.truth import TruthSequence

# How often every grasp is tried for one clip, and how many there may be.
_TRIES, _MOST_GRASPS = 3, 8
# A verb that was added later comes after the others, whose clips stay as they are.
_VERB_STREAMS = (*sorted(VERBS.keys() - set(SCREWING)), *SCREWING)
_STREAM, _PERSON_STREAM, _POOL_STREAM = 5_000_000, 5_000_001, 5_000_002
_GRASPS, _ROUNDS = 3, 60
_HANDS_APART_M = 0.004
# How far the other hand is withdrawn when two hands that hand over are tested against each other.
_WITHDRAWN_M = (0.0, 0.03, 0.07)

# By subject, the grasps of a region: each with one grip per hand.
Grasps = dict[str, list[tuple[Grip, ...]]]


class PoolTask(NamedTuple):
    """One region of one object, for all subjects of a corpus."""

    dataset: str
    seed: int
    size: StudySize
    thing: int
    region: str


class ClipTask(NamedTuple):
    """All clips of one verb with one object by the same hands, with their positions in the plan and all they need."""

    dataset: str
    seed: int
    entries: list[tuple[int, StudyEntry]]
    people: dict[str, Person]
    grasps: dict[str, Grasps]


def people_of(dataset: str, seed: int, size: StudySize) -> dict[str, Person]:
    """The subjects of a corpus, each with hands of its own."""
    pair = load_embedded_hands()
    stream = [seed, DATASET_IDS[dataset], _PERSON_STREAM]
    return {
        name: make_person(dataset, name, pair, np.random.default_rng([*stream, _number(name)]))
        for name in shares(dataset, size)
    }


def _number(subject: str) -> int:
    return int(subject[1:])


def pool_tasks(dataset: str, seed: int, size: StudySize) -> list[PoolTask]:
    """One task per region that the plan uses."""
    things = STUDY_OBJECTS[dataset]
    used = {
        (entry.thing, region.name)
        for entry in study_plan(dataset, size)
        for region in choices(things[entry.thing], entry.verb, entry.hand)[entry.region]
    }
    return [PoolTask(dataset, seed, size, *key) for key in sorted(used)]


def find_grasps(task: PoolTask) -> Grasps:
    """Grasps at one region for every subject; none for a subject whose hand finds none there."""
    thing = STUDY_OBJECTS[task.dataset][task.thing]
    names = [region.name for region in thing.all_regions]
    region = thing.all_regions[names.index(task.region)]
    people = people_of(task.dataset, task.seed, task.size)
    stream = [task.seed, DATASET_IDS[task.dataset], _POOL_STREAM, task.thing, names.index(task.region)]
    scene = Scene(region.standing(thing.spec), model_of(thing.spec), region.hold.hinge_rad)
    betas = np.stack([person.betas for person in people.values()])
    found = search_pool(
        scene, region.hold, load_embedded_hands(), betas, np.random.default_rng(stream), _GRASPS, _ROUNDS, False
    )
    return dict(zip(people, found, strict=True))


def clip_tasks(dataset: str, seed: int, size: StudySize, pools: dict[tuple[int, str], Grasps]) -> list[ClipTask]:
    """One task per object, verb and hands. pools: by object and region."""
    people = people_of(dataset, seed, size)
    grouped: dict[tuple, list[tuple[int, StudyEntry]]] = {}
    for position, entry in enumerate(study_plan(dataset, size)):
        grouped.setdefault((entry.thing, entry.verb, entry.hand), []).append((position, entry))
    return [
        ClipTask(dataset, seed, entries, people, {name: own for (row, name), own in pools.items() if row == thing})
        for (thing, _, _), entries in grouped.items()
    ]


def make_clips(task: ClipTask) -> list[tuple[int, TruthSequence]]:
    """Every clip of one task, with its position in the plan."""
    pair = load_embedded_hands()
    return [(position, _sound_clip(task, entry, pair)) for position, entry in task.entries]


def _sound_clip(task: ClipTask, entry: StudyEntry, pair: HandPair) -> TruthSequence:
    """Draw until the whole clip is sound, with one grasp after the other; where a hand finds none at the region of the
    plan, at the next one. Raises HoidataError where no region has any."""
    thing, dataset = STUDY_OBJECTS[task.dataset][entry.thing], task.dataset
    stream = [task.seed, DATASET_IDS[dataset], _STREAM, entry.thing, _VERB_STREAMS.index(entry.verb)]
    rng = np.random.default_rng([*stream, _number(entry.subject), entry.number])
    person = task.people[entry.subject]
    ways = choices(thing, entry.verb, entry.hand)
    hold = draw_hold(entry.verb, rng)
    left = entry.hand == "left" or (entry.hand == "both" and bool(rng.random() < 0.5))
    grab_key = f"{entry.subject}/{thing.spec.name}_{VERBS[entry.verb].intent}_{entry.number}"
    key = grab_key if dataset == "grab" else entry.subject
    for regions in (*ways[entry.region :], *ways[: entry.region]):
        own = [task.grasps[region.name][entry.subject] for region in regions]
        grasps = own[0] if entry.verb != HANDOVER else _handovers(thing, regions, own, person, pair)
        grasps = grasps[:_MOST_GRASPS]
        first = int(rng.integers(max(1, len(grasps))))
        for attempt in range(_TRIES * len(grasps)):
            grips = grasps[(first + attempt) % len(grasps)]
            scenario = Scenario(dataset, thing, entry.verb, regions[0], grips, person, key, left)
            truth = make_study_sequence(scenario, hold, pair, rng)
            if measure(truth, pair).is_sound:
                return truth
    raise HoidataError(
        f"{dataset}: {entry.verb} {thing.spec.name} by {entry.subject} with {entry.hand}: nothing is sound"
    )


def _handovers(
    thing: StudyObject, regions: tuple[Region, ...], own: list[list[tuple[Grip, ...]]], person: Person, pair: HandPair
) -> list[tuple[Grip, ...]]:
    """Pairs of a right hand's grip and a left hand's at the other region that do not meet, nor on the way."""
    symmetry = thing.mirror(regions[1])
    given = [grip for (grip,) in own[0]]
    taken = [mirrored_grip(grip, symmetry) for (grip,) in own[1]]
    clouds = [_clouds(grips, person, pair) for grips in (given, taken)]
    return [
        (give, take)
        for give, gives in zip(given, clouds[0], strict=True)
        for take, takes in zip(taken, clouds[1], strict=True)
        if _apart(gives, takes)
    ]


def _clouds(grips: list[Grip], person: Person, pair: HandPair) -> list[list[np.ndarray]]:
    """Per grip the hand's vertices in the object's frame: closed, and open ever farther away."""
    if not grips:
        return []
    stages = [(0.0, "hand_pose"), *((away, "open_pose") for away in _WITHDRAWN_M)]
    meshes = []
    for away, pose in stages:
        hands = PosedHands(
            grips[0].side,
            np.stack([grip.wrist_m + away * grip.rotmat[:, 1] for grip in grips]),
            np.stack([grip.rotmat for grip in grips]),
            np.stack([getattr(grip, pose) for grip in grips]),
            np.stack([grip.open_pose for grip in grips]),
            np.repeat(person.betas[None], len(grips), axis=0),
        )
        meshes.append(hands.mesh(pair)[0])
    return [list(stack) for stack in zip(*meshes, strict=True)]


def _apart(gives: list[np.ndarray], takes: list[np.ndarray]) -> bool:
    """Whether each hand, coming or going, keeps clear of the other one while that holds."""
    pairs = [*((gives[0], mesh) for mesh in takes), *((takes[0], mesh) for mesh in gives[1:])]
    return all(KDTree(held).query(moving)[0].min() > _HANDS_APART_M for held, moving in pairs)
