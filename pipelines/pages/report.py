"""The report of one profile: a self-contained page for all datasets, and one page per dataset next to it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from markupsafe import Markup

from hoidata.clips.clip import Clip
from hoidata.dataset_folders import dataset_title
from hoidata.files.written import empty_reason
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.info import embedded_hand_warning
from pipelines.pages.curves import Panel, log_curves, panels_svg, read_log
from pipelines.pages.dataset_facts import DatasetFacts, read_dataset
from pipelines.pages.dataset_page import can_be_shown, write_dataset_page
from pipelines.pages.examples import first_motion, motion_contact, shown_ids, shown_subset, true_contact
from pipelines.pages.metrics_table import CONTROLS, RETRIEVAL_BASELINES, MetricsTable, metrics_tables
from pipelines.pages.player import Player, contact_player, motion_player, write_page
from pipelines.pages.quality import QualityFacts, read_quality
from pipelines.pages.summary import MAX_EXAMINED, Summary, dataset_summary
from pipelines.pages.surface import ContactPaint

CONTACT_EXAMPLES = 3


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
    folders: ReportFolders | None = None,
) -> Path:
    """Write ``out/index.html``, the pages of datasets ``out/<dataset>.html`` and of their examples in ``out/clips``.

    Equal inputs give equal bytes. Datasets without clips are listed with their reason.

    Args:
        families: by dataset, in the order of the table. Motions of the first one are shown next to recorded ones.
        folders: outputs of the stages; by default those below the current folder.
    """
    folders = folders or ReportFolders.of(profile)
    all_sections = [_section(name, folders, names, hands) for name, names in families.items()]
    sections = [section for section in all_sections if not section.facts.empty or section.facts.quarantine]
    synthetic = any(section.facts.synthetic for section in sections)
    has_players = any(section.motions or section.contact or section.examples for section in sections)
    for section in sections:
        if section.page:
            write_dataset_page(out, folders.data / section.facts.name, section.facts.name, hands, section.title)
    return write_page(
        Path(out) / "index.html", "report.html", title=f"hoidata report: {profile}", profile=profile, sections=sections,
        empty_sections=[section for section in all_sections if section.facts.empty], synthetic=synthetic,
        hand_model=hands.name, has_players=has_players, max_examined=MAX_EXAMINED, stand_ins=_stand_ins(sections),
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
    summary = dataset_summary(facts.annotated, trained, families[0], samples, table, hands)
    return Section(
        facts,
        title,
        page=f"{name}.html" if can_be_shown(folders.data / name) else "",
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
    examples = [(kind, one) for kind, one in (("Best", summary.best), ("Worst", summary.worst)) if one is not None]
    if annotated is None:
        return []
    return [
        _player(annotated, one.clip_id, one.motion, hands, f"{kind}, {one.words}",
                motion_contact(annotated, one.clip_id, one.motion, hands))
        for kind, one in examples
    ]  # fmt: skip


def _shown_words(facts: DatasetFacts) -> str:
    subset = "" if facts.annotated is None else shown_subset(facts.annotated)
    names = {"test": "A test clip", "validation": "A validation clip (the split has no test clips)"}
    return names.get(subset, "A training clip (the split has no test or validation clips)")


def _sample_folders(samples: Path, family: str) -> dict[str, Path]:
    """The sample folders to show next to the recorded clip: of the family, and of the best retrieval baseline."""
    retrieval_folders = [
        path
        for name in RETRIEVAL_BASELINES[::-1]
        for path in (samples / CONTROLS / name, samples / name)
        if path.is_dir()
    ]
    return {f"Generated by {family}": samples / family} | {
        f"Retrieved ({path.name})": path for path in retrieval_folders[:1]
    }


def _motions(
    facts: DatasetFacts, hands: HandPair, sample_folders: dict[str, Path]
) -> tuple[list[Player], list[tuple[str, str]]]:
    """Players of a recorded clip and of the sampled motions for its sentence and object, with their ids."""
    annotated = facts.annotated
    if annotated is None or not (ids := shown_ids(annotated, 1)):
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
    for clip_id in shown_ids(annotated, CONTACT_EXAMPLES):
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
    curves = log_curves(read_log(log)) if log.is_file() else []
    if not curves:
        return None
    validation = [curve for curve in curves if "valid" in curve.name]
    training = [curve for curve in curves if curve not in validation]
    panels = [Panel(title, part) for title, part in (("training", training), ("validation", validation)) if part]
    return {"title": model, "svg": Markup(panels_svg(panels, "step", f"{dataset} {model}"))}
