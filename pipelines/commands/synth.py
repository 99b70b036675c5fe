"""``hoidata synth``: the generated corpora of the profiles embedded and study."""

from pathlib import Path
from typing import Annotated

import typer

from hoidata.errors import MissingResource
from pipelines.commands.project import enter_project

app = typer.Typer(no_args_is_help=True)
Dataset = Annotated[str, typer.Argument(help="h2o, grab or arctic. Default: all corpora of the profile.")]
Profile = Annotated[str, typer.Option(help="Profile: embedded or study.")]


@app.command()
def write(dataset: Dataset = "", profile: Profile = "embedded") -> None:
    """Write the raw files of a profile's corpora again, from their committed recipes."""
    enter_project()
    from pipelines.lineage.manifests import read_manifest
    from pipelines.stages.base import StagePaths
    from pipelines.stages.raw import write_generated

    for name in _chosen(dataset, profile):
        paths = StagePaths(profile, name)
        write_generated(paths, read_manifest(paths.manifest), paths.generated_raw)
        typer.echo(f"{name}: written to {paths.generated_raw}")


def _chosen(dataset: str, profile: str) -> list[str]:
    from pipelines.lineage.manifests import read_manifest

    committed = [read_manifest(path) for path in sorted(Path("manifests", profile).glob("*.json"))]
    generated = [item.dataset for item in committed if item.present and "size" in (item.recipe or {})]
    if not generated or (dataset and dataset not in generated):
        existing = ", ".join(generated) or "none"
        raise MissingResource(f"the profile {profile} has no corpus {dataset!r}; it has {existing}")
    return [dataset] if dataset else generated
