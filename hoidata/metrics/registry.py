"""The registry of metrics. Evaluation, the tables on pages and README.md in this folder are generated from it.

To add a metric: write a function of (pair, frame_step) that returns the values of one motion as an array, or
``Unmeasured`` with the reason, and add an entry to ``METRICS``. Lists in ``optional_metrics.py`` are computed only on
request.
"""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from hoidata.clips.slip import MOVING_CM_S
from hoidata.metrics import motion, touch
from hoidata.metrics.unmeasured import Unmeasured, Values, counted
from hoidata.physics.realism import LARGEST_PENETRATION_M
from hoidata.physics.scene import LIFTED_M

Direction = Literal["higher", "lower", "closer to recorded"]
Topic = Literal["Action", "Contact", "Physics", "Motion", "BimArt"]
Reduction = Literal["best of a clip's samples", "mean over motions", "mean over frames"]
HANDS = "frames in which the reference has the acting hand"
OWN = "this project"


@dataclass(frozen=True)
class RankedMetric:
    """How a metric, of motions or of features, is measured, ranked and described."""

    name: str  # key in metrics files
    measure: Callable[..., Any]  # Metric: (pair, frame_step); FeatureMetric: (comparison)
    _: KW_ONLY
    title: str  # column header
    unit: str = ""  # "" for a fraction or a score from 0 to 1
    direction: Direction  # which values are better; "closer to recorded": than the value of the recorded clips
    source: str = OWN  # where the definition comes from
    thresholds: str = ""  # in words
    floor_of: str = ""  # the metric whose lower bound this is; bounds are not ranked


@dataclass(frozen=True, kw_only=True)
class Metric(RankedMetric):
    """A metric of motions; ``measure`` gives the values of one motion, or why it has none."""

    topic: Topic  # tables are grouped by topic
    # "best of a clip's samples" and "mean over motions" take the mean of each motion's values first;
    # "mean over frames" pools all values of all motions.
    reduction: Reduction = "mean over motions"
    frames: str = HANDS  # which frames are measured, in words
    frame_step: int = 1  # every n-th of these frames is measured
    samples: int | None = None  # how many motions of a clip are measured; None: all
    aligned: bool = False  # compares frame by frame, so motions of estimated length have no value
    together: bool = False  # ``measure`` gets the pairs of all motions of a clip in a list, not one pair


class Result(NamedTuple):
    """The value of a metric, and how many clips, motions and per-motion values went into it."""

    value: float
    clips: int
    motions: int
    values: int

    @property
    def counts(self) -> dict[str, int]:
        return {"clips": self.clips, "motions": self.motions, "values": self.values}


WHOLE = f"{HANDS}, all together"
LIFTED = (
    f"frames in which the object is more than {1000 * LIFTED_M:g} mm above the table (3rd percentile of the lowest "
    "vertex in its recording)"
)
DEEP = f"hand capsule {1000 * LARGEST_PENETRATION_M:g} mm or more inside it"
SCORED = f"{LIFTED}, and no {DEEP}"
FORCES = "residual below 0.01, friction 0.35"
CONTACT = "distance and points of the contact stage (its info.json)"
MANIPNET = "ManipNet (Zhang et al. 2021), Sec. 8"
LOWER_BOUND = f"{OWN}: lower bound, without hands"
CHOSEN_LENGTHS = "all; only stores whose info has `length: own`"

