"""The page of one dataset: counts, lengths, examples, splits, quality control, skipped sequences, provenance."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hoidata.clips.clip import FPS, SIDES
from hoidata.errors import MissingResource
from hoidata.files.written import read_table
from hoidata.hands import HandPair
from hoidata.store.annotated import SUBSETS, AnnotatedStore, load_annotated
from pipelines.commands.store_facts import Rows, fact_rows
from pipelines.pages.clip_page import page_name, write_clip_page
from pipelines.pages.curves import COLOURS, figure_svg
from pipelines.pages.dataset_facts import UNLABELLED, DatasetFacts, count_values, read_dataset
from pipelines.pages.examples import true_contact
from pipelines.pages.player import Player, motion_player, write_page
from pipelines.pages.quality import QualityFacts, read_quality

EXAMPLES = 6
SHOWN_BARS = 24
CLIP_FOLDER = "clips"
NOT_MEASURED = "not measured"


class Bars(NamedTuple):
    """A chart of clip counts, most clips first."""

    title: str
    bars: list[tuple[str, int, float]]  # (value, clips, percent of the longest bar)
    rest: str  # the values without a bar, in words


class ObjectContact(NamedTuple):
    """Contact and penetration of one object, or of all objects, as texts; "not measured" if the object is not solid."""

    name: str
    clips: str
    frames: str
    touching: str  # percentage of frames with a joint within the threshold of a sampled point
    deep: str  # percentage of measured frames with a hand vertex too deep inside
    deepest: str  # depth of the deepest vertex, mm


def write_dataset_page(
    out: str | Path, root: Path, name: str, hands: HandPair, title: str = "", examples: int = EXAMPLES
) -> Path:
    """Write the page of a dataset; ``root`` has the outputs of its stages. See ``write_page_of``."""
    facts = read_dataset(root, name, hands)
    if facts.empty:
        raise MissingResource(f"{name} has no clips to show: {facts.empty}")
    return write_page_of(out, facts, load_annotated(root, hands), read_quality(root / "quality", name), title, examples)


def write_page_of(
    out: str | Path,
    facts: DatasetFacts,
    annotated: AnnotatedStore,
    quality: QualityFacts | None,
    title: str = "",
    examples: int = EXAMPLES,
) -> Path:
    """Write ``out/<name>.html`` and, for its examples, ``out/clips/<clip>.html``; equal inputs give equal bytes.

    Raises MissingResource if a stage has not run.
    """
    name = facts.name
    seconds = annotated.store.sequences["n_frames"].to_numpy() / FPS
    return write_page(
        Path(out) / f"{name}.html",
        "dataset_page.html",
        title=title or name,
        facts=facts,
        synthetic=facts.synthetic,
        charts=count_charts(annotated),
        lengths=Markup(lengths_svg(seconds, f"{name} lengths")),
        length_words="Shortest {:.2f} s, median {:.2f} s, longest {:.2f} s.".format(*np.quantile(seconds, (0, 0.5, 1))),
        examples=_examples(out, annotated, examples),
        splits=split_rows(annotated),
        quality=quality,
        contact=contact_by_object(annotated),
        threshold_cm=annotated.contact_threshold_m * 100,
        without_sentences=clips_without_sentences(annotated),
        provenance=fact_rows(annotated.store),
        has_players=True,
    )


def count_charts(annotated: AnnotatedStore) -> list[Bars]:
    """Clips by hand type, part of the chosen split, verb, object and subject."""
    rows = annotated.store.sequences
    chosen = annotated.split_info["chosen"]["name"]
    return [
        count_bars("hand type", annotated.hand_types["hand_type"], "none is active"),
        count_bars(f"part of the split {chosen}", annotated.splits.values(), "none"),
        count_bars("verb", annotated.hand_types["verb"], UNLABELLED),
        count_bars("object", rows["object_words"], "unnamed"),
        count_bars("subject", rows["subject"], "unnamed"),
    ]


def count_bars(title: str, column: Iterable, missing: str) -> Bars:
    """The number of clips per value; at most 24 bars."""
    counted = count_values(column, missing)
    shown, others = counted[:SHOWN_BARS], counted[SHOWN_BARS:]
    longest = shown[0][1] if shown else 1
    rest = f"and {len(others)} others with {sum(count for _, count in others):,} clips" if others else ""
    return Bars(title, [(name, count, round(100 * count / longest, 2)) for name, count in shown], rest)


def lengths_svg(seconds: np.ndarray, salt: str) -> str:
    """A histogram of the clips' lengths (clip,) in seconds."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.hist(seconds, bins=np.linspace(0, float(seconds.max()) * 1.001, 31).tolist(), color=COLOURS[0])
        axes.set_xlim(0, None)
        axes.set_xlabel("seconds")
        axes.set_ylabel("clips")
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(axis="y", color="#ededea", linewidth=0.8)
        axes.set_axisbelow(True)

    return figure_svg((7.0, 2.0), salt, draw)


