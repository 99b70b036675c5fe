"""How often hands touch each object of a dataset and how deep they are inside it, from stored measures."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hoidata.files.written import read_table
from hoidata.store.annotated import AnnotatedStore

NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class ObjectContact:
    """One object, or all of them, over its clips, as texts; "not measured" where nothing can be inside.

    touching: share of frames in which a joint is within the threshold of a sampled point. deep: share of the frames
    that quality control looked at in which a hand vertex is too deep inside. deepest: depth of the deepest vertex, mm.
    """

    name: str
    clips: str
    frames: str
    touching: str
    deep: str
    deepest: str


def contact_by_object(annotated: AnnotatedStore) -> list[ObjectContact]:
    """Every object by name, after all of them together where there are several."""
    rows = annotated.store.sequences[["clip_id", "object", "n_frames"]].reset_index(drop=True)
    rows["touching"] = [len(np.unique(annotated.distances(clip_id).frame)) for clip_id in rows["clip_id"]]
    measures = ["clip_id", "penetration_m", "penetration_share"]
    depths = read_table(Path(annotated.root) / "quality" / "clips.parquet", measures)
    rows = rows.merge(depths, on="clip_id", how="left", validate="one_to_one")
    found = [_row(str(name), group) for name, group in rows.groupby("object")]
    return [_row("all objects", rows), *found] if len(found) > 1 else found


def _row(name: str, rows) -> ObjectContact:
    measured = rows[rows["penetration_m"].notna()]
    return ObjectContact(
        name=name,
        clips=f"{len(rows):,}",
        frames=f"{rows['n_frames'].sum():,}",
        touching=f"{100 * rows['touching'].sum() / rows['n_frames'].sum():.1f} %",
        deep=f"{100 * np.average(measured['penetration_share'], weights=measured['n_frames']):.1f} %"
        if len(measured)
        else NOT_MEASURED,
        deepest=f"{measured['penetration_m'].max() * 1000:.1f}" if len(measured) else NOT_MEASURED,
    )
