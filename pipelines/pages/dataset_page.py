"""One dataset as one page: counts, lengths, examples, splits, quality control, what was left out, origin."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hoidata.clips.clip import FPS, SIDES
from hoidata.errors import MissingResource
from hoidata.files.written import read_table
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore, load_annotated
from pipelines.commands.store_facts import fact_rows
from pipelines.pages.clip_page import page_name, write_clip_page
from pipelines.pages.curves import COLOURS, figure_svg
from pipelines.pages.dataset_facts import has_tables, read_dataset
from pipelines.pages.examples import true_contact
from pipelines.pages.player import Player, motion_player, write_page
from pipelines.pages.quality import read_quality

EXAMPLES = 6
SHOWN_BARS = 24
CLIP_FOLDER = "clips"
NOT_MEASURED = "not measured"
UNLABELLED = "no label in the source"
Rows = list[tuple[str, ...]]


@dataclass(frozen=True)
class Bar:
    """name, how many clips, and per cent of the longest bar of its chart."""

    name: str
    clips: int
    width: float


@dataclass(frozen=True)
class Bars:
    """A bar chart, most clips first; rest: what is not shown, "" where everything is."""

    title: str
    bars: list[Bar]
    rest: str = ""


@dataclass(frozen=True)
class Example:
    """One clip as a still, with a link to the page that plays it."""

    still: Player
    sentence: str
    clip_id: str
    link: str


class ObjectContact(NamedTuple):
    """One object, or all of them, over its clips, as texts; "not measured" where nothing can be inside.

    touching: share of frames in which a joint is within the threshold of a sampled point. deep: share of the frames
    that quality control looked at in which a hand vertex is too deep inside. deepest: depth of the deepest vertex, mm.
    """

    name: str
    clips: str
    frames: str
    touching: str
    deep: str
    deepest: str


def write_dataset_page(
    out: str | Path, root: Path, name: str, hands: HandPair, title: str = "", examples: int = EXAMPLES
) -> Path:
    """Write ``out/<name>.html`` and, for its examples, ``out/clips/<clip>.html``; equal inputs give equal bytes.

    root: the folder of the dataset's stages. examples: at most so many. Raises MissingResource with the reason for a
    dataset without clips, or naming a stage that has not run.
    """
    facts = read_dataset(root, name, hands)
    if facts.empty:
        raise MissingResource(f"{name} has no clips to show: {facts.empty}")
    annotated = load_annotated(root, hands)
    return write_page(
        Path(out) / f"{name}.html",
        "dataset_page.html",
        title=title or name,
        facts=facts,
        synthetic=facts.synthetic,
        charts=count_charts(annotated),
        lengths=Markup(lengths_svg(annotated, f"{name} lengths")),
        length_words=length_words(annotated),
        examples=_examples(out, annotated, hands, examples),
        splits=split_rows(annotated),
        quality=read_quality(root / "quality", name),
        contact=contact_by_object(annotated),
        threshold_cm=annotated.contact_threshold_m * 100,
        without_words=without_words(annotated),
        provenance=fact_rows(annotated.store),
        has_players=True,
    )


def can_be_shown(root: Path) -> bool:
    """Whether the stages have left all that the page of a dataset and those of its clips need."""
    return has_tables(root, "quality/clips.parquet")


def count_charts(annotated: AnnotatedStore) -> list[Bars]:
    """Clips by hand type, part of the chosen split, verb, object and subject."""
    rows = annotated.store.sequences
    chosen = annotated.split_info["chosen"]["name"]
    return [
        count_bars("hand type", annotated.hand_types["hand_type"].tolist(), "none acts"),
        count_bars(f"part of the split {chosen}", list(annotated.splits.values()), "none"),
        count_bars("verb", rows["verb"].tolist(), UNLABELLED),
        count_bars("object", rows["object_words"].tolist(), "unnamed"),
        count_bars("subject", rows["subject"].tolist(), "unnamed"),
    ]


def count_bars(title: str, column: Sequence[object], missing: str) -> Bars:
    """How often each value occurs, most frequent first, equal ones by name; the ones beyond 24 as one sentence."""
    names = [missing if pd.isna(value) else str(value) for value in column]  # pyright: ignore[reportGeneralTypeIssues]
    counted = sorted(Counter(names).items(), key=lambda item: (-item[1], item[0]))
    shown, others = counted[:SHOWN_BARS], counted[SHOWN_BARS:]
    longest = shown[0][1] if shown else 1
    rest = f"and {len(others)} others with {sum(count for _, count in others):,} clips" if others else ""
    return Bars(title, [Bar(name, count, round(100 * count / longest, 2)) for name, count in shown], rest)


def length_words(annotated: AnnotatedStore) -> str:
    """Shortest, median and longest clip in words."""
    frames = annotated.store.sequences["n_frames"].to_numpy()
    seconds = [value / FPS for value in (frames.min(), np.median(frames), frames.max())]
    return "Shortest {:.2f} s, median {:.2f} s, longest {:.2f} s.".format(*seconds)


def lengths_svg(annotated: AnnotatedStore, salt: str) -> str:
    """A histogram of the clips' lengths in seconds."""
    seconds = annotated.store.sequences["n_frames"].to_numpy() / FPS

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
    """Up to ``count`` clips with sentences, each the one with most that is new (hand, verb, object, subject)."""
    rows = annotated.store.sequences.loc[annotated.ids()]
    columns = [rows[name].tolist() for name in ("verb", "object", "subject")]
    hand_types = annotated.hand_types["hand_type"]
    kinds = {
        str(clip_id): {("hand", hand_types[clip_id]), ("verb", verb), ("object", name), ("subject", subject)}
        for clip_id, verb, name, subject in zip(rows.index, *columns, strict=True)
    }
    shown: set[tuple] = set()
    chosen: list[str] = []
    while kinds and len(chosen) < count:
        best = max(kinds, key=lambda clip_id: len(kinds[clip_id] - shown))
        shown |= kinds.pop(best)
        chosen.append(best)
    return chosen


