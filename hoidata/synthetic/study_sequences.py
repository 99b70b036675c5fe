"""One clip of the corpus ``study``: hands come open, close, hold, open and leave; an idle hand may be close by.

Everything is made for the right hand, or for both; a left hand's clip is the whole scene seen in a mirror.
"""

from dataclasses import dataclass, replace

import numpy as np

from hoidata.clips.clip import FPS, SIDES, HandTrack, ObjectTrack, Side
from hoidata.geometry.rotations import mirror_rotvec_x, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import HandPair, track_joints
from hoidata.synthetic.catalogue import model_of
from hoidata.synthetic.grasps import Grip
from hoidata.synthetic.paths import ObjectPath, follow_path, minimum_jerk
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
    object_pose,
)
from hoidata.synthetic.soundness import vertex_distances_m
from hoidata.synthetic.study_objects import ANGLES, Region, StudyObject
from hoidata.synthetic.study_plan import HANDOVER, SCREWING, VERBS
from hoidata.synthetic.truth import TruthSequence

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