METRICS: tuple[Metric, ...] = (
    Metric(
        "joint_error_mm", motion.joint_error_mm, topic="Motion", title="joint error of the best sample", unit="mm",
        direction="lower", reduction="best of a clip's samples", aligned=True,
        source="mean distance of 21 joints (MPJPE), best of samples as in Petrovich et al. 2022 (TEMOS), Sec. 4",
    ),
    Metric(
        "contact_f1", touch.contact_f1, topic="Contact", title="F1 of the contact map", direction="higher",
        frames=WHOLE, thresholds=CONTACT, source="Text2HOI (Cha et al. 2024), Sec. 3.1: the map",
    ),
    Metric(
        "contact_precision", touch.contact_precision, topic="Contact", title="precision of the contact map",
        direction="higher", frames=WHOLE, thresholds=CONTACT, source=f"{OWN}: component of `contact_f1`",
    ),
    Metric(
        "contact_recall", touch.contact_recall, topic="Contact", title="recall of the contact map",
        direction="higher", frames=WHOLE, thresholds=CONTACT, source=f"{OWN}: component of `contact_f1`",
    ),
    Metric(
        "adherence", touch.adherence, topic="Contact", title="F1 of the target and the generated contact map",
        direction="higher", frames=WHOLE, thresholds=CONTACT, source=f"{OWN}: `asked.npz` next to the clips",
    ),
    Metric(
        "contact_distance_mm", touch.contact_distance_mm, topic="Contact", unit="mm", direction="closer to recorded",
        title="distance to the object of joints that touch it in the recording", aligned=True,
        frames=f"{HANDS} and a joint touches in the true clip", frame_step=3, samples=2, thresholds=CONTACT,
        source=f"{OWN}; Text2HOI Sec. 3.3 refines it",
    ),
    Metric(
        "penetration_mm", touch.penetration_mm, topic="Physics", title="penetration depth", unit="mm",
        direction="lower", frame_step=3, samples=2,
        source="depth of the deepest of 778 vertices inside the exact solid (GrabNet, Taheri et al. 2020, Sec. 5)",
    ),
    Metric(
        "deep_share", touch.deep_share, topic="Physics", title=f"fraction of frames deeper than {touch.DEEP_MM:g} mm",
        direction="lower", frame_step=3, samples=2, thresholds=f"{touch.DEEP_MM:g} mm",
    ),
    Metric(
        "penetration_volume_cm3", touch.penetration_volume_cm3, topic="Physics", unit="cm3", direction="lower",
        title="intersection volume of hand and object", frame_step=3, samples=2,
        thresholds=f"lines {1000 * touch.CELL_M:g} mm apart",
        source="DiffH2O (Christen et al. 2024), intersection volume; of solids, not voxels",
    ),
    Metric(
        "hand_hand_mm", touch.hand_hand_mm, topic="Physics", title="penetration depth of one hand in the other",
        unit="mm", direction="lower", frames=f"{HANDS}, both hands", frame_step=3, samples=2,
        source=f"{OWN}: depth of the deepest of 19 x 19 capsules",
    ),
    Metric(
        "slip_cm_s", touch.slip_cm_s, topic="Physics", title="slip of touching joints on the moving object",
        unit="cm/s", direction="lower", thresholds=f"{CONTACT}; moving: {MOVING_CM_S:g} cm/s",
        frames=f"{HANDS}, a joint touches in two in a row, and the part under it moves",
        source=f"{OWN}: speed in the frame of the touched part",
    ),
    Metric(
        "realism_si", motion.realism_si, topic="Physics", title="physical realism, SI", direction="higher",
        reduction="mean over frames", frames=SCORED, samples=1, thresholds=FORCES,
        source=f"{MANIPNET} and Appendix A, in SI units",
    ),
    Metric(
        "realism_si_floor", motion.floor_si, topic="Physics", title="physical realism, SI, without hands",
        direction="closer to recorded", reduction="mean over frames", frames=LIFTED, samples=1, thresholds=FORCES,
        source=LOWER_BOUND, floor_of="realism_si",
    ),
    Metric(
        "realism_released", motion.realism_as_released, topic="Physics", title="physical realism, as released",
        direction="higher", reduction="mean over frames", frames=SCORED, samples=1, thresholds=FORCES,
        source=f"{MANIPNET} and Appendix A, units of the released code",
    ),
    Metric(
        "realism_released_floor", motion.floor_as_released, topic="Physics",
        title="physical realism, as released, without hands", direction="closer to recorded",
        reduction="mean over frames", frames=LIFTED, samples=1, thresholds=FORCES, source=LOWER_BOUND,
        floor_of="realism_released",
    ),
    Metric(
        "realism_every_frame", motion.realism_every_frame, topic="Physics", direction="higher", frame_step=3, samples=1,
        title="physical realism of every frame, SI, with the table", reduction="mean over frames",
        frames=f"all; one with {DEEP} fails; the table pushes an object that is not lifted", thresholds=FORCES,
        source=f"Text2HOI Sec. 4 scores each frame; {MANIPNET}; the table is {OWN}",
    ),
    Metric(
        "realism_every_frame_floor", motion.floor_every_frame, topic="Physics", direction="closer to recorded",
        title="physical realism of every frame, without hands", reduction="mean over frames", frames="all",
        frame_step=3, samples=1, thresholds=FORCES, source=LOWER_BOUND, floor_of="realism_every_frame",
    ),
    Metric(
        "capsule_depth_mm", motion.capsule_depth_mm, topic="Physics", title="penetration depth of hand capsules",
        unit="mm", direction="lower", frames=LIFTED, samples=1, source=f"{MANIPNET}, penetration depth",
    ),
    Metric(
        "smoothness_m_s2", motion.smoothness, topic="Motion", title="acceleration of joints in the wrist's frame",
        unit="m/s2", direction="closer to recorded", frames=f"{HANDS}, three in a row",
        source=f"{MANIPNET}, smoothness",
    ),
    Metric(
        "jitter_m_s3", motion.jitter_m_s3, topic="Motion", title="jitter of joints in the world", unit="m/s3",
        direction="closer to recorded", frames=f"{HANDS}, four in a row",
        source="mean jerk, TransPose (Yi et al. 2021), Sec. 5.2",
    ),
    Metric(
        "object_jitter_m_s3", motion.object_jitter_m_s3, topic="Motion", unit="m/s3",
        title="jitter of the object's centre in the world", direction="closer to recorded",
        frames="all, four in a row", source=f"{OWN}: mean jerk, as `jitter_m_s3`",
    ),
    Metric(
        "action_followed", motion.action_followed, topic="Action", title="rule-based verb success",
        direction="higher", frames="all",
        thresholds="`actions.toml`, or training clips of the verb: 1st to 99th percentile and half a deviation, "
        "if that excludes an object at rest",
        source=f"{OWN}: limits of height, path, tilt, hinge and hands (`hoidata/actions`)",
    ),
    Metric(
        "action_named", motion.action_named, topic="Action", title="nearest-centroid verb accuracy",
        direction="higher", frames="all",
        source=f"{OWN}: nearest centroid of the standardised motion measures of `hoidata/actions`",
    ),
    Metric(
        "length_error_frames", motion.length_error_frames, topic="Motion", title="error of the estimated length",
        unit="frames", direction="lower", frames=CHOSEN_LENGTHS,
    ),
    Metric(
        "length_error_share", motion.length_error_share, topic="Motion",
        title="relative error of the estimated length", direction="lower", frames=CHOSEN_LENGTHS,
    ),
)  # fmt: skip


