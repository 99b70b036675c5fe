"""Whether a long motion shows where its windows meet: vertex acceleration and changes of contact there and elsewhere.

The control makes every window apart, refines it alone and puts them side by side, as the release would.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack
from hoidata.hands import HandPair, track_vertices
from hoidata.metrics.bimart import border_ratios
from hoidata.objects.surface_index import surface_index
from models.bimart.family import HandsForPaths
from models.bimart.hands import LEAST_FRAMES, TOUCH_M, MotionWish, hands_for
from models.bimart.windows import layout_of


def borders_of(frames: int, window: int) -> list[int]:
    """First frames of windows that lie side by side, but the first."""
    starts = layout_of(frames, window, overlapping=False).starts[1:]
    return [start for start in starts if frames - start >= LEAST_FRAMES]


def overlapping_borders_of(frames: int, window: int) -> list[int]:
    """Frames in which a window begins or ends, where each lies half on the next, as motions are made."""
    layout = layout_of(frames, window, overlapping=True)
    edges = {edge for start in layout.starts for edge in (start, start + layout.length)}
    return sorted(edges - {0, frames})


def made_apart(sampler: HandsForPaths, thing: ObjectTrack, wish: MotionWish, window: int) -> Clip:
    """The control: each window a motion of its own, from a seed of its own."""
    edges = [0, *borders_of(thing.n_frames, window), thing.n_frames]
    clips = [
        hands_for(sampler, thing.take(slice(start, stop)), replace(wish, seed=wish.seed + number))[0].clip
        for number, (start, stop) in enumerate(pairwise(edges))
    ]
    hands = {side: _joined([clip.hands[side] for clip in clips]) for side in SIDES}
    return replace(clips[0], hands=hands, object=thing, source_frames=np.arange(thing.n_frames, dtype=np.int32))


def border_figures(clips: Sequence[Clip], pair: HandPair, borders: Sequence[int]) -> tuple[float, float]:
    """Motions of one length: at borders over elsewhere, the 95th percentile of the length of vertices' second
    differences, and the rate at which vertices begin or end to be within 5 mm of the surface.
    """
    seconds, changes = [], []
    for clip in clips:
        for side in SIDES:
            if clip.hands[side].valid.any():
                skin = track_vertices(clip.hands[side], pair[side]).astype(np.float64)
                second = np.linalg.norm(np.diff(skin, 2, axis=0), axis=-1)
                seconds.append(np.pad(second, ((1, 1), (0, 0)), mode="edge"))
                changes.append(_changes(clip.object, skin))
    changed = np.concatenate(changes, axis=1).mean(axis=1)
    at = np.isin(np.arange(len(changed)), borders)
    rate = changed[at].mean() / changed[~at].mean() if changed[~at].any() else np.nan
    return border_ratios(np.concatenate(seconds, axis=1), borders), float(rate)


def _changes(thing: ObjectTrack, skin_m: np.ndarray) -> np.ndarray:
    """(frame, vertex) bool: contact differs from that in the frame before."""
    seen = thing.world_from_object.inverse() @ skin_m
    near = surface_index(thing.model).within(seen, thing.hinge_rad, TOUCH_M)
    return np.concatenate((np.zeros_like(near[:1]), near[1:] != near[:-1]))


def _joined(tracks: Sequence[HandTrack]) -> HandTrack:
    arrays = {name: np.concatenate([getattr(track, name) for track in tracks]) for name in HandTrack.PER_FRAME}
    return replace(tracks[0], **arrays)
