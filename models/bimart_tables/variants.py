"""Variants of BimArt's Tables 1 and 3: with which settings the networks of each are trained.

What the paper says of its baselines is a few sentences; all else here is ours (docs/hands.md names it).
"""

from collections.abc import Mapping
from typing import Any

from hoidata.errors import BadInput

Settings = Mapping[str, Any]


def _both(contact: Settings, motion: Settings | None = None) -> dict[str, Settings]:
    return {"bimart-contact": contact, "bimart-motion": contact if motion is None else motion}


def _features(**changed: Any) -> Settings:
    return {"network": {"features": changed}}


# OMOMO's first network makes joints and its second hands for them; both have an L1 loss and hear of everything always.
_L1 = {"loss": {"error": "absolute", "contact_dropout": 0.0}}
_OMOMO = _both({**_features(between="joints"), **_L1}, {**_features(between="joints", hands="mano"), **_L1})
# By variant and network what is laid over the network's settings in params.yaml.
VARIANTS: Mapping[str, Mapping[str, Settings]] = {
    "rivals": {},
    "part": _both({}),
    "unscaled": _both(_features(basis={"variant": "unscaled"})),
    "whole": _both(_features(basis={"variant": "whole"})),
    "stateless": _both(_features(state="none")),
    "mano": _both({}, _features(hands="mano")),
    "mdm": {"bimart-motion": {**_features(hands="mano"), "loss": {"contact_dropout": 1.0}}},
    "omomo": _OMOMO,
    "cams": {"cams-b": {}},
}


def variant_of(run: str) -> tuple[str, int]:
    """What ``part-2`` stands for: the variant and the seed of its trainings. Raises BadInput for any other name."""
    name, _, seed = run.rpartition("-")
    if name not in VARIANTS or not seed.isdecimal():
        raise BadInput("tables.runs", f"one of {', '.join(VARIANTS)} and a seed, as part-0", run, "correct params.yaml")
    return name, int(seed)