def metric(name: str) -> Metric:
    """The metric of that name. Raises KeyError that lists the registered names."""
    named = next((item for item in METRICS if item.name == name), None)
    if named is None:
        raise KeyError(f"no metric {name!r}; there are: {', '.join(item.name for item in METRICS)}")
    return named


def summarise(metric: Metric, clips: list[list[Values]]) -> Result | None:
    """Reduce the values of all motions to one result; None if no motion has a value.

    Motions without values are skipped, not counted as 0; ``count_unmeasured`` counts them.

    Args:
        clips: the values of every motion, by clip and sample.
    """
    motions = [_with_values(samples) for samples in clips]
    motions = [samples for samples in motions if samples]
    if not motions:
        return None
    means = [np.array([values.mean() for values in samples]) for samples in motions]
    all_values = np.concatenate([values for samples in motions for values in samples])
    if metric.reduction == "best of a clip's samples":
        value = np.mean([clip.max() if metric.direction == "higher" else clip.min() for clip in means])
    else:
        value = np.mean(all_values if metric.reduction == "mean over frames" else np.concatenate(means))
    return Result(float(value), len(motions), sum(map(len, means)), len(all_values))


def count_unmeasured(metric: Metric, clips: list[list[Values]]) -> dict[str, int]:
    """The number of clips without any value, by the reason of their first motion."""
    return counted(_reason(metric, samples) for samples in clips if not _with_values(samples))


def _with_values(samples: list[Values]) -> list[np.ndarray]:
    return [values for values in samples if isinstance(values, np.ndarray) and len(values)]


def _reason(metric: Metric, samples: list[Values]) -> str:
    reasons = [values.reason for values in samples if isinstance(values, Unmeasured)]
    return reasons[0] if reasons else f"no such frame: {metric.frames}"


def sum_and_count(metric: Metric, samples: list[Values]) -> tuple[float, int]:
    """One clip's share of a result: the sums of all clips divided by their counts are the result."""
    measured = _with_values(samples)
    if metric.reduction == "mean over frames":
        return float(sum(values.sum() for values in measured)), sum(map(len, measured))
    means = [float(values.mean()) for values in measured]
    if metric.reduction == "best of a clip's samples" and means:
        means = [max(means) if metric.direction == "higher" else min(means)]
    return sum(means), len(means)


def is_better(metric: RankedMetric, value: float, other: float, recorded: float | None) -> bool | None:
    """Whether ``value`` is better than ``other``; None for lower bounds and if a needed recorded value is missing.

    Args:
        recorded: the value of the recorded clips, None if they were not measured.
    """
    if metric.floor_of:
        return None
    if metric.direction == "closer to recorded":
        return None if recorded is None else abs(value - recorded) < abs(other - recorded)
    return value > other if metric.direction == "higher" else value < other
