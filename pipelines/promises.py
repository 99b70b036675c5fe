"""What every control must do to which figure, and whether it does: read from the metrics of one dataset.

A control that keeps its promise shows that the figure sees what was taken from the motion; one that does not shows a
figure that can be won without it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hoidata.errors import BadInput
from hoidata.metrics.feature_metrics import FEATURE_METRICS
from hoidata.metrics.unmeasured import reasons_in_words
from pipelines.figures import read_metrics

TRUTH = "ground-truth"
NOTHING = 1e-4
# Verbs that are each other backwards.
REVERSES = (("open", "close"), ("lift", "place"), ("put in", "take out"), ("screw", "unscrew"))
CONFUSED = "taken for its reverse by"
Must = Literal["fall", "rise", "stay", "be equal", "be zero"]


@dataclass(frozen=True)
class Promise:
    """control, beside: families. metric: its name, or "taken for its reverse by <classifier>".

    must: fall or rise beyond the interval over clips of the row ``beside``; stay, so not fall beyond it; be equal to it
    in every digit; be zero.
    """

    control: str
    metric: str
    must: Must
    beside: str = TRUTH


@dataclass(frozen=True)
class Kept:
    """A promise with both figures. holds: None where one of them was not measured, for the reason ``why``."""

    promise: Promise
    reference: float | None
    value: float | None
    holds: bool | None
    why: str = ""


def _promises(must: Must, control: str, *metrics: str, beside: str = TRUTH) -> list[Promise]:
    return [Promise(control, metric, must, beside) for metric in metrics]


ACCURACY = ("accuracy_top1_paper", "accuracy_top1_corrected")
# A floor is of the recorded clips themselves and could not differ.
SEEN_BY_PAPER = tuple(item.name for item in FEATURE_METRICS if item.encoder == "paper" and not item.floor_of)
CONTACT = ("bimart_con_corrected", "bimart_art_corrected")
PROMISES: tuple[Promise, ...] = (
    *_promises("be equal", "object-moved", *SEEN_BY_PAPER),
    *_promises("fall", "object-moved", "accuracy_top1_corrected", "contact_f1", "adherence", "realism_si"),
    *_promises("fall", "static", *ACCURACY, "action_followed"),
    *_promises("fall", "reversed", *ACCURACY, "action_followed"),
    *_promises("rise", "reversed", *(f"{CONFUSED} {name}" for name in ("paper", "corrected"))),
    *_promises("fall", "hands-away", "contact_f1", "adherence", "realism_si"),
    *_promises("rise", "pressed", "penetration_mm", "penetration_volume_cm3"),
    *_promises("rise", "noise", "jitter_m_s3"),
    *_promises("fall", "other-hands", "contact_f1", "realism_si"),
    *_promises("rise", "other-hands", "slip_cm_s"),
    *_promises("fall", "swapped-hands", "contact_f1", "accuracy_top1_corrected", "r_precision_hard_top1_text_motion"),
    *_promises("fall", "other-verb", *ACCURACY, "r_precision_top1_text_motion"),
    *_promises("be zero", "mean-pose", "multimodality_by_prompt_corrected"),
    *_promises("fall", "mean-pose", "diversity_corrected"),
    *_promises("rise", "prompt-lookup", "memorised_share_path"),
    *_promises("fall", "other-prompt", "accuracy_top1_corrected", beside="text2hoi"),
    *_promises("fall", "other-contact", "adherence", beside="text2hoi"),
    *_promises("fall", "hands-still", *CONTACT),
    *_promises("fall", "hands-shifted", *CONTACT),
    *_promises("fall", "pressed-deep", *CONTACT),
    *_promises("stay", "pressed-deep", "bimart_con_paper", "bimart_art_paper"),
    *_promises("fall", "bimart-other-path", "contact_f1", "bimart_art_corrected", beside="bimart"),
    *_promises("fall", "bimart-other-object", "contact_f1", *CONTACT, beside="bimart"),
    # Refinement brings hands to the surface wherever they are, so that contact alone does not see what a map asks for.
    *_promises("fall", "bimart-zero-map", "contact_f1", beside="bimart"),
    *_promises("rise", "bimart-zero-map", "bimart_cm_corrected", "joint_error_mm", beside="bimart"),
)


def datasets_below(folder: Path) -> list[Path]:
    """The folders of one dataset each that hold the truth's metrics, ``folder`` itself among them. Raises BadInput."""
    found = sorted(path.parent for path in folder.rglob(f"{TRUTH}.json"))
    if not found:
        raise BadInput(folder, f"metrics with a {TRUTH}.json", "none", "name a folder below metrics/")
    return found


def read_rows(folder: Path) -> dict[str, dict[str, Any]]:
    """What was measured of each family of one dataset, controls included; of one without motions, why (``empty``)."""
    paths = [*folder.glob("*.json"), *folder.glob("controls/*.json")]
    return {path.stem: read_metrics(path) for path in sorted(paths)}


def kept(rows: Mapping[str, Mapping[str, Any]], promises: Sequence[Promise] = PROMISES) -> list[Kept]:
    """Every promise with what the rows say of it."""
    return [_kept(rows, promise) for promise in promises]


def _kept(rows: Mapping[str, Mapping[str, Any]], promise: Promise) -> Kept:
    reference, value = (_figure(rows.get(name, {}), promise.metric) for name in (promise.beside, promise.control))
    if value is None or reference is None:
        names = [name for name, own in ((promise.beside, reference), (promise.control, value)) if own is None]
        return Kept(promise, reference, value, None, "; ".join(_why_none(rows, name, promise.metric) for name in names))
    intervals = rows[promise.beside].get("intervals", {}).get(promise.metric, {})
    low, high = intervals.get("clips", (reference, reference))
    holds = {
        "fall": value < min(low, reference),
        "rise": value > max(high, reference),
        "stay": value >= min(low, reference),
        "be equal": value == reference,
        "be zero": abs(value) <= NOTHING,
    }
    return Kept(promise, reference, value, holds[promise.must])


def _figure(row: Mapping[str, Any], metric: str) -> float | None:
    if metric.startswith(CONFUSED):
        return taken_for_reverse(row.get("evaluators", {}).get(metric.removeprefix(CONFUSED).strip(), {}))
    return row.get("figures", {}).get(metric)


def _why_none(rows: Mapping[str, Mapping[str, Any]], family: str, metric: str) -> str:
    """Why a family has no figure of a metric."""
    row = rows.get(family)
    if row is None:
        return f"{family} was not evaluated"
    if "figures" not in row:
        return f"{family}: {row['empty']}"
    reasons = row.get("unmeasured", {}).get(metric)
    return f"{family}: {reasons_in_words(reasons) if reasons else 'the metric was not computed'}"


def taken_for_reverse(evaluator: Mapping[str, Any]) -> float | None:
    """Of the motions of a verb that has a reverse, the share a classifier took for that; None where there are none."""
    labels, table = evaluator.get("labels", []), evaluator.get("confusion", [])
    both = [*REVERSES, *(pair[::-1] for pair in REVERSES)]
    pairs = [(labels.index(one), labels.index(other)) for one, other in both if one in labels and other in labels]
    motions = sum(sum(table[own]) for own, _ in pairs)
    return sum(table[own][other] for own, other in pairs) / motions if motions else None
