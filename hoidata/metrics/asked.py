"""The contact maps motions were asked for, kept beside a predicted store's folder of clips.

    <folder>/clips/      the store     <folder>/asked.npz    motion_id (motion,) text; asked (motion, point) bool
    <folder>/asked-distances.npz    maps of distances, as BimArt's: motion_id (motion,) text; first (motion + 1,) row at
        which each begins; distance_m (row, 2, point) float16; place_first (motion,) row at which its places begin;
        place_m (row of places, point, 3) float16; hand_vertices (n,) int32

In asked.npz a point is one of the contact stage's sampled points of the motion's object; true where some acting hand is
to touch it. In asked-distances.npz a row is a frame, a point a place of the object, another one in every frame; motions
for one path of an object share their places.
Families that ask for no contact write no file; a motion without a row has no adherence, and no error of its map.
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


class AskedDistances(NamedTuple):
    """The map of distances one motion was made for, frame by frame.

    place_m: (frame, point, 3) places of the object where it is in that frame, object frame. distance_m: (frame, 2,
    point) from each of them to the nearest vertex of the left and the right hand, metres, not finite where nothing was
    asked. hand_vertices: (n,) int32 of the 778 those the distances are to.
    """

    place_m: np.ndarray
    distance_m: np.ndarray
    hand_vertices: np.ndarray


def write_asked(folder: str | Path, asked: Mapping[str, np.ndarray]) -> None:
    """Write ``folder/asked.npz``. asked: (point,) bool by motion id."""
    write_npz(Path(folder) / FILE_NAME, {"motion_id": np.array(list(asked)), "asked": np.stack(list(asked.values()))})


def read_asked(clips: str | Path) -> dict[str, np.ndarray]:
    """(point,) bool by motion id, of the file beside the folder ``clips``; nothing without it. Raises BadInput."""
    path = Path(clips).parent / FILE_NAME
    if not path.is_file():
        return {}
    arrays = read_npz(path)
    names, asked = arrays.get("motion_id"), arrays.get("asked")
    if names is None or asked is None or asked.dtype != bool or asked.shape != (len(names), asked.shape[-1]):
        got = ", ".join(f"{name} {array.dtype} {array.shape}" for name, array in arrays.items())
        raise BadInput(path, "motion_id (motion,) and asked (motion, point) bool", got, REMEDY)
    return dict(zip(names.tolist(), asked, strict=True))


def write_asked_distances(folder: str | Path, asked: Mapping[str, AskedDistances]) -> None:
    """Write ``folder/asked-distances.npz``. asked: by motion id, all of as many points and of the same hand vertices.

    Kept as float16: places off by less than 0.15 mm within 0.5 m, distances by less than 0.1 mm below 20 cm.
    """
    maps, pieces, starts, rows = list(asked.values()), list[np.ndarray](), dict[bytes, int](), list[int]()
    for own in maps:
        places = own.place_m.astype(np.float16)
        key = sha256(places.tobytes()).digest()
        if key not in starts:
            starts[key] = sum(map(len, pieces))
            pieces.append(places)
        rows.append(starts[key])
    arrays = {
        "motion_id": np.array(list(asked)),
        "first": np.cumsum([0, *(len(own.distance_m) for own in maps)]),
        "distance_m": np.concatenate([own.distance_m for own in maps]).astype(np.float16),
        "place_first": np.array(rows),
        "place_m": np.concatenate(pieces),
        "hand_vertices": maps[0].hand_vertices.astype(np.int32),
    }
    write_npz(Path(folder) / DISTANCES_NAME, arrays)


def read_asked_distances(clips: str | Path) -> dict[str, AskedDistances]:
    """By motion id, of the file beside the folder ``clips``; nothing without it. Raises BadInput."""
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
            raise ValueError("numbers of hand vertices that are not there")
        spans = [slice(*ends) for ends in pairwise(first.tolist())]
        return {
            str(name): AskedDistances(place_m[start : start + count], distance_m[span], hand)
            for name, start, count, span in zip(names, starts, counts, spans, strict=True)
        }
    except (KeyError, ValueError, IndexError) as error:
        expected = f"{', '.join(_DISTANCE_ARRAYS)} that fit each other"
        raise BadInput(path, expected, str(error), REMEDY) from error


_DISTANCE_ARRAYS = ("motion_id", "first", "distance_m", "place_first", "place_m", "hand_vertices")
