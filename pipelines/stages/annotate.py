"""Stage annotate: hand type, sentences and text features of every clip."""

from pathlib import Path

from hoidata.annotation.settings import AnnotationSettings
from hoidata.contact.settings import read_contact_settings
from pipelines.stages.base import Place, empty_reason, load_hands, load_settings, print_counts, write_empty

# Text features of earlier runs, of all datasets and profiles; they spare time and change no output.
FEATURES = Path(".hoidata", "features")


def run(place: Place) -> None:
    """Annotate every clip; a dataset without clips gives an empty output."""
    settings = load_settings(AnnotationSettings, "annotate")
    if reason := empty_reason(place.clips):
        write_empty(place.annotation, reason)
        return
    annotate(place, settings)


def annotate(place: Place, settings: AnnotationSettings) -> None:
    """Clips to words."""
    from hoidata.annotation.stage import annotate_store
    from hoidata.quality.verdicts import left_out_reasons

    counts = annotate_store(
        place.clips,
        place.annotation,
        settings,
        contact=read_contact_settings(place.contact),
        hands=load_hands(place.profile),
        left_out=left_out_reasons(place.quality),
        features=FEATURES,
    )
    print_counts(place, counts)
