"""What the makers of a dataset publish about its sequences: ``published.json`` of the dataset's folder."""

from dataclasses import dataclass
from functools import lru_cache

import orjson

from hoidata.dataset_folders import dataset_folder
from hoidata.errors import BadInput
from hoidata.settings import build_config


@dataclass(frozen=True)
class Published:
    """sequences: all names, empty where no list is published. without_ground_truth: beginnings of withheld ones.

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
    return build_config(Published, values, str(path))
