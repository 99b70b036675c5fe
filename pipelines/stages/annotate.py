"""Stage annotate: hand type, sentences, text features and split of every clip."""

from typing import Literal

from pipelines.stages.base import Place, StageParams, empty_reason, load_hands, load_params, write_empty


class SplitParams(StageParams):
    """How one dataset is split: by named subjects, or in time where there is only one subject."""

    by: Literal["subject", "time", "rounds"]
    validation: tuple[str, ...] = ()
    test: tuple[str, ...] = ()


class AnnotateParams(StageParams):
    """encoder: a name for ``load_encoder``. A hand acts below ``threshold_m`` of one of ``points`` object points."""

    encoder: str
    threshold_m: float
    points: int
    split: dict[str, SplitParams]


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
    from hoidata.schema.splits import SplitRule

    rule = params.split.get(place.dataset)
    counts = annotate_store(
        place.clips,
        place.annotation,
        encoder=params.encoder,
        split=SplitRule(rule.by, rule.validation, rule.test) if rule else None,
        threshold_m=params.threshold_m,
        points=params.points,
        hands=load_hands(place.profile),
        left_out=left_out_reasons(place.quality),
    )
    print(f"{place}: {', '.join(f'{count} {name}' for name, count in counts.items())}")
