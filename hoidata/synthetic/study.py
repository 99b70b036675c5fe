"""Making the corpus ``study``: grasps per object and region, shared by all verbs; then clips, drawn until sound."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from hoidata.clips.clip import FPS, SIDES, HandTrack, ObjectTrack, Side
from hoidata.errors import HoidataError
from hoidata.geometry.rotations import mirror_rotvec_x, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import HandPair, load_embedded_hands, track_joints
from hoidata.synthetic.actions import DATASET_IDS
from hoidata.synthetic.catalogue import model_of
from hoidata.synthetic.grasps import Grip, PosedHands, Scene
from hoidata.synthetic.paths import ObjectPath, follow_path, minimum_jerk
from hoidata.synthetic.pools import search_pool
from hoidata.synthetic.sequences import (
    HELD_ABOVE_M,
    SOURCE_FPS,
    Pace,
    Person,
    Span,
    acting_hand,
    hand_track,
    idle_hand,
    lowest_point,
    make_person,
    object_pose,
)
from hoidata.synthetic.soundness import measure, vertex_distances_m
from hoidata.synthetic.study_objects import ANGLES, STUDY_OBJECTS, Region, StudyObject
from hoidata.synthetic.study_plan import HANDOVER, SCREWING, VERBS, StudyEntry, StudySize, choices, shares, study_plan
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


PACE = Pace(approach=14, close=7, open=6, retreat=12)
# 30 fps frames of a clip before and after the contact; GRAB's adapter is set to the same margin.
MARGIN = 15
SHORTEST_HOLD, LONGEST_HOLD = 26, 116
_SPEEDS = (0.75, 1.0, 1.3)
# How uneven the pace of a motion may be; the sway of a carried object, full from that height on; and the turn of one
# that is moved aside, full from that distance on.
_HURRY = 0.2
_SWAY_M, _SWAY_DEG, _CARRIED_M = 0.003, 2.0, 0.06
_TURNED_DEG, _FAR_ASIDE_M = 12.0, 0.15
# When one hand leaves and the other has come, as shares of the time the object is held.
_RECEIVED, _RELEASED = 0.42, 0.58
MIRROR = np.array([-1.0, 1.0, 1.0])
# How far an idle hand keeps from the object and from the other hand's joints, and how often it rests or passes near.
_RESTING_M, _PASSING_M = (0.035, 0.08), (0.035, 0.055)
_RESTS, _PASSES = 0.45, 0.15
_PASS_FRAMES = 18.0
_FAR_M = 0.5
# From an object to the wrist of a flat hand over it, before that is moved aside; how far a passing hand comes from.
_HAND_BEHIND_M, _PASSING_BY_M = np.array([0.0, -0.09, 0.0]), 0.28
# A resting hand drifts by this share of what a far one does.
_DRIFT = 0.3
# A hand that does nothing rests on the table, not in it.
_RAISED_M = np.array([0.0, 0.0, 0.1])


@dataclass(frozen=True)
class Scenario:
    """What is to be made: which object, how it stands and is held, by whom. left: seen in a mirror."""

    dataset: str
    thing: StudyObject
    verb: str
    region: Region
    grips: tuple[Grip, ...]
    person: Person
    source_key: str
    left: bool


def draw_hold(verb: str, rng: np.random.Generator) -> float:
    """How long the object is held, in 30 fps frames: slow, usual or quick for its verb."""
    length = VERBS[verb].length * rng.choice(_SPEEDS) * (1 + 0.06 * np.clip(rng.normal(), -2, 2))
    return float(np.clip(round(length), SHORTEST_HOLD, LONGEST_HOLD))


def make_study_sequence(scenario: Scenario, hold: float, pair: HandPair, rng: np.random.Generator) -> TruthSequence:
    """The clip at the source's frame rate; everything random comes from ``rng``."""
    dataset, thing, person = scenario.dataset, scenario.thing, scenario.person
    fps = SOURCE_FPS[dataset]
    fine = fps // FPS
    start = PACE.approach + PACE.close + (int(rng.integers(fine)) / fine if fine > 1 else 0.0)
    stop = start + hold
    times = np.arange(int(np.floor((stop + PACE.open + PACE.retreat) * fine)) + 1) / fine
    spec, model = scenario.region.standing(thing.spec), model_of(thing.spec)
    rotmats, translation, hinge = _object_motion(scenario, times, start, hold, rng)
    track = ObjectTrack(model, rotmat_to_rotvec(rotmats), translation, hinge)
    spans = _spans(scenario, start, hold)
    hands: dict[Side, HandTrack] = {
        grip.side: acting_hand(grip, person, track, rotmats, times, spans[grip.side], PACE) for grip in scenario.grips
    }
    if len(hands) == 1:
        hands["left"] = _idle_hand(person, track, hands["right"], times, (start, stop), pair, rng)
    firm: dict[Side, tuple[int, int]] = {
        side: (round(span[0] * fine), round(span[1] * fine) + 1) for side, span in spans.items()
    }
    first, last = min(span[0] for span in firm.values()), max(span[1] for span in firm.values())
    truth = TruthSequence(
        dataset=dataset, subject=person.subject, source_key=scenario.source_key, raw_start=0, source_fps=fps,
        verb=scenario.verb, object_name=spec.name, object_words=spec.words, intent=VERBS[scenario.verb].intent,
        hand_type="both" if len(spans) == 2 else "right", hands=hands, object=track,
        clip=(max(0, first - MARGIN * fine), min(len(times), last + MARGIN * fine)), contact=(first, last),
        held=lowest_point(track) > spec.stand_m + HELD_ABOVE_M, stand_m=spec.stand_m, firm=firm,
    )  # fmt: skip
    return mirrored(truth, person, thing.mirror(scenario.region)) if scenario.left else truth


