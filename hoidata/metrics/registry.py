"""The one list of metrics: evaluation, the tables on pages and README.md beside this file are made from it.

To add one: a function of (pair, every) that gives the values of one motion as an array, or ``Unmeasured`` with the
reason, and a row here. A list of
``asked_metrics.py`` is computed only where it is asked for.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np

from hoidata.clips.slip import MOVING_CM_S
from hoidata.metrics import motion, touch
from hoidata.metrics.unmeasured import Unmeasured, Values, counted
from hoidata.physics.realism import LARGEST_PENETRATION_M
from hoidata.physics.scene import LIFTED_M

Direction = Literal["higher", "lower", "nearer the truth"]
Topic = Literal["Action", "Contact", "Physics", "Motion", "BimArt"]
Reduction = Literal["best of a clip's samples", "mean over motions", "mean over frames"]


@dataclass(frozen=True)
class Metric:
    """What one figure is.

    topic: what it is about; tables are divided so. name: its key in files. title: in words. unit: of the figure; ""
    for a share or score from 0 to 1.
    direction: which figures are better; "nearer the truth": than the figure of the recorded clips themselves.
    measure: the values of one motion, given every how many frames to look at, or why it has none.
    reduction: how values become one figure. "best of a clip's samples": the mean of each motion's values, the best of
    each clip, the mean over clips; "mean over motions": the mean of each motion's values, the mean over motions; "mean
    over frames": of all values of all motions alike.
    frames: which frames count, in words. every: of these, look at every n-th. samples: motions per clip that are looked
    at; None: all. thresholds: in words. source: where the definition comes from.
    floor_of: the metric of which this is what it gives for nothing; no figure of a floor is better than another.
    aligned: compares frame by frame, so there is no figure for motions of a length their family chose.
    together: ``measure`` gets the pairs of all motions of a clip in a list, instead of one pair.
    """

    topic: Topic
    name: str
    title: str
    unit: str
    direction: Direction
    measure: Callable[..., Values]
    reduction: Reduction
    frames: str
    source: str
    every: int = 1
    samples: int | None = None
    thresholds: str = ""
    floor_of: str = ""
    aligned: bool = False
    together: bool = False


class Figure(NamedTuple):
    """value: the figure. clips, motions, values: how many went into it."""

    value: float
    clips: int
    motions: int
    values: int

    @property
    def counts(self) -> dict[str, int]:
        return {"clips": self.clips, "motions": self.motions, "values": self.values}


HANDS = "frames in which the reference has the acting hand"
LIFTED = (
    f"frames in which the object is more than {1000 * LIFTED_M:g} mm above the table (3rd percentile of the true "
    "clip's lowest vertex)"
)
SCORED = f"{LIFTED}, and no hand capsule {1000 * LARGEST_PENETRATION_M:g} mm or more inside it"
FORCES = "residual below 0.01, friction 0.35"
CONTACT = "the contact stage's distance and points (its info.json)"
MANIPNET = "ManipNet (Zhang et al. 2021), Sec. 8"

METRICS: tuple[Metric, ...] = (
    Metric(
        "Motion", "joint_error_mm", "joint error of the best sample", "mm", "lower", motion.joint_error_mm,
        "best of a clip's samples", HANDS,
        "mean distance of 21 joints (MPJPE), best of several samples as in Petrovich et al. 2022 (TEMOS), Sec. 4",
        aligned=True,
    ),
    Metric(
        "Contact", "contact_f1", "F1 of the contact map made", "", "higher", touch.contact_f1,
        "mean over motions", f"{HANDS}, all of them together", "Text2HOI (Cha et al. 2024), Sec. 3.2.2: the map",
        thresholds=CONTACT,
    ),
    Metric(
        "Contact", "contact_precision", "precision of the contact map made", "", "higher", touch.contact_precision,
        "mean over motions", f"{HANDS}, all of them together", "this project: half of `contact_f1`",
        thresholds=CONTACT,
    ),
    Metric(
        "Contact", "contact_recall", "recall of the contact map made", "", "higher", touch.contact_recall,
        "mean over motions", f"{HANDS}, all of them together", "this project: the other half of `contact_f1`",
        thresholds=CONTACT,
    ),
    Metric(
        "Contact", "adherence", "F1 of the contact map asked for and the one made", "", "higher", touch.adherence,
        "mean over motions", f"{HANDS}, all of them together", "this project: `asked.npz` beside the clips",
        thresholds=CONTACT,
    ),
    Metric(
        "Contact", "contact_distance_mm", "distance of joints that touch in the truth", "mm", "nearer the truth",
        touch.contact_distance_mm, "mean over motions", f"{HANDS} and a joint touches in the true clip",
        "this project; Text2HOI Sec. 3.5 refines it", every=3, samples=2, thresholds=CONTACT, aligned=True,
    ),
    Metric(
        "Physics", "penetration_mm", "penetration", "mm", "lower", touch.penetration_mm, "mean over motions", HANDS,
        "depth of the deepest of 778 vertices inside the exact solid (GrabNet, Taheri et al. 2020, Sec. 5)",
        every=3, samples=2,
    ),
    Metric(
        "Physics", "deep_share", f"share of frames deeper than {touch.DEEP_MM:g} mm", "", "lower", touch.deep_share,
        "mean over motions", HANDS, "this project", every=3, samples=2, thresholds=f"{touch.DEEP_MM:g} mm",
    ),
    Metric(
        "Physics", "penetration_volume_cm3", "volume that hand and object share",
        "cm3", "lower", touch.penetration_volume_cm3,
        "mean over motions", HANDS, "DiffH2O (Christen et al. 2024), intersection volume; of solids, not voxels",
        every=3, samples=2, thresholds=f"lines {1000 * touch.CELL_M:g} mm apart",
    ),
    Metric(
        "Physics", "hand_hand_mm", "penetration of one hand by the other", "mm", "lower", touch.hand_hand_mm,
        "mean over motions", f"{HANDS}, both hands", "this project: depth of the deepest of 19 x 19 capsules",
        every=3, samples=2,
    ),
    Metric(
        "Physics", "slip_cm_s", "slip of touching joints on the moving object", "cm/s", "lower", touch.slip_cm_s,
        "mean over motions", f"{HANDS}, a joint touches in two in a row, and the part under it moves",
        "this project: speed in the frame of the part touched",
        thresholds=f"{CONTACT}; moving: {MOVING_CM_S:g} cm/s",
    ),
    Metric(
        "Physics", "realism_si", "physical realism, SI", "", "higher", motion.realism_si, "mean over frames", SCORED,
        f"{MANIPNET} and Appendix A, in SI units", samples=1, thresholds=FORCES,
    ),
    Metric(
        "Physics", "realism_si_floor", "physical realism, SI, without hands", "", "nearer the truth", motion.floor_si,
        "mean over frames", LIFTED, "this project: what the metric gives for nothing", samples=1, thresholds=FORCES,
        floor_of="realism_si",
    ),
    Metric(
        "Physics", "realism_released", "physical realism, as released", "", "higher", motion.realism_as_released,
        "mean over frames", SCORED, f"{MANIPNET} and Appendix A, units of the released sources", samples=1,
        thresholds=FORCES,
    ),
    Metric(
        "Physics", "realism_released_floor", "physical realism, as released, without hands", "", "nearer the truth",
        motion.floor_as_released, "mean over frames", LIFTED, "this project: what the metric gives for nothing",
        samples=1, thresholds=FORCES, floor_of="realism_released",
    ),
    Metric(
        "Physics", "capsule_depth_mm", "penetration of overlapping capsules", "mm", "lower", motion.capsule_depth_mm,
        "mean over motions", LIFTED, f"{MANIPNET}, penetration depth", samples=1,
    ),
    Metric(
        "Motion", "smoothness_m_s2", "acceleration of joints in the wrist's frame", "m/s2", "nearer the truth",
        motion.smoothness, "mean over motions", f"{HANDS}, three in a row", f"{MANIPNET}, smoothness",
    ),
    Metric(
        "Motion", "jitter_m_s3", "jitter of joints in the world", "m/s3", "nearer the truth", motion.jitter_m_s3,
        "mean over motions", f"{HANDS}, four in a row", "mean jerk, TransPose (Yi et al. 2021), Sec. 5.2",
    ),
    Metric(
        "Motion", "object_jitter_m_s3", "jitter of the object's middle in the world", "m/s3", "nearer the truth",
        motion.object_jitter_m_s3, "mean over motions", "all, four in a row",
        "this project: mean jerk, as `jitter_m_s3`",
    ),
    Metric(
        "Action", "action_followed", "the object does what the verb says", "", "higher", motion.action_followed,
        "mean over motions", "all", "this project: limits of height, way, tilt, hinge and hands (`hoidata/actions`)",
        thresholds="`actions.toml`, or the verb's own training clips: 1st to 99th percentile and half a deviation",
    ),
    Metric(
        "Action", "action_named", "the object moves most like the verb's training clips",
        "", "higher", motion.action_named,
        "mean over motions", "all", "this project: nearest centroid of the standardised numbers of `hoidata/actions`",
    ),
    Metric(
        "Motion", "length_error_frames", "error of the length a family chose",
        "frames", "lower", motion.length_error_frames,
        "mean over motions", "all; only stores whose info says `length: own`", "this project",
    ),
    Metric(
        "Motion", "length_error_share", "error of the length a family chose, of the true one", "", "lower",
        motion.length_error_share, "mean over motions", "all; only stores whose info says `length: own`",
        "this project",
    ),
)  # fmt: skip


def metric(name: str) -> Metric:
    """The metric of that name. Raises KeyError that lists the names there are."""
    found = next((item for item in METRICS if item.name == name), None)
    if found is None:
        raise KeyError(f"no metric {name!r}; there are: {', '.join(item.name for item in METRICS)}")
    return found


def reduced(metric: Metric, clips: list[list[Values]]) -> Figure | None:
    """One figure of the values of every motion, by clip and sample; None where no motion has a value.

    Motions without values are left out, not counted as 0; ``unmeasured`` counts them.
    """
    motions = [_with_values(samples) for samples in clips]
    motions = [samples for samples in motions if samples]
    if not motions:
        return None
    means = [np.array([values.mean() for values in samples]) for samples in motions]
    every = np.concatenate([values for samples in motions for values in samples])
    if metric.reduction == "best of a clip's samples":
        value = np.mean([found.max() if metric.direction == "higher" else found.min() for found in means])
    else:
        value = np.mean(every if metric.reduction == "mean over frames" else np.concatenate(means))
    return Figure(float(value), len(motions), sum(map(len, means)), len(every))


def unmeasured(metric: Metric, clips: list[list[Values]]) -> dict[str, int]:
    """How many clips no motion of which has a value, by the reason that the first motion has."""
    return counted(_why_none(metric, samples) for samples in clips if not _with_values(samples))


def _with_values(samples: list[Values]) -> list[np.ndarray]:
    return [values for values in samples if isinstance(values, np.ndarray) and len(values)]


def _why_none(metric: Metric, samples: list[Values]) -> str:
    reasons = [values.reason for values in samples if isinstance(values, Unmeasured)]
    return reasons[0] if reasons else f"no such frame: {metric.frames}"


def sum_and_count(metric: Metric, samples: list[Values]) -> tuple[float, int]:
    """What one clip brings to a figure: sums over all clips, divided by counts, are the figure."""
    known = _with_values(samples)
    if metric.reduction == "mean over frames":
        return float(sum(values.sum() for values in known)), sum(map(len, known))
    means = [float(values.mean()) for values in known]
    if metric.reduction == "best of a clip's samples" and means:
        means = [max(means) if metric.direction == "higher" else min(means)]
    return sum(means), len(means)


class Judged(Protocol):
    """What telling the better of two figures needs of a metric of either list."""

    @property
    def direction(self) -> Direction: ...
    @property
    def floor_of(self) -> str: ...


def is_better(metric: Judged, value: float, other: float, truth: float | None) -> bool | None:
    """Whether ``value`` is better than ``other``; None where the truth is not known or the metric is a floor."""
    if metric.floor_of:
        return None
    if metric.direction == "nearer the truth":
        return None if truth is None else abs(value - truth) < abs(other - truth)
    return value > other if metric.direction == "higher" else value < other
