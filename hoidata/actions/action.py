"""What an object does in a clip, in numbers, and whether that is what a verb says.

``actions.toml`` beside this file holds what a verb asks of a motion, one table per verb, ``number = [least, most]``;
a motion follows the verb when all of them hold. A table counts for a dataset when nine in ten of the verb's own
training clips follow it; for every other verb the limits are learnt from those clips.

Numbers of a motion in words, beside the bounds they usually have, for a person to read.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from math import ceil, floor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hoidata.clips.clip import FPS, SIDES, ObjectTrack
from hoidata.errors import BadInput
from hoidata.geometry.intervals import runs
from hoidata.geometry.rotations import turns_about
from hoidata.store.annotated import AnnotatedStore


class Words(NamedTuple):
    """One number of a motion.

    what: its name. unit: after the number. seen: by how much it must lie outside the usual bounds for a person who
    watches the motion to see that, in the number's own unit. times: from that unit to ``unit``. signed: may be below 0.
    """

    what: str
    unit: str
    seen: float
    times: float = 1.0
    signed: bool = False


# What a person sees without measuring. Places: a square of the grid under every motion. Angles: an hour on the face of
# a clock. Sums over a motion count what goes there and back twice. A hand jumps where it crosses a square in one frame.
# A hand slides where that is the breadth of a finger in a second.
PLACE_M, ANGLE_DEG, JUMP_M_S, SLIDE_CM_S = 0.10, 30.0, 3.0, 2.0
WORDS = {
    "rise_m": Words("highest rise", " cm", PLACE_M, 100),
    "end_rise_m": Words("rise at the end", " cm", PLACE_M, 100, signed=True),
    "sideways_m": Words("farthest sideways", " cm", PLACE_M, 100),
    "end_sideways_m": Words("sideways at the end", " cm", PLACE_M, 100),
    "tilt_deg": Words("greatest tilt", " degrees", ANGLE_DEG),
    "end_tilt_deg": Words("tilt at the end", " degrees", ANGLE_DEG),
    "turn_deg": Words("turning about the vertical in all", " degrees", 2 * ANGLE_DEG),
    "end_turn_deg": Words("turned at the end, counter-clockwise from above,", " degrees", ANGLE_DEG, signed=True),
    "path_m": Words("length of the path", " cm", 2 * PLACE_M, 100),
    "reversals_per_s": Words("turns back", " times a second", 1.0),
    "hinge_net_deg": Words("change of the hinge at the end", " degrees", ANGLE_DEG, signed=True),
    "hinge_max_deg": Words("greatest change of the hinge", " degrees", ANGLE_DEG),
    "hand_changes": Words("hands that take or give", "", 1.0),
    "joint_m_s": Words("fastest joint", " m/s", JUMP_M_S),
    "slip_cm_s": Words("slip of hands", " cm/s", SLIDE_CM_S),
}


def beside_usual(name: str, value: float, least: float, most: float) -> str | None:
    """One number outside its usual bounds, as ``highest rise 15.8 cm (usual: 19.1 to 23.7)``.

    None where it reads as the bound itself: what a person cannot tell apart is not said.
    """
    what, unit, _, times, signed = WORDS[name]
    if not unit:  # counted
        least, most = ceil(least), floor(most)
    own, low, high = (_rounded(number * times) for number in (value, least, most))
    if own in (low, high):
        return None
    return f"{what} {own}{unit} (usual: {f'{low} to {high}' if signed or least > 0 else f'at most {high}'})"


def is_seen(name: str, value: float, least: float, most: float) -> bool:
    """Whether a number lies so far outside its usual bounds that a person who watches the motion sees it."""
    if not WORDS[name].unit:
        least, most = ceil(least), floor(most)
    return max(least - value, value - most) >= WORDS[name].seen


def _rounded(number: float) -> str:
    """Three digits, and never a power of ten."""
    return f"{number:.0f}" if abs(number) >= 1000 else f"{number:.3g}"


TABLE = Path(__file__).with_name("actions.toml")
NUMBERS = {
    "rise_m": "greatest height of the object's middle over that of the first frame",
    "end_rise_m": "the same in the last frame",
    "sideways_m": "greatest horizontal distance of the middle from where it was first",
    "end_sideways_m": "the same in the last frame",
    "tilt_deg": "greatest angle between the object's first upright direction and the upright",
    "end_tilt_deg": "the same in the last frame",
    "turn_deg": "turns about the upright, either way, added up; of steps smoothed over 5 frames, so that none is noise",
    "end_turn_deg": "by how much it has turned about the upright in the last frame, counter-clockwise from above",
    "path_m": "length of the middle's path",
    "reversals_per_s": "how often the middle turns back: 2 mm or more in 0.1 s, and as much the other way",
    "hinge_net_deg": "hinge angle of the last frame less that of the first; 0 for a rigid object",
    "hinge_max_deg": "greatest change of the hinge angle since the first frame, either way; 0 for a rigid object",
    "hand_changes": "hands that hold it first and not last, or the reverse: 0, 1 or 2",
    "first_left": "1 where the left hand holds it first: touches in half of the first quarter of the touched time",
    "first_right": "1 where the right hand holds it first",
    "last_left": "1 where the left hand holds it last: in half of the last quarter",
    "last_right": "1 where the right hand holds it last",
}
HANDS = {"one hold": (0.0, 0.0), "change": (1.0, 2.0)}  # `hands` in actions.toml, as limits of `hand_changes`
OF_GIVEN_HANDS = ("first_left", "first_right", "last_left", "last_right")  # asked for in words, so no part of a verb
LEARNT = tuple(name for name in NUMBERS if name not in OF_GIVEN_HANDS)
LEAST_CLIPS = 3  # of a verb to learn its limits from
SHARE_THAT_FOLLOWS = 0.9
MARGIN = 0.5  # deviations, added to the 1st and 99th percentile of the verb's own clips
ALIKE = 0.25  # of the deviation of all clips: a verb whose own deviate by no more says nothing of how much is usual
LEAST_DEVIATION = {
    "m": 0.03,
    "deg": 10.0,
    "s": 1.0,
    "changes": 1.0,
}  # by the end of a number's name: what counts little
_BACK_FRAMES, _BACK_M = 3, 0.002
_SMOOTH = 5
Limits = dict[str, tuple[float, float]]


def action_numbers(track: ObjectTrack, gravity: np.ndarray | None, touching: np.ndarray) -> dict[str, float]:
    """``NUMBERS`` of one motion; NaN for what needs gravity where that is not known.

    gravity: (3,) unit vector in the world, or None. touching: (2, frame) bool, whether the left and the right hand
    touch the object.
    """
    degrees = np.zeros(track.n_frames)
    if track.hinge_rad is not None:
        degrees = np.degrees(track.hinge_rad - track.hinge_rad[0], dtype=np.float64)
    middle_m = object_middle_m(track)
    nothing = dict.fromkeys(NUMBERS, float("nan"))
    return nothing | _upright(track, middle_m, gravity) | _touching(touching) | {
        "path_m": float(np.linalg.norm(np.diff(middle_m, axis=0), axis=1).sum()),
        "reversals_per_s": _reversals(middle_m) * FPS / track.n_frames,
        "hinge_net_deg": float(degrees[-1]),
        "hinge_max_deg": float(np.abs(degrees).max()),
    }  # fmt: skip


def object_middle_m(track: ObjectTrack) -> np.ndarray:
    """(frame, 3) world: the middle of the box about the object's base."""
    base = track.model.vertices_m[np.unique(track.model.faces_of(0))]
    return (track.world_from_object @ ((base.min(axis=0) + base.max(axis=0)) / 2)[None])[:, 0]


