"""One hand of one clip against the exact surface of its object: all that the stage surface keeps of it."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from hoidata.clips.clip import Clip, Side
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import SampledPoints
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.surface.bimart_maps import bimart_map, packed_map
from hoidata.surface.contact import TOUCH_M, PlacedHand, deepest_m, placed_hand, touched_vertices
from hoidata.surface.solid_overlap import SolidOverlap
from hoidata.surface.store import SideSurface


class Stopwatch:
    """Processor time by operation, of all threads of this process."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.process_time()
        yield
        self.seconds[name] += time.process_time() - start


class ObjectShape:
    """What hands are held against, built once per object.

    solid: whether anything can be inside the object. overlap: None where nothing can, or where the object is too large
    for shared volumes. Raises BadInput for a mesh without a surface.
    """

    def __init__(self, model: ObjectModel, points: SampledPoints, index: SurfaceIndex | None = None) -> None:
        self.index = index or SurfaceIndex(model)
        self.points = points
        self.solid = self.index.is_solid
        self.overlap = _overlap(self.index) if self.solid else None


def _overlap(index: SurfaceIndex) -> SolidOverlap | None:
    try:
        return SolidOverlap(index)
    except BadInput:  # a lattice of millimetres over metres
        return None


def measure_hand(
    clip: Clip,
    side: Side,
    joints_m: np.ndarray,
    hands: HandPair,
    shape: ObjectShape,
    touch_m: float = TOUCH_M,
    stopwatch: Stopwatch | None = None,
) -> SideSurface:
    """One hand of a clip against the object's surface; frames in which it is not valid are not looked at.

    joints_m: (frame, 21, 3) in the clip's world, metres. hands: the model of the clip's hands. shape: of
    ``clip.object.model``.
    """
    watch, index = stopwatch or Stopwatch(), shape.index
    with watch("hands"):
        hand = placed_hand(clip, side, hands)
        joints = (clip.object.world_from_object.inverse() @ joints_m.astype(np.float64))[hand.frames]
    with watch("contact"):
        touched = touched_vertices(hand, index, touch_m)
    with watch("depth"):
        depth = deepest_m(hand, index) if shape.solid else np.full(clip.n_frames, np.nan)
    with watch("volume"):
        volume = _deepest_volume_m3(hand, depth, shape.overlap)
    with watch("joints"):
        joint = hand.over_clip(index.distance_m(joints, hand.hinge_rad).min(axis=1), np.inf)
    with watch("maps"):
        packed = packed_map(bimart_map(hand, shape.points, clip.object.model))
    return SideSurface(touched, depth, joint, packed, volume)


def _deepest_volume_m3(hand: PlacedHand, depth_m: np.ndarray, overlap: SolidOverlap | None) -> float:
    """Volume that hand and object share in the frame of the deepest vertex; NaN where it cannot be said."""
    of_hand = depth_m[hand.frames]
    if overlap is None or not len(of_hand):
        return np.nan
    row = [int(of_hand.argmax())]
    hinge = None if hand.hinge_rad is None else hand.hinge_rad[row]
    return float(overlap.volume_m3(hand.vertices_m[row], hand.faces, hinge)[0]) if of_hand[row[0]] > 0 else 0.0
