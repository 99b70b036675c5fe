"""What one clip's page says and plots: words, what the hand type rests on, quality, splits, origin, series by frame.

Contact with points and hand types are read from the folders of the stages; the exact surface is asked here.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hoidata.clips.clip import FPS, SIDES, Clip, Side
from hoidata.contact.maps import LONGEST_CLIP
from hoidata.files.written import read_table, require_output
from hoidata.hands import JOINT_NAMES, HandPair
from hoidata.objects.surface_index import surface_index
from hoidata.quality.thresholds import CLIP_MEASURES
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.hand_evidence import HandEvidence
from hoidata.store.info import stand_in_note
from hoidata.surface.measure import SideSurface, measure_hand
from pipelines.pages.quality import read_limits

Rows = list[tuple[str, ...]]
NOTHING = "none"


@dataclass(frozen=True)
class ClipSeries:
    """Everything per frame (frame,), NaN where it means nothing.

    touched: per side (frame, point) bool, the contact map of each frame. evidence: what the hand type rests on.
    surface: per side the hand against the exact surface. solid: whether anything can be inside the object, so that
    depths mean something.
    lift_m: height of the object above its first frame, or None without gravity. hinge_rad: None for a rigid object.
    """

    touched: dict[Side, np.ndarray]
    evidence: HandEvidence
    surface: dict[Side, SideSurface]
    solid: bool
    speed_m_s: np.ndarray
    lift_m: np.ndarray | None
    hinge_rad: np.ndarray | None

    def touched_count(self, side: Side) -> np.ndarray:
        """(frame,) how many of the sampled points this hand touches."""
        return self.touched[side].sum(axis=1)

    @property
    def depth_m(self) -> dict[Side, np.ndarray] | None:
        """Per side the deepest hand vertex inside the object, or None where the mesh has no inside."""
        return {side: found.depth_m for side, found in self.surface.items()} if self.solid else None

    @property
    def surface_evidence(self) -> HandEvidence:
        """The hand test against the exact surface in place of sampled points, at the same threshold."""
        distance: dict[Side, np.ndarray] = {side: found.joint_m for side, found in self.surface.items()}
        return HandEvidence(None, distance, self.evidence.threshold_m).at_threshold(self.evidence.threshold_m)


@dataclass(frozen=True)
class HandDecision:
    """The hand type, in words how it was found, and what the exact surface says.

    hands: of each hand side, valid frames, then whether it acts and how near it comes, by points and by the surface.
    """

    hand_type: str
    rule: str
    agreement: str
    surface: str
    points: int
    hands: Rows


@dataclass(frozen=True)
class ClipQuality:
    """Verdict and reasons of quality control, and the measures: (what, value, warn above, leave out above)."""

    verdict: str
    reasons: str
    note: str
    measures: Rows


def sentence_rows(annotated: AnnotatedStore, clip_id: str) -> list[tuple[str, list[str]]]:
    """(form, sentences) as the stage annotate wrote them, in its order; nothing for a clip that got none."""
    rows = annotated.text[annotated.text["clip_id"] == clip_id]
    forms = dict.fromkeys(rows["form"].tolist())
    return [(str(form), rows.loc[rows["form"] == form, "sentence"].tolist()) for form in forms]


def hand_decision(annotated: AnnotatedStore, clip: Clip, series: ClipSeries) -> HandDecision:
    """What the stage annotate decided, and the distances it rests on."""
    row = annotated.hand_types.loc[clip.clip_id]
    threshold, points = annotated.annotation_info["threshold_m"], annotated.annotation_info["points"]
    return HandDecision(
        hand_type=NOTHING if pd.isna(row["hand_type"]) else str(row["hand_type"]),
        rule=f"A hand acts when, in any frame, one of its 21 joints is closer than {threshold * 100:g} cm to one of "
        f"{points:,} points of the object (Text2HOI, supplement 6).{_annotated_rule(annotated, row['source'])}",
        agreement=_agreement(clip, row["agreement"]),
        surface=_surface_words(series),
        points=points,
        hands=[_hand_facts(annotated, clip, series, side) for side in SIDES],
    )


def _annotated_rule(annotated: AnnotatedStore, source: Any) -> str:
    """What ``annotate.hand`` adds to the rule; nothing by default."""
    if annotated.annotation_info.get("hand", "proximity") == "proximity":
        return ""
    taken = "as here" if source == "annotated" else "which is not so here"
    return f" Where the source's annotator named a hand, that one is taken instead, {taken}."


def _agreement(clip: Clip, agreement: Any) -> str:
    if clip.labelled_hand is None:
        return "The source names no hand."
    verdict = "which agrees" if bool(agreement) else "which DISAGREES"
    return f"The source's annotator named: {clip.labelled_hand}, {verdict}."


def _surface_words(series: ClipSeries) -> str:
    """Whether the same test against the surface gives the same hand."""
    by_points, exact = series.evidence.hand_type or NOTHING, series.surface_evidence.hand_type or NOTHING
    verdict = "the same" if by_points == exact else f"{exact}, which DIFFERS"
    return f"With the object's exact surface in place of the points the hand type is {verdict}."


def _hand_facts(annotated: AnnotatedStore, clip: Clip, series: ClipSeries, side: Side) -> tuple[str, ...]:
    points, surface = series.evidence, series.surface_evidence
    valid, distance = clip.hands[side].valid, points.distance_m[side]
    count = f"{int(valid.sum())} of {clip.n_frames}"
    if not valid.any():
        return side, count, "no", "never seen", *[""] * 5
    frame = int(distance.argmin())
    within, exact = int(points.near(side).sum()), int(surface.near(side).sum())
    where = f"frame {frame}{_joint(annotated, clip.clip_id, side, frame)}"
    return (
        *(side, count, _yes(within), f"{distance[frame] * 100:.2f} cm", where, f"{within} of {clip.n_frames}"),
        *(_yes(exact), f"{surface.closest_m(side) * 100:.2f} cm", f"{exact} of {clip.n_frames}"),
    )


def _yes(frames: int) -> str:
    return "yes" if frames else "no"


def _joint(annotated: AnnotatedStore, clip_id: str, side: Side, frame: int) -> str:
    """Which joint is nearest in a frame, where the contact stage kept its distance."""
    entries = annotated.distances(clip_id, side)
    here = entries.select(entries.frame == frame)
    return f", {JOINT_NAMES[int(here.joint[here.distance_m.argmin()])]}" if len(here.frame) else ""


def clip_quality(folder: Path, clip_id: str) -> ClipQuality:
    """What quality control found. Raises MissingResource where its stage has not run."""
    require_output(folder, "quality", "clips.parquet")
    row = read_table(folder / "clips.parquet").set_index("clip_id").loc[clip_id]
    limits = read_limits(folder)
    measures = [
        (
            f"{measure.words}{', ' + measure.unit if measure.unit else ''}",
            _number(row[measure.name]),
            *(_number(limits[measure.name][end], "") for end in ("warn", "leave_out")),
        )
        for measure in CLIP_MEASURES
    ]
    return ClipQuality(str(row["verdict"]), str(row["reasons"] or ""), str(row["note"] or ""), measures)


def _number(value: Any, missing: str = "not measured") -> str:
    return missing if pd.isna(value) else f"{float(value):.4g}"


def split_rows(annotated: AnnotatedStore, clip_id: str) -> Rows:
    """(split, part) of every named split of the dataset; the chosen one first."""
    table = read_table(annotated.root / "splits" / "splits.parquet").set_index("clip_id")
    row = table.loc[clip_id]
    chosen = str(annotated.split_info["chosen"]["name"])
    parts = [(str(name), NOTHING if pd.isna(part) else str(part)) for name, part in row.items()]
    others = [(name, part) for name, part in parts if name not in ("split", chosen)]
    return [(f"{chosen} (chosen)", dict(parts)["split"]), *others]


def clip_facts(annotated: AnnotatedStore, clip: Clip, hands: HandPair) -> Rows:
    """(name, text) rows about the clip itself."""
    info, model = annotated.info, clip.object.model
    kind = "with a hinge" if model.is_articulated else "rigid"
    licence = f"{info['licence']}; derived data {'may be shared' if info['may_be_shared'] else 'not to be shared'}"
    return [
        ("clip", clip.clip_id),
        ("dataset", f"{info['dataset']}, version {info['dataset_version']}"),
        ("subject, sequence", f"{clip.subject}, {clip.sequence}"),
        ("verb", _verb(annotated, clip)),
        ("object", f"{clip.object_words} ({model.name}), {kind}, {len(model.faces):,} triangles"),
        ("other objects", ", ".join(track.model.name for track in clip.other_objects) or NOTHING),
        ("length", f"{clip.n_frames} frames, {clip.n_frames / FPS:.2f} s at {FPS} per second"),
        ("source frames", source_frames_text(clip)),
        ("gravity", _gravity(clip)),
        ("hands from", _hands_from(clip)),
        ("hand model", "; ".join(filter(None, (hands.name, stand_in_note(annotated.info))))),
        ("camera", _camera(clip)),
        ("also there", _further(clip)),
        ("licence", licence),
    ]


def source_rows(clip: Clip) -> Rows:
    """(path below the raw folder, bytes, SHA-256) of every raw file behind the clip."""
    return [(source.path, f"{source.size:,}", source.sha256) for source in clip.sources]


def _verb(annotated: AnnotatedStore, clip: Clip) -> str:
    """The source's word, or the one derived from the motion, marked as such, with what it rests on."""
    row = annotated.hand_types.loc[clip.clip_id]
    if row["verb_source"] == "derived":
        return f"{row['verb']}, derived from the motion ({row['verb_evidence']}): the source has no label"
    return clip.verb or "no label in the source"


