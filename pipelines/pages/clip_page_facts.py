"""The content of a clip page: sentences, evidence for the hand type, quality, splits, provenance and time series.

Contact with sampled points and hand types are read from the stages; distances to the exact surface are computed here.
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
from hoidata.store.info import embedded_hand_warning
from hoidata.surface.measure import HandSurfaceMeasures, measure_hand
from pipelines.pages.quality import read_limits

Rows = list[tuple[str, ...]]
NOTHING = "none"


@dataclass(frozen=True)
class ClipSeries:
    """The time series of one clip, (frame,) unless stated otherwise; NaN if undefined."""

    touched: dict[Side, np.ndarray]  # per side (frame, point) bool, the contact map of each frame
    evidence: HandEvidence  # distances that decide the hand type
    surface: dict[Side, HandSurfaceMeasures]  # per side, distances to the exact surface
    solid: bool  # the object is a closed solid, so depth is defined
    speed_m_s: np.ndarray  # of the object
    lift_m: np.ndarray | None  # height of the object above its first frame; None without gravity
    hinge_rad: np.ndarray | None  # as in ``ObjectTrack``; None for a rigid object
    is_prismatic: bool  # whether it is in metres

    @property
    def depth_m(self) -> dict[Side, np.ndarray] | None:
        """Per side (frame,) depth of the deepest hand vertex in the object; None if the object is not solid."""
        return {side: measured.depth_m for side, measured in self.surface.items()} if self.solid else None

    @property
    def surface_evidence(self) -> HandEvidence:
        """The evidence for the hand type from the exact surface in place of sampled points, at the same threshold."""
        distance: dict[Side, np.ndarray] = {side: measured.joint_m for side, measured in self.surface.items()}
        return HandEvidence(distance, self.evidence.threshold_m)


def sentence_rows(annotated: AnnotatedStore, clip_id: str) -> list[tuple[str, list[str]]]:
    """(form, sentences) of the stage annotate, in its order; empty for a clip without sentences."""
    texts = annotated.text[annotated.text["clip_id"] == clip_id]
    forms = dict.fromkeys(texts["form"].tolist())
    return [(str(form), texts.loc[texts["form"] == form, "sentence"].tolist()) for form in forms]


def hand_decision(annotated: AnnotatedStore, clip: Clip, series: ClipSeries) -> dict[str, Any]:
    """The decision of the stage annotate and its evidence, as texts; hands: the cells of each hand's row."""
    decision = annotated.hand_types.loc[clip.clip_id]
    threshold, points = annotated.annotation_info["threshold_m"], annotated.annotation_info["points"]
    rule = (
        f"A hand is active if one of its 21 joints comes closer than {threshold * 100:g} cm to one of "
        f"{points:,} sampled points of the object (Text2HOI, supplement 6)."
    )
    if "annotated" in set(annotated.hand_types["source"]):
        used = "as for this clip" if decision["source"] == "annotated" else "but not for this clip"
        rule += f" If the source has a label of the hand, the label is used instead, {used}."
    agreement = "The source has no label of the hand."
    if clip.labelled_hand is not None:
        verdict = "which agrees" if bool(decision["agreement"]) else "which DISAGREES"
        agreement = f"Label of the source: {clip.labelled_hand}, {verdict}."
    by_points, exact = series.evidence.hand_type or NOTHING, series.surface_evidence.hand_type or NOTHING
    is_same = "the same" if by_points == exact else f"{exact}, which DIFFERS"
    return {
        "hand_type": NOTHING if pd.isna(decision["hand_type"]) else str(decision["hand_type"]),
        "rule": rule,
        "agreement": agreement,
        "surface": f"With the exact surface in place of sampled points the hand type is {is_same}.",
        "points": points,
        "hands": [_hand_facts(annotated, clip, series, side) for side in SIDES],
    }


def _hand_facts(annotated: AnnotatedStore, clip: Clip, series: ClipSeries, side: Side) -> tuple[str, ...]:
    points, surface = series.evidence, series.surface_evidence
    valid, distance = clip.hands[side].valid, points.distance_m[side]
    count = f"{int(valid.sum())} of {clip.n_frames}"
    if not valid.any():
        return side, count, "no", "never visible", *[""] * 5
    frame = int(distance.argmin())
    within, exact = int(points.near(side).sum()), int(surface.near(side).sum())
    entries = annotated.distances(clip.clip_id, side)
    here = entries.select(entries.frame == frame)  # empty if the contact stage stored no distance of this frame
    joint = f", {JOINT_NAMES[int(here.joint[here.distance_m.argmin()])]}" if len(here.frame) else ""
    is_active, is_exactly = ("yes" if frames else "no" for frames in (within, exact))
    nearest = (f"{distance[frame] * 100:.2f} cm", f"frame {frame}{joint}")
    return (
        *(side, count, is_active, *nearest, f"{within} of {clip.n_frames}"),
        *(is_exactly, f"{surface.closest_m(side) * 100:.2f} cm", f"{exact} of {clip.n_frames}"),
    )


