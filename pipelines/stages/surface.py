"""Stage surface: hand vertices against the exact surface of the object, and BimArt's maps."""

from pydantic import ConfigDict

from pipelines.stages.base import Place, StageParams, empty_reason, jobs, load_hands, load_params, write_empty


class SurfaceParams(StageParams):
    """touch_m: a hand vertex closer to the surface touches it."""

    enabled: bool
    touch_m: float


class PointParams(StageParams):
    """Of the section of the stage contact: the maps of both stages lie on the same points."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    points: int


def run(place: Place) -> None:
    """Measure every clip; a dataset without clips, or the stage turned off, gives an empty output."""
    params = load_params(SurfaceParams, "surface")
    reason = empty_reason(place.clips) or (None if params.enabled else "surface.enabled is false in params.yaml")
    if reason:
        write_empty(place.surface, reason)
        return
    measure(place, params)


def measure(place: Place, params: SurfaceParams) -> None:
    """Clips to exact contact, depth and maps."""
    from hoidata.quality.verdicts import left_out_reasons
    from hoidata.surface.stage import surface_store

    report = surface_store(
        place.clips,
        place.surface,
        touch_m=params.touch_m,
        points=load_params(PointParams, "contact").points,
        hands=load_hands(place.profile),
        left_out=left_out_reasons(place.quality),
        jobs=jobs(),
    )
    print(f"{place}: {', '.join(f'{count} {name}' for name, count in report.counts.items())}; {report.cost}")
