"""Rows of BimArt's Tables 1 and 3: with which settings networks are trained, and how each row is sampled from them.

What the paper says of its baselines is a few sentences; all else here is ours (docs/hands.md names it).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hoidata.errors import BadInput

Settings = Mapping[str, Any]


@dataclass(frozen=True)
class Row:
    """One row. family: of the registry. settings: of BimArt's sampling, laid over ``sample.bimart``.

    most_samples: motions of a clip that are enough for it, where its figures are no best of many.
    """

    family: str
    title: str
    settings: Settings = field(default_factory=dict)
    most_samples: int | None = None


@dataclass(frozen=True)
class Variant:
    """Networks that are trained alike. networks: by name, laid over their settings in params.yaml. rows: by name."""

    networks: Mapping[str, Settings]
    rows: Mapping[str, Row]


def _both(contact: Settings, motion: Settings | None = None) -> dict[str, Settings]:
    return {"bimart-contact": contact, "bimart-motion": contact if motion is None else motion}


def _features(**changed: Any) -> Settings:
    return {"network": {"features": changed}}


def _plain(title: str, **sampling: Any) -> Row:
    """As the networks made it: no guidance by contact maps, no refinement."""
    return Row("bimart", title, {"sampling": {"guide": "off", **sampling}, "refined": False})


NO_MAP = {"with_map": False}
# OMOMO's first network makes joints and its second hands for them; both have an L1 loss and hear of everything always.
_L1 = {"loss": {"error": "absolute", "contact_dropout": 0.0}}
_OMOMO = _both({**_features(between="joints"), **_L1}, {**_features(between="joints", hands="mano"), **_L1})
VARIANTS: Mapping[str, Variant] = {
    "rivals": Variant(
        {},
        {
            "ground-truth": Row("ground-truth", "ground truth"),
            "nearest-window": Row("nearest-window", "nearest training window"),
            "random-window": Row("random-window", "random training window"),
            "mean-pose-at-object": Row("mean-pose-at-object", "mean pose at the object"),
            "hands-still": Row("hands-still", "truth, hands held still"),
            "hands-shifted": Row("hands-shifted", "truth, hands 3 cm to one side"),
            "pressed-deep": Row("pressed-deep", "truth, hands 3 cm in"),
        },
    ),
    "part": Variant(
        _both({}),
        {
            "no-map": _plain("without contact maps", **NO_MAP),
            "map": _plain("part-BPS; told contact maps"),
            "map-guided": Row("bimart", "and guided by them", {"refined": False}),
            "bimart": Row("bimart", "and refined: BimArt"),
            "other-path": Row("bimart-other-path", "BimArt told another path", most_samples=3),
            "other-object": Row("bimart-other-object", "BimArt told another object", most_samples=3),
            "zero-map": Row("bimart-zero-map", "BimArt told a map of zeros", most_samples=3),
        },
    ),
    "unscaled": Variant(_both(_features(basis={"variant": "unscaled"})), {"unscaled": _plain("unscaled BPS")}),
    "whole": Variant(_both(_features(basis={"variant": "whole"})), {"whole": _plain("part-agnostic BPS")}),
    "stateless": Variant(_both(_features(state="none")), {"stateless": _plain("part-BPS without global states")}),
    "mano": Variant(_both({}, _features(hands="mano")), {"mano": _plain("rotations and joints for keypoints")}),
    "mdm": Variant(
        {"bimart-motion": {**_features(hands="mano"), "loss": {"contact_dropout": 1.0}}},
        {"mdm-b": _plain("MDM-B", **NO_MAP)},
    ),
    "omomo": Variant(_OMOMO, {"omomo-b": _plain("OMOMO-B", hold_m=0.03)}),
    "cams": Variant({"cams-b": {}}, {"cams-b": Row("cams-b", "CAMS-B")}),
}


def variant_of(run: str) -> tuple[Variant, int]:
    """What ``part-2`` stands for: the variant and the seed of its trainings. Raises BadInput for any other name."""
    name, _, seed = run.rpartition("-")
    if name not in VARIANTS or not seed.isdecimal():
        raise BadInput("tables.runs", f"one of {', '.join(VARIANTS)} and a seed, as part-0", run, "correct params.yaml")
    return VARIANTS[name], int(seed)
