"""Stage quality: measures and verdicts of clips and object meshes; those that fail are not annotated or trained on."""

from hoidata.quality.thresholds import Thresholds
from pipelines.stages.base import StagePaths, empty_reason, jobs, load_hands, load_settings, print_counts, write_empty


def run(paths: StagePaths) -> None:
    """Measure all clips and compare them with the thresholds; a dataset without clips gives an empty output."""
    thresholds = load_settings(Thresholds, "quality")
    if reason := empty_reason(paths.clips):
        write_empty(paths.quality, reason)
        return
    from hoidata.quality.stage import quality_store

    hands = load_hands(paths.profile)
    print_counts(paths, quality_store(paths.clips, paths.quality, thresholds=thresholds, hands=hands, jobs=jobs()))
