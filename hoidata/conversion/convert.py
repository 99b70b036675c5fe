"""One dataset from raw files to the store: every sequence converts or is listed with its reason.

Each sequence's results are kept as soon as they are made (``finished``); when all are there, they become the store in
the order of the keys. So a run that was killed goes on where it was, at most one sequence per worker is in memory, and
the bytes depend neither on the number of workers nor on how often the run was killed.
"""

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from hoidata.clips.clip import Clip, SourceFile
from hoidata.clips.hand_parameters import hands_for
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.validation import check_clip
from hoidata.conversion.finished import FinishedWork, Item, job_of
from hoidata.datasets.base import Adapter, RawTree, Recorded, SequenceKey
from hoidata.errors import BadInput, ChangedMeanwhile
from hoidata.files.atomic import exclusive, remove_leftovers
from hoidata.hands import HandPair
from hoidata.store.info import stand_in_note, store_info
from hoidata.store.store import open_store, write_store
from hoidata.workers import WorkerLost, in_workers

DEFECT = "report this defect of hoidata"
GENERATED_LICENCE = "CC0-1.0"


@dataclass(frozen=True)
class ConversionSummary:
    """What a conversion did.

    left_out: every sequence, or stretch of one, that gave no clip, with its reason. taken_up: sequences an interrupted
    run had finished before. warning: what is wrong with every clip, or "".
    """

    dataset: str
    sequences: int
    clips: int
    frames: int
    left_out: tuple[Quarantined, ...]
    empty_reason: str | None = None
    taken_up: int = 0
    warning: str = ""

    def __str__(self) -> str:
        if self.empty_reason:
            return f"{self.dataset}: empty ({self.empty_reason})"
        head = f"{self.dataset}: {self.clips} clips, {self.frames} frames from {self.sequences} sequences"
        head += f" ({self.taken_up} finished before)" if self.taken_up else ""
        lines = [f"warning: {self.warning}"] if self.warning else []
        lines.append(f"{head}; {len(self.left_out)} left out{':' if self.left_out else ''}")
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
    stop_on_change: bool = False,
) -> ConversionSummary:
    """Convert every sequence below ``root`` and write the store ``out``.

    root: None, or a folder without sequences, gives a valid empty store that says why. jobs: worker processes; order
    and bytes of the result do not depend on it. manifest: each file read must be listed with its SHA-256.
    stop_on_change: raise ChangedMeanwhile for a listed file that is gone or another; by default its sequences are
    left out. synthetic: the raw data was generated; every clip and the store say so. progress: a bar on stderr and the
    summary on stdout.

    A run that ends early, even by ``kill -9``, leaves ``.<name>.work`` beside ``out``; the next one takes up what was
    finished there if neither raw files, code nor settings have changed. A sequence whose worker process dies, and dies
    again when it is tried alone, is left out; it stays so until the store is finished, and a later conversion tries
    it anew. Raises BadInput when ``out`` is being written by another run, or when there is no room.
    """
    hands = hands_for(adapter.hand_convention, hands)
    found = adapter.sequences(Path(root)) if root is not None and Path(root).is_dir() else []
    keys = [key for key in found if _is_utf_8(str(key))]
    unnamed = [_without_a_name(key) for key in found if key not in keys]
    reason = None if keys else _why_empty(adapter, root)
    files = manifest.values() if isinstance(manifest, Mapping) else manifest
    listed = None if files is None else {item.path: item for item in files}
    out, root = Path(out), Path(root or ".")
    if stop_on_change and (gone := [path for path in listed or () if not (root / path).exists()]):
        got, remedy = f"{len(gone)} gone, first {gone[0]}", "restore the files, or scan the raw folder again"
        raise ChangedMeanwhile(root, "all files that are listed", got, remedy)
    work = FinishedWork(out.with_name(f".{out.name}.work"), root)
    convert = SequenceConverter(adapter, root, hands, listed, synthetic, work, stop_on_change)
    with exclusive(out) as lock:
        remove_leftovers(out)
        work.open(job_of(adapter, hands, root, keys, listed, synthetic))
        taken_up = _convert_all(convert, keys, jobs, lock, progress)
        items = chain(unnamed, (item for key in keys for item in work.read(key)))
        info = _store_info(adapter, hands, synthetic, reason)
        counts = write_store(out, items, info)
        work.remove()
        # Read back: the store leaves out clips of its own accord, too (an id that is given twice).
        left_out = tuple(Quarantined(**row) for row in open_store(out).quarantine.to_dict("records"))
    warning = stand_in_note(info) if counts["clips"] else ""
    summary = ConversionSummary(
        adapter.name, len(found), counts["clips"], counts["frames"], left_out, reason, taken_up, warning
    )
    if progress:
        print(summary, file=sys.stdout)
    return summary


