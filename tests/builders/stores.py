"""Stores for tests, written by the stages."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hoidata.annotation.stage import annotate_store
from hoidata.clips import Clip
from hoidata.clips.quarantine import Quarantined
from hoidata.contact.settings import ContactSettings
from hoidata.contact.stage import contact_store
from hoidata.quality.stage import quality_store
from hoidata.splits.stage import split_store
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from tests.builders.clips import build_clip

BY_SUBJECT = {"by": "subject", "train": "rest", "validation": ["s2"], "test": ["s3"]}


def write_clips(folder: Path, clips: Sequence[Clip | Quarantined], dataset: str = "test") -> Path:
    write_store(folder, clips, generated_info(dataset))
    return folder


def write_annotated(
    root: Path,
    clips: Sequence[Clip | Quarantined],
    dataset: str = "toy",
    rule: dict[str, Any] | None = None,
    threshold_m: float = 0.02,
    points: int = 1024,
    quality: bool = False,
    **annotate: Any,
) -> Path:
    """Write clips, annotation (with the hash encoder), contact and splits below ``root``.

    quality: whether to write quality, too. annotate: further settings of the stage annotate.
    """
    contact = ContactSettings(points=points, threshold_m=threshold_m)
    write_clips(root / "clips", clips, dataset)
    if quality:
        quality_store(root / "clips", root / "quality", progress=False)
    annotate_store(root / "clips", root / "annotation", encoder="hash", contact=contact, **annotate)
    contact_store(root / "clips", root / "contact", contact)
    split_store(root / "clips", root / "annotation", root / "splits", rule or BY_SUBJECT)
    return root


def write_two_verbs(root: Path) -> list[Clip]:
    """Write and annotate five clips of two verbs and three subjects, the last two for tests."""
    plans = [("s1", "lift"), ("s1", "open"), ("s2", "lift"), ("s3", "lift"), ("s3", "open")]
    clips = [
        build_clip(20, seed=seed, clip_id=f"toy/{subject}/{seed}", subject=subject, verb=verb)
        for seed, (subject, verb) in enumerate(plans)
    ]
    write_annotated(root, clips)
    return clips
