"""Stage surface: hand vertices against the exact surface of the object, and BimArt's maps."""

from pipelines.stages.base import StagePaths, empty_reason, jobs, load_hands, load_settings, write_empty


def run(paths: StagePaths) -> None:
    """Measure every clip; a dataset without clips, or the stage turned off, gives an empty output."""
    if reason := empty_reason(paths.clips):
        write_empty(paths.surface, reason)
        return
    from hoidata.contact.settings import read_contact_settings
    from hoidata.quality.verdicts import left_out_reasons
    from hoidata.surface.stage import SurfaceSettings, surface_store

    settings = load_settings(SurfaceSettings, "surface")
    if not settings.enabled:
        write_empty(paths.surface, "surface.enabled is false in params.yaml")
        return
    report = surface_store(
        paths.clips,
        paths.surface,
        touch_m=settings.touch_m,
        points=read_contact_settings(paths.contact).points,
        hands=load_hands(paths.profile),
        left_out=left_out_reasons(paths.quality),
        jobs=jobs(),
    )
    print(f"{paths}: {', '.join(f'{count} {name}' for name, count in report.counts.items())}; {report.cost}")
