"""Stage split: the parts of every named split, the chosen one, its leak check, and the training statistics."""

from pydantic import ConfigDict

from pipelines.stages.base import Place, StageParams, empty_reason, load_params, write_empty


class SplitParams(StageParams):
    """Per dataset the name of a split, or a rule of the user's own (see ``hoidata.splits.SplitRule``)."""

    model_config = ConfigDict(extra="allow", frozen=True)


def run(place: Place) -> None:
    """Split the annotated clips; a dataset without clips gives an empty output."""
    params = load_params(SplitParams, "split")
    if reason := empty_reason(place.annotation):
        write_empty(place.splits, reason)
        return
    split(place, params)


def split(place: Place, params: SplitParams) -> None:
    """Clips and words to parts and statistics."""
    from hoidata.splits import split_store

    wanted = (params.model_extra or {}).get(place.dataset)
    counts = split_store(place.clips, place.annotation, place.splits, wanted)
    print(f"{place}: {', '.join(f'{count} {name}' for name, count in counts.items())}")
