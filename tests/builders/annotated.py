"""An annotated dataset of four short clips, for what is measured against one."""

from collections.abc import Callable
from pathlib import Path

from hoidata.clips import Clip
from tests.builders.stores import write_annotated

PLANS = (("s1", "right"), ("s2", "left"), ("s3", "right"), ("s3", "both"))


def write_annotated_dataset(
    root: Path, make_clip: Callable[..., Clip], threshold_m: float = 0.02, points: int = 256
) -> tuple[Path, dict[str, Clip]]:
    """Clips, annotation, contact and splits in ``root``; gives it and the two test clips (right hand, and both)."""
    clips = [
        make_clip(12, hand, seed=seed, clip_id=f"toy/{subject}/{seed}", subject=subject)
        for seed, (subject, hand) in enumerate(PLANS)
    ]
    write_annotated(root, clips, threshold_m=threshold_m, points=points)
    return root, {clip.clip_id: clip for clip in clips if clip.subject == "s3"}
