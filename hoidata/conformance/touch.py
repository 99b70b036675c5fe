"""Whether the hands of clips are hands that hold something: what a wrong convention shows, measured.

A wrong unit, mean pose, translation or transposed rotation leaves every array valid, but the fingertips miss the
object, fingers bend backwards, or the object turns against the hand. Where another reading of the same numbers fits
much better, that reading is named.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hoidata.clips.clip import SIDES, Clip, HandTrack, Side
from hoidata.conformance.report import Finding, finding, skipped, undecided
from hoidata.geometry.rotations import rotation_angle, rotvec_to_rotmat
from hoidata.hands import HandModel, HandPair, track_joints
from hoidata.objects.distance import closest_points

MOST_CLIPS, MOST_FRAMES = 12, 24
HAND_LENGTH_M = (0.15, 0.25)
TOUCH_M, WRIST_M = 0.02, 0.30
FAR_M = 0.05
MOST = 0.6
MUCH_BETTER = 0.65
LEAST_TURN_RAD = np.deg2rad(0.5)
# One clip shows one object in nearly one pose: a wrong reading may fit it by chance. At most 24 frames of each count.
FEWEST_FRAMES = 40
MIDDLE_FINGER = (0, 4, 5, 6, 17)
FIRST_TIP = 16
FINGERS = (1, 4, 7, 10)  # first joints of index, middle, pinky, ring

Reading = Callable[[Clip, HandPair], Clip]


@dataclass(frozen=True)
class _Touch:
    """Metres from the object (side, frame), NaN if not valid: wrist, mean of the three nearest tips, nearest tip."""

    wrist_m: np.ndarray
    tips_m: np.ndarray
    nearest_tip_m: np.ndarray


def touch_findings(clips: list[Clip], hands: HandPair) -> list[Finding]:
    """Rules over at most 24 frames of 12 clips, all warnings: data of an unusual kind may break them rightly.

    Fewer than 40 frames in which the rule can look at a hand decide nothing, but for the length of hands.
    """
    some = [clips[i].take(_spread(clips[i].n_frames, MOST_FRAMES)) for i in _spread(len(clips), MOST_CLIPS)]
    try:
        touches = [_touch(clip, hands) for clip in some]
    except Exception as error:  # arrays that check_clip refused, and which another rule reports
        return [skipped("hands hold objects", f"the clips cannot be measured: {error!r}")]
    return [
        _hand_lengths(some, hands),
        _near(
            "wrists are within 0.3 m of the object when it is nearest",
            [touch.wrist_m for touch in touches],
            WRIST_M,
            "unit, frame or translation?",
        ),
        _near(
            "a fingertip comes within 2 cm of the object in most clips",
            [touch.nearest_tip_m for touch in touches],
            TOUCH_M,
            "mean pose, frame or parts?",
        ),
        _bending(some, hands),
        _other_readings(some, touches, hands),
        _turning(some, touches),
    ]


def _spread(length: int, most: int) -> np.ndarray:
    """At most so many numbers below ``length``, evenly spread."""
    return np.unique(np.linspace(0, length - 1, most).astype(int))


def _touch(clip: Clip, hands: HandPair) -> _Touch:
    wrist, tips, nearest = [], [], []
    for side in SIDES:
        joints = track_joints(clip.hands[side], hands[side]).astype(np.float64)
        distance = _distances(clip, joints[:, [0, *range(FIRST_TIP, 21)]])
        distance[~clip.hands[side].valid] = np.nan
        ordered = np.sort(distance[:, 1:], axis=1)
        wrist.append(distance[:, 0])
        tips.append(ordered[:, :3].mean(axis=1))
        nearest.append(ordered[:, 0])
    return _Touch(np.array(wrist), np.array(tips), np.array(nearest))


def _distances(clip: Clip, points_m: np.ndarray) -> np.ndarray:
    """(frame, point) distance of world points from the object's surface, each part where its hinge has moved it."""
    track, model = clip.object, clip.object.model
    local = track.world_from_object.inverse() @ points_m
    nearest = np.full(local.shape[:2], np.inf)
    for part in model.parts:
        in_part = model.object_from_part(part, track.hinge_rad).inverse() @ local
        found = closest_points(model.vertices_m, model.faces_of(part), in_part.reshape(-1, 3)).distance_m
        nearest = np.minimum(nearest, found.reshape(nearest.shape))
    return nearest


def _too_few(rule: str, what: str, n_frames: int) -> Finding | None:
    """That a rule is not decided where it rests on fewer than 40 frames. what: which frames count."""
    if n_frames >= FEWEST_FRAMES:
        return None
    remedy = f"{FEWEST_FRAMES} are needed, at most {MOST_FRAMES} of each clip count: load more sequences"
    return undecided(rule, f"{n_frames} frames {what}; {remedy}")


