"""Converts one dataset from raw files to the store: every sequence gives clips or a reason.

Workers save the results of each finished sequence (``finished``). The parent process then writes the store in the order
of the keys. So a killed run resumes, and at most one sequence per worker is in memory. The bytes depend neither on the
number of workers nor on interruptions.
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
from hoidata.conversion.finished import FinishedWork, Item, job_description
from hoidata.datasets.base import Adapter, HasHandRecordings, RawTree, SequenceKey
from hoidata.errors import BadInput, RawFileChanged
from hoidata.files.atomic import exclusive, remove_leftovers
from hoidata.hands import HandPair
from hoidata.store.info import embedded_hand_warning, store_info
from hoidata.store.store import open_store, write_store
from hoidata.workers import WorkerDied, map_in_workers

DEFECT = "report this defect of hoidata"
GENERATED_LICENCE = "CC0-1.0"


@dataclass(frozen=True)
class ConversionSummary:
    """Counts and problems of one conversion."""

    dataset: str
    sequences: int  # number of sequences in the raw folder
    clips: int
    frames: int
    quarantined: tuple[Quarantined, ...]  # sequences and intervals without a clip, with the reason
    empty_reason: str | None = None  # why the store is empty
    resumed: int = 0  # number of sequences that an interrupted run had finished
    warning: str = ""  # a problem of every clip

    def __str__(self) -> str:
        if self.empty_reason:
            return f"{self.dataset}: empty ({self.empty_reason})"
        head = f"{self.dataset}: {self.clips} clips, {self.frames} frames from {self.sequences} sequences"
        head += f" ({self.resumed} finished before)" if self.resumed else ""
        lines = [f"warning: {self.warning}"] if self.warning else []
        lines.append(f"{head}; {len(self.quarantined)} quarantined{':' if self.quarantined else ''}")
        for item in self.quarantined:
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

    An interrupted run leaves ``.<name>.work`` next to ``out``. The next run reuses its finished sequences if raw files,
    code and settings are unchanged. A sequence is quarantined if its worker process dies, and dies again in a process
    without other sequences. Resumed runs do not try it again; the next conversion does.

    Args:
        adapter: reads the raw files.
        root: the raw folder. None, or a folder without sequences, gives an empty store with the reason.
        hands: hand models of both sides.
        out: folder of the store.
        jobs: number of worker processes; order and bytes of the result do not depend on it.
        manifest: if given, every file read must be listed with its SHA-256.
        progress: show a progress bar on stderr and the summary on stdout.
        synthetic: the raw data is generated; every clip and the store are marked.
        stop_on_change: raise RawFileChanged for a listed file that is missing or changed. By default its sequences are
            quarantined.

    Raises BadInput if another run writes ``out``, or the disk is full.
    """
    hands = hands_for(adapter.hand_convention, hands)
    all_keys = adapter.sequences(Path(root)) if root is not None and Path(root).is_dir() else []
    keys = [key for key in all_keys if _is_utf_8(str(key))]
    undecodable = [_undecodable_name(key) for key in all_keys if key not in keys]
    empty_reason = None if keys else _empty_reason(adapter, root)
    files = manifest.values() if isinstance(manifest, Mapping) else manifest
    listed = None if files is None else {item.path: item for item in files}
    out, root = Path(out), Path(root or ".")
    if stop_on_change and (gone := [path for path in listed or () if not (root / path).exists()]):
        got, remedy = f"{len(gone)} gone, first {gone[0]}", "restore the files, or scan the raw folder again"
        raise RawFileChanged(root, "all files that are listed", got, remedy)
    work = FinishedWork(out.with_name(f".{out.name}.work"), root)
    convert = SequenceConverter(
        adapter, root, hands, listed, synthetic=synthetic, work=work, stop_on_change=stop_on_change
    )
    with exclusive(out) as lock:
        remove_leftovers(out)
        work.open(job_description(adapter, hands, root, keys, listed, synthetic))
        resumed = _convert_all(convert, keys, jobs, lock, progress)
        items = chain(undecodable, (item for key in keys for item in work.read(key)))
        info = _store_info(adapter, hands, synthetic, empty_reason)
        counts = write_store(out, items, info)
        work.remove()
        # Read back, because writing the store also quarantines clips, such as one with a duplicate id.
        quarantined = tuple(Quarantined(**row) for row in open_store(out).quarantine.to_dict("records"))
    warning = embedded_hand_warning(info) if counts["clips"] else ""
    summary = ConversionSummary(
        dataset=adapter.name,
        sequences=len(all_keys),
        clips=counts["clips"],
        frames=counts["frames"],
        quarantined=quarantined,
        empty_reason=empty_reason,
        resumed=resumed,
        warning=warning,
    )
    if progress:
        print(summary, file=sys.stdout)
    return summary


