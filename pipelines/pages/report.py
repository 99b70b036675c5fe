"""The report of one profile: a self-contained page for all datasets, and one page per dataset next to it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from markupsafe import Markup

from hoidata.clips.clip import Clip
from hoidata.contact.maps import f1_score
from hoidata.dataset_folders import dataset_title
from hoidata.files.written import empty_reason
from hoidata.hands import HandPair
from hoidata.metrics.verdict import summary, verdict
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.info import embedded_hand_warning
from pipelines.pages.curves import Panel, log_curves, panels_svg
from pipelines.pages.dataset_facts import DatasetFacts, has_tables, read_dataset
from pipelines.pages.dataset_page import write_page_of
from pipelines.pages.examples import first_motion, motion_contact, shown_ids, shown_subset, true_contact
from pipelines.pages.metrics_table import CONTROLS, RETRIEVAL_BASELINES, MetricsTable, metrics_tables
from pipelines.pages.player import Player, contact_player, motion_player, write_page
from pipelines.pages.quality import QualityFacts, read_quality
from pipelines.pages.surface import ContactPaint

CONTACT_EXAMPLES = 3
MAX_EXAMINED = 6  # motions of a dataset; a verdict takes about half a second


@dataclass(frozen=True)
class ReportFolders:
    """The output folders of the stages of one profile, each with one entry per dataset."""

    data: Path
    checkpoints: Path
    samples: Path
    metrics: Path

    @classmethod
    def of(cls, profile: str, root: str | Path = ".") -> "ReportFolders":
        return cls(*(Path(root, name, profile) for name in ("data", "checkpoints", "samples", "metrics")))


@dataclass(frozen=True)
class Example:
    """A generated motion for a held-out clip, examined."""

    clip_id: str
    sentence: str
    motion: Clip
    paint: ContactPaint  # the points that it touches
    words: str  # its verdict and contact F1
    rank: tuple[int, float]  # failed checks, and contact F1 subtracted from 1; the least is the best


@dataclass(frozen=True)
class Summary:
    """One dataset of the summary."""

    trained: str
    compared: str  # with retrieval baselines
    examined: int  # number of motions
    best: Example | None = None
    worst: Example | None = None


@dataclass(frozen=True)
class Section:
    """One dataset on the page."""

    facts: DatasetFacts
    title: str
    page: str = ""  # file name of the dataset's page; "" if a stage it needs has not run
    shown: str = ""  # which subset the examples are from, in words
    quality: QualityFacts | None = None
    motions: list[Player] = field(default_factory=list)  # recorded, generated and retrieved
    motion_facts: list[tuple[str, str]] = field(default_factory=list)
    contact: list[tuple[str, list[Player]]] = field(default_factory=list)  # (sentence, [recorded, generated])
    table: MetricsTable | None = None
    curves: list[dict[str, str]] = field(default_factory=list)
    missing: list[tuple[str, str]] = field(default_factory=list)  # (network, why it was not trained)
    summary: Summary | None = None
    examples: list[Player] = field(default_factory=list)  # the best and the worst of the summary


# Text encoders other than CLIP, which Text2HOI uses.
ENCODERS = {
    "use": "the Universal Sentence Encoder (offline), in place of Text2HOI's CLIP",
    "hash": "hashed words, which carry no meaning, in place of Text2HOI's CLIP",
}


def write_report(
    out: str | Path,
    profile: str,
    families: Mapping[str, Sequence[str]],
    hands: HandPair,
    folders: ReportFolders,
) -> Path:
    """Write ``out/index.html``, the pages of datasets ``out/<dataset>.html`` and of their examples in ``out/clips``.

    Equal inputs give equal bytes. Datasets without clips are listed with their reason. ``families`` are by dataset, in
    the order of the table; motions of the first one are shown next to recorded ones.
    """
    all_sections = [_section(name, folders, names, hands) for name, names in families.items()]
    sections = [section for section in all_sections if not section.facts.empty or section.facts.quarantine]
    synthetic = any(section.facts.synthetic for section in sections)
    has_players = any(section.motions or section.contact or section.examples for section in sections)
    for section in sections:
        if section.page and section.facts.annotated is not None:
            write_page_of(out, section.facts, section.facts.annotated, section.quality, section.title)
    return write_page(
        Path(out) / "index.html", "report.html", title=f"hoidata report: {profile}", profile=profile, sections=sections,
        empty=[(section.title, section.facts.empty) for section in all_sections if section.facts.empty],
        synthetic=synthetic, hand_model=hands.name, has_players=has_players, max_examined=MAX_EXAMINED,
        stand_ins=_stand_ins(sections),
    )  # fmt: skip


def _stand_ins(sections: Sequence[Section]) -> list[str]:
    """The replacements of licensed models or encoders that the profile uses, in words."""
    infos = [section.facts.info for section in sections if section.facts.info]
    notes = [note for info in infos if (note := embedded_hand_warning(info))]
    annotation_infos = [section.facts.annotated.annotation_info for section in sections if section.facts.annotated]
    names = {str(info["encoder"]["name"]) for info in annotation_infos}
    notes += [f"sentences are encoded by {ENCODERS[name]}" for name in sorted(names & ENCODERS.keys())]
    return notes


def _section(name: str, folders: ReportFolders, families: Sequence[str], hands: HandPair) -> Section:
    facts = read_dataset(folders.data / name, name, hands)
    title = dataset_title(name)
    if facts.empty:
        return Section(facts, title)
    networks = sorted(path for path in (folders.checkpoints / name).glob("*") if path.is_dir())
    samples = folders.samples / name / families[0]
    motions, motion_facts = _motions(facts, hands, _sample_folders(folders.samples / name, families[0]))
    table = metrics_tables(folders.metrics / name, families)
    reasons = {folder.name: empty_reason(folder) for folder in networks}
    trained = [name for name, reason in reasons.items() if not reason]
    summary = _summary(facts.annotated, trained, families[0], samples, table, hands)
    return Section(
        facts,
        title,
        page=f"{name}.html" if has_tables(folders.data / name, "quality/clips.parquet") else "",
        shown=_shown_words(facts),
        quality=read_quality(folders.data / name / "quality", name),
        motions=motions,
        motion_facts=motion_facts,
        contact=_contact_pairs(facts, hands, samples),
        table=table,
        curves=[chart for folder in networks if (chart := _loss_chart(name, folder.name, folder / "log.csv"))],
        missing=[(name, reason) for name, reason in reasons.items() if reason],
        summary=summary,
        examples=_example_players(facts.annotated, summary, hands),
    )


def _example_players(annotated: AnnotatedStore | None, summary: Summary, hands: HandPair) -> list[Player]:
    players = []
    for kind, one in (("Best", summary.best), ("Worst", summary.worst)):
        if annotated is not None and one is not None:
            players.append(_player(annotated, one.clip_id, one.motion, hands, f"{kind}, {one.words}", one.paint))
    return players


def _shown_words(facts: DatasetFacts) -> str:
    subset = "" if facts.annotated is None else shown_subset(facts.annotated)
    names = {"test": "A test clip", "validation": "A validation clip (the split has no test clips)"}
    return names.get(subset, "A training clip (the split has no test or validation clips)")


def _sample_folders(samples: Path, family: str) -> dict[str, Path]:
    """The sample folders to show next to the recorded clip: of the family, and of the best retrieval baseline."""
    folders = [path for name in RETRIEVAL_BASELINES[::-1] for path in (samples / CONTROLS / name, samples / name)]
    retrieved = next((path for path in folders if path.is_dir()), None)
    return {f"Generated by {family}": samples / family} | (
        {f"Retrieved ({retrieved.name})": retrieved} if retrieved else {}
    )


def _motions(
    facts: DatasetFacts, hands: HandPair, sample_folders: dict[str, Path]
) -> tuple[list[Player], list[tuple[str, str]]]:
    """Players of a recorded clip and of the motions sampled for its sentence and object, with their ids."""
    annotated = facts.annotated
    generated = next(iter(sample_folders.values()))
    if annotated is None or not (ids := shown_ids(annotated, 1, generated)):
        return [], []
    recorded = "Synthetic ground truth" if facts.synthetic else "Recorded"
    players = [_player(annotated, ids[0], annotated.clip(ids[0]), hands, recorded, true_contact(annotated, ids[0]))]
    shown = [("clip", ids[0])]
    for kind, samples in sample_folders.items():
        motion = first_motion(samples, ids[0], hands)
        if motion is not None:
            paint = motion_contact(annotated, ids[0], motion, hands)
            players.append(_player(annotated, ids[0], motion, hands, kind, paint))
            shown.append((kind, motion.clip_id))
    return players, shown


def _player(
    annotated: AnnotatedStore, clip_id: str, clip: Clip, hands: HandPair, kind: str, paint: ContactPaint
) -> Player:
    sentence = annotated.sentences(clip_id)[0]
    return motion_player(clip, hands, sentence, f"{kind}: {sentence}", paint, touch_words(annotated))


def touch_words(annotated: AnnotatedStore) -> str:
    """The legend of a contact map, with the contact threshold."""
    return f"within {annotated.contact_threshold_m * 100:g} cm of a joint"


def _contact_pairs(facts: DatasetFacts, hands: HandPair, samples: Path) -> list[tuple[str, list[Player]]]:
    """Per example clip, the sentence and the recorded and generated contact maps."""
    annotated = facts.annotated
    if annotated is None:
        return []
    pairs = []
    for clip_id in shown_ids(annotated, CONTACT_EXAMPLES, samples):
        if (motion := first_motion(samples, clip_id, hands)) is None:
            continue
        clip, sentence = annotated.clip(clip_id), annotated.sentences(clip_id)[0]
        truth = true_contact(annotated, clip_id)
        paints = {"ground truth": truth, "generated": motion_contact(annotated, clip_id, motion, hands)}
        players = [
            contact_player(clip, paint, f"{caption}: {sentence}", caption, touch_words(annotated), truth)
            for caption, paint in paints.items()
        ]
        pairs.append((sentence, players))
    return pairs


def _loss_chart(dataset: str, model: str, log: Path) -> dict[str, str] | None:
    """The losses of a training log: one panel for the training loss and its terms, one for the validation loss."""
    curves = log_curves(log) if log.is_file() else []
    if not curves:
        return None
    validation = [curve for curve in curves if "valid" in curve.name]
    training = [curve for curve in curves if curve not in validation]
    panels = [Panel(title, part) for title, part in (("training", training), ("validation", validation)) if part]
    return {"title": model, "svg": Markup(panels_svg(panels, f"{dataset} {model}"))}


def _summary(
    annotated: AnnotatedStore | None,
    networks: Sequence[str],
    family: str,
    samples: Path,
    table: MetricsTable,
    hands: HandPair,
) -> Summary:
    """The summary of one dataset; ``family``: the method of the examples, with its motions in ``samples``."""
    if annotated is None:
        return Summary("nothing", "", 0)
    train = annotated.ids("train")
    kind = "synthetic" if any(annotated.clip(clip_id).synthetic for clip_id in train[:1]) else "recorded"
    trained = f"{', '.join(networks)} on {len(train):,} {kind} clips" if networks else "nothing"
    [method] = [one for one in table.methods if one.family == family]
    words = method.summary or "not worse than retrieval in any metric"
    compared = method.empty or f"{family}: {words} ({method.note})"
    examples = sorted(_examples(annotated, samples, hands), key=lambda example: example.rank)
    if not examples:
        return Summary(trained, compared, 0)
    return Summary(trained, compared, len(examples), examples[0], examples[-1] if len(examples) > 1 else None)


def _examples(annotated: AnnotatedStore, samples: Path, hands: HandPair) -> list[Example]:
    examples = []
    for clip_id in shown_ids(annotated, MAX_EXAMINED, samples):
        if (motion := first_motion(samples, clip_id, hands)) is not None:
            checks, paint = verdict(motion, hands), motion_contact(annotated, clip_id, motion, hands)
            n_failed = sum(check.passed is False for check in checks)
            f1, sentence = f1_score(paint.value > 0, annotated.contact(clip_id) > 0), annotated.sentences(clip_id)[0]
            words = f"{summary(checks)}; contact F1 {f1:.2f}"
            examples.append(Example(clip_id, sentence, motion, paint, words, (n_failed, 1 - f1)))
    return examples