def source_frames_text(clip: Clip) -> str:
    """Which frames of the source a clip has, and how many frames were made between them."""
    recorded = clip.source_frames[clip.recorded]
    steps = np.unique(np.diff(recorded)).tolist()
    every = "" if steps == [1] or not steps else f", in steps of {' or '.join(map(str, steps[:3]))}"
    made = clip.n_frames - len(recorded)
    note = f"; {made} of {clip.n_frames} frames are interpolated" if made else ""
    return f"{recorded[0]} to {recorded[-1]}{every}; the source has {clip.source_fps:g} per second{note}"


def _gravity(clip: Clip) -> str:
    if clip.gravity is None:
        return f"not known: {clip.gravity_note}"
    words = ", ".join(f"{value + 0.0:.3g}" for value in np.round(clip.gravity, 3))
    return f"({words}), {clip.gravity_note or 'stated by the source'}"


def _hands_from(clip: Clip) -> str:
    if clip.hands_from == "parameters":
        return "hand parameters of the source"
    error = "" if clip.fit_error_m is None else f", mean error {clip.fit_error_m * 1000:.1f} mm"
    return f"a hand model fitted to the source's keypoints{error}"


def _camera(clip: Clip) -> str:
    if clip.camera is None:
        return NOTHING
    images, lens = clip.camera.images, clip.camera.intrinsics
    numbers = "" if lens is None else ", ".join(f"{value:g}" for value in np.round(lens, 1))
    shown = f"; fx, fy, cx, cy, width, height: {numbers}" if numbers else ""
    return f"{clip.camera.name}, images {int(images[0])} to {int(images[-1])}{shown}"


