"""Rows of BimArt's Tables 1 and 3 and of their controls: how each is sampled from the networks of its variant."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from models.bimart_tables.variants import Settings

NO_MAP = {"with_map": False}
# Motions of a clip for rows that are told from others by means, and for rows that only have to lose.
ABLATED, CONTROL = 4, 2


@dataclass(frozen=True)
class Row:
    """One row. family: of the registry. settings: of BimArt's sampling, laid over ``sample.bimart``.

    most_samples: motions of a clip that are enough for it.
    """

    family: str
    title: str
    settings: Settings = field(default_factory=dict)
    most_samples: int | None = None


def _plain(title: str, **sampling: Any) -> Row:
    """As the networks made it: no guidance by contact maps, no refinement."""
    return Row("bimart", title, {"sampling": {"guide": "off", **sampling}, "refined": False}, ABLATED)


# A clip has one nearest window and one recording; the next nearest windows stand in for further samples.
ROWS: Mapping[str, Mapping[str, Row]] = {
    "rivals": {
        "ground-truth": Row("ground-truth", "ground truth", most_samples=1),
        "nearest-window": Row("nearest-window", "nearest training window", most_samples=1),
        "nearest-window-refined": Row("nearest-window-refined", "nearest training window, refined", most_samples=1),
        "nearest-windows": Row("nearest-window", "the nearest training windows"),
        "random-window": Row("random-window", "random training window"),
        "mean-pose-at-object": Row("mean-pose-at-object", "mean pose at the object", most_samples=1),
        "hands-still": Row("hands-still", "truth, hands held still", most_samples=1),
        "hands-shifted": Row("hands-shifted", "truth, hands 3 cm to one side", most_samples=1),
        "pressed-deep": Row("pressed-deep", "truth, hands 3 cm in", most_samples=1),
    },
    "part": {
        "no-map": _plain("without contact maps", **NO_MAP),
        "map": _plain("part-BPS; told contact maps"),
        "map-guided": Row("bimart", "and guided by them", {"refined": False}, ABLATED),
        "bimart": Row("bimart", "and refined: BimArt"),
        "other-path": Row("bimart-other-path", "BimArt told another path", most_samples=CONTROL),
        "other-object": Row("bimart-other-object", "BimArt told another object", most_samples=CONTROL),
        "zero-map": Row("bimart-zero-map", "BimArt told a map of zeros", most_samples=CONTROL),
    },
    "unscaled": {"unscaled": _plain("unscaled BPS")},
    "whole": {"whole": _plain("part-agnostic BPS")},
    "stateless": {"stateless": _plain("part-BPS without global states")},
    "mano": {"mano": _plain("rotations and joints for keypoints")},
    "mdm": {"mdm-b": _plain("MDM-B", **NO_MAP)},
    "omomo": {"omomo-b": _plain("OMOMO-B", hold_m=0.03)},
    "cams": {"cams-b": Row("cams-b", "CAMS-B, told the first hands and who touches which part when")},
}
