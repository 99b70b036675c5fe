"""Lists of metrics that are computed on request: ``evaluate: {metrics: [bimart]}`` names the list.

To add one: entries of ``registry.Metric`` with new names, and the name of the list in ``OPTIONAL_LISTS``.
"""

from collections.abc import Callable, Iterable

from hoidata.errors import BadInput
from hoidata.metrics import bimart
from hoidata.metrics.pair import Pair
from hoidata.metrics.registry import HANDS, METRICS, Direction, Metric
from hoidata.metrics.unmeasured import Values

Measure = Callable[[Pair, int], Values]
BIMART = "BimArt (Zhang et al. 2025)"
_PAPER, _CORRECTED = f"{BIMART}, as released", f"{BIMART}, this project: corrected"
_HINGE = f"the hinge turns by more than {bimart.TURNED_RAD:g} rad"
_MOVES = f"{HANDS} and an object vertex moves by more than {1000 * bimart.MOVED_M:g} mm, or {_HINGE}, to the next"
_TURNS = f"{HANDS} and {_HINGE} to the next"
_MOVES_RELEASED = (
    f"{HANDS} and an object vertex moves by more than {1000 * bimart.MOVED_AS_RELEASED_M:g} mm to the next, as in "
    "every frame of a recording"
)
_TURNS_RELEASED = f"{HANDS} and the hinge turns by more than {bimart.TURNED_AS_RELEASED_RAD:g} rad to the next"
_WHOLE = "inside where the winding number of the whole posed mesh is odd"
_SOLID = "inside the solid of a closed part"
_CONTACT = "5 mm or closer, none deeper than 1 cm"
_THREE = f"{HANDS}, three recorded ones in a row"


def _frame_percentages(
    name: str,
    title: str,
    direction: Direction,
    measures: tuple[Measure, Measure],
    *,
    thresholds: tuple[str, str],
    frames: tuple[str, str] = (HANDS, HANDS),
) -> tuple[Metric, Metric]:
    """A percentage of frames, (paper, corrected); ``paper`` pools the frames of the first motion of each clip."""
    return (
        Metric(
            f"bimart_{name}_paper", measures[0], topic="BimArt", title=f"{title}, paper", unit="%",
            direction=direction, reduction="mean over frames", frames=frames[0], source=_PAPER, samples=1,
            thresholds=thresholds[0],
        ),
        Metric(
            f"bimart_{name}_corrected", measures[1], topic="BimArt", title=f"{title}, corrected", unit="%",
            direction=direction, frames=frames[1], source=_CORRECTED, thresholds=thresholds[1],
        ),
    )  # fmt: skip


BIMART_METRICS: tuple[Metric, ...] = (
    Metric(
        "bimart_mul_cm", bimart.mul_cm, topic="BimArt", title="Mul: spread of the motions of one clip", unit="cm",
        direction="higher", source=f"{BIMART}: mean over pairs of motions; none of a single motion", aligned=True,
        together=True,
    ),
    Metric(
        "bimart_accel_paper", bimart.accel_paper, topic="BimArt", title="Accel: acceleration of vertices, paper",
        unit="cm/frame2", direction="lower", frames=_THREE, source=_PAPER, samples=1,
    ),
    Metric(
        "bimart_accel_corrected", bimart.accel_corrected, topic="BimArt", unit="m/s2",
        title="Accel: acceleration of vertices, corrected", direction="closer to recorded", frames=_THREE,
        source=_CORRECTED,
    ),
    *_frame_percentages(
        "pen_1cm", "Pen: frames deeper than 1 cm", "lower", (bimart.pen_1cm_paper, bimart.pen_1cm_corrected),
        thresholds=(f"1 cm, {_WHOLE}", f"1 cm, {_SOLID}"),
    ),
    *_frame_percentages(
        "pen_5mm", "Pen: frames deeper than 5 mm", "lower", (bimart.pen_5mm_paper, bimart.pen_5mm_corrected),
        thresholds=(f"5 mm, {_WHOLE}", f"5 mm, {_SOLID}"),
    ),
    *_frame_percentages(
        "con", "Con: contact while the object moves", "higher", (bimart.con_paper, bimart.con_corrected),
        frames=(_MOVES_RELEASED, _MOVES),
        thresholds=("closer than 5 mm, or at any depth inside", _CONTACT),
    ),
    Metric(
        "bimart_con_everywhere_corrected", bimart.con_everywhere_corrected, topic="BimArt",
        title="Con: contact in all frames, corrected", unit="%", direction="closer to recorded", source=_CORRECTED,
        thresholds=_CONTACT,
    ),
    *_frame_percentages(
        "art", "Art: contact while the hinge turns", "higher", (bimart.art_paper, bimart.art_corrected),
        frames=(_TURNS_RELEASED, _TURNS),
        thresholds=(
            "closer than 5 mm to the faces wholly in the moving part, or at any depth inside",
            f"{_CONTACT}, of the moving part with its seam",
        ),
    ),
    Metric(
        "bimart_cm_paper", bimart.contact_map_error_paper, topic="BimArt", title="CM: error of the contact map, paper",
        unit="cm", direction="lower", samples=1,
        source=f"{BIMART}, to 778 vertices: `asked-distances.npz` next to the clips",
    ),
    Metric(
        "bimart_cm_corrected", bimart.contact_map_error_corrected, topic="BimArt", unit="cm",
        title="CM: error of the contact map, corrected", direction="lower",
        source=f"{_CORRECTED}: to the hand vertices of the target map", thresholds="distances capped at 20 cm",
    ),
)  # fmt: skip

OPTIONAL_LISTS = {"bimart": BIMART_METRICS}


def select_metrics(names: Iterable[str]) -> tuple[Metric, ...]:
    """``METRICS`` and then the metrics of the named optional lists. Raises BadInput for an unknown name."""
    names = list(names)
    if unknown := [name for name in names if name not in OPTIONAL_LISTS]:
        expected = f"names of {', '.join(OPTIONAL_LISTS)}"
        raise BadInput("evaluate.metrics", expected, ", ".join(unknown), "correct the name")
    return METRICS + tuple(metric for name in names for metric in OPTIONAL_LISTS[name])
