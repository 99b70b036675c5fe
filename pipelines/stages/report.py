"""Stage report: one page about all datasets of a profile, with a generated motion for a held-out sentence of each."""

from pathlib import Path

from pipelines.params import read_params
from pipelines.stages.base import StagePaths, load_hands
from pipelines.stages.families import families_of


def run(paths: StagePaths) -> None:
    """Write the page; datasets without clips are listed with their reason."""
    from hoidata.files.atomic import atomic_folder
    from pipelines.metrics_files import write_dvc_plots
    from pipelines.pages.report import ReportFolders, write_report

    params = read_params(Path())
    with atomic_folder(paths.report) as partial:
        families = {dataset: families_of(params, dataset) for dataset in params["datasets"]}
        folders = ReportFolders.of(paths.profile)
        write_report(partial, paths.profile, families, load_hands(paths.profile), folders)
        write_dvc_plots(partial, folders.metrics, folders.checkpoints, families)
