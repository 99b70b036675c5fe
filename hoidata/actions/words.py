"""Numbers of a motion in words, beside the bounds they usually have, for a person to read."""

from math import ceil, floor
from typing import NamedTuple


class Words(NamedTuple):
    """what: the number's name. unit: after the number. times: from the number to that unit. signed: may be negative."""

    what: str
    unit: str
    times: float = 1.0
    signed: bool = False


WORDS = {
    "rise_m": Words("highest rise", " cm", 100),
    "end_rise_m": Words("rise at the end", " cm", 100, signed=True),
    "sideways_m": Words("farthest sideways", " cm", 100),
    "end_sideways_m": Words("sideways at the end", " cm", 100),
    "tilt_deg": Words("greatest tilt", " degrees"),
    "end_tilt_deg": Words("tilt at the end", " degrees"),
    "turn_deg": Words("turning about the vertical in all", " degrees"),
    "end_turn_deg": Words("turned at the end, counter-clockwise from above,", " degrees", signed=True),
    "path_m": Words("length of the path", " cm", 100),
    "reversals_per_s": Words("turns back", " times a second"),
    "hinge_net_deg": Words("change of the hinge at the end", " degrees", signed=True),
    "hinge_max_deg": Words("greatest change of the hinge", " degrees"),
    "hand_changes": Words("hands that take or give", ""),
    "joint_m_s": Words("fastest joint", " m/s"),
    "slip_cm_s": Words("slip of hands", " cm/s"),
}


def beside_usual(name: str, value: float, least: float, most: float) -> str:
    """One number beside its usual bounds, as ``highest rise 15.8 cm (usual: 19.1 to 23.7)``."""
    what, unit, times, signed = WORDS[name]
    if not unit:  # counted
        least, most = ceil(least), floor(most)
    own, low, high = (_rounded(number * times) for number in (value, least, most))
    return f"{what} {own}{unit} (usual: {f'{low} to {high}' if signed or least > 0 else f'at most {high}'})"


def _rounded(number: float) -> str:
    """Three digits, and never a power of ten."""
    return f"{number:.0f}" if abs(number) >= 1000 else f"{number:.3g}"
