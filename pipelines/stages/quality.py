"""Stage quality: every clip and object mesh measured and judged; what fails is left out of annotation and training."""

from pipelines.stages.base import Place, StageParams, empty_reason, jobs, load_hands, load_params, write_empty


class LimitParams(StageParams):
    """A measure above ``warn`` is reported; above ``leave_out`` its clip is not used. None: never."""

    warn: float | None
    leave_out: float | None


class QualityParams(StageParams):
    """The fields of ``hoidata.quality.thresholds.Thresholds``; limits: one for every measure."""

    penetration_every: int
    too_deep_m: float
    shaking_m_s2: float
    sudden_m: float
    sudden_ratio: float
    large_m: float
    offset_confidence: float
    limits: dict[str, LimitParams]


def run(place: Place) -> None:
    """Measure and judge every clip; a dataset without clips gives an empty output."""
    params = load_params(QualityParams, "quality")
    if reason := empty_reason(place.clips):
        write_empty(place.quality, reason)
        return
    judge(place, params)


def judge(place: Place, params: QualityParams) -> None:
    """Clips to measures and verdicts."""
    from hoidata.quality.stage import quality_store
    from hoidata.quality.thresholds import Limit, Thresholds

    limits = {name: Limit(limit.warn, limit.leave_out) for name, limit in params.limits.items()}
    thresholds = Thresholds(**params.model_dump(exclude={"limits"}), limits=limits)
    counts = quality_store(
        place.clips, place.quality, thresholds=thresholds, hands=load_hands(place.profile), jobs=jobs()
    )
    print(f"{place}: {', '.join(f'{count} {name}' for name, count in counts.items())}")
