"""Fingers for somebody's trajectories, or anew for frames of a recorded clip."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.hands.tracks import track_rotmats
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.objects.user_mesh import UNITS_M
from models.manipnet.control import Control, Motion
from models.manipnet.examples import between
from models.manipnet.rollout import Predictor, Task, roll_out
from models.manipnet.trajectory_files import Body, TrajectoryFile

NEAR_M = 0.12  # from the middle of the palm to the object: a hand that never comes nearer handles nothing
PALM_M = 0.08  # from the wrist to the middle of the palm
SWALLOWED_M = 0.03  # so deep in an object no palm is
SEAM_S = 1.0  # over so long a time fingers are led from and to where the recording goes on
UNSEEN_M = 1.0
FACING = np.array([0.8, 0.0, -0.6])  # canonical: where a hand that holds something looks to
LOOKS_AWAY, LOOKS_TO = 0.2, 0.6  # mean cosines between that and the way to the object


class Given(NamedTuple):
    """Trajectories ready for the network. active: the hands to animate. notes: what was left out, in words."""

    control: Control
    active: list[Side]
    notes: list[str]


def given_control(found: TrajectoryFile, model: ObjectModel, hands: Mapping[Side, TrackedHand]) -> Given:
    """A file's trajectories at an object. Raises BadInput where no hand comes near or looks to it.

    Both are told by where the palms are: a unit or an order of numbers that is not meant puts them elsewhere.
    """
    if model.is_articulated and found.hinge_rad is None:
        raise BadInput(found.where, "hinge_rad for a hinged object", "none", "add the column")
    thing = found.thing
    if found.at_box:
        middle = (model.vertices_m.min(axis=0) + model.vertices_m.max(axis=0)) / 2
        thing = Body(thing.position_m - thing.rotmats @ middle, thing.rotmats)
    body = Motion(found.time_s, thing.rotmats, thing.position_m)
    turn = {side: _model_from_file(found, hands[side]) for side in SIDES}
    wrists = {
        side: Motion(found.time_s, own.rotmats @ turn[side], own.position_m) for side, own in found.wrists.items()
    }
    away = Motion(found.time_s[:1], np.eye(3)[None], thing.position_m[:1] + np.array([UNSEEN_M, 0, 0]))
    control = Control({side: wrists.get(side, away) for side in SIDES}, body, model, found.hinge_rad)
    nearest: dict[Side, float] = {side: _nearest_m(control, side, hands[side]) for side in found.wrists}
    active: list[Side] = [side for side in SIDES if nearest.get(side, np.inf) < NEAR_M]
    if not active:
        _refuse_far(found, control, hands, nearest)
    for side in active:
        _check_outside(found, control, side, hands[side])
        _check_facing(found, control, side, hands[side])
    notes = [
        f"the {side} hand stays {metres:.2f} m away from the object and keeps its neutral pose"
        for side, metres in nearest.items()
        if side not in active
    ]
    if note := surface_index(model).solid_note:
        notes.append(f"{note}; fingers may pass through where there is no inside")
    return Given(control, active, notes)


def _model_from_file(found: TrajectoryFile, hand: TrackedHand) -> np.ndarray:
    """(3, 3) from the axes of the hand's own wrist joint to those the file has."""
    if found.axes == "model":
        return np.eye(3)
    file_from_canonical = np.diag([-1.0 if hand.side == "left" else 1.0, 1.0, 1.0])
    return file_from_canonical @ hand.wrist_from_canonical.T


def _palms(control: Control, side: Side, hand: TrackedHand, scale: float = 1.0) -> np.ndarray:
    """(frame, 3) the middle of the palm in the object's frame; positions of all bodies scaled."""
    wrist, thing = control.wrists[side], control.thing
    ahead = hand.wrist_from_canonical @ [PALM_M, 0.0, 0.0]
    palm = wrist.position_m * scale + wrist.rotmats @ ahead
    return ((palm - thing.position_m * scale)[:, None] @ thing.rotmats)[:, 0]


def _nearest_m(control: Control, side: Side, hand: TrackedHand, scale: float = 1.0) -> float:
    """How near the palm comes to the object in any frame; negative inside."""
    return float(_distances_m(control, _palms(control, side, hand, scale)).min())


def _distances_m(control: Control, places_m: np.ndarray) -> np.ndarray:
    """(frame,) signed distances of a place in each frame from the surface, negative inside."""
    return surface_index(control.model).nearest(places_m[:, None], control.hinge_rad).distance_m[:, 0]


