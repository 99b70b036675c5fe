"""Stage annotate: hand type, sentences and text features of every clip."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from pipelines.stages.base import Place, StageParams, empty_reason, load_hands, load_params, write_empty

# Text features of earlier runs, of all datasets and profiles; they spare time and change no output.
FEATURES = Path(".hoidata", "features")


class VariationParams(StageParams):
    """per_clip: sentences beyond the four forms. adverbs: clips of measured slow or quick hands may say so."""

    per_clip: int = Field(ge=0)
    adverbs: bool


class AnnotateParams(StageParams):
    """encoder: a name for ``load_encoder``. A hand acts below ``threshold_m`` of one of ``points`` object points.

    forms: the paper's four sentences in our English, or as the reference implementation writes them. derive_verbs: a
    clip whose source names no verb gets the one its motion shows.
    """

    encoder: str
    threshold_m: float
    points: int
    forms: Literal["paper", "reference"]
    variations: VariationParams
    derive_verbs: bool


def run(place: Place) -> None:
    """Annotate every clip; a dataset without clips gives an empty output."""
    params = load_params(AnnotateParams, "annotate")
    if reason := empty_reason(place.clips):
        write_empty(place.annotation, reason)
        return
    annotate(place, params)


def annotate(place: Place, params: AnnotateParams) -> None:
    """Clips to words."""
    from hoidata.annotation.clip_variations import VariationSettings
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
        forms=params.forms,
        variations=VariationSettings(**params.variations.model_dump()),
        features=FEATURES,
        derive_verbs=params.derive_verbs,
    )
    print(f"{place}: {', '.join(f'{count} {name}' for name, count in counts.items())}")
