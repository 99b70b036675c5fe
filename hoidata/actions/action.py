"""Measures of object motion, and a rule-based test of whether a motion shows a verb.

``actions.toml`` next to this file has one table of limits per verb: ``measure = [minimum, maximum]``. A motion shows
the verb if all measures are within their limits. A table is used for a dataset if 90 % of the verb's training clips
satisfy it. For other verbs, the limits are the usual range of the training clips, if it excludes an object at rest.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from math import ceil, floor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hoidata.clips.clip import FPS, SIDES, ObjectTrack
from hoidata.geometry.intervals import runs
from hoidata.geometry.rotations import rotation_angles_about
from hoidata.store.annotated import AnnotatedStore


class MeasureText(NamedTuple):
    """How a measure is shown to a person, and which difference is visible."""

    label: str
    unit: str  # shown after the number; "" for counts
    visible_difference: float  # distance from the usual range that a viewer notices, in the unit of the measure
    display_factor: float = 1.0  # from the unit of the measure to ``unit``
    signed: bool = False  # whether the measure can be negative


# Differences that a viewer notices. Position: one square of the grid that pages draw. Angle: one hour of a clock face.
# Sums over a motion count a movement there and back twice. Joint speed: one square per frame. Slip: the width of a
# finger per second.
POSITION_M, ANGLE_DEG, JUMP_M_S, SLIDE_CM_S = 0.10, 30.0, 3.0, 2.0
MEASURE_TEXTS = {
    "rise_m": MeasureText("highest rise", " cm", POSITION_M, 100),
    "end_rise_m": MeasureText("rise at the end", " cm", POSITION_M, 100, signed=True),
    "sideways_m": MeasureText("farthest sideways", " cm", POSITION_M, 100),
    "end_sideways_m": MeasureText("sideways at the end", " cm", POSITION_M, 100),
    "tilt_deg": MeasureText("greatest tilt", " degrees", ANGLE_DEG),
    "end_tilt_deg": MeasureText("tilt at the end", " degrees", ANGLE_DEG),
    "turn_deg": MeasureText("turning about the vertical in all", " degrees", 2 * ANGLE_DEG),
    "end_turn_deg": MeasureText("turned at the end, counter-clockwise from above,", " degrees", ANGLE_DEG, signed=True),
    "path_m": MeasureText("length of the path", " cm", 2 * POSITION_M, 100),
    "reversals_per_s": MeasureText("turns back", " times a second", 1.0),
    "hinge_net_deg": MeasureText("change of the hinge at the end", " degrees", ANGLE_DEG, signed=True),
    "hinge_max_deg": MeasureText("greatest change of the hinge", " degrees", ANGLE_DEG),
    "hand_changes": MeasureText("hands that take or give", "", 1.0),
    "joint_m_s": MeasureText("fastest joint", " m/s", JUMP_M_S),
    "slip_cm_s": MeasureText("slip of hands", " cm/s", SLIDE_CM_S),
}


def describe_unusual(name: str, value: float, least: float, most: float) -> str | None:
    """Describe a measure outside of its usual range, as ``highest rise 15.8 cm (usual: 19.1 to 23.7)``.

    Returns None if the rounded value equals a rounded bound.
    """
    label, unit, _, factor, signed = MEASURE_TEXTS[name]
    if not unit:  # a count
        least, most = ceil(least), floor(most)
    shown, low, high = (_rounded(number * factor) for number in (value, least, most))
    if shown in (low, high):
        return None
    return f"{label} {shown}{unit} (usual: {f'{low} to {high}' if signed or least > 0 else f'at most {high}'})"


def is_visible(name: str, value: float, least: float, most: float) -> bool:
    """Whether a measure is so far outside of its usual range that a viewer notices."""
    if not MEASURE_TEXTS[name].unit:
        least, most = ceil(least), floor(most)
    return max(least - value, value - most) >= MEASURE_TEXTS[name].visible_difference


def _rounded(number: float) -> str:
    """Round to three digits, without an exponent."""
    return f"{number:.0f}" if abs(number) >= 1000 else f"{number:.3g}"


TABLE = Path(__file__).with_name("actions.toml")
MEASURES = {
    "rise_m": "greatest height of the object's centre above its height in the first frame",
    "end_rise_m": "the same in the last frame",
    "sideways_m": "greatest horizontal distance of the centre from its position in the first frame",
    "end_sideways_m": "the same in the last frame",
    "tilt_deg": "greatest angle between the vertical and the object direction that is vertical in the first frame",
    "end_tilt_deg": "the same in the last frame",
    "turn_deg": "sum of the absolute rotations about the vertical, of steps smoothed over 5 frames against noise",
    "end_turn_deg": "rotation about the vertical from the first to the last frame, counter-clockwise from above",
    "path_m": "path length of the centre",
    "reversals_per_s": "rate of reversals of the centre: 2 mm or more in 0.1 s, then as much in the opposite direction",
    "hinge_net_deg": "change of the hinge angle from the first to the last frame; 0 for a rigid object",
    "hinge_max_deg": "greatest absolute change of the hinge angle since the first frame; 0 for a rigid object",
    "hand_changes": "number of hands that grasp the object only at the start or only at the end: 0, 1 or 2",
    "first_left": "1 if the left hand grasps at the start: contact in half of the first quarter of the contact time",
    "first_right": "1 if the right hand grasps at the start",
    "last_left": "1 if the left hand grasps at the end: contact in half of the last quarter of the contact time",
    "last_right": "1 if the right hand grasps at the end",
}
HAND_MEASURES = ("first_left", "first_right", "last_left", "last_right")  # a request states the hands, not the verb
VERB_MEASURES = tuple(name for name in MEASURES if name not in HAND_MEASURES)
AT_REST = dict.fromkeys(VERB_MEASURES, 0.0)  # measures of an object that does not move, in the same hands
MIN_CLIPS = 3  # of a verb, to compute its limits
MIN_FRACTION_WITHIN = 0.9  # of a verb's training clips, to use its table of actions.toml
MARGIN = 0.5  # standard deviations, added to the 1st and 99th percentile of the verb's clips
MIN_RELATIVE_DEVIATION = 0.25  # of all clips' deviation; below it, a verb's deviation is not representative
# Minimum standard deviation, by the unit at the end of a measure's name: smaller differences do not matter.
MIN_DEVIATION = {"m": 0.03, "deg": 10.0, "s": 1.0, "changes": 1.0}
_REVERSAL_FRAMES, _REVERSAL_M = 3, 0.002
_SMOOTHING_FRAMES = 5
Limits = dict[str, tuple[float, float]]


def action_numbers(track: ObjectTrack, gravity: np.ndarray | None, touching: np.ndarray) -> dict[str, float]:
    """Compute ``MEASURES`` of one motion. Measures that need gravity are NaN without it.

    Args:
        track: motion of the object.
        gravity: (3,) unit vector in the world, or None if unknown.
        touching: (2, frame) bool, whether the left and the right hand touch the object.
    """
    degrees = np.zeros(track.n_frames)
    if (angle_rad := track.joint_angle_rad) is not None:
        degrees = np.degrees(angle_rad - angle_rad[0], dtype=np.float64)
    middle_m = object_middle_m(track)
    unknown = dict.fromkeys(MEASURES, float("nan"))
    return unknown | _upright(track, middle_m, gravity) | _touching(touching) | {
        "path_m": float(np.linalg.norm(np.diff(middle_m, axis=0), axis=1).sum()),
        "reversals_per_s": _reversals(middle_m) * FPS / track.n_frames,
        "hinge_net_deg": float(degrees[-1]),
        "hinge_max_deg": float(np.abs(degrees).max()),
    }  # fmt: skip


def object_middle_m(track: ObjectTrack) -> np.ndarray:
    """Return (frame, 3) world positions of the centre of the base part's bounding box, metres."""
    base = track.model.vertices_m[np.unique(track.model.faces_of(0))]
    return (track.world_from_object @ ((base.min(axis=0) + base.max(axis=0)) / 2)[None])[:, 0]