def example_ids(annotated: AnnotatedStore, count: int) -> list[str]:
    """Up to ``count`` clips with sentences, chosen greedily for new hand types, verbs, objects and subjects."""
    rows = annotated.store.sequences.loc[annotated.ids()]
    hand_types = annotated.hand_types["hand_type"]
    kinds = {
        str(clip_id): {
            ("hand", hand_types[clip_id]),
            ("verb", annotated.verb(clip_id)),
            ("object", name),
            ("subject", subject),
        }
        for clip_id, name, subject in zip(rows.index, rows["object"], rows["subject"], strict=True)
    }
    shown: set[tuple] = set()
    chosen: list[str] = []
    while kinds and len(chosen) < count:
        chosen.append(max(kinds, key=lambda clip_id: len(kinds[clip_id] - shown)))
        shown |= kinds.pop(chosen[-1])
    return chosen


def _examples(out: str | Path, annotated: AnnotatedStore, count: int) -> list[tuple[Player, str, str, str]]:
    """(still, sentence, clip, link) of each example; writes their pages."""
    hands, examples = annotated.store.hand_pair(), []
    for clip_id in example_ids(annotated, count):
        link = f"{CLIP_FOLDER}/{page_name(clip_id)}"
        write_clip_page(Path(out) / link, annotated, clip_id, hands)
        sentence = annotated.sentences(clip_id)[0]
        examples.append((still_of(annotated, clip_id, hands, sentence), sentence, clip_id, link))
    return examples


def still_of(annotated: AnnotatedStore, clip_id: str, hands: HandPair, title: str) -> Player:
    """The clip in the frame with the most touched points, with its contact map, without a legend."""
    clip, frame = annotated.clip(clip_id), _busiest_frame(annotated, clip_id)
    still = motion_player(clip.take(slice(frame, frame + 1)), hands, title, contact=true_contact(annotated, clip_id))
    return replace(still, legend=(), contact_label="")


def _busiest_frame(annotated: AnnotatedStore, clip_id: str) -> int:
    counts = np.zeros(int(annotated.store.sequences.at[clip_id, "n_frames"]), dtype=np.int64)
    for side in SIDES:
        entries = annotated.distances(clip_id, side)
        pairs = np.unique(np.stack([entries.frame, entries.point]), axis=1)
        counts += np.bincount(pairs[0], minlength=len(counts))
    return int(counts.argmax())


def split_rows(annotated: AnnotatedStore) -> Rows:
    """Per named split: (name, train, validation, test, excluded, whether it passes its leak checks)."""
    info = annotated.split_info
    chosen = info["chosen"]["name"]
    records = {f"{chosen} (chosen)": info["chosen"]}
    records |= {name: record for name, record in info["splits"].items() if name != chosen}
    rows = []
    for name, record in records.items():
        counts = (f"{record['clips'][part]:,}" for part in (*SUBSETS, "left_out"))
        rows.append((name, *counts, "yes" if record["keeps_its_promises"] else "no"))
    return rows


def clips_without_sentences(annotated: AnnotatedStore) -> Rows:
    """(clip, reason) of every clip without sentences."""
    rows = annotated.hand_types[["clip_id", "reason"]].itertuples(index=False)
    described = set(annotated.ids())
    return [(str(clip_id), str(reason)) for clip_id, reason in rows if clip_id not in described]


def contact_by_object(annotated: AnnotatedStore) -> list[ObjectContact]:
    """One entry per object in alphabetical order, preceded by one for all objects if there are several."""
    clips = annotated.store.sequences[["clip_id", "object", "n_frames"]].reset_index(drop=True)
    clips["touching"] = [len(np.unique(annotated.distances(clip_id).frame)) for clip_id in clips["clip_id"]]
    measures = ["clip_id", "penetration_m", "penetration_share"]
    depths = read_table(annotated.root / "quality" / "clips.parquet", measures)
    clips = clips.merge(depths, on="clip_id", how="left", validate="one_to_one")
    objects = [_contact_row(str(name), group) for name, group in clips.groupby("object")]
    return [_contact_row("all objects", clips), *objects] if len(objects) > 1 else objects


def _contact_row(name: str, rows) -> ObjectContact:
    measured, frames = rows[rows["penetration_m"].notna()], rows["n_frames"].sum()
    deep = deepest = NOT_MEASURED
    if len(measured):
        deep = f"{100 * np.average(measured['penetration_share'], weights=measured['n_frames']):.1f} %"
        deepest = f"{measured['penetration_m'].max() * 1000:.1f}"
    touching = f"{100 * rows['touching'].sum() / frames:.1f} %"
    return ObjectContact(name, f"{len(rows):,}", f"{frames:,}", touching, deep, deepest)
