"""Stage surface: every clip's hands against the exact surface of its object, and BimArt's maps.

The folder it writes is described in ``hoidata.contact.surface_store``.
"""

import multiprocessing
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress

from hoidata.contact.bimart_maps import bimart_map, packed_map
from hoidata.contact.proximity import joints_in_object
from hoidata.contact.solid_overlap import SolidOverlap
from hoidata.contact.surface_contact import TOUCH_M, PlacedHand, penetration, placed_hand, touched_vertices
from hoidata.contact.surface_store import ClipSurface, SideSurface, SurfaceWriter
from hoidata.errors import BadInput
from hoidata.files import atomic_folder
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import POINT_COUNT, SampledPoints, sample_points
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.schema.clip import SIDES, Clip, Side
from hoidata.schema.store import Store, open_store

# Below this a second process costs more to start than it saves.
FRAMES_PER_JOB = 20_000


class SurfaceReport(NamedTuple):
    """counts: of clips, frames, objects; seconds: processor time of each operation, over all processes."""

    counts: dict[str, int]
    seconds: dict[str, float]

    @property
    def cost(self) -> str:
        """Processor time per 1,000 frames, in words."""
        thousands = max(self.counts["frames"], 1) / 1000
        parts = ", ".join(f"{name} {seconds / thousands:.3f}" for name, seconds in self.seconds.items())
        return f"{sum(self.seconds.values()) / thousands:.3f} s per 1,000 frames of two hands ({parts})"


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
    with atomic_folder(out_folder) as part, Progress(console=Console(stderr=True), disable=not progress) as bar:
        writer = SurfaceWriter(part, points, touch_m)
        for clip, spent in bar.track(_in_order(bench, jobs), len(store), description="surface"):
            writer.add(clip)
            for name, value in spent.items():
                seconds[name] += value
        counts = writer.finish(_object_row(SurfaceIndex(store.object_model(name))) for name in store.objects["object"])
    return SurfaceReport(counts, dict(seconds))


def measure_hand(
    clip: Clip,
    side: Side,
    joints_m: np.ndarray,
    hands: HandPair,
    shape: "ObjectShape",
    touch_m: float = TOUCH_M,
    stopwatch: "Stopwatch | None" = None,
) -> SideSurface:
    """One hand of a clip against the object's surface; frames in which it is not valid are not looked at.

    joints_m: (frame, 21, 3) in the clip's world, metres. hands: the model of the clip's hands. shape: of
    ``clip.object.model``.
    """
    watch, index = stopwatch or Stopwatch(), shape.index
    with watch("hands"):
        hand = placed_hand(clip, side, hands)
        joints = joints_in_object(joints_m, clip.object)[hand.frames]
    with watch("contact"):
        touched = touched_vertices(hand, index, touch_m)
    with watch("depth"):
        depth = penetration(hand, index).deepest_m if shape.overlap else np.full(clip.n_frames, np.nan)
    with watch("volume"):
        volume = _deepest_volume_m3(hand, depth, shape.overlap)
    with watch("joints"):
        joint = hand.over_clip(index.distance_m(joints, hand.hinge_rad).min(axis=1), np.inf)
    with watch("maps"):
        packed = packed_map(bimart_map(hand, shape.points, clip.object.model.hinge))
    return SideSurface(touched, depth, joint, packed, volume)


def _deepest_volume_m3(hand: PlacedHand, depth_m: np.ndarray, overlap: SolidOverlap | None) -> float:
    """Volume that hand and object share in the frame of the deepest vertex; NaN without the hand or an inside."""
    of_hand = depth_m[hand.frames]
    if overlap is None or not len(of_hand):
        return np.nan
    row = [int(of_hand.argmax())]
    hinge = None if hand.hinge_rad is None else hand.hinge_rad[row]
    return float(overlap.volume_m3(hand.vertices_m[row], hand.faces, hinge)[0]) if of_hand[row[0]] > 0 else 0.0


class ObjectShape:
    """What hands are held against, built once per object. overlap: None where nothing can be inside the object."""

    def __init__(self, model: ObjectModel, points: SampledPoints, index: SurfaceIndex | None = None) -> None:
        self.index = index or SurfaceIndex(model)
        self.points = points
        self.overlap = SolidOverlap(self.index) if encloses_solid(self.index) else None


def encloses_solid(index: SurfaceIndex) -> bool:
    """Whether anything can be inside the object."""
    try:
        index.check_solid()
    except BadInput:
        return False
    return True


def _object_row(index: SurfaceIndex) -> dict[str, Any]:
    return {"object": index.model.name, "solid": encloses_solid(index), "note": index.solid_note}


class Stopwatch:
    """Processor time by operation, of all threads of this process."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.process_time()
        yield
        self.seconds[name] += time.process_time() - start


@dataclass
class _Bench:
    """What a process needs to measure clips. Shapes are built once in each process that meets them."""

    store: Store
    touch_m: float
    points: int
    left_out: Mapping[str, str]
    shapes: dict[str, ObjectShape] = field(default_factory=dict)

    def measure(self, clip_id: str) -> tuple[ClipSurface, dict[str, float]]:
        watch, clip = Stopwatch(), self.store.clip(clip_id)
        name = clip.object.model.name
        if clip_id in self.left_out:
            return ClipSurface(clip_id, name, clip.n_frames, self.left_out[clip_id], {}), watch.seconds
        with watch("objects"):
            shape = self._shape(clip.object.model)
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


def _in_order(bench: _Bench, jobs: int) -> Iterator[tuple[ClipSurface, dict[str, float]]]:
    if jobs <= 1:
        yield from map(bench.measure, bench.store.ids)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(bench,)) as pool:
        yield from pool.map(_work, bench.store.ids, chunksize=4)


_bench_here: _Bench | None = None


def _start_worker(bench: _Bench) -> None:
    """Give a worker its store once, and one thread: the pool already uses the cores."""
    import torch

    torch.set_num_threads(1)
    global _bench_here
    _bench_here = bench


def _work(clip_id: str) -> tuple[ClipSurface, dict[str, float]]:
    assert _bench_here is not None
    return _bench_here.measure(clip_id)
