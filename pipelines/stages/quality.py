"""Stage quality: every clip and object mesh measured and judged; what fails is left out of annotation and training."""

from hoidata.quality.thresholds import Thresholds
from pipelines.stages.base import Place, empty_reason, jobs, load_hands, load_settings, print_counts, write_empty


def run(place: Place) -> None:
    """Measure and judge every clip; a dataset without clips gives an empty output."""
    thresholds = load_settings(Thresholds, "quality")
    if reason := empty_reason(place.clips):
        write_empty(place.quality, reason)
        return
    judge(place, thresholds)


def judge(place: Place, thresholds: Thresholds) -> None:
    """Clips to measures and verdicts."""
    from hoidata.quality.stage import quality_store

    hands = load_hands(place.profile)
    print_counts(place, quality_store(place.clips, place.quality, thresholds=thresholds, hands=hands, jobs=jobs()))
