"""Detects wrong conventions by measuring hands against the object.

With a wrong unit, mean pose, translation or transposed rotation every array is still valid. But fingertips miss the
object, fingers bend backwards, or the object rotates against the hand. If another interpretation of the same numbers
fits much better, the finding names it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Clip, HandTrack, Side
from hoidata.conformance.loading import Finding, finding, skipped, undecided
from hoidata.geometry.rotations import rotation_angle, rotvec_to_rotmat
from hoidata.hands import HandModel, HandPair, track_joints
from hoidata.objects.distance import closest_points

MAX_CLIPS, MAX_FRAMES_PER_CLIP = 12, 24
HAND_LENGTH_M = (0.15, 0.25)
TOUCH_M, WRIST_M = 0.02, 0.30
MAX_TIP_DISTANCE_M = 0.05
MIN_CLIP_FRACTION = 0.6
MAX_BETTER_RATIO = 0.65
MIN_ROTATION_RAD = np.deg2rad(0.5)
# One clip has one object in nearly one pose, which a wrong interpretation may fit by chance.
MIN_FRAMES = 40
MIDDLE_FINGER = (0, 4, 5, 6, 17)
FIRST_TIP = 16
FIRST_FINGER_JOINTS = (1, 4, 7, 10)  # first joints of index, middle, pinky, ring

Reading = Callable[[Clip, HandPair], Clip]


@dataclass(frozen=True)
class _Touch:
    """Distances from the object's surface, (side, frame); NaN for invalid hands."""

    wrist_m: np.ndarray
    tips_m: np.ndarray  # mean of the three closest fingertips
    nearest_tip_m: np.ndarray


def touch_findings(clips: list[Clip], hands: HandPair) -> list[Finding]:
    """Measure at most 24 frames of each of 12 clips. All rules only warn, because unusual data may break them.

    Rules other than the hand length need at least 40 frames with a hand.
    """
    some_clips = [clips[i] for i in _spread(len(clips), MAX_CLIPS)]
    sampled_clips = [clip.take(_spread(clip.n_frames, MAX_FRAMES_PER_CLIP)) for clip in some_clips]
    try:
        touches = [_touch(clip, hands) for clip in sampled_clips]
    except Exception as error:  # arrays that check_clip refused, and which another rule reports
        return [skipped("hands touch the object", f"the clips cannot be measured: {error!r}")]
    wrist_rule = "wrists are within 0.3 m of the object when closest"
    tip_rule = "a fingertip comes within 2 cm of the object in most clips"
    return [
        _hand_lengths(sampled_clips, hands),
        _is_near(wrist_rule, [touch.wrist_m for touch in touches], WRIST_M, "unit, frame or translation?"),
        _is_near(tip_rule, [touch.nearest_tip_m for touch in touches], TOUCH_M, "mean pose, frame or parts?"),
        _bending(sampled_clips, hands),
        _alternative_readings(sampled_clips, touches, hands),
        _rotates_with_hand(sampled_clips, touches),
    ]


def _spread(length: int, most: int) -> np.ndarray:
    """At most ``most`` evenly spread indices below ``length``."""
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
    """Distance of world points from the object's surface, with its parts posed by the hinge. Returns (frame, point)."""
    track, model = clip.object, clip.object.model
    local = track.world_from_object.inverse() @ points_m
    nearest = np.full(local.shape[:2], np.inf)
    for part in model.parts:
        in_part = model.object_from_part(part, track.hinge_rad).inverse() @ local
        distance_m = closest_points(model.vertices_m, model.faces_of(part), in_part.reshape(-1, 3)).distance_m
        nearest = np.minimum(nearest, distance_m.reshape(nearest.shape))
    return nearest


def _too_few(rule: str, frames_in_words: str, n_frames: int) -> Finding | None:
    """The finding "undecided" below 40 frames, else None. frames_in_words: which frames count."""
    if n_frames >= MIN_FRAMES:
        return None
    remedy = f"{MIN_FRAMES} are needed, at most {MAX_FRAMES_PER_CLIP} of each clip count: load more sequences"
    return undecided(rule, f"{n_frames} frames {frames_in_words}; {remedy}")


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
    """Sum of bone lengths from wrist to middle fingertip, in the first valid frame; None if there is none."""
    track = clip.hands[side]
    if not track.valid.any():
        return None
    joints = track_joints(track, hands[side])[track.valid.argmax()]
    return float(np.linalg.norm(np.diff(joints[list(MIDDLE_FINGER)], axis=0), axis=1).sum())


