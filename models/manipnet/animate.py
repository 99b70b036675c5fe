"""Finger animation for a user's trajectories, or for frames of a recorded clip."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.errors import BadInput
from hoidata.geometry.motion import Motion, interpolate_rotations
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands.kinematics import track_rotmats
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.object_paths.trajectory_files import MAX_FRAMES, TrajectoryFile
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from models.manipnet.control import Control
from models.manipnet.plausible import plausible_reading
from models.manipnet.rollout import Predictor, RolloutTask, roll_out

SEAM_S = 1.0  # predicted fingers are blended to the recorded poses before and after them over this time
MAX_INTERPOLATED_S = 2.0  # in a gap up to this, interpolation has a lower error than the network (docs/fingers.md)


class AnimationInput(NamedTuple):
    """A checked trajectory file as input of the network."""

    control: Control
    active: list[Side]  # the hands near the object
    notes: list[str]  # warnings for the user


def control_from_file(file: TrajectoryFile, model: ObjectModel, hands: Mapping[Side, TrackedHand]) -> AnimationInput:
    """Convert the trajectories of a file with an object to a control signal.

    Raises BadInput if they are implausible; the remedy names the probable mistake, such as another unit.
    """
    if model.is_articulated and file.hinge_rad is None:
        raise BadInput(file.source, "hinge_rad for a hinged object", "none", "add the column")
    if file.hinge_rad is not None and file.hinge_rad.any() and not model.is_articulated:
        remedy = 'give the hinge of a two-piece mesh (--hinge "px,py,pz dx,dy,dz"), or remove the column'
        raise BadInput(file.source, "an object with a hinge for hinge_rad", f"{model.name!r}, which is rigid", remedy)
    accepted = plausible_reading(file, model, hands)
    notes = [*file.notes]
    notes += [
        f"the {side} hand stays {metres:.2f} m away from the object and keeps its neutral pose"
        for side, metres in accepted.nearest_m.items()
        if side not in accepted.active
    ]
    if note := surface_index(model).repair_note:
        notes.append(f"{note}; fingers may pass through open parts")
    return AnimationInput(accepted.control, accepted.active, notes)


def control_of_two_objects(
    file: TrajectoryFile, models: Mapping[Side, ObjectModel], hands: Mapping[Side, TrackedHand]
) -> AnimationInput:
    """Likewise with an object in each hand."""
    if len(file.wrists) < len(SIDES):
        raise BadInput(file.source, "both wrists, with an object in each hand", "one", "add the other one")
    inputs = {side: control_from_file(file.of(side), models[side], hands) for side in SIDES}
    wrists: dict[Side, Motion] = {side: inputs[side].control.wrists[side] for side in SIDES}
    left, right = (replace(one.control, wrists=wrists) for one in inputs.values())
    notes = dict.fromkeys(note for one in inputs.values() for note in one.notes)  # notes on the file are in both
    return AnimationInput(replace(right, left=left), list(SIDES), list(notes))


def at_rate(control: Control, fps: int = FPS) -> Control:
    """Resample trajectories from their first frame on. Raises BadInput for too many frames."""
    first_s, last_s = control.object_motion.time_s[[0, -1]]
    n_frames = int(np.floor((last_s - first_s) * fps + 1e-6)) + 1
    if n_frames > MAX_FRAMES:
        expected = f"at most {MAX_FRAMES} frames at {fps} per second"
        raise BadInput("time_s", expected, f"{n_frames}", "cut it into pieces")
    return control.at(first_s + np.arange(n_frames) / fps)


class Gap(NamedTuple):
    """Frames ``first`` to ``stop - 1`` of a hand, with its finger poses in the tracked frames before and after them."""

    first: int
    stop: int
    before: np.ndarray | None  # (15, 3, 3); None if no earlier frame is tracked
    after: np.ndarray | None  # (15, 3, 3); None if no later frame is tracked

    @property
    def is_short(self) -> bool:
        """Whether interpolation has a lower error than the network."""
        has_both_sides = self.before is not None and self.after is not None
        return has_both_sides and self.stop - self.first <= round(MAX_INTERPOLATED_S * FPS)


def gap_of(track: HandTrack, frames: slice) -> Gap:
    """Extend some frames of a track to the nearest tracked frames before and after them."""
    tracked, fingers = np.flatnonzero(track.valid), track_rotmats(track)[:, 1:].astype(np.float64)
    earlier, later = tracked[tracked < frames.start], tracked[tracked >= frames.stop]
    first, before = (earlier[-1] + 1, fingers[earlier[-1]]) if len(earlier) else (frames.start, None)
    stop, after = (later[0], fingers[later[0]]) if len(later) else (frames.stop, None)
    return Gap(int(first), int(stop), before, after)


def predict_fingers(predictor: Predictor, hand: TrackedHand, side: Side, control: Control, gap: Gap) -> np.ndarray:
    """Predict finger rotations (frame, joint - 1, 3, 3) of a gap, from the pose before it or the neutral pose on.

    The prediction is blended to the poses before and after the gap over ``SEAM_S``.
    """
    known_frames = int(gap.before is not None)
    start = hand.rest_rotmats if gap.before is None else gap.before
    time_s = control.object_motion.time_s[gap.first - known_frames : gap.stop]
    (predicted,) = roll_out(predictor, [RolloutTask(hand, side, control.of(side), time_s, start)])
    return blend_ends(predicted[known_frames:], gap.before, gap.after, round(SEAM_S * FPS))


def interpolate_fingers(gap: Gap) -> np.ndarray:
    """Interpolate finger rotations (frame, joint - 1, 3, 3) of a gap between the poses before and after it."""
    if gap.before is None or gap.after is None:
        raise ValueError("a gap without a known pose on both sides")
    return interpolated(gap.before, gap.after, gap.stop - gap.first)


def blend_ends(
    predicted: np.ndarray, before: np.ndarray | None, after: np.ndarray | None, seam_frames: int
) -> np.ndarray:
    """Blend predicted poses (frame, joint, 3, 3) over ``seam_frames`` to the known poses (joint, 3, 3) around them.

    Near a known end, the result is a blend of the prediction and the interpolation between both ends.
    """
    first, last = (after if before is None else before), (before if after is None else after)
    if first is None or last is None:
        return predicted
    frames = np.arange(1, len(predicted) + 1)
    ends = [end for end, pose in ((frames, before), (frames[::-1], after)) if pose is not None]
    fraction = np.clip(np.minimum.reduce(ends) / max(seam_frames, 1), 0, 1)
    smoothstep = fraction * fraction * (3 - 2 * fraction)
    return interpolate_rotations(interpolated(first, last, len(predicted)), predicted, smoothstep)


def interpolated(before: np.ndarray, after: np.ndarray, count: int) -> np.ndarray:
    """(count, joint, 3, 3) evenly interpolated poses between two, without these two."""
    ends = np.broadcast_to(before, (count, *before.shape)), np.broadcast_to(after, (count, *after.shape))
    return interpolate_rotations(*ends, np.arange(1, count + 1) / (count + 1))


def with_fingers(track: HandTrack, frames: slice, fingers: np.ndarray, wrist: Motion) -> HandTrack:
    """Replace the finger poses (frame, 15, 3, 3) of some frames, which become valid.

    wrist: that of all frames; it replaces the track's wrist in untracked frames.
    """
    pose, valid = track.hand_pose.copy(), track.valid.copy()
    wrist_m, global_orient = track.wrist_m.copy(), track.global_orient.copy()
    pose[frames] = rotmat_to_rotvec(fingers).reshape(len(fingers), -1)
    valid[frames] = True
    lost = valid & ~track.valid
    wrist_m[lost], global_orient[lost] = wrist.position_m[lost], rotmat_to_rotvec(wrist.rotmats[lost])
    return replace(track, wrist_m=wrist_m, global_orient=global_orient, hand_pose=pose, valid=valid)


def clip_of(control: Control, fingers: Mapping[Side, np.ndarray], templates_m: np.ndarray | None,
            up: tuple[float, float, float] | None, name: str, synthetic: bool) -> Clip:  # fmt: skip
    """A clip of trajectories with fingers (frame, 15, 3, 3); a hand without fingers is invalid.

    templates_m: (2, 778, 3) personal rest meshes.
    """
    n_frames = len(control.object_motion.time_s)
    tracks: dict[Side, HandTrack] = {}
    for index, side in enumerate(SIDES):
        wrist, has_fingers = control.wrists[side].at(control.object_motion.time_s), side in fingers
        hand_pose = rotmat_to_rotvec(fingers[side]).reshape(n_frames, -1) if has_fingers else np.zeros((n_frames, 45))
        wrist_m, orient, hand_pose = (
            array.astype(np.float32) for array in (wrist.translation, rotmat_to_rotvec(wrist.rotation), hand_pose)
        )
        betas, valid = np.zeros((1, 10), np.float32), np.full(n_frames, has_fingers)
        template_m = None if templates_m is None else templates_m[index]
        tracks[side] = HandTrack(wrist_m, orient, hand_pose, betas, valid, template_m)
    return Clip(
        clip_id=f"animated/{name}",
        dataset="generated",
        subject="generated",
        sequence=name,
        hands=tracks,
        object=_object_track(control),
        other_objects=(_object_track(control.left),) if control.left else (),
        source_frames=np.arange(n_frames, dtype=np.int32),
        gravity=None if up is None else -np.asarray(up),
        gravity_note="" if up else "the file of trajectories does not state which axis is up",
        verb=None,
        object_words=control.model.name.replace("_", " "),
        synthetic=synthetic,
    )


def _object_track(control: Control) -> ObjectTrack:
    rotvec, hinge_rad = rotmat_to_rotvec(control.object_motion.rotmats).astype(np.float32), control.hinge_rad
    position_m = control.object_motion.position_m.astype(np.float32)
    return ObjectTrack(control.model, rotvec, position_m, None if hinge_rad is None else hinge_rad.astype(np.float32))
