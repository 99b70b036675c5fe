"""Lists of metrics that are computed only where they are asked for: ``evaluate: {metrics: [bimart]}``, by their name.

To add one: rows of ``registry.Metric``, whose names no other list has, and its name in ``ASKED_LISTS``.
"""

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType

from hoidata.errors import BadInput
from hoidata.metrics import bimart
from hoidata.metrics.pair import Pair
from hoidata.metrics.registry import HANDS, METRICS, Direction, Metric
from hoidata.metrics.unmeasured import Values

BIMART = "BimArt (Zhang et al. 2025)"
_PAPER, _CORRECTED = "as released", "this project: corrected"
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
_CONTACT = "5 mm or nearer, none deeper than 1 cm"
Measure = Callable[[Pair, int], Values]
_THREE = f"{HANDS}, three recorded ones in a row"


def _shares(
    name: str,
    title: str,
    direction: Direction,
    measures: tuple[Measure, Measure],
    frames: tuple[str, str],
    limits: tuple[str, str],
) -> tuple[Metric, Metric]:
    """A share of frames in percent, paper and corrected; ``paper`` pools the frames of each clip's first motion."""
    return (
        Metric(
            "BimArt", f"bimart_{name}_paper", f"{title}, paper", "%", direction, measures[0],
            "mean over frames", frames[0], f"{BIMART}, {_PAPER}", samples=1, thresholds=limits[0],
        ),
        Metric(
            "BimArt", f"bimart_{name}_corrected", f"{title}, corrected", "%", direction, measures[1],
            "mean over motions", frames[1], f"{BIMART}, {_CORRECTED}", thresholds=limits[1],
        ),
    )  # fmt: skip


BIMART_METRICS: tuple[Metric, ...] = (
    Metric(
        "BimArt", "bimart_mul_cm", "Mul: spread of the motions of one clip", "cm", "higher", bimart.mul_cm,
        "mean over motions", HANDS, f"{BIMART}: mean over pairs of motions; none of a single motion", aligned=True,
        together=True,
    ),
    Metric(
        "BimArt", "bimart_accel_paper", "Accel, paper", "cm/frame2", "lower", bimart.accel_paper, "mean over motions",
        _THREE, f"{BIMART}, {_PAPER}", samples=1,
    ),
    Metric(
        "BimArt", "bimart_accel_corrected", "Accel, corrected", "m/s2", "nearer the truth", bimart.accel_corrected,
        "mean over motions", _THREE, f"{BIMART}, {_CORRECTED}",
    ),
    *_shares(
        "pen_1cm", "Pen 1 cm", "lower", (bimart.pen_1cm_paper, bimart.pen_1cm_corrected), (HANDS, HANDS),
        (f"1 cm, {_WHOLE}", f"1 cm, {_SOLID}"),
    ),
    *_shares(
        "pen_5mm", "Pen 5 mm", "lower", (bimart.pen_5mm_paper, bimart.pen_5mm_corrected), (HANDS, HANDS),
        (f"5 mm, {_WHOLE}", f"5 mm, {_SOLID}"),
    ),
    *_shares(
        "con", "Con", "higher", (bimart.con_paper, bimart.con_corrected), (_MOVES_RELEASED, _MOVES),
        ("nearer than 5 mm, or at any depth inside", _CONTACT),
    ),
    Metric(
        "BimArt", "bimart_con_everywhere_corrected", "Con in all frames, corrected", "%", "nearer the truth",
        bimart.con_everywhere_corrected, "mean over motions", HANDS, f"{BIMART}, {_CORRECTED}", thresholds=_CONTACT,
    ),
    *_shares(
        "art", "Art", "higher", (bimart.art_paper, bimart.art_corrected), (_TURNS_RELEASED, _TURNS),
        (
            "nearer than 5 mm to the faces wholly in the moving part, or at any depth inside",
            f"{_CONTACT}, of the moving part with its seam",
        ),
    ),
    Metric(
        "BimArt", "bimart_cm_paper", "CM, paper", "cm", "lower", bimart.cm_paper, "mean over motions", HANDS,
        f"{BIMART}, to 778 vertices: `asked-distances.npz` beside the clips", samples=1,
    ),
    Metric(
        "BimArt", "bimart_cm_corrected", "CM, corrected", "cm", "lower", bimart.cm_corrected, "mean over motions",
        HANDS, f"{BIMART}, {_CORRECTED}: to the hand vertices the map was made of",
        thresholds="distances capped at 20 cm",
    ),
)  # fmt: skip

ASKED_LISTS: Mapping[str, tuple[Metric, ...]] = MappingProxyType({"bimart": BIMART_METRICS})


def with_lists(names: Iterable[str]) -> tuple[Metric, ...]:
    """The metrics that are always computed, then those of the lists named. Raises BadInput for an unknown name."""
    names = list(names)
    if unknown := [name for name in names if name not in ASKED_LISTS]:
        raise BadInput("evaluate.metrics", f"names of {', '.join(ASKED_LISTS)}", ", ".join(unknown), "correct the name")
    return METRICS + tuple(metric for name in names for metric in ASKED_LISTS[name])
