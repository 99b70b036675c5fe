"""Stage split: the parts of every named split, the chosen one, its leak check, and the training statistics."""

from typing import Any

from pipelines.stages.base import Place, empty_reason, print_counts, read_section, write_empty


def run(place: Place) -> None:
    """Split the annotated clips; a dataset without clips gives an empty output."""
    wanted = read_section("split").get(place.dataset)
    if reason := empty_reason(place.annotation):
        write_empty(place.splits, reason)
        return
    split(place, wanted)


def split(place: Place, wanted: Any) -> None:
    """Clips and words to parts and statistics. wanted: a split's name, or a rule (``hoidata.splits.SplitRule``)."""
    from hoidata.splits.stage import split_store

    print_counts(place, split_store(place.clips, place.annotation, place.splits, wanted))