def _upright(track: ObjectTrack, middle_m: np.ndarray, gravity: np.ndarray | None) -> dict[str, float]:
    """What is measured against gravity. middle_m: (frame, 3) world."""
    if gravity is None:
        return {}
    up = -np.asarray(gravity, np.float64)
    way = middle_m - middle_m[0]
    rise, sideways = way @ up, np.linalg.norm(way - (way @ up)[:, None] * up, axis=1)
    rotation = track.world_from_object.rotation
    since_first = rotation @ rotation[0].T
    tilt = np.degrees(np.arccos(np.clip((since_first @ up) @ up, -1, 1)))
    steps = turns_about(rotation, up)
    turn = np.degrees(np.abs(np.convolve(steps, np.full(_SMOOTH, 1 / _SMOOTH), mode="full")).sum())
    return {
        "rise_m": float(rise.max()),
        "end_rise_m": float(rise[-1]),
        "sideways_m": float(sideways.max()),
        "end_sideways_m": float(sideways[-1]),
        "tilt_deg": float(tilt.max()),
        "end_tilt_deg": float(tilt[-1]),
        "turn_deg": float(turn),
        "end_turn_deg": float(np.degrees(steps.sum())),
    }


def _reversals(middle_m: np.ndarray) -> int:
    """How often a path (frame, 3) turns back on itself."""
    step = middle_m[_BACK_FRAMES:] - middle_m[:-_BACK_FRAMES]
    before, after = step[:-_BACK_FRAMES], step[_BACK_FRAMES:]
    length = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    back = (before * after).sum(axis=1) < -0.5 * length[0] * length[1]
    return len(runs(back & (np.minimum(*length) >= _BACK_M)))