def _object_motion(scenario: Scenario, times: np.ndarray, start: float, hold: float, rng: np.random.Generator):
    """World-from-object rotations and translations, and the hinge angles of an object that has a lid."""
    thing, verb = scenario.thing, VERBS[scenario.verb]
    motion = verb.motion_of("both" if len(scenario.grips) == 2 else "right")
    size, turn_size = rng.uniform(0.85, 1.15, 2)
    if scenario.verb == "turn":
        turn_size *= rng.choice((-1.0, 1.0))
    elif scenario.verb in SCREWING and scenario.left:
        turn_size = -turn_size
    path = follow_path(motion, _hurried(times, start, hold, rng), start, hold, False, float(size), float(turn_size))
    heading = np.deg2rad(rng.uniform(-verb.heading_deg, verb.heading_deg))
    path = path._replace(shift_m=path.shift_m @ rotvec_to_rotmat(np.array([0.0, 0.0, heading])).T)
    path = _unsteady(path, times, rng)._replace(hinge_rad=_hinge(path, scenario.verb, rng))
    spec, model = scenario.region.standing(thing.spec), model_of(thing.spec)
    rotmats, translation = object_pose(spec, model, path, rng)
    return rotmats, translation, path.hinge_rad if model.is_articulated else None


def _hurried(times: np.ndarray, start: float, hold: float, rng: np.random.Generator) -> np.ndarray:
    """The times at which the path is read: some people hurry first, others last."""
    phase = (times - start) / hold
    inside = np.clip(phase, 0.0, 1.0)
    return times + hold * rng.uniform(-_HURRY, _HURRY) * inside * (1 - inside)


def _unsteady(path: ObjectPath, times: np.ndarray, rng: np.random.Generator) -> ObjectPath:
    """A hand that carries sways a little and slowly, and what is moved aside comes to stand a little turned."""
    rate_hz, phase = rng.uniform(0.2, 0.6, (2, 6)), rng.uniform(0, 2 * np.pi, (2, 6))
    waves = np.sin(2 * np.pi * times[:, None, None] / FPS * rate_hz + phase).sum(axis=1) / np.sqrt(2)
    carried = minimum_jerk(path.shift_m[:, 2:] / _CARRIED_M)
    aside = np.linalg.norm(path.shift_m[:, :2], axis=1)
    turned = np.deg2rad(rng.uniform(-_TURNED_DEG, _TURNED_DEG)) * aside / max(_FAR_ASIDE_M, aside.max())
    return path._replace(
        shift_m=path.shift_m + _SWAY_M * carried * waves[:, :3],
        turn_rad=path.turn_rad + np.deg2rad(_SWAY_DEG) * carried * waves[:, 3:] + turned[:, None] * [0.0, 0.0, 1.0],
    )


def _hinge(path: ObjectPath, verb: str, rng: np.random.Generator) -> np.ndarray:
    """Shares of the way as angles; a lid that nobody moves is shut."""
    low, high = ANGLES[0] + rng.uniform(0, 0.06), ANGLES[-1] - rng.uniform(0, 0.06)
    return low + (high - low) * path.hinge_rad if verb in ("open", "close") else np.zeros_like(path.hinge_rad)


