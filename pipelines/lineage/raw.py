"""The raw files and source frames behind a checkpoint or store, with digests and licence; read without torch."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files.written import REMEDY, check_written, read_json

TABLE = "meta/sequences.parquet"


@dataclass(frozen=True)
class RawClip:
    """One clip: which frames of which raw files. frames: first and last number in the source, both included."""

    clip_id: str
    subject: str
    objects: tuple[str, ...]
    frames: tuple[int, int]
    files: tuple[str, ...]


@dataclass(frozen=True)
class RawSource:
    """What of one store was seen. digests: SHA-256 of each raw file by its path below the raw root."""

    store: str
    licence: str
    may_be_shared: bool
    where_to_register: str
    synthetic: bool
    digests: dict[str, str]
    clips: tuple[RawClip, ...]

    def as_json(self) -> dict[str, Any]:
        """A row per clip; files are numbers of ``files``, as the same few stand behind many clips."""
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
    """What ``RawSource.as_json`` gave."""
    files = [path for path, _ in values["files"]]
    clips = (
        RawClip(clip_id, subject, tuple(objects), (first, last), tuple(files[index] for index in numbers))
        for clip_id, subject, objects, first, last, numbers in values["clips"]
    )
    facts = (values[name] for name in _FACTS)
    return RawSource(store, *facts, digests=dict(values["files"]), clips=tuple(clips))


def read_raw(root: Path, store: str, wanted: set[str] | None = None) -> RawSource | None:
    """What lies behind some clips (all when None) of a store; None where the folder holds no clips."""
    folder = root / store
    if not (folder / TABLE).is_file():
        return None
    info = read_json(folder / "meta/info.json")
    files = _rows(folder / "meta/files.parquet", ["path", "sha256"])
    frames = ["first_source_frame", "last_source_frame"]
    columns = ["clip_id", "subject", "object", "other_objects", *frames, "source_files"]
    rows = _rows(folder / TABLE, columns)
    clips = [_clip(row, files) for row in rows if wanted is None or row["clip_id"] in wanted]
    used = {path for clip in clips for path in clip.files}
    digests = {file["path"]: file["sha256"] for file in files if file["path"] in used}
    facts = (info.get(name, default) for name, default in zip(_FACTS, ("", False, "", False), strict=True))
    return RawSource(store, *facts, digests=digests, clips=tuple(clips)) if clips else None


def _rows(path: Path, columns: list[str]) -> list[dict[str, Any]]:
    """Rows of a table, without pandas, whose import takes longer than all the rest."""
    import pyarrow.parquet as parquet

    try:
        check_written(path)
        return parquet.read_table(path, columns=columns).to_pylist()
    except (OSError, ValueError, KeyError) as error:
        raise BadInput(path, "a table of the store", str(error)[:300], REMEDY) from error


def _clip(row: dict[str, Any], files: list[dict[str, Any]]) -> RawClip:
    frames = (row["first_source_frame"], row["last_source_frame"])
    paths = tuple(files[index]["path"] for index in row["source_files"])
    return RawClip(row["clip_id"], row["subject"], (row["object"], *row["other_objects"]), frames, paths)


def raw_sources(root: Path | None, record: dict[str, Any]) -> list[RawSource]:
    """The raw files behind a record: as the checkpoint's header has them, else as the stores here do."""
    if "raw" in record:
        return [raw_from_json(store, values) for store, values in record["raw"].items()]
    if root is None:
        return []
    wanted = clips_of(record) if "clips" in record else None
    sources = (read_raw(root, path, wanted) for path in stores_behind(record))
    return [source for source in sources if source is not None]


def clips_of(record: dict[str, Any]) -> set[str]:
    """The clips a checkpoint learned from or was chosen by."""
    return {clip for ids in record.get("clips", {}).values() for clip in ids}


def stores_behind(record: dict[str, Any]) -> list[str]:
    """The inputs and outputs of all stages of a record that may be stores of recorded clips."""
    paths = (
        path
        for stage in record.get("stages", {}).values()
        for key in ("inputs", "outputs")
        for path in stage.get(key, ())
    )
    return sorted({path for path in paths if path.startswith("data/")})


@dataclass(frozen=True)
class RawList:
    """The file-level manifest of raw files, of which only this is asked here. files: path, bytes, SHA-256."""

    dataset: str
    synthetic: bool
    licence: str
    where_to_register: str
    files: tuple[tuple[str, int, str], ...]


def raw_list(root: Path, path: str) -> RawList | None:
    """The manifest at ``data/<profile>/<dataset>/raw.json``; None for other paths, or where it is not readable."""
    if not path.endswith("/raw.json"):
        return None
    try:
        values = json.loads((root / path).read_bytes())
        files = tuple((entry["path"], entry["size"], entry["sha256"]) for entry in values["files"])
        facts = (values["source"] == "generated", values["licence"], values["where_to_register"])
        return RawList(values["dataset"], *facts, files=files)
    except (OSError, ValueError, KeyError, TypeError):
        return None
