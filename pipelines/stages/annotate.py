"""Stage annotate: hand type, sentences and text features of every clip."""

from pipelines.stages.base import Place, StageParams, empty_reason, load_hands, load_params, write_empty


class AnnotateParams(StageParams):
    """encoder: a name for ``load_encoder``. A hand acts below ``threshold_m`` of one of ``points`` object points."""

    encoder: str
    threshold_m: float
    points: int


def run(place: Place) -> None:
    """Annotate every clip; a dataset without clips gives an empty output."""
    params = load_params(AnnotateParams, "annotate")
    if reason := empty_reason(place.clips):
        write_empty(place.annotation, reason)
        return
    annotate(place, params)


def annotate(place: Place, params: AnnotateParams) -> None:
    """Clips to words."""
    from hoidata.annotation.stage import annotate_store
    from hoidata.quality.verdicts import left_out_reasons

    counts = annotate_store(
        place.clips,
        place.annotation,
        encoder=params.encoder,
        threshold_m=params.threshold_m,
        points=params.points,
        hands=load_hands(place.profile),
        left_out=left_out_reasons(place.quality),
    )
    print(f"{place}: {', '.join(f'{count} {name}' for name, count in counts.items())}")
