"""Expected orderings: which metrics each negative control must change against its reference, and whether it does.

A metric that meets its expected ordering responds to the property that the control perturbs. A metric that does not can
be good without that property.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hoidata.errors import BadInput
from hoidata.metrics.feature_metrics import FEATURE_METRICS
from hoidata.metrics.unmeasured import reasons_in_words
from pipelines.metrics_files import read_metrics

RECORDED = "ground-truth"
ZERO_TOLERANCE = 1e-4
# Pairs of verbs that are each other's time reversal.
REVERSES = (("open", "close"), ("lift", "place"), ("put in", "take out"), ("screw", "unscrew"))
CONFUSED = "taken for its reverse by"
Change = Literal["fall", "rise", "stay", "be equal", "be zero"]


@dataclass(frozen=True)
class ExpectedOrdering:
    """A metric of a control that must change in a given way against a reference family."""

    control: str  # family
    metric: str  # name, or "taken for its reverse by <classifier>"
    # fall or rise: beyond the interval over clips of the reference; stay: not fall beyond it; be equal: in every digit;
    # be zero
    must: Change
    reference: str = RECORDED  # family


@dataclass(frozen=True)
class OrderingResult:
    """An expected ordering with both values."""

    ordering: ExpectedOrdering
    reference: float | None
    value: float | None  # of the control
    holds: bool | None  # None if a value is missing
    reason: str = ""  # why it is missing


def _orderings(must: Change, control: str, *metrics: str, reference: str = RECORDED) -> list[ExpectedOrdering]:
    return [ExpectedOrdering(control, metric, must, reference) for metric in metrics]


ACCURACY = ("accuracy_top1_paper", "accuracy_top1_corrected")
# The metrics of ``paper`` without lower bounds, which are measured on the recorded clips alone and cannot differ.
METRICS_OF_PAPER = tuple(item.name for item in FEATURE_METRICS if item.encoder == "paper" and not item.floor_of)
REALISM = ("realism_si", "realism_every_frame")
CONTACT = ("bimart_con_corrected", "bimart_art_corrected")
EXPECTED_ORDERINGS: tuple[ExpectedOrdering, ...] = (
    *_orderings("be equal", "object-moved", *METRICS_OF_PAPER),
    *_orderings("fall", "object-moved", "accuracy_top1_corrected", "contact_f1", "adherence", *REALISM),
    *_orderings("fall", "static", *ACCURACY, "action_followed"),
    *_orderings("fall", "reversed", *ACCURACY, "action_followed"),
    *_orderings("rise", "reversed", *(f"{CONFUSED} {name}" for name in ("paper", "corrected"))),
    *_orderings("fall", "hands-away", "contact_f1", "adherence", *REALISM),
    *_orderings("rise", "pressed", "penetration_mm", "penetration_volume_cm3"),
    *_orderings("rise", "noise", "jitter_m_s3"),
    *_orderings("fall", "other-hands", "contact_f1", "realism_si"),
    *_orderings("rise", "other-hands", "slip_cm_s"),
    *_orderings("fall", "swapped-hands", "contact_f1", "accuracy_top1_corrected", "r_precision_hard_top1_text_motion"),
    *_orderings("fall", "other-verb", *ACCURACY, "r_precision_top1_text_motion"),
    *_orderings("be zero", "mean-pose", "multimodality_by_prompt_corrected"),
    *_orderings("fall", "mean-pose", "diversity_corrected"),
    *_orderings("rise", "prompt-retrieval", "memorised_share_path"),
    *_orderings("fall", "other-prompt", "accuracy_top1_corrected", reference="text2hoi"),
    *_orderings("fall", "other-contact", "adherence", reference="text2hoi"),
    *_orderings("fall", "hands-still", *CONTACT),
    *_orderings("fall", "hands-shifted", *CONTACT),
    *_orderings("fall", "pressed-deep", *CONTACT),
    *_orderings("stay", "pressed-deep", "bimart_con_paper", "bimart_art_paper"),
    *_orderings("fall", "bimart-other-path", "contact_f1", "bimart_art_corrected", reference="bimart"),
    *_orderings("fall", "bimart-other-object", "contact_f1", *CONTACT, reference="bimart"),
    # Refinement moves any hand to the surface, so contact alone does not depend on the target map.
    *_orderings("fall", "bimart-zero-map", "contact_f1", reference="bimart"),
    *_orderings("rise", "bimart-zero-map", "bimart_cm_corrected", "joint_error_mm", reference="bimart"),
)


def datasets_below(folder: Path) -> list[Path]:
    """All folders at or below ``folder`` with the metrics of one dataset. Raises BadInput if there are none."""
    folders = sorted(path.parent for path in folder.rglob(f"{RECORDED}.json"))
    if not folders:
        raise BadInput(folder, f"metrics with a {RECORDED}.json", "none", "name a folder below metrics/")
    return folders


def read_methods(folder: Path) -> dict[str, dict[str, Any]]:
    """The metrics files of one dataset by family, controls included; ``empty`` is the reason for no motions."""
    paths = [*folder.glob("*.json"), *folder.glob("controls/*.json")]
    return {path.stem: read_metrics(path) for path in sorted(paths)}


def check_orderings(
    methods: Mapping[str, Mapping[str, Any]], orderings: Sequence[ExpectedOrdering] = EXPECTED_ORDERINGS
) -> list[OrderingResult]:
    """Check expected orderings on metrics files by family."""
    return [_check(methods, ordering) for ordering in orderings]


def _check(methods: Mapping[str, Mapping[str, Any]], ordering: ExpectedOrdering) -> OrderingResult:
    families = (ordering.reference, ordering.control)
    reference, value = (_value(methods.get(family, {}), ordering.metric) for family in families)
    if value is None or reference is None:
        missing = [family for family, result in zip(families, (reference, value), strict=True) if result is None]
        reason = "; ".join(_reason(methods, family, ordering.metric) for family in missing)
        return OrderingResult(ordering, reference, value, holds=None, reason=reason)
    intervals = methods[ordering.reference].get("intervals", {}).get(ordering.metric, {})
    low, high = intervals.get("clips", (reference, reference))
    holds = {
        "fall": value < min(low, reference),
        "rise": value > max(high, reference),
        "stay": value >= min(low, reference),
        "be equal": value == reference,
        "be zero": abs(value) <= ZERO_TOLERANCE,
    }
    return OrderingResult(ordering, reference, value, holds[ordering.must])


def _value(measured: Mapping[str, Any], metric: str) -> float | None:
    if metric.startswith(CONFUSED):
        return taken_for_reverse(measured.get("evaluators", {}).get(metric.removeprefix(CONFUSED).strip(), {}))
    return measured.get("figures", {}).get(metric)


def _reason(methods: Mapping[str, Mapping[str, Any]], family: str, metric: str) -> str:
    """Why a family has no value of a metric."""
    measured = methods.get(family)
    if measured is None:
        return f"{family} was not evaluated"
    if "figures" not in measured:
        return f"{family}: {measured['empty']}"
    reasons = measured.get("unmeasured", {}).get(metric)
    return f"{family}: {reasons_in_words(reasons) if reasons else 'the metric was not computed'}"


def taken_for_reverse(evaluator: Mapping[str, Any]) -> float | None:
    """The fraction of motions of a reversible verb that a classifier takes for the reverse; None without such motions.

    ``evaluator`` has the ``labels`` and ``confusion`` (label, predicted label) of a metrics file.
    """
    labels, table = evaluator.get("labels", []), evaluator.get("confusion", [])
    both = [*REVERSES, *(pair[::-1] for pair in REVERSES)]
    pairs = [(labels.index(one), labels.index(other)) for one, other in both if one in labels and other in labels]
    motions = sum(sum(table[verb]) for verb, _ in pairs)
    return sum(table[verb][reverse] for verb, reverse in pairs) / motions if motions else None