def _refuse_far(
    found: TrajectoryFile, control: Control, hands: Mapping[Side, TrackedHand], nearest: Mapping[Side, float]
) -> None:
    """Raise BadInput that says how near the hands come, and which unit of the positions would bring them to it."""
    likely = [
        name
        for name, factor in UNITS_M.items()
        if factor != 1 and min(_nearest_m(control, side, hands[side], factor) for side in nearest) < NEAR_M
    ]
    got = ", ".join(f"the {side} one {metres:.3g} m" for side, metres in nearest.items())
    remedy = f"perhaps the positions are not metres: --trajectory-unit {likely[0]}" if likely else "check the positions"
    raise BadInput(found.where, f"a palm that comes within {NEAR_M} m of the object", got, remedy)


def _check_outside(found: TrajectoryFile, control: Control, side: Side, hand: TrackedHand) -> None:
    """Raise BadInput where the object holds the palm of a hand most of the time: its mesh has another unit."""
    distance_m = _distances_m(control, _palms(control, side, hand))
    inside = (distance_m < -SWALLOWED_M).sum() / max((distance_m < NEAR_M).sum(), 1)
    if inside > 0.5:
        got = f"a {side} palm inside it in {100 * inside:.0f} % of the frames in which it is near"
        remedy = "perhaps the mesh has another unit (--unit cm), or another origin than the trajectories mean"
        raise BadInput(f"{found.where} with {control.model.name}", "an object beside the hands", got, remedy)


def _check_facing(found: TrajectoryFile, control: Control, side: Side, hand: TrackedHand) -> None:
    """Raise BadInput where a hand at the object looks away from it, and would not with w last in its quaternions."""
    palms = _palms(control, side, hand)
    near = _distances_m(control, palms) < NEAR_M
    centre = control.model.vertices_m.mean(axis=0)
    wrist, thing = control.wrists[side], control.thing
    toward = thing.position_m + thing.rotmats @ centre - wrist.position_m
    toward = (toward / np.linalg.norm(toward, axis=1, keepdims=True))[near]
    looks = hand.wrist_from_canonical @ FACING

    def facing(rotmats: np.ndarray) -> float:
        return float(np.einsum("fi,fij,j->f", toward, rotmats[near], looks).mean())

    as_read = Rotation.from_matrix(found.wrists[side].rotmats).as_quat()  # x, y, z, w
    other = Rotation.from_quat(as_read[:, [3, 0, 1, 2]]).as_matrix() @ _model_from_file(found, hand)
    if facing(wrist.rotmats) < LOOKS_AWAY and facing(other) > LOOKS_TO:
        got = f"a {side} hand that looks away from the object it is at, and to it if they are x, y, z, w"
        raise BadInput(found.where, "quaternions in the order w, x, y, z", got, "put w first")


def at_30_fps(control: Control) -> Control:
    """The same trajectories at the rate of clips, from their first frame on."""
    count = int(np.floor((control.thing.time_s[-1] - control.thing.time_s[0]) * FPS + 1e-6)) + 1
    time_s = control.thing.time_s[0] + np.arange(count) / FPS
    hinge = control.hinge_at(time_s)

    def slowed(motion: Motion) -> Motion:
        placed = motion.at(time_s)
        return Motion(time_s, placed.rotation, placed.translation)

    wrists: dict[Side, Motion] = {side: slowed(motion) for side, motion in control.wrists.items()}
    return Control(wrists, slowed(control.thing), control.model, hinge)


def clip_control(clip: Clip) -> Control:
    """Wrists and object of a recorded clip, in its world; a wrist that is lost stays where it was seen nearest."""
    time_s = np.arange(clip.n_frames) / FPS
    placed = clip.object.world_from_object
    thing = Motion(time_s, placed.rotation, placed.translation)
    hinge = None if clip.object.hinge_rad is None else np.asarray(clip.object.hinge_rad, dtype=np.float64)
    wrists: dict[Side, Motion] = {}
    for side, track in clip.hands.items():
        seen = np.flatnonzero(track.valid)
        if len(seen):
            rows = seen[abs(np.arange(clip.n_frames)[:, None] - seen).argmin(axis=1)]
            turn = rotvec_to_rotmat(track.global_orient[rows].astype(np.float64))
            wrists[side] = Motion(time_s, turn, track.wrist_m[rows].astype(np.float64))
        else:
            wrists[side] = Motion(
                time_s, np.tile(np.eye(3), (clip.n_frames, 1, 1)), thing.position_m + np.array([UNSEEN_M, 0, 0])
            )
    return Control(wrists, thing, clip.object.model, hinge)


