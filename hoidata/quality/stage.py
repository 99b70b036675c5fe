"""Stage quality: measures each clip and object of a store and compares the measures with limits.

clips.parquet    one row per clip: verdict, reasons, ``thresholds.CLIP_MEASURES``; null if not measurable (``note`` says
                 why)
meshes.parquet   one row per object: likewise, ``thresholds.MESH_MEASURES``
info.json        thresholds, counts
"""

import functools
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rich.console import Console
from rich.progress import Progress

from hoidata.clips.clip import SIDES
from hoidata.files import atomic_folder, canonical_json
from hoidata.files.written import write_table
from hoidata.hands import HandPair
from hoidata.quality.measures import ObjectFacts, clip_row, distances_to_others, meant_betas, object_row
from hoidata.quality.thresholds import (
    CLIP_MEASURES,
    MESH_MEASURES,
    Finding,
    Thresholds,
    findings,
    reasons_of,
    verdict_of,
)
from hoidata.settings import plain_config
from hoidata.store.store import Store, open_store
from hoidata.workers import map_in_workers

# Below this a second process costs more to start than it saves.
FRAMES_PER_JOB = 50_000
_TEXT, _NUMBER, _COUNT = pa.string(), pa.float64(), pa.int32()
_VERDICT = [("verdict", _TEXT), ("reasons", _TEXT)]
CLIPS = pa.schema(
    [
        *(("clip_id", _TEXT), ("object", _TEXT), *_VERDICT, ("note", _TEXT)),
        *((measure.name, _NUMBER) for measure in CLIP_MEASURES),
        *((f"{side}_invalid_share", _NUMBER) for side in SIDES),
        ("time_offset_confidence", _NUMBER),
        *((name, _COUNT) for name in ("time_offset_samples", "hand_jump_frame", "object_jump_frame", "seam_triangles")),
    ]
)
MESHES = pa.schema(
    [
        *(("object", _TEXT), *_VERDICT, ("parts", _COUNT), ("faces", _COUNT), ("seam_triangles", _COUNT)),
        *(("watertight", pa.bool_()), ("solid", pa.bool_()), ("volume_m3", _NUMBER)),
        *((measure.name, _NUMBER) for measure in MESH_MEASURES),
    ]
)


def quality_store(
    clips_folder: str | Path,
    out_folder: str | Path,
    *,
    thresholds: Thresholds | None = None,
    hands: HandPair | None = None,
    jobs: int = 1,
    progress: bool = True,
) -> dict[str, int]:
    """Measure each clip and object of the store; the folder appears whole or not at all.

    A clip is excluded for its measures or for those of its object's mesh.

    Args:
        clips_folder: the store.
        out_folder: folder to write.
        thresholds: settings and limits.
        hands: as in ``open_store``.
        jobs: maximum number of worker processes; the result does not depend on it.
        progress: whether to show a progress bar on stderr.

    Returns:
        Counts: clips, ok, warned, left_out, objects, objects_warned, objects_left_out.
    """
    thresholds = thresholds or Thresholds()
    store = open_store(clips_folder, hands)
    facts = {name: ObjectFacts.of(store.object_model(name)) for name in store.objects["object"]}
    meshes = [{"object": name, **object_row(item)} for name, item in facts.items()]
    mesh_findings = {measures["object"]: findings(measures, MESH_MEASURES, thresholds.limits) for measures in meshes}
    clips = _measured(store, facts, thresholds, jobs, progress)
    _add_beta_distances(store, clips)
    for measures in clips:
        # An excluded mesh excludes its clips. Warnings of a mesh are not repeated for its clips.
        unusable = [item for item in mesh_findings[measures["object"]] if item.verdict == "left out"]
        inherited = [item._replace(reason=f"object {measures['object']}: {item.reason}") for item in unusable]
        _add_verdict(measures, [*findings(measures, CLIP_MEASURES, thresholds.limits), *inherited])
    for measures in meshes:
        _add_verdict(measures, mesh_findings[measures["object"]])
    counts = _counts(clips, meshes)
    with atomic_folder(out_folder) as partial:
        write_table(partial / "clips.parquet", [_nulled(measures, CLIPS) for measures in clips], CLIPS)
        write_table(partial / "meshes.parquet", [_nulled(measures, MESHES) for measures in meshes], MESHES)
        info = {"thresholds": plain_config(thresholds), "counts": counts}
        (partial / "info.json").write_text(canonical_json(info) + "\n", encoding="utf-8")
    return counts


def _add_verdict(measures: dict[str, Any], violations: list[Finding]) -> None:
    measures |= {"verdict": verdict_of(violations), "reasons": reasons_of(violations)}


def _measured(
    store: Store, facts: dict[str, ObjectFacts], thresholds: Thresholds, jobs: int, progress: bool
) -> list[dict[str, Any]]:
    """Measure all clips, in the store's order."""
    store.hand_pair()
    measure = functools.partial(_measure, store, facts, thresholds)
    frames = sum(store.sequences["n_frames"].tolist())
    jobs = min(jobs, 1 + frames // FRAMES_PER_JOB)
    with Progress(console=Console(stderr=True), disable=not progress) as bar:
        rows = dict(bar.track(map_in_workers(measure, store.ids, jobs), len(store), description="quality"))
    return [rows[clip_id] for clip_id in store.ids]


def _measure(store: Store, facts: dict[str, ObjectFacts], thresholds: Thresholds, clip_id: str) -> dict[str, Any]:
    clip = store.clip(clip_id, motion_only=True)
    name = clip.object.model.name
    return {"clip_id": clip_id, "object": name, **clip_row(clip, facts[name], store.hand_pair(), thresholds)}


def _add_beta_distances(store: Store, rows: list[dict[str, Any]]) -> None:
    """Add ``beta_distance`` of the worse hand. A hand that is never valid, or has a template, has no shape."""
    distances_of: dict[str, list[float]] = {measures["clip_id"]: [] for measures in rows}
    for _, clips in store.sequences.groupby("subject", sort=False):
        for side in SIDES:
            with_shape = clips[(clips[f"{side}_valid_frames"] > 0) & clips[f"{side}_template"].isna()]
            tracks = {key: store.clip(key, motion_only=True).hands[side] for key in with_shape["clip_id"]}
            betas = {key: meant_betas(track) for key, track in tracks.items()}
            for clip_id, distance in distances_to_others(betas).items():
                distances_of[clip_id].append(distance)
    for measures in rows:
        finite = [distance for distance in distances_of[measures["clip_id"]] if np.isfinite(distance)]
        measures["beta_distance"] = max(finite, default=float("nan"))


def _nulled(measures: dict[str, Any], schema: pa.Schema) -> dict[str, Any]:
    """Return the columns of a schema, with null for NaN."""
    values = {name: measures[name] for name in schema.names}
    return {name: None if isinstance(value, float) and np.isnan(value) else value for name, value in values.items()}


def _counts(clips: list[dict[str, Any]], meshes: list[dict[str, Any]]) -> dict[str, int]:
    of_clips, of_meshes = (Counter(measures["verdict"] for measures in rows) for rows in (clips, meshes))
    return {
        "clips": len(clips),
        "ok": of_clips["ok"],
        "warned": of_clips["warned"],
        "left_out": of_clips["left out"],
        "objects": len(meshes),
        "objects_warned": of_meshes["warned"],
        "objects_left_out": of_meshes["left out"],
    }
