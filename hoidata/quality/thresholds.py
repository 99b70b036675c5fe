"""What is measured, the limits on it, and the verdict on one row of measures."""

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
    """unit: "" for a count or a share. words: what it is, for people; its faults sit at high values.

    warn, leave_out: its :class:`Limit` by default. frame: the column of the frame it was found at, "" for none.
    unmeasured: why a clip has none, in words.
    """

    name: str
    unit: str
    words: str
    warn: float | None = None
    leave_out: float | None = None
    frame: str = ""
    unmeasured: str = NO_HAND


# Limits are chosen on the embedded corpora (251 clips) and ManipNet's recordings (45): no clip of theirs reaches
# ``leave_out``. Where good clips reach any value (a closed mesh around a cavity, an open mesh), a measure only warns.
CLIP_MEASURES = (
    Measure("wrist_acceleration_m_s2", "m/s²", "median acceleration of the wrist, the worse hand", 15.0, 60.0),
    Measure("finger_acceleration_m_s2", "m/s²", "median acceleration of the finger joints about the wrist", 15.0, 60.0),
    Measure("object_acceleration_m_s2", "m/s²", "median acceleration of the object's corners", 15.0, 60.0),
    Measure("shaking_share", "", "share of frames in which one of them shakes", 0.05, 0.5),
    Measure("hand_jump_m", "m", "largest sudden step of a joint", 0.12, 0.3, "hand_jump_frame"),
    Measure("object_jump_m", "m", "largest sudden step of a corner of the object", 0.05, 0.2, "object_jump_frame"),
    Measure(
        "frozen_hand_frames", "frames", "longest stretch of one hand exactly still while something else moves", 45.0
    ),
    Measure("frozen_all_frames", "frames", "longest stretch of everything exactly still", 30.0, 90.0),
    Measure("penetration_m", "m", "deepest hand vertex inside the object", 0.02, unmeasured=NO_SOLID),
    Measure("penetration_share", "", "share of frames in which a hand is too deep inside", 0.5, unmeasured=NO_SOLID),
    Measure(
        "time_offset_frames",
        "frames",
        "lag between hands and object, either way",
        1.0,
        5.0,
        unmeasured="hands move with the object in too few frames, or too unlike it",
    ),
    Measure(
        "largest_beta",
        "sd",
        "largest shape coefficient",
        3.0,
        10.0,
        unmeasured="no hand is ever valid, or its shape is a template",
    ),
    Measure(
        "beta_distance",
        "sd",
        "distance of the shape from the subject's other clips",
        1.5,
        6.0,
        unmeasured="the subject has no other clip, or no hand with a shape",
    ),
    Measure("gap_share", "", "share of frames in which a hand is lost and comes back", 0.05, 0.5),
    Measure("handless_share", "", "share of frames without any hand", 0.1, 0.9),
)
MESH_MEASURES = (
    Measure("open_edge_share", "", "share of edges at a hole, or of uneven orientation", 0.0),
    Measure("unfilled_share", "", "1 - volume / convex hull: 1 encloses nothing, above 1 is inside out", 0.99),
    Measure("shells", "", "separate pieces of a part", 1.0),
    Measure("degenerate_share", "", "share of triangles without area", 0.01, 0.9),
    Measure("size_m", "m", "longest side of the bounding box", 1.0, 3.0),
)
MEASURES = {measure.name: measure for measure in (*CLIP_MEASURES, *MESH_MEASURES)}


@dataclass(frozen=True)
class Limit:
    """A measure above ``warn`` is reported; above ``leave_out`` its clip is not used. None: never."""

    warn: float | None
    leave_out: float | None


DEFAULT_LIMITS = {name: Limit(measure.warn, measure.leave_out) for name, measure in MEASURES.items()}


@dataclass(frozen=True)
class Thresholds:
    """Settings of the measures and limits on them: the section ``quality`` of params.yaml.

    penetration_every: penetration is measured in every n-th frame, the first included. too_deep_m: from where a hand
    counts as too deep. shaking_m_s2: from which acceleration a frame counts as shaking. sudden_m, sudden_ratio: a step
    is sudden above ``sudden_m`` and ``sudden_ratio`` times the motion around it, or above ``large_m``.
    offset_confidence: time offsets of a lower correlation are not judged. limits: by name of the measure.
    """

    penetration_every: int = 5
    too_deep_m: float = 0.01
    shaking_m_s2: float = 50.0
    sudden_m: float = 0.03
    sudden_ratio: float = 4.0
    large_m: float = 0.3
    offset_confidence: float = 0.8
    limits: Mapping[str, Limit] = field(default_factory=lambda: dict(DEFAULT_LIMITS))

    def __post_init__(self) -> None:
        if set(self.limits) != set(MEASURES):
            wrong = sorted(set(self.limits) ^ set(MEASURES))
            known = f"a limit for each of: {', '.join(MEASURES)}"
            raise BadInput("quality.limits", known, f"missing or unknown: {', '.join(wrong)}", "correct the names")
        if self.penetration_every < 1:
            raise BadInput("quality.penetration_every", "1 or more frames", f"{self.penetration_every}", "correct it")


class Finding(NamedTuple):
    """One measure above a limit, in words."""

    verdict: Verdict
    reason: str


def findings(values: Mapping[str, float], measures: Sequence[Measure], limits: Mapping[str, Limit]) -> list[Finding]:
    """What is wrong with one row of measures, by the worse limit of each. NaN (could not be measured) is never wrong.

    The size of a signed measure counts.
    """
    found: list[Finding] = []
    for measure in measures:
        value, limit = abs(values[measure.name]), limits[measure.name]
        if limit.leave_out is not None and value > limit.leave_out:
            found.append(Finding("left out", _reason(measure, values, limit.leave_out)))
        elif limit.warn is not None and value > limit.warn:
            found.append(Finding("warned", _reason(measure, values, limit.warn)))
    return found


def verdict_of(found: Sequence[Finding]) -> Verdict:
    """The worst verdict of the findings; "ok" without any."""
    verdicts = {finding.verdict for finding in found}
    return "left out" if "left out" in verdicts else "warned" if verdicts else "ok"


def reasons_of(found: Sequence[Finding]) -> str:
    """The findings behind the verdict in one line; "" without any. Warnings of a clip left out do not explain it."""
    worst = verdict_of(found)
    return "; ".join(finding.reason for finding in found if finding.verdict == worst)


def _reason(measure: Measure, values: Mapping[str, float], limit: float) -> str:
    unit = f" {measure.unit}" if measure.unit else ""
    frame = f" at frame {values[measure.frame]:g}" if measure.frame else ""
    return f"{measure.words}: {values[measure.name]:.3g}{unit}{frame}, above {limit:g}{unit}"


def left_out_reasons(folder: str | Path) -> dict[str, str]:
    """Why each clip that failed is left out, by clip id. Raises MissingResource where no stage has written."""
    require_output(folder, "quality", "clips.parquet")
    rows = read_table(Path(folder) / "clips.parquet", ["clip_id", "verdict", "reasons"])
    failed = rows[rows["verdict"] == "left out"]
    return {
        clip_id: f"left out by quality control: {reasons}"
        for clip_id, reasons in zip(failed["clip_id"].tolist(), failed["reasons"].tolist(), strict=True)
    }
