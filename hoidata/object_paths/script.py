"""A short script of what an object does: ``lift 15 cm, open to 70 deg in 1.5 s, tilt 30 deg, hold, put down``.

Steps are parted by commas, semicolons, new lines or "then" and follow each other; what "and" joins happens at once.
``#`` begins a remark. A step is a verb, a direction where it has one, an amount with its unit ("to" makes it absolute),
and how long it takes ("in 1.5 s"); without, at an easy pace.
"""

import difflib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.object_paths.path import ObjectPath, PathStep, check_mean_rate, checked_path, frame_times, smooth
from hoidata.objects.model import ObjectModel

MOST_LETTERS, MOST_STEPS = 5000, 200
REST_S = 0.5  # before the first step and after the last, in which hands come and go
PACE = {"length": 0.2, "angle": math.radians(60)}  # mean speed of a step without a time: m/s, rad/s
SHORTEST_S, HOLD_S, SHAKES, SHAKES_PER_S = 0.6, 1.0, 3, 2.0
MOST_SHAKES_PER_S = 10.0  # 30 frames per second show no more
LIFT_M, SHAKE_M, TILT_RAD, TURN_RAD, OPEN_RAD = 0.15, 0.03, math.radians(45), math.pi / 2, math.pi / 2
UNITS: dict[str, tuple[str, float]] = {
    **{word: ("length", 1.0) for word in ("m", "metre", "metres", "meter", "meters")},
    **{word: ("length", 0.01) for word in ("cm", "centimetre", "centimetres", "centimeter", "centimeters")},
    **{word: ("length", 0.001) for word in ("mm", "millimetre", "millimetres", "millimeter", "millimeters")},
    **{word: ("length", 0.0254) for word in ("inch", "inches")},
    **{word: ("angle", math.pi / 180) for word in ("deg", "degree", "degrees", "°")},
    **{word: ("angle", 1.0) for word in ("rad", "radian", "radians")},
    **{word: ("time", 1.0) for word in ("s", "sec", "second", "seconds")},
    "ms": ("time", 0.001),
    **{word: ("count", 1.0) for word in ("times", "x", "time")},
}
DIRECTIONS = {
    "left": np.array([-1.0, 0, 0]),
    "right": np.array([1.0, 0, 0]),
    **dict.fromkeys(("away", "forward", "forwards"), np.array([0.0, 1, 0])),
    **dict.fromkeys(("back", "backward", "backwards", "towards", "toward"), np.array([0.0, -1, 0])),
    "up": np.array([0.0, 0, 1]),
    "down": np.array([0.0, 0, -1]),
    **dict.fromkeys(("clockwise",), np.array([1.0, 0, 0])),
    **dict.fromkeys(("anticlockwise", "counterclockwise"), np.array([-1.0, 0, 0])),
}
_FILLING = ("by", "the", "it", "a", "an", "object", "lid", "slowly", "again")
_CHANNELS = ("x", "y", "z", "yaw", "tilt_x", "tilt_y", "hinge")


@dataclass(frozen=True)
class Step:
    """One step as it is written. amount: metres or radians, None where not told; absolute: it was "to" that amount."""

    verb: str
    words: str
    amount: float | None = None
    unit: str = ""
    absolute: bool = False
    direction: str = ""
    duration_s: float | None = None
    count: float | None = None


@dataclass
class _State:
    """Where everything is, by channel; limits: stops of the hinge."""

    value: dict[str, float]
    limits: tuple[float, float] | None


@dataclass
class _Plan:
    """keys: per channel times and values. shakes: (start, duration, count, vector) of each."""

    keys: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {name: [] for name in _CHANNELS})
    shakes: list[tuple[float, float, float, np.ndarray]] = field(default_factory=list)


def scripted_path(
    model: ObjectModel,
    script: str,
    limits_rad: tuple[float, float] | None = None,
    rest_s: float = REST_S,
    standing: np.ndarray | None = None,
) -> ObjectPath:
    """The motion of an object that does what a script says.

    limits_rad: stops of the hinge, where they are known; by the larger of the two it opens. rest_s: how long it stands
    before and after. standing: as in ``checked_path``. Raises BadInput for what ``parse_script`` or ``checked_path``
    refuse, and for a hinge it has not.
    """
    plan, state = _Plan(), _State(dict.fromkeys(_CHANNELS, 0.0), limits_rad)
    now, steps = rest_s, [PathStep("at rest", 0.0, rest_s)]
    for group in parse_script(script, re.findall(r"[^\W\d_]+", model.name.lower())):
        spans = [_planned(step, model, state, plan, now) for step in group]
        steps += [PathStep(step.words, now, now + span) for step, span in zip(group, spans, strict=True)]
        now += max(spans)
    steps.append(PathStep("at rest", now, now + rest_s))
    at_s = frame_times(now + rest_s)
    curve = {name: _channel(keys, at_s) for name, keys in plan.keys.items()}
    shift = np.stack([curve[name] for name in "xyz"], axis=1)
    for shake in plan.shakes:
        shift += _shaken(shake, at_s)
    zero = np.zeros(len(at_s))
    tilt = rotvec_to_rotmat(np.stack((curve["tilt_x"], curve["tilt_y"], zero), axis=1))
    rotmats = tilt @ rotvec_to_rotmat(np.stack((zero, zero, curve["yaw"]), axis=1))
    return checked_path(model, shift, rotmats, curve["hinge"], steps, limits_rad, standing)