def _touching(touching: np.ndarray) -> dict[str, float]:
    frames = np.flatnonzero(touching.any(axis=0))
    span = touching[:, frames[0] : frames[-1] + 1] if len(frames) else touching[:, :0]
    quarter = -(-span.shape[1] // 4)
    first, last = (own.sum(axis=1) * 2 >= max(quarter, 1) for own in (span[:, :quarter], span[:, -quarter:]))
    sides = {
        f"{name}_{side}": float(own[row])
        for name, own in (("first", first), ("last", last))
        for row, side in enumerate(SIDES)
    }
    return sides | {"hand_changes": float((first != last).sum())}


@dataclass(frozen=True)
class Actions:
    """What the verbs of a dataset ask of a motion.

    limits: of every verb that has any, by number. learnt: how many training clips a verb's limits are learnt from; the
    other verbs have theirs from ``actions.toml``. usual: bounds of every verb with ``LEAST_CLIPS`` clips, whether or
    not it has limits in the file: from the 1st to the 99th percentile and ``MARGIN`` of its own deviations beyond, or
    of all clips' where its own are ``ALIKE``; learnt limits are wider, always by ``MARGIN`` of all clips'. centroids:
    by verb, the mean of its training clips' standardised numbers. scale: of each of these numbers its mean and standard
    deviation over all training clips, the latter at least ``LEAST_DEVIATION``: in clean recordings some hardly differ,
    and a prediction a little off is not far off.
    """

    limits: Mapping[str, Limits]
    learnt: Mapping[str, int]
    centroids: Mapping[str, np.ndarray]
    scale: Mapping[str, tuple[float, float]]
    usual: Mapping[str, Limits] = field(default_factory=dict)

    def followed(self, verb: str | None, numbers: Mapping[str, float]) -> bool | None:
        """Whether a motion does what the verb says; None where nothing is known of the verb or of its numbers."""
        limits = self.limits.get(verb or "")
        return None if limits is None else _within(numbers, limits)

    def named(self, numbers: Mapping[str, float]) -> str | None:
        """The verb whose centroid is nearest; None where a number is not known or no verb has a centroid."""
        asked = _standardised(numbers, self.scale)
        if not self.centroids or np.isnan(asked).any():
            return None
        return min(self.centroids, key=lambda verb: float(np.linalg.norm(self.centroids[verb] - asked)))

    def unusual(self, verb: str, numbers: Mapping[str, float]) -> tuple[str, ...]:
        """The numbers, in words, that lie outside the verb's ``usual`` bounds; none where it or they are not known."""
        limits = self.usual.get(verb, {})
        said = (beside_usual(name, numbers[name], *limits[name]) for name in self.beyond(verb, numbers))
        return tuple(filter(None, said))

    def seen(self, verb: str, numbers: Mapping[str, float]) -> tuple[str, ...]:
        """Those of ``unusual`` that a person who watches the motion sees."""
        limits = self.usual.get(verb, {})
        seen = [name for name in self.beyond(verb, numbers) if is_seen(name, numbers[name], *limits[name])]
        return tuple(filter(None, (beside_usual(name, numbers[name], *limits[name]) for name in seen)))

    def beyond(self, verb: str, numbers: Mapping[str, float]) -> dict[str, float]:
        """By how much numbers lie outside the verb's ``usual`` bounds, in widths of these; without those inside."""
        found = {
            name: max(least - numbers[name], numbers[name] - most) / ((most - least) or 1.0)
            for name, (least, most) in self.usual.get(verb, {}).items()
        }
        return {name: far for name, far in found.items() if far > 0}

    @property
    def record(self) -> dict[str, Any]:
        """What ``named`` and ``unusual`` need, as plain values."""
        centroids = {verb: dict(zip(self.scale, own.tolist(), strict=True)) for verb, own in self.centroids.items()}
        usual = {verb: {name: list(own) for name, own in limits.items()} for verb, limits in self.usual.items()}
        scale = {name: list(own) for name, own in self.scale.items()}
        return {"scale": scale, "centroids": centroids, "usual": usual}

    @classmethod
    def read(cls, record: Mapping[str, Any]) -> "Actions":
        """From a record; without limits, so that nothing is known of what follows a verb."""
        scale = {name: (float(mean), float(deviation)) for name, (mean, deviation) in record["scale"].items()}
        centroids = {verb: np.array([own[name] for name in scale]) for verb, own in record["centroids"].items()}
        usual = {
            verb: {name: (float(least), float(most)) for name, (least, most) in limits.items()}
            for verb, limits in record.get("usual", {}).items()
        }
        return cls({}, {}, centroids, scale, usual)

    @property
    def facts(self) -> dict[str, Any]:
        """Where each verb's limits come from, for the file of figures."""
        return {"limits": sorted(set(self.limits) - set(self.learnt)), "learnt": dict(sorted(self.learnt.items()))}


def training_actions(annotated: AnnotatedStore) -> Actions:
    """The actions of an annotated dataset: of its training part alone, and of ``actions.toml``."""
    numbers: dict[str, list[dict[str, float]]] = {}
    for clip_id in annotated.ids("train"):
        if verb := verb_of(annotated, clip_id):
            clip = annotated.store.clip(clip_id, motion_only=True)
            near = annotated.distances(clip_id)
            touching = np.zeros((len(SIDES), clip.n_frames), bool)
            touching[near.side, near.frame] = True
            numbers.setdefault(verb, []).append(action_numbers(clip.object, clip.gravity, touching))
    return learn_actions(numbers, written_limits())


def verb_of(annotated: AnnotatedStore, clip_id: str) -> str | None:
    """The verb of a clip, as it was annotated."""
    verb = annotated.hand_types.at[clip_id, "verb"]
    return verb if isinstance(verb, str) and verb else None


def learn_actions(
    numbers: Mapping[str, list[dict[str, float]]], written: Mapping[str, Limits] | None = None
) -> Actions:
    """Actions of clips' numbers by verb. written: limits that take the place of learnt ones where the clips follow."""
    every = [row for rows in numbers.values() for row in rows]
    scale = {}
    for name in LEARNT:
        column = np.array([row[name] for row in every])
        if len(column) and np.isfinite(column).all():
            scale[name] = float(column.mean()), max(float(column.std()), LEAST_DEVIATION[name.rpartition("_")[2]])
    limits, learnt = dict[str, Limits](), dict[str, int]()
    usual = usual_limits(numbers, scale)
    for verb, rows in numbers.items():
        known = (written or {}).get(verb)
        if known is not None and np.mean([_within(row, known) is True for row in rows]) >= SHARE_THAT_FOLLOWS:
            limits[verb] = known
        elif verb in usual:
            limits[verb], learnt[verb] = _bands(rows, {name: own for name, (_, own) in scale.items()}), len(rows)
    centroids = {verb: np.mean([_standardised(row, scale) for row in rows], axis=0) for verb, rows in numbers.items()}
    return Actions(limits, learnt, centroids, scale, usual)


def usual_limits(
    numbers: Mapping[str, list[dict[str, float]]], scale: Mapping[str, tuple[float, float]]
) -> dict[str, Limits]:
    """Bounds of the numbers that ``scale`` names, of every verb with enough clips, as ``Actions.usual`` has them."""
    return {verb: _bands(rows, _own(rows, scale)) for verb, rows in numbers.items() if len(rows) >= LEAST_CLIPS}


def _own(rows: list[dict[str, float]], scale: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Deviations of a verb's own clips, which tell how often to shake; of all clips where its own are alike."""
    found = {name: float(np.std([row[name] for row in rows])) for name in scale}
    return {name: found[name] if found[name] > ALIKE * every else every for name, (_, every) in scale.items()}


def _bands(rows: list[dict[str, float]], deviations: Mapping[str, float]) -> Limits:
    bands = {}
    for name, deviation in deviations.items():
        low, high = np.percentile([row[name] for row in rows], (1, 99))
        bands[name] = float(low - MARGIN * deviation), float(high + MARGIN * deviation)
    return bands


def _within(numbers: Mapping[str, float], limits: Limits) -> bool | None:
    if any(np.isnan(numbers[name]) for name in limits):
        return None
    return all(least <= numbers[name] <= most for name, (least, most) in limits.items())


def _standardised(numbers: Mapping[str, float], scale: Mapping[str, tuple[float, float]]) -> np.ndarray:
    return np.array([(numbers[name] - mean) / deviation for name, (mean, deviation) in scale.items()])


@lru_cache(maxsize=1)
def written_limits(path: Path = TABLE) -> dict[str, Limits]:
    """The limits of ``actions.toml`` by verb; none without the file. Raises BadInput for anything else in it."""
    tables = tomllib.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return {verb: _limits(f"{path.name}: {verb}", table) for verb, table in tables.items()}


def _limits(where: str, table: Mapping[str, Any]) -> Limits:
    named = {name: value for name, value in table.items() if name != "hands"}
    if "hands" in table:
        named["hand_changes"] = HANDS.get(table["hands"], ())
    for name, limits in named.items():
        if name not in NUMBERS or len(limits) != 2 or not limits[0] <= limits[1]:
            expected = f"hands: {' or '.join(HANDS)}; [least, most] of any of {', '.join(NUMBERS)}"
            raise BadInput(where, expected, f"{name} = {limits}", "correct the table")
    return {name: (float(least), float(most)) for name, (least, most) in named.items()}
