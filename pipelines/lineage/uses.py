"""What saw a raw file, a subject or an object: what must go when data is withdrawn."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from pipelines.lineage.locks import Locked, read_locks
from pipelines.lineage.provenance import read_provenance
from pipelines.lineage.raw import RawClip, RawSource, clips_of, raw_sources, read_raw
from pipelines.lineage.targets import WEIGHTS
from pipelines.stages.base import empty_reason

_STORE = "clips"


@dataclass(frozen=True)
class Use:
    """One output that saw the data. why: in words."""

    kind: str
    name: str
    why: str


def uses(root: Path, words: str) -> list[Use]:
    """Every store, table, checkpoint, sample and metric that saw ``words``. Raises BadInput for what nothing saw.

    words: the path of a raw file, or its end; a subject; an object; a clip. A checkpoint saw what is in its training
    and validation clips, or in those of one it builds on. Samples saw what their checkpoints did and the clips they
    were asked for (of a family without networks also the training clips); metrics what was measured, and against it.
    """
    locks = read_locks(root)
    stores = {path: read_raw(root, path) for path in _stores(root, locks)}
    clips = {path: _matching(source, words) for path, source in stores.items() if source is not None}
    clips = {path: found for path, found in clips.items() if found}
    seen: dict[str, set[str]] = {path: found for path, found in clips.items()}
    found = [Use("store", path, _count(ids)) for path, ids in clips.items()]
    for folder in sorted(
        {
            path.parent
            for path in (*root.glob("checkpoints/**/model.safetensors"), *root.glob("evaluators/**/model.safetensors"))
        }
    ):
        name = folder.relative_to(root).as_posix()
        if ids := _seen_by_checkpoint(root, folder / "model.safetensors", words):
            seen[name] = ids
            found.append(Use("checkpoint", name, _count(ids)))
    for stage in _in_order(locks):
        found += _derived(root, stage, clips, seen)
    if not found:
        raise BadInput(
            words, "a raw file, subject, object or clip that something here was made from", "none", "correct it"
        )
    return found


def _stores(root: Path, locks: dict[str, Locked]) -> list[str]:
    outs = {
        path for lock in locks.values() for path in lock.outs if Path(path).name == _STORE and path.startswith("data/")
    }
    written = (
        path.parent.parent.relative_to(root).as_posix() for path in root.glob("data/*/*/clips/meta/sequences.parquet")
    )
    return sorted({*outs, *written})


def _matching(source: RawSource, words: str) -> set[str]:
    """The clips of a store that are meant."""
    return {clip.clip_id for clip in source.clips if is_meant(clip, words)}


def is_meant(clip: RawClip, words: str) -> bool:
    """Whether a clip is, was recorded by, shows, or was read from ``words``."""
    names = (clip.clip_id, clip.subject, *clip.objects)
    return words in names or any(
        path == words or words.endswith(f"/{path}") or path.endswith(f"/{words}") for path in clip.files
    )


def _seen_by_checkpoint(root: Path, path: Path, words: str) -> set[str]:
    """The clips of ``words`` in what a checkpoint, or one it builds on, learned from or was chosen by."""
    try:
        record = read_provenance(path)
    except BadInput:
        return set()
    learned = clips_of(record)
    ids = {clip for source in raw_sources(root, record) for clip in _matching(source, words) if clip in learned}
    for name in record.get("stages", {}).get(record.get("stage"), {}).get("inputs", ()):
        if (below := root / name / WEIGHTS).is_file() and below != path:
            ids |= _seen_by_checkpoint(root, below, words)
    return ids


def _in_order(locks: dict[str, Locked]) -> Iterator[Locked]:
    """Samples, then what is measured of them."""
    yield from (lock for lock in locks.values() if any(path.startswith("samples/") for path in lock.outs))
    yield from (lock for lock in locks.values() if not any(path.startswith("samples/") for path in lock.outs))


def _derived(root: Path, lock: Locked, clips: dict[str, set[str]], seen: dict[str, set[str]]) -> list[Use]:
    """What one stage made that saw the clips, noted in ``seen`` for the stages after it."""
    outs = {path: kind for path in lock.outs if (kind := _KINDS.get(path.partition("/")[0])) and path not in seen}
    if not outs:
        return []
    recorded = set().union(*(clips.get(path, ()) for path in lock.deps)) if lock.deps else set()
    below = {clip for path in lock.deps for clip in _seen_at(seen, path)}
    found = []
    for path, kind in outs.items():
        ids = recorded if kind == "table" else _asked(root, path, lock, recorded) | below
        if ids and (root / path).exists() and not empty_reason(root / path):
            seen[path] = ids
            found.append(Use(kind, path, _count(ids)))
    return found


_KINDS = {"samples": "sample", "metrics": "metric", "data": "table"}


def _seen_at(seen: dict[str, set[str]], path: str) -> set[str]:
    """What a folder and all below it saw (``evaluators/embedded/grab`` holds several); never the store's own clips."""
    return set().union(
        *(ids for name, ids in seen.items() if Path(name).is_relative_to(path) and not path.startswith("data/"))
    )


def _asked(root: Path, path: str, lock: Locked, recorded: set[str]) -> set[str]:
    """The recorded clips that motions stand for; of rows that look clips up all of the dataset."""
    if not path.startswith("samples/"):
        return set()
    if Path(path).name.startswith("controls") or not any(dep.startswith("checkpoints/") for dep in lock.deps):
        return recorded
    import pyarrow.parquet as parquet

    tables = (root / path).rglob("meta/sequences.parquet")
    asked: set[Any] = set().union(
        *(parquet.read_table(table, columns=["sequence"])["sequence"].to_pylist() for table in tables)
    )
    return recorded & asked


def _count(ids: set[str]) -> str:
    return f"{len(ids)} clip{'s' if len(ids) > 1 else ''}, first {min(ids)}"
