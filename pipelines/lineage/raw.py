"""The raw files and source frames of a checkpoint or store, with digests and licence. Does not import torch."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files.written import REMEDY, check_written, read_json

SEQUENCES = "meta/sequences.parquet"
COLUMNS = ["clip_id", "subject", "object", "other_objects", "first_source_frame", "last_source_frame", "source_files"]


@dataclass(frozen=True)
class RawClip:
    """The raw files and frames of one clip."""

    clip_id: str
    subject: str
    objects: tuple[str, ...]
    frames: tuple[int, int]  # first and last frame in the source, inclusive
    files: tuple[str, ...]


@dataclass(frozen=True)
class RawSource:
    """The raw files and clips of one store that a record uses."""

    store: str
    licence: str
    may_be_shared: bool
    where_to_register: str
    synthetic: bool
    digests: dict[str, str]  # SHA-256 of each raw file by its path relative to the raw folder
    clips: tuple[RawClip, ...]

    def as_json(self) -> dict[str, Any]:
        """A list per clip, in which files are indices into ``files``: many clips share the same files."""
        files = list(self.digests)
        number = {path: index for index, path in enumerate(files)}
        rows = [
            [clip.clip_id, clip.subject, list(clip.objects), *clip.frames, [number[path] for path in clip.files]]
            for clip in self.clips
        ]
        facts = {name: getattr(self, name) for name in _FACTS}
        return {**facts, "files": [[path, self.digests[path]] for path in files], "clips": rows}


_FACTS = ("licence", "may_be_shared", "where_to_register", "synthetic")


def raw_from_json(store: str, values: dict[str, Any]) -> RawSource:
    """The inverse of ``RawSource.as_json``."""
    files = [path for path, _ in values["files"]]
    clips = (
        RawClip(clip_id, subject, tuple(objects), frames=(first, last), files=tuple(files[index] for index in numbers))
        for clip_id, subject, objects, first, last, numbers in values["clips"]
    )
    facts = (values[name] for name in _FACTS)
    return RawSource(store, *facts, digests=dict(values["files"]), clips=tuple(clips))


def read_raw(root: Path, store: str, clip_ids: set[str] | None = None) -> RawSource | None:
    """The raw files of some clips (None: all clips) of a store; None if the folder is not a store."""
    folder = root / store
    if not (folder / SEQUENCES).is_file():
        return None
    info = read_json(folder / "meta/info.json")
    files = _rows(folder / "meta/files.parquet", ["path", "sha256"])
    rows = _rows(folder / SEQUENCES, COLUMNS)
    clips = [_clip(values, files) for values in rows if clip_ids is None or values["clip_id"] in clip_ids]
    used = {path for clip in clips for path in clip.files}
    digests = {file["path"]: file["sha256"] for file in files if file["path"] in used}
    facts = (info.get(name, default) for name, default in zip(_FACTS, ("", False, "", False), strict=True))
    return RawSource(store, *facts, digests=digests, clips=tuple(clips)) if clips else None


def _rows(path: Path, columns: list[str]) -> list[dict[str, Any]]:
    """Rows of a table, read without pandas, whose import takes longer than the rest of the command."""
    import pyarrow.parquet as parquet

    try:
        check_written(path)
        return parquet.read_table(path, columns=columns).to_pylist()
    except (OSError, ValueError, KeyError) as error:
        raise BadInput(path, "a table of the store", str(error)[:300], REMEDY) from error


def _clip(values: dict[str, Any], files: list[dict[str, Any]]) -> RawClip:
    clip_id, subject, main_object, other_objects, first, last, numbers = (values[name] for name in COLUMNS)
    paths = tuple(files[index]["path"] for index in numbers)
    return RawClip(clip_id, subject, (main_object, *other_objects), frames=(first, last), files=paths)


def raw_sources(root: Path | None, record: dict[str, Any]) -> list[RawSource]:
    """The raw files of a record: from the checkpoint's header, else from the stores of this project."""
    if "raw" in record:
        return [raw_from_json(store, values) for store, values in record["raw"].items()]
    if root is None:
        return []
    clip_ids = clips_of(record) if "clips" in record else None
    sources = (read_raw(root, path, clip_ids) for path in upstream_stores(record))
    return [source for source in sources if source is not None]


def clips_of(record: dict[str, Any]) -> set[str]:
    """The training and validation clips of a checkpoint."""
    return {clip for ids in record.get("clips", {}).values() for clip in ids}


def upstream_stores(record: dict[str, Any]) -> list[str]:
    """The inputs and outputs below ``data/`` of all stages of a record; the stores of recorded clips are among them."""
    stages = record.get("stages", {}).values()
    paths = {path for stage in stages for key in ("inputs", "outputs") for path in stage.get(key, ())}
    return sorted(path for path in paths if path.startswith("data/"))


@dataclass(frozen=True)
class RawList:
    """The fields of a file-level manifest that this package reads without importing adapters."""

    dataset: str
    synthetic: bool
    licence: str
    where_to_register: str
    files: tuple[tuple[str, int, str], ...]  # path, bytes, SHA-256


def raw_list(root: Path, path: str) -> RawList | None:
    """The manifest at ``data/<profile>/<dataset>/raw.json``; None for other paths and unreadable files."""
    if not path.endswith("/raw.json"):
        return None
    try:
        values = json.loads((root / path).read_bytes())
        files = tuple((entry["path"], entry["size"], entry["sha256"]) for entry in values["files"])
        facts = (values["source"] == "generated", values["licence"], values["where_to_register"])
        return RawList(values["dataset"], *facts, files=files)
    except (OSError, ValueError, KeyError, TypeError):
        return None