def parse_script(script: str, names: Sequence[str] = ()) -> list[list[Step]]:
    """Groups of steps; those of a group happen at once. names: words for the object, which say nothing.

    Raises BadInput that names the step and what to write.
    """
    if len(script) > MOST_LETTERS:
        raise BadInput("script", f"at most {MOST_LETTERS} letters", f"{len(script)}", "leave steps out")
    text = re.sub(r"#[^\n]*", "", script).lower()
    pieces = [piece.strip() for piece in re.split(r"[,;\n]+(?!\d)|\bthen\b|\.(?!\d)", text)]
    groups = [
        [_parsed(part.strip(), names) for part in re.split(r"\band\b|\bwhile\b", piece)] for piece in pieces if piece
    ]
    if not 1 <= sum(map(len, groups)) <= MOST_STEPS:
        raise BadInput("script", f"1 to {MOST_STEPS} steps", f"{sum(map(len, groups))}", f"write e.g. {EXAMPLE!r}")
    return groups


EXAMPLE = "lift 15 cm, open to 70 deg in 1.5 s, hold, put down"


def _parsed(words: str, names: Sequence[str]) -> Step:
    tokens = re.findall(r"\d*\.?\d+(?:e[+-]?\d+)?|[^\W\d_]+|°|[^\w\s]", words.replace("degrees", "deg"))
    if not tokens:
        raise BadInput("script", "a verb", repr(words), f"begin with one of {', '.join(VERBS)}")
    if len(tokens) > 20:
        raise BadInput(
            f"script: {words[:40]!r}", "a step of at most 20 words", f"{len(tokens)}", "part steps by commas"
        )
    verb, rest = _verb(words, tokens)
    return _with_details(Step(verb, words), rest, names)


def _verb(words: str, tokens: list[str]) -> tuple[str, list[str]]:
    for pair, verb in _TWO_WORDS.items():
        first, second = pair.split()
        if tokens[0] == first and second in tokens[1:]:  # "put the box down"
            place = tokens.index(second, 1)
            return verb, tokens[1:place] + tokens[place + 1 :]
    if tokens[0] in _SYNONYMS:
        return _SYNONYMS[tokens[0]], tokens[1:]
    whole = [pair for pair in _TWO_WORDS if pair.split()[0] == tokens[0]]
    near = whole or difflib.get_close_matches(" ".join(tokens[:2]), _TWO_WORDS, 1, 0.75)
    near = near or difflib.get_close_matches(tokens[0], _SYNONYMS, 1, 0.5)
    remedy = f"did you mean {near[0]!r}?" if near else f"write e.g. {EXAMPLE!r}"
    raise BadInput(f"script: {words[:40]!r}", f"a verb: {', '.join(VERBS)}", tokens[0], remedy)


def _with_details(step: Step, tokens: list[str], names: Sequence[str]) -> Step:
    """The step with its direction, amounts and time."""
    values: dict[str, object] = {}
    place, before = 0, ""
    while place < len(tokens):
        word = tokens[place]
        if _is_number(word) or word in "+-":
            sign = -1.0 if word == "-" else 1.0
            place += word in "+-"
            number, unit = [*tokens[place : place + 2], "", ""][:2]
            values |= _amount(step, number, unit, sign, before, values)
            place += 1
        elif word in DIRECTIONS and "direction" not in values:
            values["direction"] = word
        elif word not in (*_FILLING, "to", "in", "for", "over", "within", *names):
            near = difflib.get_close_matches(word, [*DIRECTIONS, *UNITS], 1, 0.7)
            remedy = f"did you mean {near[0]!r}?" if near else f"leave {word!r} out"
            raise BadInput(f"script: {step.words[:40]!r}", "a direction, an amount or a time", word, remedy)
        before, place = word, place + 1
    return Step(step.verb, step.words, **values)  # pyright: ignore[reportArgumentType]


def _is_number(word: str) -> bool:
    return word[:1].isdigit() or (word[:1] == "." and word[1:2].isdigit())


