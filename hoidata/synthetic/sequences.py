"""Builds a whole action from a grasp and a path: approach, close, carry, open, retreat.

Hands move within their grasp, and the recording has noise, of the size that real recordings have. In ARCTIC, the finger
joints of a hand in contact rotate by 60 degrees per second, mostly below 2 Hz, and the hand slides by 4 cm/s on the
object. Above 4 Hz, wrists and objects move by 0.1 mm per axis and frame.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import FPS, SIDES, HandTrack, ObjectTrack, Side
from hoidata.geometry.rotations import mirror_rotvec_x, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel, articulate
from hoidata.objects.surface_index import surface_index
from hoidata.synthetic.actions import LENGTH_DEVIATION, LONGEST_CLIP, MEAN_LENGTH, SHORTEST_CLIP, Action
from hoidata.synthetic.catalogue import ObjectSpec
from hoidata.synthetic.grasps import Grip, PosedHands, mirrored_pose
from hoidata.synthetic.paths import ObjectPath, follow_path, minimum_jerk, waves, with_sway
from hoidata.synthetic.truth import TruthSequence

# Standard deviation of a free hand: wrist position in metres, wrist rotation and joint angles in radians.
_FREE = np.repeat([0.005, 0.04, 0.12], [3, 3, 45])
_TOUCHING_M, _TOLERANCE_M, _PRESSED_M = 0.003, 0.0003, 0.0015
_SMALL = 0.1  # step of the finite differences, relative to _FREE
_RATES_HZ = (0.2, 1.6)
# Standard deviations of the noise of a recording, per axis and frame.
_NOISE_M, _OBJECT_NOISE_RAD, _JOINT_NOISE_RAD = 1e-4, 5e-4, 2e-3


class Play(NamedTuple):
    """Motions within a grasp: shift and rotation of the wrist in the frame of the part, and 45 joint angles."""

    pressed: np.ndarray  # (51,) presses the hand on the object
    modes: np.ndarray  # (51, 51) maps independent random numbers of variance 1 to motions

    def sample(self, times: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
        """Return (time, 51) smooth motions. times: frames at 30 fps."""
        return scale * (self.pressed + waves(times, _RATES_HZ, len(self.modes), rng) @ self.modes)


def grasp_play(grip: Grip, betas: np.ndarray, track: ObjectTrack, pair: HandPair) -> Play:
    """Return the motions within a grasp that keep its contacts.

    They are the random motions of a free hand, under the condition that touching vertices keep their distance from the
    surface, to first order.
    """
    moves = np.concatenate([np.zeros((1, len(_FREE))), _SMALL * np.diag(_FREE)])
    hands = PosedHands(
        side=grip.side,
        wrist_m=grip.wrist_m + moves[:, :3],
        rotmats=rotvec_to_rotmat(moves[:, 3:6]) @ grip.rotmat,
        hand_pose=grip.hand_pose + moves[:, 6:],
        open_pose=grip.open_pose,
        betas=np.repeat(betas[None], len(moves), axis=0),
    )
    hinge = None if track.hinge_rad is None else track.hinge_rad[:1]
    vertices = track.model.object_from_part(grip.part, hinge) @ hands.mesh(pair)[0]
    near = surface_index(track.model).nearest(vertices[:1], hinge, _TOUCHING_M)
    touching = near.distance_m[0] < _TOUCHING_M
    normals = near.normal[0, touching]
    lifted_m = np.einsum("mvi,vi->mv", vertices[1:, touching] - vertices[0, touching], normals) / _SMALL
    eigenvalues, vectors = np.linalg.eigh(np.eye(len(_FREE)) + lifted_m @ lifted_m.T / _TOLERANCE_M**2)
    pressed = vectors / eigenvalues @ vectors.T @ lifted_m.sum(axis=1) * (-_PRESSED_M / _TOLERANCE_M**2)
    return Play(_FREE * pressed, vectors / np.sqrt(eigenvalues) @ vectors.T * _FREE)


def recorded_hand(hand: HandTrack, scale: float, rng: np.random.Generator) -> HandTrack:
    """Add the noise of a recording. scale: of the noise."""
    pose = hand.hand_pose + scale * _JOINT_NOISE_RAD * rng.normal(size=hand.hand_pose.shape)
    wrist_m = hand.wrist_m + scale * _NOISE_M * rng.normal(size=hand.wrist_m.shape)
    return replace(hand, wrist_m=wrist_m, hand_pose=pose)


def recorded_object(track: ObjectTrack, scale: float, rng: np.random.Generator) -> ObjectTrack:
    """Add the noise of a recording. scale: of the noise."""
    rotations = rotvec_to_rotmat(scale * _OBJECT_NOISE_RAD * rng.normal(size=track.rotvec.shape))
    return replace(
        track,
        rotvec=rotmat_to_rotvec(rotations @ rotvec_to_rotmat(track.rotvec)),
        translation_m=track.translation_m + scale * _NOISE_M * rng.normal(size=track.translation_m.shape),
    )


# Durations in frames at 30 fps.
APPROACH, CLOSE, OPEN, RETREAT = 10, 4, 3, 8
LED_IN, LED_OUT = 6, 4  # frames of a labelled clip before and after the action
_AWAY_M = 0.22
_SIZES = (0.7, 0.9)  # of the paths, so that objects are not much faster than recorded ones
# A regrasp: frames of the first contact, of the way out and of the stay away, and the distance; it needs a long action.
_FIRST_HOLD, _WITHDRAW, _STAY, _WITHDRAWN_M = 6, 6, 6, 0.08
REGRASP_FRAMES = _FIRST_HOLD + OPEN + 2 * _WITHDRAW + _STAY + CLOSE
_REGRASP_FROM = 70  # shortest contact
_REGRASPS = 0.3  # probability in a long action
LIFTED_ABOVE_M = 0.015
SOURCE_FPS = {"h2o": 30, "grab": 120, "arctic": 30}
_IDLE_RIGHT_M = np.array([0.6, -0.35, 0.05])
# Idle right hand, palm down, fingers forward: hand x to -y, back of the hand up, thumb to -x.
_IDLE_RIGHT = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


Span = tuple[float, float]


@dataclass(frozen=True)
class Timing:
    """Times of an action in frames at 30 fps, possibly fractions."""

    contact_start: float
    start: float  # of the path
    length: float  # of the path
    contact_stop: float
    end: float  # of the retreat


class Release(NamedTuple):
    """A hand lets go of the resting object and grasps it again a little later. Times in frames at 30 fps."""

    side: Side
    stop: float  # of the first contact
    start: float  # of the second contact


class Pace(NamedTuple):
    """Durations of the phases of a hand, in frames at 30 fps."""

    approach: int = APPROACH
    close: int = CLOSE
    open: int = OPEN
    retreat: int = RETREAT


USUAL_PACE = Pace()


@dataclass(frozen=True)
class Person:
    """A subject and the shape of the hands."""

    subject: str
    betas: np.ndarray  # (10,)
    template_m: dict[Side, np.ndarray] | None  # (778, 3) personal rest mesh of each side; None: betas give the shape


def sample_length(dataset: str, verb: str, rng: np.random.Generator) -> int:
    """Sample the length of a clip around the mean of its verb, in frames at 30 fps."""
    length = MEAN_LENGTH[dataset][verb] + LENGTH_DEVIATION * rng.normal()
    return int(np.clip(round(length), SHORTEST_CLIP, LONGEST_CLIP))


def plan_timing(dataset: str, action: Action, length: int, rng: np.random.Generator) -> Timing:
    """Schedule an action such that the labelled clip has the given length. A clip of GRAB is the contact alone."""
    motion = action.motion
    stride = SOURCE_FPS[dataset] // FPS
    contact_start = APPROACH + CLOSE + (int(rng.integers(stride)) / stride if stride > 1 else 0.0)
    before, after = (0, 0) if dataset == "grab" else (motion.lifted_before, motion.lowered_after)
    lead_frames = 0 if dataset == "grab" else LED_IN * (before == 0) + LED_OUT * (after == 0)
    path_length = length - lead_frames
    start = contact_start + before
    contact_stop = start + path_length + after
    return Timing(contact_start, start, path_length, contact_stop, end=contact_stop + OPEN + RETREAT)


def make_sequence(
    dataset: str,
    action: Action,
    spec: ObjectSpec,
    model: ObjectModel,
    grips: tuple[Grip, ...],
    person: Person,
    source_key: str,
    length: int,
    pair: HandPair,
    play: float,
    rng: np.random.Generator,
) -> TruthSequence:
    """Generate one action at the frame rate of the source. play: scale of the motion in the grasp and of the noise."""
    timing = plan_timing(dataset, action, length, rng)
    release = None
    if timing.start == timing.contact_start:
        release = sample_release(grips, timing.start, timing.length, _REGRASPS, rng)
    if release is not None:
        timing = replace(timing, start=timing.start + REGRASP_FRAMES, length=timing.length - REGRASP_FRAMES)
    fps = SOURCE_FPS[dataset]
    times = np.arange(int(np.floor(timing.end * fps / FPS)) + 1) * (FPS / fps)
    hand = action.grasp.hand
    scales = float(rng.uniform(*_SIZES)), float(rng.uniform(0.9, 1.1))
    path = follow_path(action.motion, times, timing.start, timing.length, hand == "left", *scales)
    rotmats, translation = object_pose(spec, model, with_sway(path, times, rng), rng)
    hinge = path.hinge_rad if model.is_articulated else None
    idle_absent = dataset == "h2o" and bool(rng.random() < 0.5)
    hands: dict[Side, HandTrack] = {side: idle_hand(side, person, len(times), rng, not idle_absent) for side in SIDES}
    track = ObjectTrack(model, rotmat_to_rotvec(rotmats), translation, hinge)
    spans = dict.fromkeys((grip.side for grip in grips), (timing.contact_start, timing.contact_stop))
    for grip in grips:
        moves = grasp_play(grip, person.betas, track, pair).sample(times, play, rng)
        grasps = grasps_of(spans[grip.side], grip.side, release)
        hands[grip.side] = grasping_hand(grip, person, track, rotmats, times, grasps, moves)
    contact = (round(timing.contact_start * fps / FPS), round(timing.contact_stop * fps / FPS) + 1)
    return TruthSequence(
        dataset=dataset, subject=person.subject, source_key=source_key, raw_start=0, source_fps=fps, verb=action.verb,
        object_name=spec.name, object_words=spec.words, intent=action.intent, hand_type=hand,
        hands={side: recorded_hand(hands[side], play, rng) for side in SIDES}, object=recorded_object(track, play, rng),
        clip=_clip_span(dataset, action, timing, contact), contact=contact,
        lifted=track.lowest_m(np.eye(3)[2]) > spec.stand_m + LIFTED_ABOVE_M, stand_m=spec.stand_m,
        released=released_frames(release, fps // FPS),
    )  # fmt: skip


def sample_release(
    grips: tuple[Grip, ...], start: float, length: float, probability: float, rng: np.random.Generator
) -> Release | None:
    """Sample whether a hand regrasps at the start of a long action, before the object moves."""
    side = grips[int(rng.integers(len(grips)))].side
    if rng.random() > probability or length < _REGRASP_FROM:
        return None
    return Release(side, start + _FIRST_HOLD, start + REGRASP_FRAMES)


def released_frames(release: Release | None, stride: int) -> dict[Side, tuple[int, int]]:
    """Return ``TruthSequence.released``."""
    if release is None:
        return {}
    return {release.side: (round(release.stop * stride) + 1, round(release.start * stride))}


def grasps_of(contact: Span, side: Side, release: Release | None) -> tuple[Span, ...]:
    """Divide the contact of a hand if it regrasps."""
    if release is None or release.side != side:
        return (contact,)
    return (contact[0], release.stop), (release.start, contact[1])


def _clip_span(dataset: str, action: Action, timing: Timing, contact: tuple[int, int]) -> tuple[int, int]:
    if dataset == "grab":
        return contact
    start = timing.start if action.motion.lifted_before else timing.contact_start - LED_IN
    proper_stop = timing.start + timing.length
    return round(start), round(proper_stop if action.motion.lowered_after else proper_stop + LED_OUT)


def object_pose(
    spec: ObjectSpec, model: ObjectModel, path: ObjectPath, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return world_from_object rotations (frame, 3, 3) and translations (frame, 3), with a start close to zero."""
    base = model.vertices_m[model.part == 0]
    centre = (base.min(0) + base.max(0)) / 2
    upright = spec.upright_from_object
    standing = articulate(model.vertices_m, model.part, model.hinge, path.hinge_rad[:1])[0] @ upright.T
    start = np.array([*np.clip(0.025 * rng.normal(size=2), -0.06, 0.06), spec.stand_m - standing[:, 2].min()])
    start[2] += (upright @ centre)[2]
    yaw = np.deg2rad(np.clip(10 * rng.normal(), -25, 25))
    at_rest = rotvec_to_rotmat(np.array([0.0, 0.0, yaw])) @ upright
    rotmats = rotvec_to_rotmat(path.rotation_rad) @ at_rest
    return rotmats, start + path.shift_m - rotmats @ centre


