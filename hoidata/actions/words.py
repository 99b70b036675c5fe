"""Numbers of a motion in words, beside the bounds they usually have, for a person to read."""

from math import ceil, floor
from typing import NamedTuple


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
