"""An annotated dataset of four short clips, for what is measured against one."""

from collections.abc import Callable
from pathlib import Path

from hoidata.annotation.stage import annotate_store
from hoidata.clips import Clip
from hoidata.contact.stage import contact_store
from hoidata.splits import split_store
from hoidata.store.info import generated_info
from hoidata.store.store import write_store

RULE = {"by": "subject", "train": ["s1"], "validation": ["s2"], "test": ["s3"]}
PLANS = (("s1", "right"), ("s2", "left"), ("s3", "right"), ("s3", "both"))


def write_annotated_dataset(
    root: Path, make_clip: Callable[..., Clip], threshold_m: float = 0.02, points: int = 256
) -> tuple[Path, dict[str, Clip]]:
    """Clips, annotation, contact and splits in ``root``; gives it and the two test clips (right hand, and both)."""
    clips = [
        make_clip(12, hand, seed=seed, clip_id=f"toy/{subject}/{seed}", subject=subject)
        for seed, (subject, hand) in enumerate(PLANS)
    ]
    write_store(root / "clips", clips, generated_info("toy"))
    annotate_store(root / "clips", root / "annotation", encoder="hash")
    contact_store(root / "clips", root / "contact", points=points, threshold_m=threshold_m)
    split_store(root / "clips", root / "annotation", root / "splits", RULE)
    return root, {clip.clip_id: clip for clip in clips if clip.subject == "s3"}
