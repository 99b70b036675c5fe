"""Stage contact: contact maps and sparse distances on sampled points of every object."""

from hoidata.contact.settings import ContactSettings
from pipelines.stages.base import Place, empty_reason, load_hands, load_settings, print_counts, write_empty


def run(place: Place) -> None:
    """Measure every clip; a dataset without clips gives an empty output."""
    settings = load_settings(ContactSettings, "contact")
    if reason := empty_reason(place.clips):
        write_empty(place.contact, reason)
        return
    measure(place, settings)


def measure(place: Place, settings: ContactSettings) -> None:
    """Clips to contact and distance maps."""
    from hoidata.contact.stage import contact_store

    print_counts(place, contact_store(place.clips, place.contact, settings, hands=load_hands(place.profile)))
