"""`hoidata lineage uses`: the outputs that use a raw file, subject, object or clip, and must go if it is withdrawn."""

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
    """One output that uses the data."""

    kind: str
    name: str
    why: str  # the number of clips it uses, and the first one


def uses(root: Path, source: str) -> list[Use]:
    """All stores, tables, checkpoints, samples and metrics that use a source. Raises BadInput if none does.

    A checkpoint uses its training and validation clips, and those of the checkpoints it builds on. Samples use the
    clips of their checkpoints and the clips they stand for; samples without networks use all clips. Metrics use the
    samples and the recorded clips.

    Args:
        source: the path of a raw file or its end, a subject, an object, or a clip id.
    """
    locks = read_locks(root)
    stores = {path: read_raw(root, path) for path in _stores(root, locks)}
    matching = {path: _matching_clips(store, source) for path, store in stores.items() if store is not None}
    clips = {path: ids for path, ids in matching.items() if ids}
    used_by = dict(clips)  # clip ids by the path of each output that uses them
    outputs = [Use("store", path, _count(ids)) for path, ids in clips.items()]
    checkpoints = (*root.glob(f"checkpoints/**/{WEIGHTS}"), *root.glob(f"evaluators/**/{WEIGHTS}"))
    for checkpoint in sorted(checkpoints):
        name = checkpoint.parent.relative_to(root).as_posix()
        if ids := _clips_of_checkpoint(root, checkpoint, source):
            used_by[name] = ids
            outputs.append(Use("checkpoint", name, _count(ids)))
    for stage in _samples_first(locks):
        outputs += _derived(root, stage, clips, used_by)
    if not outputs:
        expected = "a raw file, subject, object or clip that an output of this project uses"
        raise BadInput(source, expected, "none", "correct it")
    return outputs


def _stores(root: Path, locks: dict[str, Locked]) -> list[str]:
    outs = {
        path for lock in locks.values() for path in lock.outs if Path(path).name == _STORE and path.startswith("data/")
    }
    written = (
        path.parent.parent.relative_to(root).as_posix() for path in root.glob("data/*/*/clips/meta/sequences.parquet")
    )
    return sorted({*outs, *written})


def _matching_clips(store: RawSource, source: str) -> set[str]:
    return {clip.clip_id for clip in store.clips if comes_from(clip, source)}


def comes_from(clip: RawClip, source: str) -> bool:
    """Whether ``source`` is the clip's id, its subject, one of its objects, or one of its raw files."""
    names = (clip.clip_id, clip.subject, *clip.objects)
    return source in names or any(
        path == source or source.endswith(f"/{path}") or path.endswith(f"/{source}") for path in clip.files
    )


def _clips_of_checkpoint(root: Path, path: Path, source: str) -> set[str]:
    """The clips from ``source`` that a checkpoint, or one it builds on, uses for training or validation."""
    try:
        record = read_provenance(path)
    except BadInput:
        return set()
    stores = raw_sources(root, record)
    ids = {clip for store in stores for clip in _matching_clips(store, source)} & clips_of(record)
    for name in record.get("stages", {}).get(record.get("stage"), {}).get("inputs", ()):
        if (base := root / name / WEIGHTS).is_file() and base != path:
            ids |= _clips_of_checkpoint(root, base, source)
    return ids


def _samples_first(locks: dict[str, Locked]) -> Iterator[Locked]:
    """The stages that write samples, then all others, which may read the samples."""
    yield from (lock for lock in locks.values() if any(path.startswith("samples/") for path in lock.outs))
    yield from (lock for lock in locks.values() if not any(path.startswith("samples/") for path in lock.outs))


def _derived(root: Path, lock: Locked, clips: dict[str, set[str]], used_by: dict[str, set[str]]) -> list[Use]:
    """The outputs of one stage that use the clips; adds them to ``used_by`` for the stages after it."""
    outs = {path: kind for path in lock.outs if (kind := _KINDS.get(path.partition("/")[0])) and path not in used_by}
    if not outs:
        return []
    recorded = set().union(*(clips.get(path, ()) for path in lock.deps)) if lock.deps else set()
    inherited = {clip for path in lock.deps for clip in _used_at(used_by, path)}
    outputs = []
    for path, kind in outs.items():
        ids = recorded if kind == "table" else _sampled_clips(root, path, lock, recorded) | inherited
        if ids and (root / path).exists() and not empty_reason(root / path):
            used_by[path] = ids
            outputs.append(Use(kind, path, _count(ids)))
    return outputs


_KINDS = {"samples": "sample", "metrics": "metric", "data": "table"}


def _used_at(used_by: dict[str, set[str]], path: str) -> set[str]:
    """The clips that a folder and all below it use (``evaluators/embedded/grab`` has several); none for stores."""
    return set().union(
        *(ids for name, ids in used_by.items() if Path(name).is_relative_to(path) and not path.startswith("data/"))
    )


def _sampled_clips(root: Path, path: str, lock: Locked, recorded: set[str]) -> set[str]:
    """The recorded clips that samples stand for; for methods without networks, all clips of the dataset."""
    if not path.startswith("samples/"):
        return set()
    if Path(path).name.startswith("controls") or not any(dep.startswith("checkpoints/") for dep in lock.deps):
        return recorded
    import pyarrow.parquet as parquet

    tables = (root / path).rglob("meta/sequences.parquet")
    sampled: set[Any] = set().union(
        *(parquet.read_table(table, columns=["sequence"])["sequence"].to_pylist() for table in tables)
    )
    return recorded & sampled


def _count(ids: set[str]) -> str:
    return f"{len(ids)} clip{'s' if len(ids) > 1 else ''}, first {min(ids)}"