def _is_near(rule: str, distances_m: list[np.ndarray], limit_m: float, question: str) -> Finding:
    """Whether most clips have a smallest distance within the limit. distances_m: per clip (side, frame)."""
    n_frames = sum(int(np.isfinite(distance).any(axis=0).sum()) for distance in distances_m)
    if few := _too_few(rule, "with a hand", n_frames):
        return few
    nearest = [distance[np.isfinite(distance)].min(initial=np.inf) for distance in distances_m]
    near_fraction = np.mean([value <= limit_m for value in nearest])
    problem = f"only in {near_fraction:.0%} of clips; typically {np.median(nearest) * 100:.2g} cm: {question}"
    return finding(rule, [] if near_fraction >= MIN_CLIP_FRACTION else [problem], "warn")


def _bending(clips: list[Clip], hands: HandPair) -> Finding:
    """Fingers flex towards the palm. If sides are swapped or mirrored, they bend backwards."""
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
    """Mean flexion of the middle joints of four fingers, positive towards the palm."""
    track = clip.hands[side]
    joints = track_joints(track, hands[side]).astype(np.float64)[track.valid]
    palm = np.cross(joints[:, 1] - joints[:, 0], joints[:, 7] - joints[:, 0]) * (1 if side == "right" else -1)
    angles = []
    for first in FIRST_FINGER_JOINTS:
        along, after = joints[:, first + 1] - joints[:, first], joints[:, first + 2] - joints[:, first + 1]
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        across = palm - (palm * along).sum(axis=1, keepdims=True) * along
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        angles.append(np.arctan2((after * across).sum(axis=1), (after * along).sum(axis=1)))
    return float(np.mean(angles))


def _alternative_readings(clips: list[Clip], touches: list[_Touch], hands: HandPair) -> Finding:
    """Whether another interpretation of the same numbers brings the fingertips much closer to the object."""
    rule, problems = "no other interpretation of the numbers brings the fingertips closer", dict[str, float]()
    n_frames = sum(int(np.isfinite(touch.tips_m).any(axis=0).sum()) for touch in touches)
    if few := _too_few(rule, "with a hand", n_frames):
        return few
    for reading_in_words, reading in READINGS.items():
        others = [_touch(reading(clip, hands), hands) for clip in clips]
        pairs = list(map(_paired, touches, others))
        as_read_m, alternative_m = np.mean(pairs, axis=0)
        agrees = [alternative < MAX_BETTER_RATIO * as_read for as_read, alternative in pairs if as_read or alternative]
        if alternative_m < MAX_BETTER_RATIO * as_read_m and sum(agrees) > 1:  # a single clip may agree by chance
            problem = f"{alternative_m * 1e3:.0f} mm in place of {as_read_m * 1e3:.0f} mm {reading_in_words}"
            problems[problem] = alternative_m / as_read_m
    return finding(rule, sorted(problems, key=problems.__getitem__), "warn")  # a finding shows the first ones only


def _paired(touch: _Touch, other: _Touch) -> tuple[float, float]:
    """Mean tip distances of two interpretations, over frames in which a hand touches the object in either."""
    tips_m = np.array([np.fmin(np.fmin.reduce(t.tips_m), MAX_TIP_DISTANCE_M) for t in (touch, other)])
    at_object = tips_m.min(axis=0) < TOUCH_M
    as_read_m, alternative_m = tips_m[:, at_object].mean(axis=1).tolist() if at_object.any() else (0.0, 0.0)
    return as_read_m, alternative_m


