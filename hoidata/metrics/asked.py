"""The contact maps motions were asked for, kept beside a predicted store's folder of clips.

    <folder>/clips/      the store     <folder>/asked.npz    motion_id (motion,) text; asked (motion, point) bool

A point is one of the contact stage's sampled points of the motion's object; true where some acting hand is to touch it.
Families that ask for no contact write no file; a motion without a row has no adherence.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hoidata.errors import BadInput
from hoidata.files.arrays import read_npz, write_npz

FILE_NAME = "asked.npz"


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
        raise BadInput(path, "motion_id (motion,) and asked (motion, point) bool", got, "sample the family again")
    return dict(zip(names.tolist(), asked, strict=True))