def _examples(out: str | Path, annotated: AnnotatedStore, hands: HandPair, count: int) -> list[Example]:
    """Stills of the examples; the page of each is written beside."""
    examples = []
    for clip_id in example_ids(annotated, count):
        link = f"{CLIP_FOLDER}/{page_name(clip_id)}"
        write_clip_page(Path(out) / link, annotated, clip_id, hands)
        sentence = annotated.sentences(clip_id)[0]
        examples.append(Example(still_of(annotated, clip_id, hands, sentence), sentence, clip_id, link))
    return examples


def still_of(annotated: AnnotatedStore, clip_id: str, hands: HandPair, title: str) -> Player:
    """The clip in the frame in which most points are touched, with its contact map; without a legend."""
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
    """Of every named split: (name, train, validation, test, left out, whether it keeps its promises)."""
    info = annotated.split_info
    chosen = info["chosen"]["name"]
    records = {f"{chosen} (chosen)": info["chosen"]}
    records |= {name: record for name, record in info["splits"].items() if name != chosen}
    return [
        (
            name,
            *(f"{record['clips'][part]:,}" for part in ("train", "validation", "test", "left_out")),
            "yes" if record["keeps_its_promises"] else "no",
        )
        for name, record in records.items()
    ]


def without_words(annotated: AnnotatedStore) -> Rows:
    """(clip, why) of every clip that got no sentences."""
    named = set(annotated.ids())
    rows = zip(annotated.hand_types["clip_id"].tolist(), annotated.hand_types["reason"].tolist(), strict=True)
    return [(str(clip_id), str(reason)) for clip_id, reason in rows if clip_id not in named]


def contact_by_object(annotated: AnnotatedStore) -> list[ObjectContact]:
    """Every object by name, after all of them together where there are several."""
    rows = annotated.store.sequences[["clip_id", "object", "n_frames"]].reset_index(drop=True)
    rows["touching"] = [len(np.unique(annotated.distances(clip_id).frame)) for clip_id in rows["clip_id"]]
    measures = ["clip_id", "penetration_m", "penetration_share"]
    depths = read_table(Path(annotated.root) / "quality" / "clips.parquet", measures)
    rows = rows.merge(depths, on="clip_id", how="left", validate="one_to_one")
    found = [_contact_row(str(name), group) for name, group in rows.groupby("object")]
    return [_contact_row("all objects", rows), *found] if len(found) > 1 else found


def _contact_row(name: str, rows) -> ObjectContact:
    measured = rows[rows["penetration_m"].notna()]
    return ObjectContact(
        name=name,
        clips=f"{len(rows):,}",
        frames=f"{rows['n_frames'].sum():,}",
        touching=f"{100 * rows['touching'].sum() / rows['n_frames'].sum():.1f} %",
        deep=f"{100 * np.average(measured['penetration_share'], weights=measured['n_frames']):.1f} %"
        if len(measured)
        else NOT_MEASURED,
        deepest=f"{measured['penetration_m'].max() * 1000:.1f}" if len(measured) else NOT_MEASURED,
    )
