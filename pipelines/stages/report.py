"""Stage report: one page over all datasets of a profile, with a motion generated for a held-out sentence of each."""

from pathlib import Path

from pipelines.lineage.graph import read_params
from pipelines.stages.base import Place, StageParams, load_hands, load_params


class ReportParams(StageParams):
    """seed: of the generated motions."""

    seed: int


def run(place: Place) -> None:
    """Write the page; datasets without clips are listed with their reason."""
    from hoidata.files.atomic import atomic_folder
    from pipelines.pages.report import write_report

    params, hands = load_params(ReportParams, "report"), load_hands(place.profile)
    datasets = read_params(Path())["datasets"]
    with atomic_folder(place.report) as part:
        write_report(part, place.profile, datasets, hands, seed=params.seed)
