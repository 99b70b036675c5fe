"""What the stage surface found, as pages show it: by object how often hands touch it and lie inside it."""

from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import SIDES
from hoidata.errors import BadInput
from hoidata.store.annotated import AnnotatedStore
from hoidata.surface.store import REMEDY, SurfaceStore, open_surface

NOT_MEASURED = "not measured"
PENETRATION_M = 0.01  # BimArt counts frames with a hand vertex deeper than this ("Pen 1cm")


@dataclass(frozen=True)
class ObjectContact:
    """One object, or all of them, over the frames of its clips: texts, "not measured" where nothing can be inside.

    touching: share of frames in which a hand touches; inside, deep: in which a hand vertex lies inside, and deeper than
    1 cm; deepest: in all frames; volume: the largest that a hand and the object share in the frame of the deepest
    vertex of a clip. note: what was repaired of the mesh, or why it has no inside; of all objects, in how many clips
    nothing can be inside.
    """

    name: str
    clips: str
    frames: str
    touching: str
    inside: str
    deep: str
    deepest: str
    volume: str
    note: str


@dataclass(frozen=True)
class _Frames:
    """Of one clip: touching, (frame,) bool; depth_m (frame,) of the worse hand and volume_m3, the larger one of its
    deepest frames: NaN where nothing can be inside.
    """

    touching: np.ndarray
    depth_m: np.ndarray
    volume_m3: float


def surface_beside(annotated: AnnotatedStore) -> SurfaceStore | None:
    """What the stage surface left beside a dataset's other folders; None where it has not run or found no clip.

    Raises BadInput when it belongs to another conversion or to other points than the dataset's.
    """
    folder = annotated.root / "surface"
    if not (folder / "info.json").is_file():
        return None
    store = open_surface(folder)
    expected = annotated.store.sequences[["clip_id", "n_frames"]].to_numpy().tolist()
    if store.clips[["clip_id", "n_frames"]].to_numpy().tolist() != expected:
        raise BadInput(folder, f"the {len(expected)} clips of the store beside it", "others", REMEDY)
    points = annotated.contact_info["points"]
    if store.info["points"] != points:
        raise BadInput(folder, f"maps on {points} points", f"on {store.info['points']}", REMEDY)
    return store


def contact_by_object(store: SurfaceStore) -> list[ObjectContact]:
    """Every object with a measured clip, by name, after all of them together."""
    frames: dict[str, list[_Frames]] = {}
    for clip_id in store.ids:
        frames.setdefault(str(store.clips.at[clip_id, "object"]), []).append(_frames(store, clip_id))
    notes = dict(zip(store.objects["object"].tolist(), store.objects["note"].tolist(), strict=True))
    rows = [_row(name, found, notes[name]) for name, found in sorted(frames.items())]
    everything = [clip for found in frames.values() for clip in found]
    without = sum(np.isnan(clip.volume_m3) for clip in everything)
    note = f"{NOT_MEASURED} in {without:,} of {len(everything):,} clips: the object has no inside" if without else None
    return [_row("all objects", everything, note), *rows] if len(rows) > 1 else rows


def _frames(store: SurfaceStore, clip_id: str) -> _Frames:
    touching = np.any([store.touched(clip_id, side).any(axis=1) for side in SIDES], axis=0)
    depth = np.array([store.depth_m(clip_id, side) for side in SIDES])
    if not store.is_solid(clip_id):
        return _Frames(touching, np.full(len(touching), np.nan), np.nan)
    volumes = [store.hand(clip_id, side).deepest_volume_m3 for side in SIDES]
    return _Frames(touching, np.nan_to_num(depth, nan=0.0).max(axis=0), float(np.nan_to_num(volumes).max()))


def _row(name: str, found: list[_Frames], note: str | None) -> ObjectContact:
    touching = np.concatenate([clip.touching for clip in found])
    depth = np.concatenate([clip.depth_m for clip in found])
    depth = depth[np.isfinite(depth)]
    volumes = [clip.volume_m3 for clip in found if np.isfinite(clip.volume_m3)]
    return ObjectContact(
        name=name,
        clips=f"{len(found):,}",
        frames=f"{len(touching):,}",
        touching=_share(touching),
        inside=_share(depth > 0),
        deep=_share(depth > PENETRATION_M),
        deepest=f"{depth.max() * 1000:.1f}" if len(depth) else NOT_MEASURED,
        volume=f"{max(volumes) * 1e6:.2f}" if volumes else NOT_MEASURED,
        note=note.removeprefix(f"{name}: ") if isinstance(note, str) else "",
    )


def _share(hits: np.ndarray) -> str:
    return f"{hits.mean() * 100:.1f} %" if len(hits) else NOT_MEASURED