def _rotates_with_hand(clips: list[Clip], touches: list[_Touch]) -> Finding:
    """A grasped object rotates with the hand; with transposed rotations it rotates the other way."""
    rule = "grasped objects rotate with the hand"
    steps = [_rotation_steps(clip, touch) for clip, touch in zip(clips, touches, strict=True)]
    turning = [step[step[:, 2] > MIN_ROTATION_RAD] for step in steps]
    rotating_steps = np.concatenate(turning)
    if len(rotating_steps) < MAX_FRAMES_PER_CLIP // 2 or sum(len(step) > 0 for step in turning) < 2:
        steps_of_clips = f"{len(rotating_steps)} steps of {sum(len(step) > 0 for step in turning)} clips"
        return undecided(rule, f"grasped objects rotate in {steps_of_clips}: load more sequences")
    as_read_deg, transposed_deg = np.rad2deg(rotating_steps[:, :2].mean(axis=0))
    if transposed_deg >= MAX_BETTER_RATIO * as_read_deg:
        return finding(rule, [])
    degrees = f"{as_read_deg:.1f} degrees per step, transposed by {transposed_deg:.1f}"
    return finding(rule, [f"they differ by {degrees}: row vectors taken for columns?"], "warn")


def _rotation_steps(clip: Clip, touch: _Touch) -> np.ndarray:
    """Rotations between consecutive frames in which a fingertip touches the object.

    Returns:
        (step, 3) angles in radians: between hand and object rotation, between hand and transposed object rotation, and
        of the object rotation alone.
    """
    object_rotmat = rotvec_to_rotmat(clip.object.rotvec.astype(np.float64))
    steps = []
    for number, side in enumerate(SIDES):
        hand_rotmat = rotvec_to_rotmat(clip.hands[side].global_orient.astype(np.float64))
        at_object = np.nan_to_num(touch.nearest_tip_m[number], nan=np.inf) < TOUCH_M
        pairs = np.flatnonzero(at_object[1:] & at_object[:-1])
        hand_rotation = hand_rotmat[pairs + 1] @ hand_rotmat[pairs].transpose(0, 2, 1)
        object_rotation = object_rotmat[pairs + 1] @ object_rotmat[pairs].transpose(0, 2, 1)
        transposed_rotation = object_rotmat[pairs + 1].transpose(0, 2, 1) @ object_rotmat[pairs]
        readings = (object_rotation, transposed_rotation)
        columns = (*(rotation.transpose(0, 2, 1) @ hand_rotation for rotation in readings), object_rotation)
        steps.append(np.stack([rotation_angle(column) for column in columns], axis=1))
    return np.concatenate(steps)


def _with_mean(sign: int) -> Reading:
    return _each_hand(lambda track, model: {"hand_pose": track.hand_pose + sign * model.mean_pose})


def _with_wrist(sign: int) -> Reading:
    def moved(track: HandTrack, model: HandModel) -> dict[str, np.ndarray]:
        return {"wrist_m": track.wrist_m + sign * model.wrist_offset_m(track.betas, track.template_m)}

    return _each_hand(moved)


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


def _quaternions_reordered(order: list[int], hands_too: bool) -> Reading:
    """Rotations whose quaternions (x, y, z, w) have another order. hands_too: also the hands' global orientation."""

    def reordered(rotvec: np.ndarray) -> np.ndarray:
        return Rotation.from_quat(Rotation.from_rotvec(rotvec).as_quat()[:, order]).as_rotvec()

    def read(clip: Clip, hands: HandPair) -> Clip:
        clip = replace(clip, object=replace(clip.object, rotvec=reordered(clip.object.rotvec)))
        change = _each_hand(lambda track, model: {"global_orient": reordered(track.global_orient)})
        return change(clip, hands) if hands_too else clip

    return read


READINGS: dict[str, Reading] = {
    "with object rotations transposed": lambda clip, _: replace(
        clip, object=replace(clip.object, rotvec=-clip.object.rotvec)
    ),
    **{
        f"if quaternions{' of hands too' * hands_too} are {given}, not {read}": _quaternions_reordered(order, hands_too)
        for given, read, order in (("wxyz", "xyzw", [1, 2, 3, 0]), ("xyzw", "wxyz", [3, 0, 1, 2]))
        for hands_too in (False, True)
    },
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