def _hand_lengths(clips: list[Clip], hands: HandPair) -> Finding:
    rule, problems, measured = "hands are 0.15 to 0.25 m long", [], 0
    for clip in clips:
        for side in SIDES:
            length_m = _hand_length_m(clip, side, hands)
            measured += length_m is not None
            if length_m is not None and not HAND_LENGTH_M[0] <= length_m <= HAND_LENGTH_M[1]:
                problems.append(f"{clip.clip_id}: the {side} hand is {length_m:.3g} m long: unit of shape or mesh?")
    return finding(rule, problems, "warn") if measured else undecided(rule, "no hand is valid in any frame")


def _hand_length_m(clip: Clip, side: Side, hands: HandPair) -> float | None:
    """Bone by bone from the wrist to the middle fingertip, in the first valid frame."""
    track = clip.hands[side]
    if not track.valid.any():
        return None
    joints = track_joints(track, hands[side])[track.valid.argmax()]
    return float(np.linalg.norm(np.diff(joints[list(MIDDLE_FINGER)], axis=0), axis=1).sum())


def _near(rule: str, distances_m: list[np.ndarray], limit_m: float, question: str) -> Finding:
    """Whether the smallest distance of most clips is within the limit."""
    n_frames = sum(int(np.isfinite(distance).any(axis=0).sum()) for distance in distances_m)
    if few := _too_few(rule, "with a hand", n_frames):
        return few
    nearest = [distance[np.isfinite(distance)].min(initial=np.inf) for distance in distances_m]
    share = np.mean([value <= limit_m for value in nearest])
    text = f"only in {share:.0%} of clips; typically {np.median(nearest) * 100:.2g} cm: {question}"
    return finding(rule, [] if share >= MOST else [text], "warn")


def _bending(clips: list[Clip], hands: HandPair) -> Finding:
    """Fingers flex towards the palm; exchanged or mirrored sides bend them backwards."""
    rule, problems = "fingers bend towards the palm: a left hand is a left hand", []
    n_frames = sum(int(track.valid.sum()) for clip in clips for track in clip.hands.values())
    if few := _too_few(rule, "of hands", n_frames):
        return few
    for side in SIDES:
        angles = [_flexion_rad(clip, side, hands) for clip in clips if clip.hands[side].valid.any()]
        if angles and np.median(angles) < np.deg2rad(-3):
            degrees = np.rad2deg(np.median(angles))
            problems.append(f"the {side} hand's by {degrees:.0f} degrees: sides exchanged, or mirrored?")
    return finding(rule, problems, "warn")


def _flexion_rad(clip: Clip, side: Side, hands: HandPair) -> float:
    """Mean angle of the four fingers' middle joints, positive towards the palm."""
    track = clip.hands[side]
    joints = track_joints(track, hands[side]).astype(np.float64)[track.valid]
    palm = np.cross(joints[:, 1] - joints[:, 0], joints[:, 7] - joints[:, 0]) * (1 if side == "right" else -1)
    angles = []
    for first in FINGERS:
        along, after = joints[:, first + 1] - joints[:, first], joints[:, first + 2] - joints[:, first + 1]
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        across = palm - (palm * along).sum(axis=1, keepdims=True) * along
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        angles.append(np.arctan2((after * across).sum(axis=1), (after * along).sum(axis=1)))
    return float(np.mean(angles))


def _other_readings(clips: list[Clip], touches: list[_Touch], hands: HandPair) -> Finding:
    """Whether fingertips are much nearer the object when the same numbers are read in another way."""
    rule, problems = "no other reading of the numbers brings the fingertips nearer", []
    n_frames = sum(int(np.isfinite(touch.tips_m).any(axis=0).sum()) for touch in touches)
    if few := _too_few(rule, "with a hand", n_frames):
        return few
    for what, reading in READINGS.items():
        pairs = [
            _paired(touch, _touch(reading(clip, hands), hands)) for clip, touch in zip(clips, touches, strict=True)
        ]
        as_is, other = np.mean(pairs, axis=0)
        agrees = [theirs < MUCH_BETTER * ours for ours, theirs in pairs if ours or theirs]
        if other < MUCH_BETTER * as_is and sum(agrees) > 1:  # what one clip alone says may be chance
            problems.append(f"{other * 1e3:.0f} mm in place of {as_is * 1e3:.0f} mm {what}")
    return finding(rule, problems, "warn")


