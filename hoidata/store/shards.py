"""Arrays of a store on their way to disk: rows are added clip by clip, a full shard is written and forgotten."""

from pathlib import Path

import numpy as np

from hoidata.files.arrays import write_npz
from hoidata.store.fields import BODY, FRAMES, SOURCE_CONTACT, StoreFile, empty_array

FRAMES_PER_SHARD = 65536
CONTACTS_PER_SHARD = 1 << 23  # 9 bytes each: GRAB's labels can be ten times the motion


class ShardWriter:
    """Collects the rows of one shard of ``frames-*``, ``body-*`` and ``source_contact-*`` files.

    At most one shard is in memory; a clip lies in one shard.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.number = 0
        self._start()

    def _start(self) -> None:
        self.pieces = {file.path: {f.name: [empty_array(f)] for f in file.fields} for file in _SHARDED}
        self.lengths = {file.path: {field.name: 0 for field in file.fields} for file in _SHARDED}

    def append(self, file: StoreFile, name: str, array: np.ndarray) -> int:
        """Add rows to one member, in its dtype; the row they start at."""
        pieces, lengths = self.pieces[file.path], self.lengths[file.path]
        pieces[name].append(np.array(array, pieces[name][0].dtype))
        lengths[name] += len(array)
        return lengths[name] - len(array)

    def append_all(self, file: StoreFile, arrays: dict[str, np.ndarray]) -> int:
        """Add rows to several members that grow together; the row they start at."""
        (first,) = {self.append(file, name, array) for name, array in arrays.items()}
        return first

    def rows(self, file: StoreFile, name: str) -> int:
        return self.lengths[file.path][name]

    def end_clip(self) -> None:
        """Write the shard if it is full."""
        full = self.rows(FRAMES, "source_frames") >= FRAMES_PER_SHARD
        if full or self.rows(SOURCE_CONTACT, "frame") >= CONTACTS_PER_SHARD:
            self._flush()

    def finish(self) -> None:
        """Write what is left; a store has at least one shard."""
        if self.number == 0 or self.rows(FRAMES, "source_frames"):
            self._flush()

    def _flush(self) -> None:
        for file in _SHARDED:
            pieces = self.pieces.pop(file.path)
            if file is FRAMES or any(self.lengths[file.path].values()):
                arrays = {name: np.concatenate(pieces.pop(name)) for name in list(pieces)}
                write_npz(self.folder / file.path.replace("*", f"{self.number:05d}"), arrays)
        self.number += 1
        self._start()


_SHARDED = (FRAMES, BODY, SOURCE_CONTACT)
