"""WebDataset shards: tar files with ``<number>.npz`` and ``<number>.json`` of each clip.

The NPZ has the arrays of ``COLUMNS`` and ``CLIP_COLUMNS``, the JSON the facts.
"""

import io
import tarfile
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

import orjson

from hoidata.files.arrays import write_npz_to
from pipelines.exports.motion import ExportedClip

CLIPS_PER_SHARD = 500


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write <subset>-<number>.tar, ``all-`` for clips in no subset; clips of one subset follow each other."""
    for subset, group in groupby(clips, key=lambda item: item.subset):
        for shard, numbered in groupby(enumerate(group), key=lambda pair: pair[0] // CLIPS_PER_SHARD):
            with tarfile.open(folder / f"{subset or 'all'}-{shard:06d}.tar", "w", format=tarfile.USTAR_FORMAT) as tar:
                for number, item in numbered:
                    _add(tar, f"{number:08d}", item)


def _add(tar: tarfile.TarFile, key: str, item: ExportedClip) -> None:
    arrays = io.BytesIO()
    write_npz_to(arrays, item.arrays() | item.clip_arrays())
    for suffix, content in (("npz", arrays.getvalue()), ("json", orjson.dumps(item.facts))):
        member = tarfile.TarInfo(f"{key}.{suffix}")  # dated 1970: equal clips, equal bytes
        member.size = len(content)
        tar.addfile(member, io.BytesIO(content))