def new_fingers(predictor: Predictor, hand: TrackedHand, side: Side, control: Control, frames: slice,
                recorded: np.ndarray | None, seam_s: float = SEAM_S) -> np.ndarray:  # fmt: skip
    """Finger rotations (frame, joint - 1, 3, 3) of some frames of ``control``, which are a step apart.

    recorded: (all frames, joint - 1, 3, 3). Only the poses just before and after the frames are taken from it: what the
    network makes is led over ``seam_s`` from the first and to the last. Without one before: from the neutral pose on.
    """
    n_frames = len(control.thing.time_s)
    first, stop, _ = frames.indices(n_frames)
    before = recorded[first - 1] if first > 0 and recorded is not None else None
    after = recorded[stop] if stop < n_frames and recorded is not None else None
    given = int(before is not None)
    start = hand.rest_rotmats if before is None else before
    (made,) = roll_out(predictor, [Task(hand, side, control, control.thing.time_s[first - given : stop], start)])
    return led(made[given:], before, after, round(seam_s / predictor.settings.step_s))


def led(made: np.ndarray, before: np.ndarray | None, after: np.ndarray | None, seam: int) -> np.ndarray:
    """Poses (frame, joint, 3, 3) led from the pose before them and to the one after, each over ``seam`` frames.

    Near a pose that is known they are between it (both: turned evenly from the one to the other) and what was made.
    """
    first, last = (after if before is None else before), (before if after is None else after)
    if first is None or last is None:
        return made
    away = np.arange(1, len(made) + 1)
    ends = [end for end, pose in ((away, before), (away[::-1], after)) if pose is not None]
    share = np.clip(np.minimum.reduce(ends) / max(seam, 1), 0, 1)
    return between(interpolated(first, last, len(made)), made, share * share * (3 - 2 * share))


def interpolated(before: np.ndarray, after: np.ndarray, count: int) -> np.ndarray:
    """(count, joint, 3, 3) poses evenly between two, neither of them among these."""
    ends = np.broadcast_to(before, (count, *before.shape)), np.broadcast_to(after, (count, *after.shape))
    return between(*ends, np.arange(1, count + 1) / (count + 1))


def recorded_fingers(track: HandTrack) -> np.ndarray:
    """(frame, 15, 3, 3) of a recorded hand."""
    return track_rotmats(track)[:, 1:].astype(np.float64)


def with_fingers(track: HandTrack, frames: slice, fingers: np.ndarray) -> HandTrack:
    """A track whose finger poses of some frames are these, (frame, 15, 3, 3); it counts as seen in them."""
    pose, valid = track.hand_pose.copy(), track.valid.copy()
    pose[frames] = rotmat_to_rotvec(fingers).reshape(len(fingers), -1)
    valid[frames] = True
    return replace(track, hand_pose=pose.astype(np.float32), valid=valid)


def clip_of(control: Control, fingers: Mapping[Side, np.ndarray], up: tuple[float, float, float] | None,
            name: str, synthetic: bool) -> Clip:  # fmt: skip
    """A clip of trajectories at 30 fps with these fingers (frame, 15, 3, 3); other hands are not there."""
    n_frames = len(control.thing.time_s)
    tracks: dict[Side, HandTrack] = {}
    for side in SIDES:
        wrist, there = control.wrists[side].at(control.thing.time_s), side in fingers
        pose = rotmat_to_rotvec(fingers[side]).reshape(n_frames, -1) if there else np.zeros((n_frames, 45))
        turn = rotmat_to_rotvec(wrist.rotation)
        place, turn, pose = (array.astype(np.float32) for array in (wrist.translation, turn, pose))
        tracks[side] = HandTrack(place, turn, pose, np.zeros((1, 10), np.float32), np.full(n_frames, there))
    thing = control.thing
    placed = (rotmat_to_rotvec(thing.rotmats).astype(np.float32), thing.position_m.astype(np.float32))
    hinge = None if control.hinge_rad is None else control.hinge_rad.astype(np.float32)
    return Clip(
        clip_id=f"animated/{name}",
        dataset="generated",
        subject="generated",
        sequence=name,
        hands=tracks,
        object=ObjectTrack(control.model, *placed, hinge),
        source_frames=np.arange(n_frames, dtype=np.int32),
        gravity=None if up is None else -np.asarray(up),
        verb=None,
        object_words=control.model.name.replace("_", " "),
        synthetic=synthetic,
    )