def _amount(
    step: Step, number: str, unit: str, sign: float, before: str, values: dict[str, object]
) -> dict[str, object]:
    where = f"script: {step.words[:40]!r}"
    takes = VERBS[step.verb].takes
    if not _is_number(number):
        raise BadInput(where, "a number after the sign", number or "nothing", "write e.g. 15 cm")
    if unit not in UNITS:
        units = {"length": "cm", "angle": "deg", "time": "s", "count": "times"}
        wanted = " or ".join(f"{number} {units[kind]}" for kind in (*takes, "time"))
        raise BadInput(where, f"a unit after {number}", unit or "nothing", f"write {wanted}")
    kind, factor = UNITS[unit]
    value = sign * float(number) * factor
    if kind == "time" or (kind == "count" and "count" in takes):
        name = "duration_s" if kind == "time" else "count"
        if not 1e-3 <= value <= 120:
            raise BadInput(where, "0.001 or more, and at most 120", f"{value:g} {unit}", "correct the number")
        return {name: value}
    if kind not in takes:
        told = " or ".join({"length": "a length (cm)", "angle": "an angle (deg)"}.get(k, k) for k in takes) or "a time"
        raise BadInput(where, told, f"{number} {unit}", "correct the unit")
    if "amount" in values or not abs(value) < 100:
        raise BadInput(where, "one amount, below 100 m or rad", f"{number} {unit}", "part steps by commas")
    return {"amount": value, "unit": kind, "absolute": before == "to"}


def _planned(step: Step, model: ObjectModel, state: _State, plan: _Plan, start: float) -> float:
    """Put the step into the plan; gives its seconds."""
    where = f"script: {step.words[:40]!r}"
    if step.verb in ("open", "close") and not model.is_articulated:
        remedy = 'tell the hinge of a two-piece mesh (--hinge "px,py,pz dx,dy,dz"), or leave the step out'
        raise BadInput(where, "an object with a hinge", f"{model.name!r}, which is rigid", remedy)
    targets = VERBS[step.verb].targets(step, state)
    if step.verb == "shake":
        count = step.count or SHAKES
        span = step.duration_s or count / SHAKES_PER_S
        way = DIRECTIONS[step.direction or "up"] * (SHAKE_M if step.amount is None else step.amount)
        if count / span > MOST_SHAKES_PER_S:
            remedy = f"give it {math.ceil(10 * count / MOST_SHAKES_PER_S) / 10:g} s or more"
            raise BadInput(where, f"at most {MOST_SHAKES_PER_S:g} times a second", f"{count / span:.3g}", remedy)
        plan.shakes.append((start, span, count, way))
        return span
    span = step.duration_s or _easy_span(targets, state)
    for name, target in targets.items():
        unit = "m/s" if name in "xyz" else "rad/s of the hinge" if name == "hinge" else "rad/s"
        check_mean_rate(PathStep(step.words, start, start + span), np.array([target - state.value[name]]), unit)
        if plan.keys[name] and plan.keys[name][-1][0] > start + 1e-9:
            raise BadInput(where, "steps at once that move different things", "two that move the same", "write 'then'")
        plan.keys[name] += [(start, state.value[name]), (start + span, target)]
        state.value[name] = target
    return span


def _easy_span(targets: dict[str, float], state: _State) -> float:
    if not targets:
        return HOLD_S
    ways = {name: abs(target - state.value[name]) for name, target in targets.items()}
    spans = [way / PACE["length" if name in "xyz" else "angle"] for name, way in ways.items()]
    return max(SHORTEST_S, math.ceil(10 * max(spans) - 1e-9) / 10)


def _channel(keys: list[tuple[float, float]], at_s: np.ndarray) -> np.ndarray:
    """(frame,) values: each step from stop to stop."""
    out = np.zeros(len(at_s))
    for (start, first), (end, last) in zip(keys[::2], keys[1::2], strict=True):
        inside = np.clip(at_s, start, end)
        moved = smooth(np.array([start, end]), np.array([first, last]), inside)
        out = np.where(at_s >= start, moved, out)
    return out


def _shaken(shake: tuple[float, float, float, np.ndarray], at_s: np.ndarray) -> np.ndarray:
    """(frame, 3) there and back, beginning and ending softly."""
    start, span, count, way = shake
    part = np.clip((at_s - start) / span, 0, 1)
    ramp = np.clip(np.minimum(part, 1 - part) * 2 * max(count, 1), 0, 1)
    soft = ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
    return (soft * np.sin(2 * np.pi * count * part))[:, None] * way


def _shifted(name: str, amount: float, step: Step, state: _State) -> dict[str, float]:
    return {name: amount if step.absolute else state.value[name] + amount}


