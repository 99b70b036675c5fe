"""Stage annotate: hand type, sentences and text features of all clips."""

from pipelines.stages.base import StagePaths, empty_reason, load_hands, load_settings, print_counts, write_empty


def run(paths: StagePaths) -> None:
    """Annotate all clips; a dataset without clips gives an empty output."""
    if reason := empty_reason(paths.clips):
        write_empty(paths.annotation, reason)
        return
    from hoidata.annotation.settings import AnnotationSettings
    from hoidata.annotation.stage import annotate_store
    from hoidata.contact.settings import read_contact_settings
    from hoidata.quality.thresholds import exclusion_reasons

    counts = annotate_store(
        paths.clips,
        paths.annotation,
        load_settings(AnnotationSettings, "annotate"),
        contact=read_contact_settings(paths.contact),
        hands=load_hands(paths.profile),
        excluded=exclusion_reasons(paths.quality),
    )
    print_counts(paths, counts)
