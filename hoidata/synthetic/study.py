"""Generates the corpus ``study``: grasps by object and region, then rejection sampling of clips."""

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
from hoidata.synthetic.generate import subject_number
from hoidata.synthetic.grasps import MIRROR, Grip, PosedHands, Scene, mirrored_pose, search_pool
from hoidata.synthetic.paths import ObjectPath, follow_path, minimum_jerk, with_sway
from hoidata.synthetic.sequences import (
    LIFTED_ABOVE_M,
    SOURCE_FPS,
    Pace,
    Person,
    Span,
    grasp_play,
    grasping_hand,
    grasps_of,
    hand_track,
    idle_hand,
    make_person,
    object_pose,
    recorded_hand,
    recorded_object,
    released_frames,
    sample_release,
)
from hoidata.synthetic.soundness import is_sound, vertex_distances_m
from hoidata.synthetic.study_plan import (
    ANGLES,
    HANDOVER,
    SCREWING,
    STUDY_OBJECTS,
    VERBS,
    Region,
    StudyEntry,
    StudyObject,
    StudySize,
    choices,
    shares,
    study_plan,
)
from hoidata.synthetic.truth import TruthSequence

_MAX_GRASPS = 8  # for one clip
# Scales of the motion within the grasp and of the noise, of successive attempts with all grasps.
_PLAYS = (1.0, 0.6, 0.3, 0.0, 0.0, 0.0)
# Verbs of SCREWING come last, so that the random numbers of the other verbs do not depend on them.
_VERB_STREAMS = (*sorted(VERBS.keys() - set(SCREWING)), *SCREWING)
_STREAM, _PERSON_STREAM, _POOL_STREAM = 5_000_000, 5_000_001, 5_000_002
_GRASPS, _ROUNDS = 3, 60
_HANDS_APART_M = 0.004
# Distances of the retreating hand when two hands of a handover are tested against each other.
_WITHDRAWN_M = (0.0, 0.03, 0.07)

# By subject, the grasps of a region, each with one grip per hand.
Grasps = dict[str, list[tuple[Grip, ...]]]


class PoolTask(NamedTuple):
    """One region of one object, for all subjects of a corpus."""

    dataset: str
    seed: int
    size: StudySize
    object_index: int
    region: str


class ClipTask(NamedTuple):
    """All clips of one verb with one object by the same hands."""

    dataset: str
    seed: int
    entries: list[tuple[int, StudyEntry]]  # with positions in the plan
    people: dict[str, Person]
    grasps: dict[str, Grasps]  # by region


def people_of(dataset: str, seed: int, size: StudySize) -> dict[str, Person]:
    """Return the subjects of a corpus, each with individual hands."""
    pair = load_embedded_hands()
    stream = [seed, DATASET_IDS[dataset], _PERSON_STREAM]
    return {
        name: make_person(dataset, name, pair, np.random.default_rng([*stream, subject_number(name)]))
        for name in shares(dataset, size)
    }


def pool_tasks(dataset: str, seed: int, size: StudySize) -> list[PoolTask]:
    """Return one task per region that the plan uses."""
    objects = STUDY_OBJECTS[dataset]
    used = {
        (entry.object_index, region.name)
        for entry in study_plan(dataset, size)
        for region in choices(objects[entry.object_index], entry.verb, entry.hand)[entry.region]
    }
    return [PoolTask(dataset, seed, size, *key) for key in sorted(used)]


def find_grasps(task: PoolTask) -> Grasps:
    """Search grasps at one region for each subject. A subject may have none."""
    study_object = STUDY_OBJECTS[task.dataset][task.object_index]
    names = [region.name for region in study_object.all_regions]
    region = study_object.all_regions[names.index(task.region)]
    people = people_of(task.dataset, task.seed, task.size)
    stream = [task.seed, DATASET_IDS[task.dataset], _POOL_STREAM, task.object_index, names.index(task.region)]
    scene = Scene(region.standing(study_object.spec), model_of(study_object.spec), region.grasp.hinge_rad)
    betas, rng = np.stack([person.betas for person in people.values()]), np.random.default_rng(stream)
    grasps = search_pool(scene, region.grasp, load_embedded_hands(), betas, rng, _GRASPS, _ROUNDS, complete=False)
    return dict(zip(people, grasps, strict=True))


