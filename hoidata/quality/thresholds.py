"""The quality measures, their limits, and the verdict that follows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

from hoidata.errors import BadInput
from hoidata.files.written import read_table, require_output

Verdict = Literal["ok", "warned", "left out"]


NO_HAND = "no hand is ever valid"
NO_SOLID = "the mesh of the object is not solid"


@dataclass(frozen=True)
class Measure:
    """A quality measure. High values are faults."""

    name: str
    unit: str  # "" for a count or a fraction
    words: str  # description for people
    warn: float | None = None  # default limit
    leave_out: float | None = None  # default limit
    frame: str = ""  # column with the frame of the fault
    unmeasured: str = NO_HAND  # why a clip has no value


# Chosen such that no clip of the embedded corpora (251) and of ManipNet's recordings (45) is excluded. Measures that
# are high for some good clips (a closed mesh around a cavity, an open mesh) only warn.
CLIP_MEASURES = (
    Measure(
        "wrist_acceleration_m_s2", "m/s²", "median acceleration of the wrist, the worse hand", warn=15.0, leave_out=60.0
    ),
    Measure(
        "finger_acceleration_m_s2",
        "m/s²",
        "median acceleration of the finger joints about the wrist",
        warn=15.0,
        leave_out=60.0,
    ),
    Measure(
        "object_acceleration_m_s2", "m/s²", "median acceleration of the object's corners", warn=15.0, leave_out=60.0
    ),
    Measure("shaking_share", "", "share of frames in which one of them shakes", warn=0.05, leave_out=0.5),
    Measure("hand_jump_m", "m", "largest sudden step of a joint", warn=0.12, leave_out=0.3, frame="hand_jump_frame"),
    Measure(
        "object_jump_m",
        "m",
        "largest sudden step of a corner of the object",
        warn=0.05,
        leave_out=0.2,
        frame="object_jump_frame",
    ),
    Measure(
        "frozen_hand_frames",
        "frames",
        "longest stretch of one hand exactly still while something else moves",
        warn=45.0,
    ),
    Measure("frozen_all_frames", "frames", "longest stretch of everything exactly still", warn=30.0, leave_out=90.0),
    Measure("penetration_m", "m", "deepest hand vertex inside the object", warn=0.02, unmeasured=NO_SOLID),
    Measure(
        "penetration_share", "", "share of frames in which a hand is too deep inside", warn=0.5, unmeasured=NO_SOLID
    ),
    Measure(
        "time_offset_frames",
        "frames",
        "lag between hands and object",
        warn=1.0,
        leave_out=5.0,
        unmeasured="hands move with the object in too few frames, or too unlike it",
    ),
    Measure(
        "largest_beta",
        "sd",
        "largest shape coefficient",
        warn=3.0,
        leave_out=10.0,
        unmeasured="no hand is ever valid, or its shape is a template",
    ),
    Measure(
        "beta_distance",
        "sd",
        "distance of the shape from the subject's other clips",
        warn=1.5,
        leave_out=6.0,
        unmeasured="the subject has no other clip, or no hand with a shape",
    ),
    Measure("gap_share", "", "share of frames in which a hand is lost and comes back", warn=0.05, leave_out=0.5),
    Measure("handless_share", "", "share of frames without any hand", warn=0.1, leave_out=0.9),
)
MESH_MEASURES = (
    Measure("open_edge_share", "", "share of edges at a hole, or of uneven orientation", warn=0.0),
    Measure("unfilled_share", "", "1 - volume / convex hull: 1 encloses nothing, above 1 is inside out", warn=0.99),
    Measure("shells", "", "separate pieces of a part", warn=1.0),
    Measure("degenerate_share", "", "share of triangles without area", warn=0.01, leave_out=0.9),
    Measure("size_m", "m", "longest side of the bounding box", warn=1.0, leave_out=3.0),
)
MEASURES = {measure.name: measure for measure in (*CLIP_MEASURES, *MESH_MEASURES)}


@dataclass(frozen=True)
class Limit:
    """A measure above ``warn`` is reported; above ``leave_out`` its clip is excluded. None: no limit."""

    warn: float | None
    leave_out: float | None


DEFAULT_LIMITS = {name: Limit(measure.warn, measure.leave_out) for name, measure in MEASURES.items()}


@dataclass(frozen=True)
class Thresholds:
    """Settings of the measures, and their limits: the section ``quality`` of params.yaml."""

    penetration_every: int = 5  # penetration is measured in every n-th frame, from the first
    too_deep_m: float = 0.01  # minimum depth that counts as too deep
    shaking_m_s2: float = 50.0  # minimum acceleration that counts as shaking
    sudden_m: float = 0.03  # a step above it and above ``sudden_ratio`` times the motion around it is sudden
    sudden_ratio: float = 4.0
    large_m: float = 0.3  # a step above it is always sudden
    offset_confidence: float = 0.8  # minimum correlation of a time offset
    limits: Mapping[str, Limit] = field(default_factory=lambda: dict(DEFAULT_LIMITS))  # limits of each measure

    def __post_init__(self) -> None:
        if set(self.limits) != set(MEASURES):
            wrong = sorted(set(self.limits) ^ set(MEASURES))
            expected = f"a limit for each of: {', '.join(MEASURES)}"
            raise BadInput("quality.limits", expected, f"missing or unknown: {', '.join(wrong)}", "correct the names")
        if self.penetration_every < 1:
            raise BadInput("quality.penetration_every", "1 or more frames", f"{self.penetration_every}", "correct it")


class Finding(NamedTuple):
    """A measure above a limit, as text."""

    verdict: Verdict
    reason: str


def findings(values: Mapping[str, float], measures: Sequence[Measure], limits: Mapping[str, Limit]) -> list[Finding]:
    """Return the measures above a limit, by absolute value. NaN (not measurable) is within all limits."""
    violations: list[Finding] = []
    for measure in measures:
        value, limit = abs(values[measure.name]), limits[measure.name]
        if limit.leave_out is not None and value > limit.leave_out:
            violations.append(Finding("left out", _reason(measure, values, limit.leave_out)))
        elif limit.warn is not None and value > limit.warn:
            violations.append(Finding("warned", _reason(measure, values, limit.warn)))
    return violations


def verdict_of(violations: Sequence[Finding]) -> Verdict:
    """Return the worst verdict; "ok" without findings."""
    verdicts = {finding.verdict for finding in violations}
    return "left out" if "left out" in verdicts else "warned" if verdicts else "ok"


def reasons_of(violations: Sequence[Finding]) -> str:
    """Return the findings of the worst verdict in one line; "" without any."""
    worst = verdict_of(violations)
    return "; ".join(finding.reason for finding in violations if finding.verdict == worst)


def _reason(measure: Measure, values: Mapping[str, float], limit: float) -> str:
    unit = f" {measure.unit}" if measure.unit else ""
    frame = f" at frame {values[measure.frame]:g}" if measure.frame else ""
    value = values[measure.name]
    beyond = f"above {limit:g}" if value > 0 else f"below {-limit:g}"
    return f"{measure.words}: {value:.3g}{unit}{frame}, {beyond}{unit}"


def exclusion_reasons(folder: str | Path) -> dict[str, str]:
    """Return the reasons of excluded clips, by clip id. Raises MissingResource if the stage has not run."""
    require_output(folder, "quality", "clips.parquet")
    rows = read_table(Path(folder) / "clips.parquet", ["clip_id", "verdict", "reasons"])
    failed = rows[rows["verdict"] == "left out"]
    return {
        clip_id: f"left out by quality control: {reasons}"
        for clip_id, reasons in zip(failed["clip_id"].tolist(), failed["reasons"].tolist(), strict=True)
    }
