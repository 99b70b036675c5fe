"""What the makers of a dataset publish about its sequences: ``published.json`` of the dataset's folder."""

from dataclasses import dataclass
from functools import lru_cache

import orjson

from hoidata.dataset_folders import dataset_folder
from hoidata.errors import BadInput
from hoidata.settings import build_config


@dataclass(frozen=True)
class Published:
    """What ``published.json`` states; what it leaves out is not known.

    source: where the lists are from, or why there is none. sequences: all names. without_ground_truth: beginnings of
    withheld ones.

    motion_files: patterns of the raw files that hold motion; other raw files (meshes, templates) serve many sequences.
    segments, frames: per sequence, where the source tells.
    """

    source: str
    sequences: tuple[str, ...] = ()
    without_ground_truth: tuple[str, ...] = ()
    motion_files: tuple[str, ...] = ()
    segments: tuple[int, ...] = ()
    frames: tuple[int, ...] = ()

    @property
    def usable(self) -> tuple[str, ...]:
        """The sequences whose ground truth is published."""
        return tuple(name for name in self.sequences if not name.startswith(self.without_ground_truth))


@lru_cache
def published(dataset: str) -> Published:
    """What is known of a dataset; nothing (an empty ``source``) of one without a list."""
    folder = dataset_folder(dataset)
    path = None if folder is None else folder / "published.json"
    if path is None or not path.is_file():
        return Published("")
    try:
        values = orjson.loads(path.read_bytes())
    except orjson.JSONDecodeError as error:
        raise BadInput(path, "a JSON object", str(error), "correct it") from error
    found = build_config(Published, values, str(path))
    if empty := sorted(key for key, value in values.items() if value == []):
        remedy = "leave it out, and say in its source why there is none"
        raise BadInput(f"{path}: {empty[0]}", "a list of one entry or more", "an empty one", remedy)
    return found