@dataclass(frozen=True)
class SequenceConverter:
    """Converts one sequence in a worker process and saves its results in ``work``."""

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
            if isinstance(self.adapter, HasHandRecordings) and any(isinstance(item, Clip) for item in results):
                results += self.adapter.recordings(raw, key)
        except BadInput as error:
            if self.stop_on_change and isinstance(error, RawFileChanged):
                raise
            self.work.save(key, [_quarantined(key, self.root, error)], None)
        except Exception as error:  # one sequence must not stop the others; the reason blames hoidata
            problem = BadInput(str(key), "a sequence the adapter can read", repr(error), DEFECT)
            self.work.save(key, [_quarantined(key, self.root, problem)], None)
        else:
            self.work.save(key, results, raw.sources)

    def quarantine(self, lost: WorkerDied) -> None:
        """Save the reason as the sequence's result; a resumed run does not try the sequence again."""
        self.work.save(lost.item, [_quarantined(lost.item, self.root, lost)], ())


def _convert_all(convert: SequenceConverter, keys: Sequence[SequenceKey], jobs: int, lock: int, progress: bool) -> int:
    """Convert the unfinished sequences. Returns how many were finished before."""
    missing = [key for key in keys if not convert.work.is_finished(key)]
    resumed = len(keys) - len(missing)
    title = f"convert {convert.adapter.name}" + (f" ({resumed} finished before)" if resumed else "")
    with Progress(console=Console(stderr=True), disable=not progress) as bar:
        task = bar.add_task(title, total=len(keys), completed=resumed)
        for _ in map_in_workers(convert, missing, jobs, lock, convert.quarantine):
            bar.advance(task)
    return resumed


def _quarantined(key: SequenceKey, root: Path, error: BadInput) -> Quarantined:
    """The error with paths relative to the raw root, so that the store does not depend on the root."""
    prefix = f"{root}/"
    location, got = error.where.replace(prefix, ""), error.got.replace(prefix, "")
    expected = error.expected.replace(prefix, "")
    return Quarantined(str(key), where=location, expected=expected, got=got, remedy=error.remedy)


def _is_utf_8(text: str) -> bool:
    return text == text.encode(errors="replace").decode()


def _undecodable_name(key: SequenceKey) -> Quarantined:
    """The reason for a sequence whose file name is not UTF-8, which ids, tables and manifests require."""
    shown = str(key).encode(errors="backslashreplace").decode()
    return Quarantined(shown, where=shown, expected="a file name in UTF-8", got="other bytes", remedy="rename it")


def _empty_reason(adapter: Adapter, root: str | Path | None) -> str:
    if root is None:
        return f"no raw folder was given; register at {adapter.where_to_register}"
    problem = "has no sequences" if Path(root).is_dir() else "does not exist"
    return f"the raw folder {Path(root).name} {problem}; register at {adapter.where_to_register}"


def _store_info(adapter: Adapter, hands: HandPair, synthetic: bool, reason: str | None) -> dict[str, object]:
    array_licences = {} if synthetic else getattr(adapter, "licences", {})
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
        **({"licences": array_licences} if array_licences else {}),
        **({"derives_verbs": True} if getattr(adapter, "derives_verbs", False) else {}),
    )
