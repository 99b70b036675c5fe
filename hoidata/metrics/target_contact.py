"""Target contact maps: the contact that a generated motion was conditioned on, stored next to its folder of clips.

    <folder>/clips/                the store
    <folder>/asked.npz             binary maps: motion_id (motion,) text; asked (motion, point) bool
    <folder>/asked-distances.npz   distance maps of BimArt, all motions concatenated:
        motion_id (motion,) text
        first (motion + 1,)                        first row of each motion in distance_m
        distance_m (row, 2, point) float16         one row per frame
        place_first (motion,)                      first row of each motion in place_m
        place_m (place row, point, 3) float16      motions for the same object trajectory share these rows
        hand_vertices (n,) int32

A point of asked.npz is one of the contact stage's sampled points of the motion's object; true if an acting hand should
touch it. A point of asked-distances.npz is a position on the object that differs from frame to frame.
Families without target contact write no file. A motion without an entry has no adherence and no map error.
"""

from collections.abc import Mapping
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hoidata.errors import BadInput
from hoidata.files.arrays import read_npz, write_npz
from hoidata.hands.model import N_VERTICES

FILE_NAME = "asked.npz"
DISTANCES_NAME = "asked-distances.npz"
REMEDY = "sample the family again"


class TargetDistances(NamedTuple):
    """The target distance map of one motion, frame by frame."""

    place_m: np.ndarray  # (frame, point, 3) positions on the object in that frame's pose, object frame
    distance_m: np.ndarray  # (frame, 2, point) to the nearest vertex of the left and right hand; not finite: no target
    hand_vertices: np.ndarray  # (n,) int32, the vertices among 778 that the distances refer to


def write_target_contact(folder: str | Path, targets: Mapping[str, np.ndarray]) -> None:
    """Write ``folder/asked.npz`` from (point,) bool maps by motion id."""
    arrays = {"motion_id": np.array(list(targets)), "asked": np.stack(list(targets.values()))}
    write_npz(Path(folder) / FILE_NAME, arrays)


def read_target_contact(clips: str | Path) -> dict[str, np.ndarray]:
    """(point,) bool by motion id, from the file next to the folder ``clips``; empty without it. Raises BadInput."""
    path = Path(clips).parent / FILE_NAME
    if not path.is_file():
        return {}
    arrays = read_npz(path)
    names, maps = arrays.get("motion_id"), arrays.get("asked")
    if names is None or maps is None or maps.dtype != bool or maps.shape != (len(names), maps.shape[-1]):
        got = ", ".join(f"{name} {array.dtype} {array.shape}" for name, array in arrays.items())
        raise BadInput(path, "motion_id (motion,) and asked (motion, point) bool", got, REMEDY)
    return dict(zip(names.tolist(), maps, strict=True))


def write_target_distances(folder: str | Path, targets: Mapping[str, TargetDistances]) -> None:
    """Write ``folder/asked-distances.npz`` from target maps by motion id.

    float16 rounds positions by less than 0.15 mm within 0.5 m, distances by less than 0.1 mm below 20 cm.

    Args:
        targets: maps with the same number of points and the same hand vertices.
    """
    maps = list(targets.values())
    place_chunks: list[np.ndarray] = []
    row_of_digest: dict[bytes, int] = {}
    place_first: list[int] = []
    for target in maps:
        places = target.place_m.astype(np.float16)
        digest = sha256(places.tobytes()).digest()
        if digest not in row_of_digest:
            row_of_digest[digest] = sum(map(len, place_chunks))
            place_chunks.append(places)
        place_first.append(row_of_digest[digest])
    arrays = {
        "motion_id": np.array(list(targets)),
        "first": np.cumsum([0, *(len(target.distance_m) for target in maps)]),
        "distance_m": np.concatenate([target.distance_m for target in maps]).astype(np.float16),
        "place_first": np.array(place_first),
        "place_m": np.concatenate(place_chunks),
        "hand_vertices": maps[0].hand_vertices.astype(np.int32),
    }
    write_npz(Path(folder) / DISTANCES_NAME, arrays)


def read_target_distances(clips: str | Path) -> dict[str, TargetDistances]:
    """Target maps by motion id, from the file next to the folder ``clips``; empty without it. Raises BadInput."""
    path = Path(clips).parent / DISTANCES_NAME
    if not path.is_file():
        return {}
    arrays = read_npz(path)
    try:
        names, first, distance_m, starts, place_m, hand = (arrays[name] for name in _DISTANCE_ARRAYS)
        counts = np.diff(first)
        fits = distance_m.shape[1:] == (2, place_m.shape[1]) and place_m.shape[2:] == (3,) and len(names) == len(starts)
        fits = fits and first[0] == 0 and first[-1] == len(distance_m) and (counts >= 0).all()
        if not fits or starts.min(initial=0) < 0 or (starts + counts > len(place_m)).any():
            raise ValueError(f"{len(names)} motions, place_m {place_m.shape}, distance_m {distance_m.shape}")
        if not (hand.min(initial=0) >= 0 and hand.max(initial=0) < N_VERTICES):
            raise ValueError("numbers of hand vertices out of range")
        spans = [slice(*ends) for ends in pairwise(first.tolist())]
        return {
            str(name): TargetDistances(place_m[start : start + count], distance_m[span], hand)
            for name, start, count, span in zip(names, starts, counts, spans, strict=True)
        }
    except (KeyError, ValueError, IndexError) as error:
        expected = f"{', '.join(_DISTANCE_ARRAYS)} that fit each other"
        raise BadInput(path, expected, str(error), REMEDY) from error


_DISTANCE_ARRAYS = ("motion_id", "first", "distance_m", "place_first", "place_m", "hand_vertices")
