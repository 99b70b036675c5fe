"""``hoidata synth``: the generated corpora of the profiles embedded and study."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from hoidata.errors import BadInput, MissingResource
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


@app.command()
def check(
    size: Annotated[
        str, typer.Option(help="Corpus to generate: full or small (embedded), study or study-small (study).")
    ] = "full",
    seed: Annotated[int, typer.Option(help="Random seed of the corpora.")] = 0,
) -> None:
    """Generate the corpora and measure contact forces, distances, penetration and controls.

    The exit code is 0 if forces explain at least 98 % of the grasped frames, hands stay within 20 mm of the object, and
    penetrate it by less than 10 mm. Else it is 1.
    """
    import numpy as np

    from hoidata.synthetic.check import as_text, check_corpus
    from hoidata.synthetic.corpus import SIZES
    from pipelines.stages.base import jobs

    if size not in SIZES:
        raise BadInput("--size", " or ".join(SIZES), size, "correct it")
    measures = check_corpus(size, seed, jobs())
    Console().print(as_text(measures))
    is_near = measures["largest hand-object distance mm"] < 20
    sound = (measures["pass %"] >= 98) & is_near & (measures["largest penetration mm"] < 10)
    raise typer.Exit(0 if np.asarray(sound).all() else 1)


def _chosen(dataset: str, profile: str) -> list[str]:
    from pipelines.lineage.manifests import read_manifest

    committed = [read_manifest(path) for path in sorted(Path("manifests", profile).glob("*.json"))]
    generated = [item.dataset for item in committed if item.present and "size" in (item.recipe or {})]
    if not generated or (dataset and dataset not in generated):
        existing = ", ".join(generated) or "none"
        raise MissingResource(f"the profile {profile} has no corpus {dataset!r}; it has {existing}")
    return [dataset] if dataset else generated