def _spans(scenario: Scenario, start: float, hold: float) -> dict[Side, Span]:
    """When each hand holds; the right hand hands over to the left."""
    if scenario.verb == HANDOVER:
        return {"right": (start, start + _RELEASED * hold), "left": (start + _RECEIVED * hold, start + hold)}
    return {grip.side: (start, start + hold) for grip in scenario.grips}


def _idle_hand(
    person: Person, track: ObjectTrack, acting: HandTrack, times: np.ndarray, contact: Span, pair: HandPair, rng
) -> HandTrack:
    """The left hand: far away, resting on the table beside the object, or passing it."""
    far = idle_hand("left", person, len(times), rng, True)
    far = replace(far, wrist_m=far.wrist_m + _RAISED_M)
    kind = rng.random()
    angle, target = np.deg2rad(rng.uniform(150, 230)), rng.uniform(*(_RESTING_M if kind < _RESTS else _PASSING_M))
    yaw = rotvec_to_rotmat(np.array([0.0, 0.0, np.deg2rad(rng.uniform(-40, 25))]))
    middle, height = contact[0] + rng.uniform(0.3, 0.7) * (contact[1] - contact[0]), rng.uniform(0.035, 0.06)
    if kind >= _RESTS + _PASSES:
        return far
    away = np.array([np.cos(angle), np.sin(angle), 0.0])
    path = np.array([*track.translation_m[0, :2], height]) + _HAND_BEHIND_M + _DRIFT * (far.wrist_m - far.wrist_m[0])
    if kind >= _RESTS:
        here = minimum_jerk(1 - np.abs(times - middle) / _PASS_FRAMES)
        path = path + _PASSING_BY_M * (1 - here)[:, None] * away + [0.0, 0.0, rng.uniform(0.0, 0.12)]
    orient = rotmat_to_rotvec(yaw @ rotvec_to_rotmat(far.global_orient))
    near = hand_track(person, "left", path, orient, far.hand_pose, True)
    return replace(near, wrist_m=path + _clear_reach(near, away, track, acting, pair, target) * away)


def _clear_reach(
    hand: HandTrack, away: np.ndarray, track: ObjectTrack, acting: HandTrack, pair: HandPair, target: float
) -> float:
    """How far ``hand`` must be moved along ``away`` to keep ``target`` metres from object and acting hand."""
    frames = np.arange(0, hand.n_frames, max(1, hand.n_frames // 40))
    joints = track_joints(hand.take(frames), pair["left"]).astype(np.float64)
    other = track_joints(acting.take(frames), pair["right"]).astype(np.float64)
    seen = track.take(frames)
    for reach in np.arange(0.0, _FAR_M, 0.01):
        moved = joints + reach * away
        apart = np.linalg.norm(moved[:, :, None] - other[:, None], axis=-1).min()
        if apart >= target and vertex_distances_m(seen, moved).min() >= target:
            return float(reach)
    return _FAR_M


def mirrored(truth: TruthSequence, person: Person, symmetry: np.ndarray) -> TruthSequence:
    """The same seen in a mirror with normal x; ``symmetry`` (3, 3) maps the object to itself (StudyObject.mirror)."""
    other: dict[Side, Side] = {"left": "right", "right": "left"}
    hands: dict[Side, HandTrack] = {}
    for side, hand in truth.hands.items():
        pose = mirror_rotvec_x(hand.hand_pose.reshape(-1, 15, 3)).reshape(-1, 45)
        hands[other[side]] = hand_track(
            person, other[side], hand.wrist_m * MIRROR, mirror_rotvec_x(hand.global_orient), pose, True
        )
    track = truth.object
    rotmats = np.diag(MIRROR) @ rotvec_to_rotmat(track.rotvec) @ symmetry.T
    hand_type = truth.hand_type if truth.hand_type == "both" else other[truth.hand_type]
    return replace(
        truth,
        hands={side: hands[side] for side in SIDES},
        hand_type=hand_type,
        object=replace(track, rotvec=rotmat_to_rotvec(rotmats), translation_m=track.translation_m * MIRROR),
        firm={other[side]: span for side, span in truth.firm.items()},
    )


def mirrored_grip(grip: Grip, symmetry: np.ndarray) -> Grip:
    """A right hand's grip as the left hand's on the mirrored object."""
    mirror = np.diag(MIRROR)
    pose, opened = (mirror_rotvec_x(one.reshape(-1, 15, 3)).reshape(-1, 45) for one in (grip.hand_pose, grip.open_pose))
    return Grip("left", symmetry @ grip.wrist_m, symmetry @ grip.rotmat @ mirror, pose, opened, grip.part)
