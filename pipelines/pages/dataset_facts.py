"""The facts of one dataset as the report shows them, read from the folders its stages wrote."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from hoidata.clips.clip import FPS
from hoidata.files.written import empty_reason
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store.store import Store, open_store

MOST_FREQUENT = 12


@dataclass(frozen=True)
class DatasetFacts:
    """Numbers and tables of one dataset.

    tiles: (number, name). counts: (title, [(name, clips)]). quarantine: rows of the store's table, as dicts.
    annotated: None where no clip is annotated; empty: the reason, where there is no clip at all.
    """

    name: str
    synthetic: bool
    empty: str
    tiles: list[tuple[str, str]]
    counts: list[tuple[str, list[tuple[str, int]]]]
    quarantine: list[dict[str, str]]
    annotated: AnnotatedStore | None
    info: dict

    @property
    def missing_subsets(self) -> list[str]:
        """What it means that parts of the chosen split have no clips."""
        return [] if self.annotated is None else list(self.annotated.missing_subsets.values())

    @property
    def reasons(self) -> list[tuple[str, int]]:
        """What the sequences left out should have been, most frequent first."""
        return _frequent([row["expected"] for row in self.quarantine], "")


def read_dataset(root: Path, name: str, hands: HandPair) -> DatasetFacts:
    """Facts of the dataset below ``root`` (its ``clips``, ``annotation``, ``contact`` and ``splits`` folders)."""
    reason = reason_for_nothing(root / "clips")
    if not (root / "clips" / "meta" / "info.json").is_file():
        return DatasetFacts(name, False, reason or "it was not converted", [], [], [], None, {})
    store = open_store(root / "clips", hands)
    quarantine = [{key: str(row[key]) for key in store.quarantine} for row in store.quarantine.to_dict("records")]
    if not len(store):
        return DatasetFacts(name, False, reason or "no sequence gave a clip", [], [], quarantine, None, store.info)
    annotated = load_annotated(root, hands) if has_tables(root) else None
    synthetic = bool(store.sequences["synthetic"].any())
    tiles, counts = _tiles(store, annotated), _counts(store, annotated)
    return DatasetFacts(name, synthetic, "", tiles, counts, quarantine, annotated, store.info)


def reason_for_nothing(folder: Path) -> str:
    """The reason a stage noted in ``folder/empty.json``; "" where it noted none."""
    return empty_reason(folder) or ""


def has_tables(root: Path, *tables: str) -> bool:
    """Whether the stages have left these files below a dataset's folder, and what annotated clips need."""
    needed = ("annotation/text.parquet", "contact/points.npz", "splits/splits.parquet")
    return all((root / table).is_file() for table in (*tables, *needed))


def _tiles(store: Store, annotated: AnnotatedStore | None) -> list[tuple[str, str]]:
    rows = store.sequences
    frames = sum(int(count) for count in rows["n_frames"])
    tiles = [
        (f"{len(rows):,}", "clips"),
        (f"{frames:,}", "frames at 30 fps"),
        (f"{frames / FPS / 60:.1f}", "minutes"),
        (f"{rows['subject'].nunique():,}", "subjects"),
        (f"{rows['object'].nunique():,}", "objects"),
        (f"{rows['verb'].nunique():,}", "verbs"),
        (f"{len(store.quarantine):,}", "not converted"),
    ]
    if annotated is not None:
        tiles.append((f"{len(annotated.text):,}", "sentences"))
        tiles += majority_verb(annotated)
    return tiles


def majority_verb(annotated: AnnotatedStore) -> list[tuple[str, str]]:
    """The accuracy of always guessing the most frequent verb of the training clips, as a tile; none without test clips.

    Of equally frequent verbs the first in the alphabet counts.
    """
    verbs = annotated.hand_types["verb"]
    trained, tested = (
        [verbs[clip_id] for clip_id in annotated.ids(subset) if isinstance(verbs[clip_id], str)]
        for subset in ("train", "test")
    )
    if not trained or not tested:
        return []
    verb = min(trained, key=lambda own: (-trained.count(own), own))
    return [(f"{tested.count(verb) / len(tested):.0%}", f"of test clips show the most frequent training verb, {verb}")]


def _counts(store: Store, annotated: AnnotatedStore | None) -> list[tuple[str, list[tuple[str, int]]]]:
    rows = store.sequences
    tables = []
    if annotated is not None:
        tables.append(("hands", _frequent(list(annotated.hand_types["hand_type"]), "none acts")))
        tables.append(("split", _frequent([annotated.splits[clip_id] for clip_id in annotated.ids()], "none")))
    tables.append(("verb", _frequent(list(rows["verb"]), "no label in the source")))
    tables.append(("object", _frequent(list(rows["object_words"]), "unnamed")))
    return tables


def _frequent(column: list, missing: str) -> list[tuple[str, int]]:
    names = [missing if pd.isna(value) else str(value) for value in column]
    counted = sorted(Counter(names).items(), key=lambda item: (-item[1], item[0]))
    rest = counted[MOST_FREQUENT:]
    tail = [(f"{len(rest)} others", sum(count for _, count in rest))] if rest else []
    return counted[:MOST_FREQUENT] + tail
