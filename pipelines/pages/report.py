"""The report of one profile: a self-contained page over all its datasets, and beside it a page per dataset."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from markupsafe import Markup

from hoidata.dataset_folders import dataset_title
from hoidata.files import atomic_file
from hoidata.hands import HandPair
from pipelines.pages.curves import Panel, log_curves, panels_svg, read_log
from pipelines.pages.dataset_facts import DatasetFacts, read_dataset, reason_for_nothing
from pipelines.pages.dataset_page import can_be_shown, write_dataset_page
from pipelines.pages.examples import contact_examples, generated_example, is_trained, shown_ids, true_contact
from pipelines.pages.generation_page import generated_contact, generation_facts
from pipelines.pages.metrics_table import Table, metrics_tables
from pipelines.pages.player import Player, contact_player, motion_player, render_page
from pipelines.pages.quality import QualityFacts, read_quality
from pipelines.pages.view import touched_side

MODELS = ("contact", "length", "diffusion", "refiner")
CONTACT_EXAMPLES = 3


@dataclass(frozen=True)
class ReportFolders:
    """Where the stages of one profile wrote: each folder holds one entry per dataset."""

    data: Path
    checkpoints: Path
    metrics: Path

    @classmethod
    def of(cls, profile: str, root: str | Path = ".") -> "ReportFolders":
        root = Path(root)
        return cls(root / "data" / profile, root / "checkpoints" / profile, root / "metrics" / profile)


@dataclass(frozen=True)
class Section:
    """One dataset on the page. motions: recorded and generated, side by side; contact: sentence, (truth, predicted).

    page: the dataset's own page, beside the report's; "" where a stage it needs has not run.
    """

    facts: DatasetFacts
    title: str
    page: str = ""
    shown: str = ""
    quality: QualityFacts | None = None
    motions: list[Player] = field(default_factory=list)
    motion_facts: list[tuple[str, str]] = field(default_factory=list)
    contact: list[tuple[str, list[Player]]] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    metrics_note: str = ""
    curves: list[dict[str, str]] = field(default_factory=list)
    missing: list[tuple[str, str]] = field(default_factory=list)


def write_report(
    out: str | Path,
    profile: str,
    datasets: Sequence[str],
    hands: HandPair,
    folders: ReportFolders | None = None,
    seed: int = 0,
) -> Path:
    """Write ``out/index.html`` from what the stages of ``profile`` left in ``folders`` (below the current folder).

    Beside it the page of each dataset, ``out/<dataset>.html``, and in ``out/clips`` those of its examples.

    Where all four models of a dataset are trained, a motion is generated for a held-out clip and shown beside it; seed:
    of what they draw. Equal inputs give equal bytes. Datasets without clips are listed with their reason.
    """
    folders = folders or ReportFolders.of(profile)
    all_sections = [_section(name, folders, hands, seed) for name in datasets]
    sections = [section for section in all_sections if not section.facts.empty or section.facts.quarantine]
    synthetic = any(section.facts.synthetic for section in sections)
    has_players = any(section.motions or section.contact for section in sections)
    page = render_page(
        "report.html", title=f"hoidata report: {profile}", profile=profile, sections=sections,
        empty_sections=[section for section in all_sections if section.facts.empty], synthetic=synthetic,
        hand_model=hands.name, has_players=has_players,
    )  # fmt: skip
    for section in sections:
        if section.page:
            write_dataset_page(out, folders.data / section.facts.name, section.facts.name, hands, section.title)
    path = Path(out) / "index.html"
    with atomic_file(path) as part:
        part.write_text(page, encoding="utf-8")
    return path


def _section(name: str, folders: ReportFolders, hands: HandPair, seed: int) -> Section:
    facts = read_dataset(folders.data / name, name, hands)
    title = dataset_title(name)
    if facts.empty:
        return Section(facts, title)
    checkpoints = folders.checkpoints / name
    tables, note = _metrics(folders.metrics / f"{name}.json")
    motions, motion_facts = _motions(facts, hands, checkpoints, seed)
    return Section(
        facts,
        title,
        page=f"{name}.html" if can_be_shown(folders.data / name) else "",
        shown=_what_is_shown(facts),
        quality=read_quality(folders.data / name / "quality", name),
        motions=motions,
        motion_facts=motion_facts,
        contact=_contact_pairs(facts, checkpoints / "contact", seed),
        tables=tables,
        metrics_note=note,
        curves=[chart for model in MODELS if (chart := _loss_chart(name, model, checkpoints / model / "log.csv"))],
        missing=[(model, reason) for model in MODELS if (reason := reason_for_nothing(checkpoints / model))],
    )


def _metrics(path: Path) -> tuple[list[Table], str]:
    if not path.is_file():
        return [], "The models of this dataset have not been evaluated."
    values = json.loads(path.read_text(encoding="utf-8"))
    if "empty" in values:
        return [], f"Not evaluated: {values['empty']}."
    return metrics_tables(values), ""


def _what_is_shown(facts: DatasetFacts) -> str:
    held_out = facts.annotated is not None and bool(facts.annotated.split_ids("test"))
    return "A clip of the test split" if held_out else "A clip (this dataset has no test split)"


def _motions(
    facts: DatasetFacts, hands: HandPair, checkpoints: Path, seed: int
) -> tuple[list[Player], list[tuple[str, str]]]:
    """A recorded clip, beside it a motion generated for its sentence and object, and how that one came about."""
    annotated = facts.annotated
    if annotated is None or not (ids := shown_ids(annotated, 1)):
        return [], []
    sentence = annotated.sentences(ids[0])[0]
    caption = f"{'Synthetic ground truth' if facts.synthetic else 'Recorded'}: {sentence}"
    paint = true_contact(annotated, ids[0])
    recorded = motion_player(annotated.clip(ids[0]), hands, sentence, caption, paint, "within 2 cm of a joint")
    if not is_trained(checkpoints):
        return [recorded], [("clip", ids[0])]
    motion = generated_example(annotated, checkpoints, hands, ids[0], seed)
    paint, caption = generated_contact(motion), f"Generated: {sentence}"
    generated = motion_player(motion.clip, hands, sentence, caption, paint, "contact it was made for")
    return [recorded, generated], [("clip", ids[0]), *generation_facts(motion)]


def _contact_pairs(facts: DatasetFacts, folder: Path, seed: int) -> list[tuple[str, list[Player]]]:
    annotated = facts.annotated
    if annotated is None or not (folder / "model.safetensors").is_file():
        return []
    pairs = []
    for example in contact_examples(annotated, folder, shown_ids(annotated, CONTACT_EXAMPLES), seed):
        look = touched_side(example.clip, example.truth)
        players = [
            contact_player(example.clip, paint, f"{caption}: {example.sentence}", caption, look, label)
            for caption, paint, label in (
                ("ground truth", example.truth, "within 2 cm of a joint"),
                ("predicted", example.predicted, "chance of contact, 0 to 1"),
            )
        ]
        pairs.append((example.sentence, players))
    return pairs


def _loss_chart(dataset: str, model: str, log: Path) -> dict[str, str] | None:
    """The losses of a training log: what was minimised and its parts, and the validation loss in a panel of its own."""
    curves = log_curves(read_log(log)) if log.is_file() else []
    if not curves:
        return None
    validation = [curve for curve in curves if "valid" in curve.name]
    training = [curve for curve in curves if curve not in validation]
    panels = [Panel(title, part) for title, part in (("training", training), ("validation", validation)) if part]
    return {"title": model, "svg": Markup(panels_svg(panels, "step", f"{dataset} {model}"))}