def _paired(touch: _Touch, other: _Touch) -> tuple[float, float]:
    """Mean tip distances under two readings, over the frames in which a hand is at the object under either."""
    ours, theirs = (np.fmin.reduce([*t.tips_m, np.full(t.tips_m.shape[1], FAR_M)]) for t in (touch, other))
    held = np.minimum(ours, theirs) < TOUCH_M
    return (float(ours[held].mean()), float(theirs[held].mean())) if held.any() else (0.0, 0.0)


def _turning(clips: list[Clip], touches: list[_Touch]) -> Finding:
    """A held object turns as the hand does; with transposed rotations it turns the other way."""
    rule = "held objects turn with the hand"
    steps = [_turns(clip, touch) for clip, touch in zip(clips, touches, strict=True)]
    turning = [step[step[:, 2] > LEAST_TURN_RAD] for step in steps]
    told = np.concatenate(turning)
    if len(told) < MOST_FRAMES // 2 or sum(len(step) > 0 for step in turning) < 2:
        n_clips = sum(len(step) > 0 for step in turning)
        return undecided(rule, f"held objects turn in {len(told)} steps of {n_clips} clips: load more sequences")
    as_is, transposed = np.rad2deg(told[:, :2].mean(axis=0))
    if transposed >= MUCH_BETTER * as_is:
        return finding(rule, [])
    text = (
        f"they differ by {as_is:.1f} degrees per step, transposed by {transposed:.1f}: row vectors taken for columns?"
    )
    return finding(rule, [text], "warn")


def _turns(clip: Clip, touch: _Touch) -> np.ndarray:
    """(step, 3) radians: hand against object, hand against the transposed object, and the object's own turn."""
    thing = rotvec_to_rotmat(clip.object.rotvec.astype(np.float64))
    steps = []
    for number, side in enumerate(SIDES):
        hand = rotvec_to_rotmat(clip.hands[side].global_orient.astype(np.float64))
        held = np.nan_to_num(touch.nearest_tip_m[number], nan=np.inf) < TOUCH_M
        pairs = np.flatnonzero(held[1:] & held[:-1])
        hand_turn = hand[pairs + 1] @ hand[pairs].transpose(0, 2, 1)
        turn = thing[pairs + 1] @ thing[pairs].transpose(0, 2, 1)
        turn_transposed = thing[pairs + 1].transpose(0, 2, 1) @ thing[pairs]
        columns = (turn.transpose(0, 2, 1) @ hand_turn, turn_transposed.transpose(0, 2, 1) @ hand_turn, turn)
        steps.append(np.stack([rotation_angle(column) for column in columns], axis=1))
    return np.concatenate(steps)


def _with_mean(sign: int) -> Reading:
    return _each_hand(lambda track, model: {"hand_pose": track.hand_pose + sign * model.mean_pose})


def _with_wrist(sign: int) -> Reading:
    return _each_hand(
        lambda track, model: {"wrist_m": track.wrist_m + sign * model.wrist_offset_m(track.betas, track.template_m)}
    )


def _each_hand(change: Callable[[HandTrack, HandModel], dict[str, np.ndarray]]) -> Reading:
    def read(clip: Clip, hands: HandPair) -> Clip:
        moved = {side: replace(track, **change(track, hands[side])) for side, track in clip.hands.items()}
        return replace(clip, hands=moved)

    return read


def _parts_exchanged(clip: Clip, hands: HandPair) -> Clip:
    if not clip.object.is_articulated:
        return clip
    model = replace(clip.object.model, part=(1 - clip.object.model.part).astype(np.uint8))
    return replace(clip, object=replace(clip.object, model=model))


def _hinge_reversed(clip: Clip, hands: HandPair) -> Clip:
    hinge = clip.object.hinge_rad
    return clip if hinge is None else replace(clip, object=replace(clip.object, hinge_rad=-hinge))


READINGS: dict[str, Reading] = {
    "with object rotations transposed": lambda clip, _: replace(
        clip, object=replace(clip.object, rotvec=-clip.object.rotvec)
    ),
    "with the mean pose added to the fingers": _with_mean(1),
    "with the mean pose taken from the fingers": _with_mean(-1),
    "with J0 added to the wrist (MANO's transl taken for it?)": _with_wrist(1),
    "with J0 taken from the wrist (a wrist taken for MANO's transl?)": _with_wrist(-1),
    "with left and right exchanged": lambda clip, _: replace(
        clip, hands={"left": clip.hands["right"], "right": clip.hands["left"]}
    ),
    "with the object's parts exchanged": _parts_exchanged,
    "with the hinge turned the other way": _hinge_reversed,
}