def clip_tasks(dataset: str, seed: int, size: StudySize, pools: dict[tuple[int, str], Grasps]) -> list[ClipTask]:
    """Return one task per object, verb and hands. pools: grasps by object index and region."""
    people = people_of(dataset, seed, size)
    grouped: dict[tuple, list[tuple[int, StudyEntry]]] = {}
    grasps_of_object: dict[int, dict[str, Grasps]] = {}
    for position, entry in enumerate(study_plan(dataset, size)):
        grouped.setdefault((entry.object_index, entry.verb, entry.hand), []).append((position, entry))
    for (index, region), grasps in pools.items():
        grasps_of_object.setdefault(index, {})[region] = grasps
    tasks = [(entries, people, grasps_of_object[index]) for (index, _, _), entries in grouped.items()]
    return [ClipTask(dataset, seed, *task) for task in tasks]


def make_clips(task: ClipTask) -> list[tuple[int, TruthSequence]]:
    """Generate the clips of one task, with their positions in the plan."""
    pair = load_embedded_hands()
    return [(position, _sound_clip(task, entry, pair)) for position, entry in task.entries]


def _sound_clip(task: ClipTask, entry: StudyEntry, pair: HandPair) -> TruthSequence:
    """Sample clips, with one grasp after the other, until one is plausible.

    If no grasp of the planned region succeeds, the next region is used. Raises HoidataError if none succeeds.
    """
    study_object, dataset = STUDY_OBJECTS[task.dataset][entry.object_index], task.dataset
    stream = [task.seed, DATASET_IDS[dataset], _STREAM, entry.object_index, _VERB_STREAMS.index(entry.verb)]
    rng = np.random.default_rng([*stream, subject_number(entry.subject), entry.number])
    person = task.people[entry.subject]
    region_choices = choices(study_object, entry.verb, entry.hand)
    contact_frames = sample_contact_frames(entry.verb, rng)
    left = entry.hand == "left" or (entry.hand == "both" and bool(rng.random() < 0.5))
    grab_key = f"{entry.subject}/{study_object.spec.name}_{VERBS[entry.verb].intent}_{entry.number}"
    key = grab_key if dataset == "grab" else entry.subject
    for regions in (*region_choices[entry.region :], *region_choices[: entry.region]):
        region_grasps = [task.grasps[region.name][entry.subject] for region in regions]
        is_handover = entry.verb == HANDOVER
        grasps = _handovers(study_object, regions, region_grasps, person, pair) if is_handover else region_grasps[0]
        grasps = grasps[:_MAX_GRASPS]
        first = int(rng.integers(max(1, len(grasps))))
        for attempt in range(len(_PLAYS) * len(grasps)):
            grips = grasps[(first + attempt) % len(grasps)]
            scenario = Scenario(dataset, study_object, entry.verb, regions[0], grips, person, source_key=key, left=left)
            truth = make_study_sequence(scenario, contact_frames, pair, _PLAYS[attempt // len(grasps)], rng)
            if is_sound(truth, pair):
                return truth
    action_words = f"{entry.verb} {study_object.spec.name} by {entry.subject} with {entry.hand}"
    raise HoidataError(f"{dataset}: {action_words}: no plausible clip")


def _handovers(
    study_object: StudyObject,
    regions: tuple[Region, ...],
    region_grasps: list[list[tuple[Grip, ...]]],
    person: Person,
    pair: HandPair,
) -> list[tuple[Grip, ...]]:
    """Return pairs of a right and a left hand's grip that do not collide, also while approaching and retreating."""
    symmetry = study_object.mirror(regions[1])
    giving = [grip for (grip,) in region_grasps[0]]
    taking = [mirrored_grip(grip, symmetry) for (grip,) in region_grasps[1]]
    clouds = [_clouds(grips, person, pair) for grips in (giving, taking)]
    return [
        (give, take)
        for give, giving_meshes in zip(giving, clouds[0], strict=True)
        for take, taking_meshes in zip(taking, clouds[1], strict=True)
        if _apart(giving_meshes, taking_meshes)
    ]


def _clouds(grips: list[Grip], person: Person, pair: HandPair) -> list[list[np.ndarray]]:
    """Return the hand's vertices of each grip in the object frame: closed, and open at increasing distances."""
    if not grips:
        return []
    stages = [(0.0, "hand_pose"), *((away, "open_pose") for away in _WITHDRAWN_M)]
    meshes = []
    for away, pose in stages:
        hands = PosedHands(
            side=grips[0].side,
            wrist_m=np.stack([grip.wrist_m + away * grip.rotmat[:, 1] for grip in grips]),
            rotmats=np.stack([grip.rotmat for grip in grips]),
            hand_pose=np.stack([getattr(grip, pose) for grip in grips]),
            open_pose=np.stack([grip.open_pose for grip in grips]),
            betas=np.repeat(person.betas[None], len(grips), axis=0),
        )
        meshes.append(hands.mesh(pair)[0])
    return [list(stack) for stack in zip(*meshes, strict=True)]


def _apart(giving: list[np.ndarray], taking: list[np.ndarray]) -> bool:
    """Whether each moving hand keeps clear of the other, grasping hand."""
    pairs = [*((giving[0], mesh) for mesh in taking), *((taking[0], mesh) for mesh in giving[1:])]
    return all(KDTree(grasping).query(moving)[0].min() > _HANDS_APART_M for grasping, moving in pairs)


PACE = Pace(approach=14, close=7, open=6, retreat=12)
# Frames of a clip at 30 fps before and after the contact, as in the settings of GRAB's adapter.
MARGIN = 15
MIN_CONTACT_FRAMES, MAX_CONTACT_FRAMES = 26, 116
_SPEEDS = (0.75, 1.0, 1.3)
_MAX_PACE_CHANGE = 0.2  # variation of the speed within a motion
_SWAY_M, _SWAY_DEG = 0.003, 2.0  # sway of a carried object
_REGRASPS = 0.9  # probability in a long action
_ASIDE_DEG, _FAR_ASIDE_M = 12.0, 0.15  # rotation of an object that is moved aside, full from this distance
# Handover: when the second hand has grasped and when the first releases, as fractions of the contact.
_RECEIVED, _RELEASED = 0.42, 0.58
# Distances of an idle hand from the object and from the other hand, and probabilities that it rests or passes close.
_RESTING_M, _PASSING_M = (0.035, 0.08), (0.035, 0.055)
_RESTS, _PASSES = 0.45, 0.15
_PASS_FRAMES = 18.0
_FAR_M = 0.5
# Offset of an idle hand's wrist from the object before it is moved away; distance from which a passing hand comes.
_HAND_BEHIND_M, _PASSING_BY_M = np.array([0.0, -0.09, 0.0]), 0.28
_DRIFT = 0.3  # drift of a resting hand, relative to a far one
# An idle hand rests on the table, not inside it.
_RAISED_M = np.array([0.0, 0.0, 0.1])


@dataclass(frozen=True)
class Scenario:
    """The parameters of one clip."""

    dataset: str
    study_object: StudyObject
    verb: str
    region: Region
    grips: tuple[Grip, ...]
    person: Person
    source_key: str
    left: bool  # whether the clip is mirrored


def sample_contact_frames(verb: str, rng: np.random.Generator) -> float:
    """Sample the duration of the contact in frames at 30 fps: slow, usual or fast for its verb."""
    length = VERBS[verb].length * rng.choice(_SPEEDS) * (1 + 0.06 * np.clip(rng.normal(), -2, 2))
    return float(np.clip(round(length), MIN_CONTACT_FRAMES, MAX_CONTACT_FRAMES))


def make_study_sequence(
    scenario: Scenario, contact_frames: float, pair: HandPair, play: float, rng: np.random.Generator
) -> TruthSequence:
    """Generate a clip at the frame rate of the source. play: scale of the motion in the grasp and of the noise."""
    dataset, study_object, person = scenario.dataset, scenario.study_object, scenario.person
    fps = SOURCE_FPS[dataset]
    stride = fps // FPS
    start = PACE.approach + PACE.close + (int(rng.integers(stride)) / stride if stride > 1 else 0.0)
    stop = start + contact_frames
    times = np.arange(int(np.floor((stop + PACE.open + PACE.retreat) * stride)) + 1) / stride
    spec, model = scenario.region.standing(study_object.spec), model_of(study_object.spec)
    release = (
        None if scenario.verb == HANDOVER else sample_release(scenario.grips, start, contact_frames, _REGRASPS, rng)
    )
    path_start = start if release is None else release.start
    rotmats, translation, hinge = _object_motion(scenario, times, path_start, stop - path_start, rng)
    track = ObjectTrack(model, rotmat_to_rotvec(rotmats), translation, hinge)
    spans = _spans(scenario, start, contact_frames)
    hands: dict[Side, HandTrack] = {}
    for grip in scenario.grips:
        moves = grasp_play(grip, person.betas, track, pair).sample(times, play, rng)
        grasps = grasps_of(spans[grip.side], grip.side, release)
        hands[grip.side] = grasping_hand(grip, person, track, rotmats, times, grasps, moves, PACE)
    if len(hands) == 1:
        hands["left"] = _idle_hand(person, track, hands["right"], times, (start, stop), pair, rng)
    frames_by_side: dict[Side, tuple[int, int]] = {
        side: (round(span[0] * stride), round(span[1] * stride) + 1) for side, span in spans.items()
    }
    first, last = min(span[0] for span in frames_by_side.values()), max(span[1] for span in frames_by_side.values())
    truth = TruthSequence(
        dataset=dataset, subject=person.subject, source_key=scenario.source_key, raw_start=0, source_fps=fps,
        verb=scenario.verb, object_name=spec.name, object_words=spec.words, intent=VERBS[scenario.verb].intent,
        hand_type="both" if len(spans) == 2 else "right",
        hands={side: recorded_hand(hand, play, rng) for side, hand in hands.items()},
        object=recorded_object(track, play, rng),
        clip=(max(0, first - MARGIN * stride), min(len(times), last + MARGIN * stride)), contact=(first, last),
        lifted=track.lowest_m(np.eye(3)[2]) > spec.stand_m + LIFTED_ABOVE_M, stand_m=spec.stand_m,
        contact_by_side=frames_by_side, released=released_frames(release, stride),
    )  # fmt: skip
    return mirrored(truth, person, study_object.mirror(scenario.region)) if scenario.left else truth


def _object_motion(scenario: Scenario, times: np.ndarray, start: float, length: float, rng: np.random.Generator):
    """Return world_from_object rotations and translations, and the hinge angles of an articulated object."""
    study_object, verb = scenario.study_object, VERBS[scenario.verb]
    motion = verb.motion_of("both" if len(scenario.grips) == 2 else "right")
    size, rotation_scale = rng.uniform(0.68, 0.92), rng.uniform(0.85, 1.15)
    if scenario.verb == "turn":
        rotation_scale *= rng.choice((-1.0, 1.0))
    elif scenario.verb in SCREWING and scenario.left:
        rotation_scale = -rotation_scale
    uneven_times = _uneven_times(times, start, length, rng)
    path = follow_path(motion, uneven_times, start, length, False, float(size), float(rotation_scale))
    heading = np.deg2rad(rng.uniform(-verb.heading_deg, verb.heading_deg))
    path = path._replace(shift_m=path.shift_m @ rotvec_to_rotmat(np.array([0.0, 0.0, heading])).T)
    path = _turned_aside(with_sway(path, times, rng, _SWAY_M, _SWAY_DEG), rng)
    path = path._replace(hinge_rad=_hinge(path, scenario.verb, rng))
    spec, model = scenario.region.standing(study_object.spec), model_of(study_object.spec)
    rotmats, translation = object_pose(spec, model, path, rng)
    return rotmats, translation, path.hinge_rad if model.is_articulated else None


def _uneven_times(times: np.ndarray, start: float, length: float, rng: np.random.Generator) -> np.ndarray:
    """Warp the times so that the motion is faster at its start or at its end."""
    phase = (times - start) / length
    inside = np.clip(phase, 0.0, 1.0)
    return times + length * rng.uniform(-_MAX_PACE_CHANGE, _MAX_PACE_CHANGE) * inside * (1 - inside)


def _turned_aside(path: ObjectPath, rng: np.random.Generator) -> ObjectPath:
    """Add a rotation to an object that is moved aside."""
    aside = np.linalg.norm(path.shift_m[:, :2], axis=1)
    yaw_rad = np.deg2rad(rng.uniform(-_ASIDE_DEG, _ASIDE_DEG)) * aside / max(_FAR_ASIDE_M, aside.max())
    return path._replace(rotation_rad=path.rotation_rad + yaw_rad[:, None] * [0.0, 0.0, 1.0])


def _hinge(path: ObjectPath, verb: str, rng: np.random.Generator) -> np.ndarray:
    """Convert fractions of the range to hinge angles. The lid is closed unless the verb is open or close."""
    low, high = ANGLES[0] + rng.uniform(0, 0.06), ANGLES[-1] - rng.uniform(0, 0.06)
    return low + (high - low) * path.hinge_rad if verb in ("open", "close") else np.zeros_like(path.hinge_rad)


def _spans(scenario: Scenario, start: float, contact_frames: float) -> dict[Side, Span]:
    """Return the contact interval of each hand. In a handover, the right hand gives to the left."""
    if scenario.verb == HANDOVER:
        received, released = start + _RECEIVED * contact_frames, start + _RELEASED * contact_frames
        return {"right": (start, released), "left": (received, start + contact_frames)}
    return {grip.side: (start, start + contact_frames) for grip in scenario.grips}


def _idle_hand(
    person: Person, track: ObjectTrack, grasping: HandTrack, times: np.ndarray, contact: Span, pair: HandPair, rng
) -> HandTrack:
    """Return the idle left hand: far away, resting on the table next to the object, or passing it."""
    far = idle_hand("left", person, len(times), rng, True)
    far = replace(far, wrist_m=far.wrist_m + _RAISED_M)
    random_kind = rng.random()
    angle = np.deg2rad(rng.uniform(150, 230))
    target = rng.uniform(*(_RESTING_M if random_kind < _RESTS else _PASSING_M))
    yaw = rotvec_to_rotmat(np.array([0.0, 0.0, np.deg2rad(rng.uniform(-40, 25))]))
    middle, height = contact[0] + rng.uniform(0.3, 0.7) * (contact[1] - contact[0]), rng.uniform(0.035, 0.06)
    if random_kind >= _RESTS + _PASSES:
        return far
    away = np.array([np.cos(angle), np.sin(angle), 0.0])
    path = np.array([*track.translation_m[0, :2], height]) + _HAND_BEHIND_M + _DRIFT * (far.wrist_m - far.wrist_m[0])
    if random_kind >= _RESTS:
        closeness = minimum_jerk(1 - np.abs(times - middle) / _PASS_FRAMES)
        path = path + _PASSING_BY_M * (1 - closeness)[:, None] * away + [0.0, 0.0, rng.uniform(0.0, 0.12)]
    orient = rotmat_to_rotvec(yaw @ rotvec_to_rotmat(far.global_orient))
    close_hand = hand_track(person, "left", path, orient, far.hand_pose, True)
    return replace(close_hand, wrist_m=path + _clear_shift_m(close_hand, away, track, grasping, pair, target) * away)


def _clear_shift_m(
    hand: HandTrack, away: np.ndarray, track: ObjectTrack, grasping: HandTrack, pair: HandPair, target: float
) -> float:
    """Return the shift along ``away`` that keeps ``hand`` ``target`` metres from object and grasping hand."""
    frames = np.arange(0, hand.n_frames, max(1, hand.n_frames // 40))
    joints = track_joints(hand.take(frames), pair["left"]).astype(np.float64)
    other = track_joints(grasping.take(frames), pair["right"]).astype(np.float64)
    sampled_track = track.take(frames)
    for shift_m in np.arange(0.0, _FAR_M, 0.01):
        moved = joints + shift_m * away
        hand_distance_m = np.linalg.norm(moved[:, :, None] - other[:, None], axis=-1).min()
        if hand_distance_m >= target and vertex_distances_m(sampled_track, moved).min() >= target:
            return float(shift_m)
    return _FAR_M


def mirrored(truth: TruthSequence, person: Person, symmetry: np.ndarray) -> TruthSequence:
    """Mirror a clip in x. symmetry: (3, 3), maps the object to itself (``StudyObject.mirror``)."""
    other: dict[Side, Side] = {"left": "right", "right": "left"}
    hands: dict[Side, HandTrack] = {}
    for side, hand in truth.hands.items():
        wrist_m, orient = hand.wrist_m * MIRROR, mirror_rotvec_x(hand.global_orient)
        hands[other[side]] = hand_track(person, other[side], wrist_m, orient, mirrored_pose(hand.hand_pose), True)
    track = truth.object
    rotmats = np.diag(MIRROR) @ rotvec_to_rotmat(track.rotvec) @ symmetry.T
    hand_type = truth.hand_type if truth.hand_type == "both" else other[truth.hand_type]
    return replace(
        truth,
        hands={side: hands[side] for side in SIDES},
        hand_type=hand_type,
        object=replace(track, rotvec=rotmat_to_rotvec(rotmats), translation_m=track.translation_m * MIRROR),
        contact_by_side={other[side]: span for side, span in truth.contact_by_side.items()},
        released={other[side]: span for side, span in truth.released.items()},
    )


def mirrored_grip(grip: Grip, symmetry: np.ndarray) -> Grip:
    """Convert a right hand's grip to the left hand's grip on the mirrored object."""
    wrist_m, rotmat = symmetry @ grip.wrist_m, symmetry @ grip.rotmat @ np.diag(MIRROR)
    pose, opened = mirrored_pose(grip.hand_pose), mirrored_pose(grip.open_pose)
    return Grip("left", wrist_m, rotmat, hand_pose=pose, open_pose=opened, part=grip.part)
