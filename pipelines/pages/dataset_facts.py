"""The facts of one dataset for the report, read from the outputs of its stages."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from hoidata.clips.clip import FPS
from hoidata.files.written import empty_reason
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store.store import Store, open_store

MOST_FREQUENT = 12
UNLABELLED = "no verb"


@dataclass(frozen=True)
class DatasetFacts:
    """Numbers and tables of one dataset."""

    name: str
    synthetic: bool = False
    empty: str = ""  # why the dataset has no clips
    tiles: list[tuple[str, str]] = field(default_factory=list)  # (number, name)
    counts: list[tuple[str, list[tuple[str, int]]]] = field(default_factory=list)  # (title, [(name, clips)])
    quarantine: list[tuple[str, ...]] = field(default_factory=list)  # (sequence, source, expected, got, remedy)
    annotated: AnnotatedStore | None = None  # None if no clip is annotated
    info: dict = field(default_factory=dict)  # of the store

    @property
    def missing_subsets(self) -> list[str]:
        """The consequences of subsets of the chosen split without clips, in words."""
        return [] if self.annotated is None else list(self.annotated.missing_subsets.values())

    @property
    def reasons(self) -> list[tuple[str, int]]:
        """The violated expectations of skipped sequences with counts, most frequent first."""
        return _frequent([expected for _, _, expected, _, _ in self.quarantine], "")


def read_dataset(root: Path, name: str, hands: HandPair) -> DatasetFacts:
    """Facts of the dataset below ``root`` (its ``clips``, ``annotation``, ``contact`` and ``splits`` folders)."""
    reason = empty_reason(root / "clips")
    if not (root / "clips" / "meta" / "info.json").is_file():
        return DatasetFacts(name, empty=reason or "it was not converted")
    store = open_store(root / "clips", hands)
    quarantine = [tuple(map(str, entry)) for entry in store.quarantine.itertuples(index=False)]
    if not len(store):
        empty = reason or "no sequence gave a clip"
        return DatasetFacts(name, empty=empty, quarantine=quarantine, info=store.info)
    annotated = load_annotated(root, hands) if has_tables(root) else None
    return DatasetFacts(
        name=name,
        synthetic=bool(store.sequences["synthetic"].any()),
        tiles=_tiles(store, annotated),
        counts=_counts(store, annotated),
        quarantine=quarantine,
        annotated=annotated,
        info=store.info,
    )


def has_tables(root: Path, *tables: str) -> bool:
    """Whether a dataset's folder has these files and those that annotated clips need."""
    needed = ("annotation/text.parquet", "contact/points.npz", "splits/splits.parquet")
    return all((root / table).is_file() for table in (*tables, *needed))


def _tiles(store: Store, annotated: AnnotatedStore | None) -> list[tuple[str, str]]:
    rows, frames = store.sequences, sum(store.sequences["n_frames"].tolist())
    tiles = [
        (f"{len(rows):,}", "clips"),
        (f"{frames:,}", "frames at 30 fps"),
        (f"{frames / FPS / 60:.1f}", "minutes"),
        (f"{rows['subject'].nunique():,}", "subjects"),
        (f"{rows['object'].nunique():,}", "objects"),
        (f"{_verbs(store, annotated).nunique():,}", "verbs"),
        (f"{len(store.quarantine):,}", "not converted"),
    ]
    if annotated is not None:
        tiles.append((f"{len(annotated.text):,}", "sentences"))
        tiles += majority_verb(annotated)
    return tiles


def majority_verb(annotated: AnnotatedStore) -> list[tuple[str, str]]:
    """The accuracy of always guessing the most frequent training verb, as a tile; none without test clips.

    Ties are broken alphabetically.
    """
    verbs = annotated.hand_types["verb"]
    trained, tested = (
        [verbs[clip_id] for clip_id in annotated.ids(subset) if isinstance(verbs[clip_id], str)]
        for subset in ("train", "test")
    )
    if not trained or not tested:
        return []
    verb = min(trained, key=lambda name: (-trained.count(name), name))
    return [(f"{tested.count(verb) / len(tested):.0%}", f"of test clips show the most frequent training verb, {verb}")]


def _counts(store: Store, annotated: AnnotatedStore | None) -> list[tuple[str, list[tuple[str, int]]]]:
    tables = []
    if annotated is not None:
        tables.append(("hands", _frequent(annotated.hand_types["hand_type"], "none is active")))
        tables.append(("split", _frequent([annotated.splits[clip_id] for clip_id in annotated.ids()], "none")))
    tables.append(("verb", _frequent(_verbs(store, annotated), UNLABELLED)))
    tables.append(("object", _frequent(store.sequences["object_words"], "unnamed")))
    return tables


def _verbs(store: Store, annotated: AnnotatedStore | None) -> pd.Series:
    """The annotated verb of every clip; without annotation the source's."""
    return pd.Series(store.sequences["verb"] if annotated is None else annotated.hand_types["verb"])


def count_values(column: Iterable, missing: str) -> list[tuple[str, int]]:
    """(value, count), most frequent first, ties in alphabetical order."""
    names = [missing if pd.isna(value) else str(value) for value in column]
    return sorted(Counter(names).items(), key=lambda item: (-item[1], item[0]))


def _frequent(column: Iterable, missing: str) -> list[tuple[str, int]]:
    counted = count_values(column, missing)
    rest = counted[MOST_FREQUENT:]
    tail = [(f"{len(rest)} others", sum(count for _, count in rest))] if rest else []
    return counted[:MOST_FREQUENT] + tail