def grasping_hand(
    grip: Grip,
    person: Person,
    track: ObjectTrack,
    rotmats: np.ndarray,
    times: np.ndarray,
    grasps: tuple[Span, ...],
    moves: np.ndarray,
    pace: Pace = USUAL_PACE,
) -> HandTrack:
    """Return a hand that approaches, grasps once or twice, and retreats along its back.

    rotmats: (frame, 3, 3) of the object. times: (frame,) in frames at 30 fps. grasps: intervals of contact.
    moves: (frame, 51) motion within the grasp, of ``Play.sample``.
    """
    model, hinge = track.model, track.hinge_rad
    follow = rotmats
    if grip.part == 1 and model.hinge is not None and hinge is not None:
        follow = rotmats @ rotvec_to_rotmat(model.hinge.axis * hinge[:, None])
    start, stop = grasps[0][0], grasps[-1][1]
    arriving = 1 - minimum_jerk((times - (start - pace.close - pace.approach)) / pace.approach)
    leaving = minimum_jerk((times - stop - pace.open) / pace.retreat)
    away_m, closed = _AWAY_M * (arriving + leaving), np.zeros(len(times))
    for start, stop in grasps:
        closed += minimum_jerk((times - start + pace.close) / pace.close) - minimum_jerk((times - stop) / pace.open)
    for (_, stop), (start, _) in pairwise(grasps):
        out, back = (times - stop - pace.open) / _WITHDRAW, (times - start + pace.close) / _WITHDRAW + 1
        away_m += _WITHDRAWN_M * (minimum_jerk(out) - minimum_jerk(back))
    moves = closed[:, None] * moves
    world = follow @ rotvec_to_rotmat(moves[:, 3:6]) @ grip.rotmat
    wrist = np.einsum("fij,fj->fi", follow, grip.wrist_m + moves[:, :3]) + track.translation_m
    wrist += away_m[:, None] * world[:, :, 1]
    pose = grip.open_pose + closed[:, None] * (grip.hand_pose - grip.open_pose) + moves[:, 6:]
    return hand_track(person, grip.side, wrist, rotmat_to_rotvec(world), pose, True)