def _further(clip: Clip) -> str:
    found = ["body parameters"] if clip.body is not None else []
    if clip.source_contact is not None:
        found.append(f"contact labels of the source ({len(clip.source_contact.frame):,} entries)")
    return "; ".join(found) or "nothing"


def measure_clip(annotated: AnnotatedStore, clip: Clip, hands: HandPair) -> ClipSeries:
    """The series of one clip of an annotated dataset; hands: the model of its store."""
    points = annotated.points(annotated.object_key(clip.clip_id))
    # The mean of the sampled points: the moving part counts as far as its surface goes.
    centre_m = clip.object.points_in_world(points.points_m, points.part).mean(axis=1)
    return ClipSeries(
        touched={side: _touched(annotated, clip, side, len(points)) for side in SIDES},
        evidence=annotated.hand_evidence(clip.clip_id),
        surface={side: measure_hand(clip, side, hands, points) for side in SIDES},
        solid=surface_index(clip.object.model).is_solid,
        speed_m_s=_speed_m_s(centre_m),
        lift_m=None if clip.gravity is None else -(centre_m - centre_m[0]) @ np.asarray(clip.gravity, np.float64),
        hinge_rad=clip.object.hinge_rad,
    )


def _touched(annotated: AnnotatedStore, clip: Clip, side: Side, n_points: int) -> np.ndarray:
    """(frame, point) bool: a joint of the hand is within the contact stage's threshold of the point."""
    assert clip.n_frames <= LONGEST_CLIP
    entries = annotated.distances(clip.clip_id, side)
    touched = np.zeros((clip.n_frames, n_points), dtype=bool)
    touched[entries.frame, entries.point] = True
    return touched


def _speed_m_s(centre_m: np.ndarray) -> np.ndarray:
    """(frame,) central differences; 0 for a single frame."""
    if len(centre_m) < 2:
        return np.zeros(len(centre_m))
    return np.linalg.norm(np.gradient(centre_m, axis=0), axis=1) * FPS
