"""One dataset from raw files to the store: every sequence converts or is listed with its reason."""

import multiprocessing
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from hoidata.adapters.base import Adapter, RawTree, SequenceKey
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.schema.clip import Clip, SourceFile
from hoidata.schema.hand_parameters import hands_for
from hoidata.schema.quarantine import Quarantined
from hoidata.schema.store import write_store
from hoidata.schema.validation import check_clip

Results = list[Clip | Quarantined]


@dataclass(frozen=True)
class ConversionSummary:
    """What a conversion did. left_out: every sequence, or stretch of one, that gave no clip, with its reason."""

    dataset: str
    sequences: int
    clips: int
    frames: int
    left_out: tuple[Quarantined, ...]
    empty_reason: str | None = None

    def __str__(self) -> str:
        if self.empty_reason:
            return f"{self.dataset}: empty ({self.empty_reason})"
        head = f"{self.dataset}: {self.clips} clips, {self.frames} frames from {self.sequences} sequences"
        lines = [f"{head}; {len(self.left_out)} left out{':' if self.left_out else ''}"]
        for item in self.left_out:
            lines.append(f"  {item.source_key}: {item.where}: expected {item.expected}, got {item.got}; {item.remedy}")
        return "\n".join(lines)


def convert_dataset(
    adapter: Adapter,
    root: str | Path | None,
    hands: HandPair,
    out: str | Path,
    jobs: int = 1,
    manifest: Mapping[str, SourceFile] | Iterable[SourceFile] | None = None,
    progress: bool = True,
    synthetic: bool = False,
) -> ConversionSummary:
    """Convert every sequence below ``root`` and write the store ``out``.

    root: None, or a folder without sequences, gives a valid empty store that says why. jobs: worker processes; order
    and bytes of the result do not depend on it. manifest: each file read must be listed with its SHA-256.
    synthetic: the raw data was generated; every clip and the store say so. progress: a bar on stderr and the summary
    on stdout.
    """
    hands = hands_for(adapter.hand_convention, hands)
    keys = adapter.sequences(Path(root)) if root is not None and Path(root).is_dir() else []
    reason = None if keys else _why_empty(adapter, root)
    files = manifest.values() if isinstance(manifest, Mapping) else manifest
    listed = None if files is None else {item.path: item for item in files}
    convert = partial(convert_sequence, adapter, Path(root or "."), hands, listed, synthetic)
    left_out: list[Quarantined] = []
    info = _store_info(adapter, hands, synthetic, reason)
    with Progress(console=Console(stderr=True), disable=not progress) as bar:
        groups = bar.track(_in_order(convert, keys, jobs), len(keys), description=f"convert {adapter.name}")
        counts = write_store(out, _flattened(groups, left_out), info)
    summary = ConversionSummary(adapter.name, len(keys), counts["clips"], counts["frames"], tuple(left_out), reason)
    if progress:
        print(summary, file=sys.stdout)
    return summary


def convert_sequence(
    adapter: Adapter,
    root: Path,
    hands: HandPair,
    manifest: dict[str, SourceFile] | None,
    synthetic: bool,
    key: SequenceKey,
) -> Results:
    """The checked clips of one sequence; one Quarantined in their place when it cannot be used."""
    try:
        results = adapter.load(RawTree(root, manifest), key, hands)
        clips = [item if isinstance(item, Quarantined) else replace(item, synthetic=synthetic) for item in results]
        return [item if isinstance(item, Quarantined) else check_clip(item) for item in clips]
    except BadInput as error:
        return [_left_out(key, root, error)]
    except Exception as error:  # one sequence must not stop the others; the reason says that this is our fault
        problem = BadInput(str(key), "a sequence the adapter can read", repr(error), "report this defect of hoidata")
        return [_left_out(key, root, problem)]


def _left_out(key: SequenceKey, root: Path, error: BadInput) -> Quarantined:
    """The error with paths below the raw root, so that the store does not depend on where the raw data lies."""
    prefix = f"{root}/"
    where, got = error.where.replace(prefix, ""), error.got.replace(prefix, "")
    return Quarantined(str(key), where, error.expected.replace(prefix, ""), got, error.remedy)


def _why_empty(adapter: Adapter, root: str | Path | None) -> str:
    if root is None:
        return f"no raw folder was given; register at {adapter.where_to_register}"
    what = "has no sequences" if Path(root).is_dir() else "does not exist"
    return f"the raw folder {Path(root).name} {what}; register at {adapter.where_to_register}"


def _store_info(adapter: Adapter, hands: HandPair, synthetic: bool, reason: str | None) -> dict[str, object]:
    return {
        "dataset": adapter.name,
        "synthetic": synthetic,
        "hand_model": {"name": hands.name, "digest": hands.digest},
        "dataset_version": adapter.version,
        "frame": {"handedness": "right", **asdict(adapter.frame)},
        "hand_convention": adapter.hand_convention.as_json(),
        "licence": adapter.licence,
        "may_be_shared": adapter.may_be_shared,
        "where_to_register": adapter.where_to_register,
        "source_fps": adapter.source_fps,
        "empty_reason": reason,
    }


def _flattened(groups: Iterable[Results], left_out: list[Quarantined]) -> Iterator[Clip | Quarantined]:
    for group in groups:
        for item in group:
            if isinstance(item, Quarantined):
                left_out.append(item)
            yield item


def _in_order(convert: Callable[[SequenceKey], Results], keys: list[SequenceKey], jobs: int) -> Iterator[Results]:
    """Results in the order of the keys; at most four sequences per worker wait at any time."""
    if jobs <= 1 or len(keys) < 2:
        yield from map(convert, keys)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(convert,)) as pool:
        waiting: deque[Future[Results]] = deque()
        for key in keys:
            waiting.append(pool.submit(_work, key))
            if len(waiting) >= 4 * jobs:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


_convert_here: Callable[[SequenceKey], Results] | None = None


def _start_worker(convert: Callable[[SequenceKey], Results]) -> None:
    """Give a worker its adapter and hands once, and one thread: the pool already uses the cores."""
    import torch

    torch.set_num_threads(1)
    global _convert_here
    _convert_here = convert


def _work(key: SequenceKey) -> Results:
    assert _convert_here is not None
    return _convert_here(key)
