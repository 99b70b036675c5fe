"""``hoidata synth``: the corpora of the profiles embedded and study."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from hoidata.errors import BadInput, MissingResource
from pipelines.commands.project import enter_project

app = typer.Typer(no_args_is_help=True)
Dataset = Annotated[str, typer.Argument(help="h2o, grab or arctic; all the profile has when left out.")]
Profile = Annotated[str, typer.Option(help="embedded or study.")]


@app.command()
def write(dataset: Dataset = "", profile: Profile = "embedded") -> None:
    """Write the raw trees of a profile's corpora anew, as their committed recipes say."""
    enter_project()
    from pipelines.lineage.manifests import read_manifest
    from pipelines.stages.base import StagePaths
    from pipelines.stages.raw import write_generated

    for name in _chosen(dataset, profile):
        paths = StagePaths(profile, name)
        write_generated(paths, read_manifest(paths.manifest), paths.generated_raw)
        typer.echo(f"{name}: written to {paths.generated_raw}")


@app.command()
def check(
    size: Annotated[str, typer.Option(help="full or small: of embedded; study or study-small.")] = "full",
    seed: Annotated[int, typer.Option(help="Seed of the corpora.")] = 0,
) -> None:
    """Make the corpora anew and measure them: contact forces, distances, penetration, controls. Exit code 1 if unsound.

    Sound: at least 98 % of held frames pass, hands stay within 20 mm of the object and less than 10 mm inside it.
    """
    import numpy as np

    from hoidata.synthetic.check import as_text, check_corpus
    from hoidata.synthetic.corpus import SIZES
    from pipelines.stages.base import jobs

    if size not in SIZES:
        raise BadInput("--size", " or ".join(SIZES), size, "correct it")
    figures = check_corpus(size, seed, jobs())
    Console().print(as_text(figures))
    sound = np.asarray(
        (figures["pass %"] >= 98)
        & (figures["largest hand-object distance mm"] < 20)
        & (figures["largest penetration mm"] < 10)
    )
    raise typer.Exit(0 if sound.all() else 1)


def _chosen(dataset: str, profile: str) -> list[str]:
    from pipelines.lineage.manifests import read_manifest

    committed = [read_manifest(path) for path in sorted(Path("manifests", profile).glob("*.json"))]
    generated = [item.dataset for item in committed if item.present and "size" in (item.recipe or {})]
    if not generated or (dataset and dataset not in generated):
        raise MissingResource(
            f"the profile {profile} has no corpus {dataset!r}; it has {', '.join(generated) or 'none'}"
        )
    return [dataset] if dataset else generated
