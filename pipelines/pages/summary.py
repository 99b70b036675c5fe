"""The summary at the top of a report: what was trained, what to believe, and the best and worst example."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hoidata.clips.clip import Clip
from hoidata.contact.maps import f1_score
from hoidata.hands import HandPair
from hoidata.metrics.verdict import summary, verdict
from hoidata.store.annotated import AnnotatedStore
from pipelines.pages.examples import first_motion, motion_contact, shown_ids
from pipelines.pages.metrics_table import MetricsTable

MAX_EXAMINED = 6  # motions of a dataset; a verdict takes about half a second


@dataclass(frozen=True)
class Example:
    """A generated motion for a held-out clip, examined."""

    clip_id: str
    sentence: str
    motion: Clip
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


def dataset_summary(
    annotated: AnnotatedStore | None,
    networks: Sequence[str],
    family: str,
    samples: Path,
    table: MetricsTable | None,
    hands: HandPair,
) -> Summary:
    """The summary of one dataset.

    Args:
        family: the method of the examples, with its motions in ``samples``.
    """
    if annotated is None:
        return Summary("nothing", "", 0)
    kind = (
        "synthetic" if any(annotated.clip(clip_id).synthetic for clip_id in annotated.ids("train")[:1]) else "recorded"
    )
    trained = f"{', '.join(networks)} on {len(annotated.ids('train')):,} {kind} clips" if networks else "nothing"
    method = next((one for one in table.methods if one.family == family), None) if table else None
    compared = ""
    if method is not None:
        words = method.summary or "not worse than retrieval in any metric"
        compared = method.empty or f"{family}: {words} ({method.note})"
    examples = sorted(_examples(annotated, samples, hands), key=lambda example: example.rank)
    if not examples:
        return Summary(trained, compared, 0)
    return Summary(trained, compared, len(examples), examples[0], examples[-1] if len(examples) > 1 else None)


def _examples(annotated: AnnotatedStore, samples: Path, hands: HandPair) -> list[Example]:
    examples = []
    for clip_id in shown_ids(annotated, MAX_EXAMINED):
        if (motion := first_motion(samples, clip_id, hands)) is not None:
            checks = verdict(motion, hands)
            n_failed = sum(check.passed is False for check in checks)
            f1 = f1_score(motion_contact(annotated, clip_id, motion, hands).value > 0, annotated.contact(clip_id) > 0)
            words = f"{summary(checks)}; contact F1 {f1:.2f}"
            examples.append(Example(clip_id, annotated.sentences(clip_id)[0], motion, words, (n_failed, 1 - f1)))
    return examples
