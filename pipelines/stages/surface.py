"""Stage surface: hand vertices against the exact surface of the object, and BimArt's maps."""

from hoidata.contact.settings import read_contact_settings
from hoidata.surface.stage import SurfaceSettings
from pipelines.stages.base import Place, empty_reason, jobs, load_hands, load_settings, write_empty


def run(place: Place) -> None:
    """Measure every clip; a dataset without clips, or the stage turned off, gives an empty output."""
    settings = load_settings(SurfaceSettings, "surface")
    reason = empty_reason(place.clips) or (None if settings.enabled else "surface.enabled is false in params.yaml")
    if reason:
        write_empty(place.surface, reason)
        return
    measure(place, settings)


def measure(place: Place, settings: SurfaceSettings) -> None:
    """Clips to exact contact, depth and maps; the maps lie on the points of the stage contact."""
    from hoidata.quality.verdicts import left_out_reasons
    from hoidata.surface.stage import surface_store

    report = surface_store(
        place.clips,
        place.surface,
        touch_m=settings.touch_m,
        points=read_contact_settings(place.contact).points,
        hands=load_hands(place.profile),
        left_out=left_out_reasons(place.quality),
        jobs=jobs(),
    )
    print(f"{place}: {', '.join(f'{count} {name}' for name, count in report.counts.items())}; {report.cost}")