@dataclass(frozen=True)
class SequenceConverter:
    """What a worker needs: called with a key, it leaves that sequence's results in ``work``."""

    adapter: Adapter
    root: Path
    hands: HandPair
    manifest: Mapping[str, SourceFile] | None
    synthetic: bool
    work: FinishedWork
    stop_on_change: bool = False

    def __call__(self, key: SequenceKey) -> None:
        raw = RawTree(self.root, self.manifest)
        try:
            results: list[Item] = [
                item if isinstance(item, Quarantined) else check_clip(replace(item, synthetic=self.synthetic))
                for item in self.adapter.load(raw, key, self.hands)
            ]
            if isinstance(self.adapter, Recorded) and any(isinstance(item, Clip) for item in results):
                results += self.adapter.recordings(raw, key)
        except BadInput as error:
            if self.stop_on_change and isinstance(error, ChangedMeanwhile):
                raise
            self.work.keep(key, [_left_out(key, self.root, error)], None)
        except Exception as error:  # one sequence must not stop the others; the reason says that this is our fault
            problem = BadInput(str(key), "a sequence the adapter can read", repr(error), DEFECT)
            self.work.keep(key, [_left_out(key, self.root, problem)], None)
        else:
            self.work.keep(key, results, raw.sources)

    def leave_out(self, lost: WorkerLost) -> None:
        """Keep the reason in the place of the clips; a run that goes on does not try it again."""
        self.work.keep(lost.item, [_left_out(lost.item, self.root, lost)], ())


def _convert_all(convert: SequenceConverter, keys: Sequence[SequenceKey], jobs: int, lock: int, progress: bool) -> int:
    """Convert every sequence that was not finished before; how many were."""
    missing = [key for key in keys if not convert.work.holds(key)]
    taken_up = len(keys) - len(missing)
    title = f"convert {convert.adapter.name}" + (f" ({taken_up} finished before)" if taken_up else "")
    with Progress(console=Console(stderr=True), disable=not progress) as bar:
        task = bar.add_task(title, total=len(keys), completed=taken_up)
        for _ in in_workers(convert, missing, jobs, lock, convert.leave_out):
            bar.advance(task)
    return taken_up


def _left_out(key: SequenceKey, root: Path, error: BadInput) -> Quarantined:
    """The error with paths below the raw root, so that the store does not depend on where the raw data lies."""
    prefix = f"{root}/"
    where, got = error.where.replace(prefix, ""), error.got.replace(prefix, "")
    return Quarantined(str(key), where, error.expected.replace(prefix, ""), got, error.remedy)


def _is_utf_8(text: str) -> bool:
    return text == text.encode(errors="replace").decode()


def _without_a_name(key: SequenceKey) -> Quarantined:
    """A sequence whose file has a name that no id, table or manifest can hold."""
    shown = str(key).encode(errors="backslashreplace").decode()
    return Quarantined(shown, shown, "a file name in UTF-8", "other bytes", "rename it")


def _why_empty(adapter: Adapter, root: str | Path | None) -> str:
    if root is None:
        return f"no raw folder was given; register at {adapter.where_to_register}"
    what = "has no sequences" if Path(root).is_dir() else "does not exist"
    return f"the raw folder {Path(root).name} {what}; register at {adapter.where_to_register}"


def _store_info(adapter: Adapter, hands: HandPair, synthetic: bool, reason: str | None) -> dict[str, object]:
    of_arrays = {} if synthetic else getattr(adapter, "licences", {})
    return store_info(
        adapter.name,
        hands,
        frame=adapter.frame,
        hand_convention=adapter.hand_convention,
        dataset_version=adapter.version,
        licence=f"{GENERATED_LICENCE} (generated in the files of {adapter.name})" if synthetic else adapter.licence,
        may_be_shared=synthetic or adapter.may_be_shared,
        source_fps=adapter.source_fps,
        synthetic=synthetic,
        where_to_register=adapter.where_to_register,
        empty_reason=reason,
        **({"licences": of_arrays} if of_arrays else {}),
    )
