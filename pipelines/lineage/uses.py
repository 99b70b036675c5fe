"""`hoidata lineage uses`: the outputs that use a raw file, subject, object or clip, and must go if it is withdrawn."""

from dataclasses import dataclass
from pathlib import Path, PurePath

from hoidata.errors import BadInput
from pipelines.lineage.locks import Locked, read_locks
from pipelines.lineage.provenance import read_provenance
from pipelines.lineage.raw import SEQUENCES, RawClip, RawSource, clips_of, raw_sources, read_raw
from pipelines.lineage.targets import WEIGHTS
from pipelines.stages.base import empty_reason


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
    written = {path for lock in locks.values() for path in lock.outs if PurePath(path).match("data/*/*/clips")}
    here = {path.parent.parent.relative_to(root).as_posix() for path in root.glob(f"data/*/*/clips/{SEQUENCES}")}
    stores = {path: read_raw(root, path) for path in sorted(written | here)}
    clips = {path: ids for path, store in stores.items() if store and (ids := _matching_clips(store, source))}
    used_by = dict(clips)  # clip ids by the path of each output that uses them
    outputs = [Use("store", path, _count(ids)) for path, ids in clips.items()]
    checkpoints = (*root.glob(f"checkpoints/**/{WEIGHTS}"), *root.glob(f"evaluators/**/{WEIGHTS}"))
    for checkpoint in sorted(checkpoints):
        name = checkpoint.parent.relative_to(root).as_posix()
        if ids := _clips_of_checkpoint(root, checkpoint, source):
            used_by[name] = ids
            outputs.append(Use("checkpoint", name, _count(ids)))
    # Stages that write samples first, since all others may read these.
    for stage in sorted(locks.values(), key=lambda lock: not any(path.startswith("samples/") for path in lock.outs)):
        outputs += _derived(root, stage, clips, used_by)
    if not outputs:
        expected = "a raw file, subject, object or clip that an output of this project uses"
        raise BadInput(source, expected, "none", "correct it")
    return outputs


def _matching_clips(store: RawSource, source: str) -> set[str]:
    return {clip.clip_id for clip in store.clips if comes_from(clip, source)}


def comes_from(clip: RawClip, source: str) -> bool:
    """Whether ``source`` is the clip's id, its subject, one of its objects, or one of its raw files."""
    names = (clip.clip_id, clip.subject, *clip.objects)
    return source in names or any(
        # A clip lists a folder of frame files as one file.
        f"/{source}".endswith(f"/{path}") or path.endswith(f"/{source}") or f"/{path}/" in f"/{source}"
        for path in clip.files
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
    users = [ids for name, ids in used_by.items() if Path(name).is_relative_to(path) and not path.startswith("data/")]
    return set().union(*users)


def _sampled_clips(root: Path, path: str, lock: Locked, recorded: set[str]) -> set[str]:
    """The recorded clips that samples stand for; for methods without networks, all clips of the dataset."""
    if not path.startswith("samples/"):
        return set()
    if Path(path).name.startswith("controls") or not any(dep.startswith("checkpoints/") for dep in lock.deps):
        return recorded
    import pyarrow.parquet as parquet

    tables = (parquet.read_table(file, columns=["sequence"]) for file in (root / path).rglob(SEQUENCES))
    return recorded.intersection(name for table in tables for name in table["sequence"].to_pylist())


def _count(ids: set[str]) -> str:
    return f"{len(ids)} clip{'s' if len(ids) > 1 else ''}, first {min(ids)}"
