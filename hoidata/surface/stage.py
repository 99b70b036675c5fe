"""Stage surface: every clip's hands against the exact surface of its object, and BimArt's maps.

The folder it writes is described in ``hoidata.surface.store``.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress

from hoidata.clips.clip import SIDES, Side
from hoidata.errors import BadInput
from hoidata.files import atomic_folder
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import POINT_COUNT, sample_points
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.store.store import Store, open_store
from hoidata.surface.contact import TOUCH_M
from hoidata.surface.measure import ObjectShape, Stopwatch, measure_hand
from hoidata.surface.store import ClipSurface, SideSurface, SurfaceWriter
from hoidata.workers import in_workers

# Below this a second process costs more to start than it saves.
FRAMES_PER_JOB = 20_000


@dataclass(frozen=True)
class SurfaceSettings:
    """enabled: only the pages read what it measures. touch_m: a hand vertex closer to the surface touches it."""

    enabled: bool = True
    touch_m: float = TOUCH_M


class SurfaceReport(NamedTuple):
    """counts: of clips, frames, objects; seconds: processor time of each operation, over all processes."""

    counts: dict[str, int]
    seconds: dict[str, float]

    @property
    def cost(self) -> str:
        """Processor time per 1,000 frames, in words."""
        thousands = max(self.counts["frames"], 1) / 1000
        operations = ", ".join(f"{name} {seconds / thousands:.3f}" for name, seconds in self.seconds.items())
        return f"{sum(self.seconds.values()) / thousands:.3f} s per 1,000 frames of two hands ({operations})"


def surface_store(
    clips_folder: str | Path,
    out_folder: str | Path,
    *,
    touch_m: float = TOUCH_M,
    points: int = POINT_COUNT,
    hands: HandPair | None = None,
    left_out: Mapping[str, str] | None = None,
    jobs: int = 1,
    progress: bool = True,
) -> SurfaceReport:
    """Measure every clip of the store; the folder appears whole or not at all.

    touch_m: a hand vertex nearer to the surface touches. points: per object, of BimArt's maps. hands: as in
    ``open_store``. left_out: reasons by clip id; these clips are listed, not measured. jobs: worker processes at most;
    order and bytes of the result do not depend on it. progress: a bar on stderr.
    Raises BadInput for a threshold that is not positive and finite, or less than one point.
    """
    if not 0 < touch_m < np.inf:
        raise BadInput("surface.touch_m", "a distance in metres, above 0", f"{touch_m}", "the paper's labels use 0.005")
    if points < 1:
        raise BadInput("surface.points", "at least 1 point", f"{points}", "the stage contact samples 1024")
    store = open_store(clips_folder, hands)
    store.hand_pair()
    bench = _Bench(store, touch_m, points, left_out or {})
    seconds: defaultdict[str, float] = defaultdict(float)
    jobs = min(jobs, 1 + sum(store.sequences["n_frames"].tolist()) // FRAMES_PER_JOB)
    with atomic_folder(out_folder) as partial, Progress(console=Console(stderr=True), disable=not progress) as bar:
        writer = SurfaceWriter(partial, points, touch_m)
        for clip, spent in _in_order(
            bar.track(in_workers(bench.measure, store.ids, jobs), len(store), description="surface"), store.ids
        ):
            writer.add(clip)
            for name, value in spent.items():
                seconds[name] += value
        counts = writer.finish(_object_row(store.object_model(name)) for name in store.objects["object"])
    return SurfaceReport(counts, dict(seconds))


def _object_row(model: ObjectModel) -> dict[str, Any]:
    try:
        index = SurfaceIndex(model)
    except BadInput as error:  # its clips are left out with the same words
        return {"object": model.name, "solid": False, "note": str(error)}
    return {"object": model.name, "solid": index.is_solid, "note": index.solid_note}


_Result = tuple[ClipSurface, dict[str, float]]


@dataclass
class _Bench:
    """What a process needs to measure clips. Shapes are built once in each process that meets them."""

    store: Store
    touch_m: float
    points: int
    left_out: Mapping[str, str]
    shapes: dict[str, ObjectShape] = field(default_factory=dict)

    def measure(self, clip_id: str) -> _Result:
        watch, clip = Stopwatch(), self.store.clip(clip_id, motion_only=True)
        name = clip.object.model.name
        if clip_id in self.left_out:
            return ClipSurface(clip_id, name, clip.n_frames, self.left_out[clip_id], {}), watch.seconds
        try:
            with watch("objects"):
                shape = self._shape(clip.object.model)
        except BadInput as error:
            return ClipSurface(clip_id, name, clip.n_frames, str(error), {}), watch.seconds
        sides: dict[Side, SideSurface] = {}
        for side in SIDES:
            with watch("hands"):
                joints = self.store.joints(clip_id, side)
            sides[side] = measure_hand(clip, side, joints, self.store.hand_pair(), shape, self.touch_m, watch)
        return ClipSurface(clip_id, name, clip.n_frames, None, sides), watch.seconds

    def _shape(self, model: ObjectModel) -> ObjectShape:
        if model.name not in self.shapes:
            self.shapes[model.name] = ObjectShape(model, sample_points(model, self.points))
        return self.shapes[model.name]


def _in_order(found: Iterable[tuple[str, _Result]], clip_ids: Sequence[str]) -> Iterator[_Result]:
    """Results in the order of the clips, each as soon as all before it are there."""
    early: dict[str, _Result] = {}
    waiting = iter(clip_ids)
    wanted = next(waiting, None)
    for clip_id, result in found:
        early[clip_id] = result
        while wanted in early:
            yield early.pop(wanted)
            wanted = next(waiting, None)
