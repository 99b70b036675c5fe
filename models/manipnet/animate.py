"""Fingers for somebody's trajectories, or anew for frames of a recorded clip."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.hands.tracks import track_rotmats
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from models.manipnet.control import UNSEEN_M, Control, Motion, between
from models.manipnet.plausible import plausible_reading
from models.manipnet.rollout import Predictor, Task, roll_out
from models.manipnet.trajectory_files import MOST_FRAMES, TrajectoryFile

SEAM_S = 1.0  # over so long a time fingers are led from and to where the recording goes on
INTERPOLATED_S = 2.0  # up to so long a gap between known poses is best filled straight (docs/fingers.md)


class Given(NamedTuple):
    """Trajectories ready for the network. active: the hands to animate. notes: what was left out, in words."""

    control: Control
    active: list[Side]
    notes: list[str]


def given_control(found: TrajectoryFile, model: ObjectModel, hands: Mapping[Side, TrackedHand]) -> Given:
    """A file's trajectories at an object. Raises BadInput where they cannot be meant, with what may have been."""
    if model.is_articulated and found.hinge_rad is None:
        raise BadInput(found.where, "hinge_rad for a hinged object", "none", "add the column")
    if found.hinge_rad is not None and found.hinge_rad.any() and not model.is_articulated:
        remedy = 'tell the hinge of a two-piece mesh (--hinge "px,py,pz dx,dy,dz"), or leave the column out'
        raise BadInput(found.where, "an object with a hinge for hinge_rad", f"{model.name!r}, which is rigid", remedy)
    read = plausible_reading(found, model, hands)
    notes = [
        f"the {side} hand stays {metres:.2f} m away from the object and keeps its neutral pose"
        for side, metres in read.nearest_m.items()
        if side not in read.active
    ]
    if note := surface_index(model).solid_note:
        notes.append(f"{note}; fingers may pass through where there is no inside")
    return Given(read.control, read.active, notes)


def at_30_fps(control: Control) -> Control:
    """The same trajectories at the rate of clips, from their first frame on. Raises BadInput for too many frames."""
    count = int(np.floor((control.thing.time_s[-1] - control.thing.time_s[0]) * FPS + 1e-6)) + 1
    if count > MOST_FRAMES:
        raise BadInput("time_s", f"at most {MOST_FRAMES} frames at {FPS} per second", f"{count}", "cut it into pieces")
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


class Gap(NamedTuple):
    """Frames ``first`` to ``stop - 1`` of a hand, and its finger poses (15, 3, 3) in the known frames beside them.

    None where no frame is known on that side.
    """

    first: int
    stop: int
    before: np.ndarray | None
    after: np.ndarray | None

    @property
    def is_short(self) -> bool:
        """Whether plain interpolation is nearer to recorded fingers than the network."""
        known = self.before is not None and self.after is not None
        return known and self.stop - self.first <= round(INTERPOLATED_S * FPS)


def gap_of(track: HandTrack, frames: slice) -> Gap:
    """The gap that some frames of a track are in: lost frames beside them belong to it, up to the nearest seen ones."""
    seen, fingers = np.flatnonzero(track.valid), track_rotmats(track)[:, 1:].astype(np.float64)
    earlier, later = seen[seen < frames.start], seen[seen >= frames.stop]
    first, before = (earlier[-1] + 1, fingers[earlier[-1]]) if len(earlier) else (frames.start, None)
    stop, after = (later[0], fingers[later[0]]) if len(later) else (frames.stop, None)
    return Gap(int(first), int(stop), before, after)


def new_fingers(predictor: Predictor, hand: TrackedHand, side: Side, control: Control, gap: Gap,
                seam_s: float = SEAM_S) -> np.ndarray:  # fmt: skip
    """Finger rotations (frame, joint - 1, 3, 3) of a gap in ``control``, whose frames are a step apart.

    What the network makes is led over ``seam_s`` from the pose before and to the one after. Without one before: from
    the neutral pose on.
    """
    given = int(gap.before is not None)
    start = hand.rest_rotmats if gap.before is None else gap.before
    (made,) = roll_out(
        predictor, [Task(hand, side, control, control.thing.time_s[gap.first - given : gap.stop], start)]
    )
    return led(made[given:], gap.before, gap.after, round(seam_s / predictor.settings.step_s))


def straight_fingers(gap: Gap) -> np.ndarray:
    """Finger rotations (frame, joint - 1, 3, 3) of a gap, evenly between the poses on both sides of it."""
    if gap.before is None or gap.after is None:
        raise ValueError("a gap without a known pose on both sides")
    return interpolated(gap.before, gap.after, gap.stop - gap.first)


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


def with_fingers(track: HandTrack, frames: slice, fingers: np.ndarray, wrist: Motion) -> HandTrack:
    """A track whose finger poses of some frames are these, (frame, 15, 3, 3); it counts as seen in them.

    wrist: of all frames; taken where the hand was lost, since a track says nothing there.
    """
    pose, valid = track.hand_pose.copy(), track.valid.copy()
    place, turn = track.wrist_m.copy(), track.global_orient.copy()
    pose[frames] = rotmat_to_rotvec(fingers).reshape(len(fingers), -1)
    valid[frames] = True
    lost = valid & ~track.valid
    place[lost], turn[lost] = wrist.position_m[lost], rotmat_to_rotvec(wrist.rotmats[lost])
    return replace(track, wrist_m=place, global_orient=turn, hand_pose=pose, valid=valid)


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