def _upright(track: ObjectTrack, middle_m: np.ndarray, gravity: np.ndarray | None) -> dict[str, float]:
    """Measures that need gravity. middle_m: (frame, 3) world positions of the object's centre."""
    if gravity is None:
        return {}
    up = -np.asarray(gravity, np.float64)
    offset_m = middle_m - middle_m[0]
    rise, sideways = offset_m @ up, np.linalg.norm(offset_m - (offset_m @ up)[:, None] * up, axis=1)
    rotation = track.world_from_object.rotation
    since_first = rotation @ rotation[0].T
    tilt = np.degrees(np.arccos(np.clip((since_first @ up) @ up, -1, 1)))
    steps = rotation_angles_about(rotation, up)
    # Smoothing first: tracking noise would add up in a sum of absolute steps.
    smoothed = np.convolve(steps, np.full(_SMOOTHING_FRAMES, 1 / _SMOOTHING_FRAMES), mode="full") if len(steps) else 0
    turn_deg = np.degrees(np.abs(smoothed).sum())
    return {
        "rise_m": float(rise.max()),
        "end_rise_m": float(rise[-1]),
        "sideways_m": float(sideways.max()),
        "end_sideways_m": float(sideways[-1]),
        "tilt_deg": float(tilt.max()),
        "end_tilt_deg": float(tilt[-1]),
        "turn_deg": float(turn_deg),
        "end_turn_deg": float(np.degrees(steps.sum())),
    }