def clip_quality(folder: Path, clip_id: str) -> dict[str, Any]:
    """Verdict, reasons and measures of quality control. Raises MissingResource if its stage has not run."""
    require_output(folder, "quality", "clips.parquet")
    record = read_table(folder / "clips.parquet").set_index("clip_id").loc[clip_id]
    limits = read_limits(folder)
    measures = [
        (
            f"{measure.words}{', ' + measure.unit if measure.unit else ''}",
            _number(record[measure.name]),
            *(_number(limits[measure.name][end], "") for end in ("warn", "leave_out")),
        )
        for measure in CLIP_MEASURES
    ]
    return {**{name: record[name] or "" for name in ("verdict", "reasons", "note")}, "measures": measures}


def _number(value: Any, missing: str = "not measured") -> str:
    return missing if pd.isna(value) else f"{float(value):.4g}"


def split_rows(annotated: AnnotatedStore, clip_id: str) -> Rows:
    """(split, part) of every named split of the dataset; the chosen one first."""
    table = read_table(annotated.root / "splits" / "splits.parquet").set_index("clip_id")
    parts_by_split = table.loc[clip_id]
    chosen = str(annotated.split_info["chosen"]["name"])
    parts = [(str(name), NOTHING if pd.isna(part) else str(part)) for name, part in parts_by_split.items()]
    others = [(name, part) for name, part in parts if name not in ("split", chosen)]
    return [(f"{chosen} (chosen)", dict(parts)["split"]), *others]


def clip_facts(annotated: AnnotatedStore, clip: Clip, hands: HandPair) -> Rows:
    """(name, text) rows about the clip itself."""
    info, model = annotated.info, clip.object.model
    kind = "with a hinge" if model.is_articulated else "rigid"
    licence = f"{info['licence']}; derived data {'may be shared' if info['may_be_shared'] else 'not to be shared'}"
    extras = ["body parameters"] if clip.body is not None else []
    if clip.source_contact is not None:
        extras.append(f"contact labels of the source ({len(clip.source_contact.frame):,} entries)")
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
        ("hand model", "; ".join(filter(None, (hands.name, embedded_hand_warning(annotated.info))))),
        ("camera", _camera(clip)),
        ("further data", "; ".join(extras) or "nothing"),
        ("licence", licence),
    ]


def _verb(annotated: AnnotatedStore, clip: Clip) -> str:
    """The verb of the source, or the verb derived from the motion with its evidence."""
    decision = annotated.hand_types.loc[clip.clip_id]
    if decision["verb_source"] == "derived":
        return f"{decision['verb']}, derived from the motion ({decision['verb_evidence']}): the source has no label"
    return clip.verb or "no label in the source"


def source_frames_text(clip: Clip) -> str:
    """The frames of the source that a clip has, and the number of interpolated frames."""
    recorded = clip.source_frames[clip.recorded]
    steps = np.unique(np.diff(recorded)).tolist()
    steps_text = "" if steps == [1] or not steps else f", in steps of {' or '.join(map(str, steps[:3]))}"
    interpolated = clip.n_frames - len(recorded)
    note = f"; {interpolated} of {clip.n_frames} frames are interpolated" if interpolated else ""
    return f"{recorded[0]} to {recorded[-1]}{steps_text}; the source has {clip.source_fps:g} per second{note}"


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
    words = f"{clip.camera.name}, images {int(images[0])} to {int(images[-1])}"
    if lens is not None:
        words += f"; fx, fy, cx, cy, width, height: {', '.join(f'{value:g}' for value in np.round(lens, 1))}"
    return words


def measure_clip(annotated: AnnotatedStore, clip: Clip, hands: HandPair) -> ClipSeries:
    """The series of one clip of an annotated dataset; hands: the model of its store."""
    points = annotated.points(annotated.object_key(clip.clip_id))
    # The mean of the sampled points: the moving part counts as far as its surface goes.
    centre_m = clip.object.points_in_world(points.points_m, points.part).mean(axis=1)
    # np.gradient needs two frames.
    speed_m_s = np.linalg.norm(np.gradient(centre_m, axis=0), axis=1) * FPS if len(centre_m) > 1 else np.zeros(1)
    return ClipSeries(
        touched={side: _touched(annotated, clip, side, len(points)) for side in SIDES},
        evidence=annotated.hand_evidence(clip.clip_id),
        surface={side: measure_hand(clip, side, hands, points) for side in SIDES},
        solid=surface_index(clip.object.model).is_solid,
        speed_m_s=speed_m_s,
        lift_m=None if clip.gravity is None else -(centre_m - centre_m[0]) @ np.asarray(clip.gravity, np.float64),
        hinge_rad=clip.object.hinge_rad,
        is_prismatic=clip.object.model.hinge is not None and clip.object.model.hinge.is_prismatic,
    )


def _touched(annotated: AnnotatedStore, clip: Clip, side: Side, n_points: int) -> np.ndarray:
    """(frame, point) bool: a joint of the hand is within the contact stage's threshold of the point."""
    assert clip.n_frames <= LONGEST_CLIP
    entries = annotated.distances(clip.clip_id, side)
    touched = np.zeros((clip.n_frames, n_points), dtype=bool)
    touched[entries.frame, entries.point] = True
    return touched
