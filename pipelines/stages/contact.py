"""Stage contact: contact maps and sparse distances on points sampled on the objects."""

from pipelines.stages.base import StagePaths, empty_reason, jobs, load_hands, load_settings, print_counts, write_empty


def run(paths: StagePaths) -> None:
    """Measure all clips; a dataset without clips gives an empty output."""
    if reason := empty_reason(paths.clips):
        write_empty(paths.contact, reason)
        return
    from hoidata.contact.settings import ContactSettings
    from hoidata.contact.stage import contact_store

    settings = load_settings(ContactSettings, "contact")
    hands = load_hands(paths.profile)
    print_counts(paths, contact_store(paths.clips, paths.contact, settings, hands=hands, jobs=jobs()))