def idle_hand(side: Side, person: Person, n_frames: int, rng: np.random.Generator, present: bool) -> HandTrack:
    """Return a relaxed hand that drifts slightly, far from the object on its side."""
    fraction = np.linspace(0, 1, n_frames)[:, None]
    drift = 0.03 * rng.normal(size=3) + 0.02 * fraction * rng.normal(size=3)
    wrist, orient = _IDLE_RIGHT_M + drift, np.tile(rotmat_to_rotvec(_IDLE_RIGHT), (n_frames, 1))
    curl = np.tile([0.0, 0.0, 0.25], 15) * np.repeat([1.0, 1.0, 1.0, 1.0, 0.3], 9)
    pose = np.tile(curl + 0.03 * rng.normal(size=45), (n_frames, 1))
    if side == "left":
        wrist = wrist * np.array([-1.0, 1.0, 1.0])
        orient = mirror_rotvec_x(orient)
        pose = mirrored_pose(pose)
    return hand_track(person, side, wrist, orient, pose, present)


def hand_track(person: Person, side: Side, wrist, orient, pose, present: bool) -> HandTrack:
    betas = person.betas if person.template_m is None else np.zeros(10)
    template = None if person.template_m is None else person.template_m[side]
    return HandTrack(wrist, orient, pose, betas[None], valid=np.full(len(wrist), present), template_m=template)


def make_person(dataset: str, subject: str, pair: HandPair, rng: np.random.Generator) -> Person:
    """Sample a subject with individual hands. GRAB stores a personal mesh instead of betas, in float32."""
    betas = np.round(np.clip(0.6 * rng.normal(size=10), -1.5, 1.5), 6).astype(np.float32).astype(np.float64)
    if dataset != "grab":
        return Person(subject, betas, None)
    meshes: dict[Side, np.ndarray] = {}
    for side in SIDES:
        shaped = pair[side].template_m + pair[side].shape_directions @ betas
        meshes[side] = shaped.astype(np.float32).astype(np.float64)
    return Person(subject, betas, meshes)