def _reversals(middle_m: np.ndarray) -> int:
    """Count the reversals of a path (frame, 3): direction changes of more than 120 degrees."""
    step = middle_m[_REVERSAL_FRAMES:] - middle_m[:-_REVERSAL_FRAMES]
    before, after = step[:-_REVERSAL_FRAMES], step[_REVERSAL_FRAMES:]
    length = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    is_reversal = (before * after).sum(axis=1) < -0.5 * length[0] * length[1]  # cos 120 degrees = -0.5
    return len(runs(is_reversal & (np.minimum(*length) >= _REVERSAL_M)))


def _touching(touching: np.ndarray) -> dict[str, float]:
    frames = np.flatnonzero(touching.any(axis=0))
    span = touching[:, frames[0] : frames[-1] + 1] if len(frames) else touching[:, :0]
    quarter = -(-span.shape[1] // 4)
    first, last = (part.sum(axis=1) * 2 >= max(quarter, 1) for part in (span[:, :quarter], span[:, -quarter:]))
    grasps = {
        f"{name}_{side}": float(is_grasping[hand])
        for name, is_grasping in (("first", first), ("last", last))
        for hand, side in enumerate(SIDES)
    }
    return grasps | {"hand_changes": float((first != last).sum())}


@dataclass(frozen=True)
class Actions:
    """Limits, usual ranges and centroids of the measures, by verb of a dataset."""

    limits: Mapping[str, Limits]  # by verb, limits that a motion of the verb satisfies
    learnt: Mapping[str, int]  # number of clips for verbs with limits from clips; other limits are from actions.toml
    centroids: Mapping[str, np.ndarray]  # by verb, mean standardised measures of its training clips
    scale: Mapping[str, tuple[float, float]]  # by measure, mean and deviation (``MIN_DEVIATION`` or more) of all clips
    usual: Mapping[str, Limits] = field(default_factory=dict)  # by verb, ``usual_limits``

    def satisfies_limits(self, verb: str | None, numbers: Mapping[str, float]) -> bool | None:
        """Whether a motion is within the verb's limits; None if the verb has no limits or a measure is NaN."""
        limits = self.limits.get(verb or "")
        return None if limits is None else _within(numbers, limits)

    def nearest_verb(self, numbers: Mapping[str, float]) -> str | None:
        """Return the verb with the nearest centroid; None if a measure is NaN or no verb has a centroid."""
        standardised = _standardised(numbers, self.scale)
        if not self.centroids or np.isnan(standardised).any():
            return None
        return min(self.centroids, key=lambda verb: float(np.linalg.norm(self.centroids[verb] - standardised)))

    def unusual(self, verb: str, numbers: Mapping[str, float]) -> tuple[str, ...]:
        """Describe the measures outside of the verb's ``usual`` range."""
        limits = self.usual.get(verb, {})
        texts = (describe_unusual(name, numbers[name], *limits[name]) for name in self.violations(verb, numbers))
        return tuple(filter(None, texts))

    def visibly_unusual(self, verb: str, numbers: Mapping[str, float]) -> tuple[str, ...]:
        """Describe the measures so far outside of the verb's ``usual`` range that a viewer notices."""
        limits = self.usual.get(verb, {})
        visible = [name for name in self.violations(verb, numbers) if is_visible(name, numbers[name], *limits[name])]
        return tuple(filter(None, (describe_unusual(name, numbers[name], *limits[name]) for name in visible)))

    def violations(self, verb: str, numbers: Mapping[str, float]) -> dict[str, float]:
        """Return the distance of each unusual measure from the verb's ``usual`` range, relative to its width."""
        excess = {
            name: max(least - numbers[name], numbers[name] - most) / ((most - least) or 1.0)
            for name, (least, most) in self.usual.get(verb, {}).items()
        }
        return {name: relative for name, relative in excess.items() if relative > 0}

    @property
    def record(self) -> dict[str, Any]:
        """What ``nearest_verb`` and ``unusual`` need, as plain values."""
        centroids = {verb: dict(zip(self.scale, mean.tolist(), strict=True)) for verb, mean in self.centroids.items()}
        usual = {verb: {name: list(pair) for name, pair in limits.items()} for verb, limits in self.usual.items()}
        scale = {name: list(pair) for name, pair in self.scale.items()}
        return {"scale": scale, "centroids": centroids, "usual": usual}

    @classmethod
    def read(cls, record: Mapping[str, Any]) -> "Actions":
        """Build from a record. The result has no limits: ``satisfies_limits`` returns None for each verb."""
        scale = {name: (float(mean), float(deviation)) for name, (mean, deviation) in record["scale"].items()}
        centroids = {verb: np.array([means[name] for name in scale]) for verb, means in record["centroids"].items()}
        usual = {
            verb: {name: (float(least), float(most)) for name, (least, most) in limits.items()}
            for verb, limits in record.get("usual", {}).items()
        }
        return cls(limits={}, learnt={}, centroids=centroids, scale=scale, usual=usual)

    @property
    def facts(self) -> dict[str, Any]:
        """The source of each verb's limits, for the metrics file."""
        return {"limits": sorted(set(self.limits) - set(self.learnt)), "learnt": dict(sorted(self.learnt.items()))}


def training_actions(annotated: AnnotatedStore) -> Actions:
    """Compute the actions of a dataset from its training clips and ``actions.toml``."""
    numbers: dict[str, list[dict[str, float]]] = {}
    for clip_id in annotated.ids("train"):
        if verb := annotated.verb(clip_id):
            clip = annotated.store.clip(clip_id, motion_only=True)
            near = annotated.distances(clip_id)
            touching = np.zeros((len(SIDES), clip.n_frames), bool)
            touching[near.side, near.frame] = True
            numbers.setdefault(verb, []).append(action_numbers(clip.object, clip.gravity, touching))
    return learn_actions(numbers, written_limits())


def learn_actions(
    numbers: Mapping[str, list[dict[str, float]]], written: Mapping[str, Limits] | None = None
) -> Actions:
    """Compute actions from the measures of clips.

    Args:
        numbers: by verb, ``action_numbers`` of each clip.
        written: by verb, limits that replace computed ones if most of the verb's clips satisfy them.
    """
    scale = {}
    for name in VERB_MEASURES:
        by_verb = [_finite(clips, name) for clips in numbers.values()]
        if by_verb and all(by_verb):  # each verb needs a value, or verbs could not be compared
            column = np.concatenate(by_verb)
            scale[name] = float(column.mean()), max(float(column.std()), MIN_DEVIATION[name.rpartition("_")[2]])
    usual = usual_limits(numbers, scale)
    limits, learnt = dict[str, Limits](), dict[str, int]()
    for verb, clips in numbers.items():
        table = (written or {}).get(verb)
        within = [] if table is None else [one for clip in clips if (one := _within(clip, table)) is not None]
        if table is not None and within and np.mean(within) >= MIN_FRACTION_WITHIN:
            limits[verb] = table
        elif verb in usual and not _within(AT_REST, usual[verb]):
            limits[verb], learnt[verb] = usual[verb], len(clips)
    centroids = {verb: np.nanmean([_standardised(clip, scale) for clip in clips], 0) for verb, clips in numbers.items()}
    return Actions(limits=limits, learnt=learnt, centroids=centroids, scale=scale, usual=usual)


def usual_limits(
    numbers: Mapping[str, list[dict[str, float]]], scale: Mapping[str, tuple[float, float]]
) -> dict[str, Limits]:
    """Compute the usual range of each measure in ``scale``, by verb; only from ``MIN_CLIPS`` known values or more.

    The range is the 1st to the 99th percentile, widened by ``MARGIN`` deviations of the verb's clips. If these hardly
    differ, the deviation of all clips is used.
    """
    limits = dict[str, Limits]()
    for verb, clips in numbers.items():
        columns = {name: _finite(clips, name) for name in scale}
        ranges = {name: _range(values, scale[name][1]) for name, values in columns.items() if len(values) >= MIN_CLIPS}
        limits |= {verb: ranges} if ranges else {}
    return limits


def _finite(clips: list[dict[str, float]], name: str) -> list[float]:
    """The values of one measure, without those of clips in which it is unknown."""
    return [clip[name] for clip in clips if np.isfinite(clip[name])]


def _range(values: list[float], of_all_clips: float) -> tuple[float, float]:
    of_verb = float(np.std(values))
    deviation = of_verb if of_verb > MIN_RELATIVE_DEVIATION * of_all_clips else of_all_clips
    low, high = np.percentile(values, (1, 99))
    return float(low - MARGIN * deviation), float(high + MARGIN * deviation)


def _within(numbers: Mapping[str, float], limits: Limits) -> bool | None:
    if any(np.isnan(numbers[name]) for name in limits):
        return None
    return all(least <= numbers[name] <= most for name, (least, most) in limits.items())


def _standardised(numbers: Mapping[str, float], scale: Mapping[str, tuple[float, float]]) -> np.ndarray:
    return np.array([(numbers[name] - mean) / deviation for name, (mean, deviation) in scale.items()])


@cache
def written_limits() -> dict[str, Limits]:
    """Read the limits of ``actions.toml`` by verb."""
    tables = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    return {
        verb: {name: (float(least), float(most)) for name, (least, most) in table.items()}
        for verb, table in tables.items()
    }
