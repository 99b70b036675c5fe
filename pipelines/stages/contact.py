"""Stage contact: contact maps and sparse distances on sampled points of every object."""

from pipelines.stages.base import Place, StageParams, empty_reason, load_hands, load_params, write_empty


class ContactParams(StageParams):
    """points: sampled per object. threshold_m: larger joint-point distances are not kept."""

    points: int
    threshold_m: float


def run(place: Place) -> None:
    """Measure every clip; a dataset without clips gives an empty output."""
    params = load_params(ContactParams, "contact")
    if reason := empty_reason(place.clips):
        write_empty(place.contact, reason)
        return
    measure(place, params)


def measure(place: Place, params: ContactParams) -> None:
    """Clips to contact and distance maps."""
    from hoidata.contact.stage import contact_store

    hands = load_hands(place.profile)
    counts = contact_store(
        place.clips, place.contact, points=params.points, threshold_m=params.threshold_m, hands=hands
    )
    print(f"{place}: {', '.join(f'{count} {name}' for name, count in counts.items())}")