def _lift(step: Step, state: _State) -> dict[str, float]:
    return _shifted("z", LIFT_M if step.amount is None else step.amount, step, state)


def _lower(step: Step, state: _State) -> dict[str, float]:
    if step.amount is None:
        return {"z": 0.0}
    return _shifted("z", step.amount if step.absolute else -step.amount, step, state)


def _put_down(step: Step, state: _State) -> dict[str, float]:
    """Upright, on the table."""
    return {name: 0.0 for name in ("z", "tilt_x", "tilt_y")}


def _move(step: Step, state: _State) -> dict[str, float]:
    if step.amount is None or not step.direction:
        remedy = "write e.g. 'move left 20 cm'"
        raise BadInput(f"script: {step.words[:40]!r}", "a direction and a length", "only one of them", remedy)
    way = DIRECTIONS[step.direction] * step.amount
    axis = int(np.abs(way).argmax())
    return _shifted("xyz"[axis], float(way[axis]), step, state)


def _turn(step: Step, state: _State) -> dict[str, float]:
    """About the vertical; to the left (anticlockwise from above) where nothing is said."""
    sign = 1.0 if not step.direction else -float(np.sign(DIRECTIONS[step.direction][0]))
    if sign == 0:
        remedy = "write left or right; 'tilt' leans it over"
        raise BadInput(f"script: {step.words[:40]!r}", "a turn about the vertical", step.direction, remedy)
    return _shifted("yaw", sign * (TURN_RAD if step.amount is None else step.amount), step, state)


def _tilt(step: Step, state: _State) -> dict[str, float]:
    """The top goes where it is said, forward where nothing is."""
    way = DIRECTIONS[step.direction or "forward"]
    if way[2]:
        remedy = "write left, right, forward or back"
        raise BadInput(f"script: {step.words[:40]!r}", "a side to lean to", step.direction, remedy)
    amount = TILT_RAD if step.amount is None else step.amount
    name, sign = ("tilt_y", way[0]) if way[0] else ("tilt_x", -way[1])
    return _shifted(name, float(sign) * amount, step, state)


def _level(step: Step, state: _State) -> dict[str, float]:
    return {"tilt_x": 0.0, "tilt_y": 0.0}


def _open(step: Step, state: _State) -> dict[str, float]:
    """To an angle; by it where it says so."""
    low, high = state.limits or (0.0, math.pi)
    sign = 1.0 if high >= -low else -1.0
    if step.amount is None:
        return {"hinge": sign * min(OPEN_RAD, max(high, -low))}
    by = re.search(r"\bby\b", step.words) is not None
    return {"hinge": state.value["hinge"] * by + sign * step.amount}


def _close(step: Step, state: _State) -> dict[str, float]:
    low, high = state.limits or (0.0, math.pi)
    sign = 1.0 if high >= -low else -1.0
    if step.amount is None or step.absolute:
        return {"hinge": sign * (step.amount or 0.0)}
    return {"hinge": state.value["hinge"] - sign * step.amount}


def _nothing(step: Step, state: _State) -> dict[str, float]:
    return {}


@dataclass(frozen=True)
class Verb:
    """targets: where a step takes which channel. takes: kinds of amounts beside a time."""

    targets: Callable[[Step, _State], dict[str, float]]
    takes: tuple[str, ...] = ()


VERBS = {
    "lift": Verb(_lift, ("length",)),
    "lower": Verb(_lower, ("length",)),
    "put down": Verb(_put_down),
    "move": Verb(_move, ("length",)),
    "turn": Verb(_turn, ("angle",)),
    "tilt": Verb(_tilt, ("angle",)),
    "level": Verb(_level),
    "open": Verb(_open, ("angle",)),
    "close": Verb(_close, ("angle",)),
    "shake": Verb(_nothing, ("length", "count")),
    "hold": Verb(_nothing),
}
_SYNONYMS = {name: name for name in VERBS if " " not in name} | {
    **dict.fromkeys(("raise",), "lift"),
    **dict.fromkeys(("sink",), "lower"),
    **dict.fromkeys(("place",), "put down"),
    **dict.fromkeys(("shift", "slide", "push", "pull"), "move"),
    **dict.fromkeys(("rotate", "spin"), "turn"),
    **dict.fromkeys(("lean", "tip"), "tilt"),
    **dict.fromkeys(("straighten",), "level"),
    **dict.fromkeys(("shut",), "close"),
    **dict.fromkeys(("wait", "pause", "stay", "rest"), "hold"),
}
_TWO_WORDS = {
    "put down": "put down",
    "set down": "put down",
    "lay down": "put down",
    "pick up": "lift",
    "hold still": "hold",
}
