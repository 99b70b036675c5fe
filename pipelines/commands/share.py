"""``hoidata share``: whether ``dvc push`` sends what was made from the data."""

import re
from pathlib import Path
from typing import Annotated

import typer

from pipelines.commands.project import current_profile, enter_project

LINE = re.compile(r"^( +push: )(true|false)$", re.MULTILINE)


def share(
    on: Annotated[bool, typer.Option("--on/--off", help="Let `dvc push` send it, or keep it here.")],
) -> None:
    """Let `dvc push` send clips and everything made from them, or keep them on this machine (as delivered).

    Most of these datasets forbid passing on what is derived from them. Whether you may is yours to know.
    """
    enter_project()
    path = Path("dvc.yaml")
    text, count = LINE.subn(rf"\g<1>{'true' if on else 'false'}", path.read_text())
    path.write_text(text)
    for line in _terms() if on else ():
        typer.echo(line)
    typer.echo(f"dvc.yaml: push set to {'true' if on else 'false'} in {count} outputs")


def _terms() -> list[str]:
    """One line per dataset of the current profile whose licence does not let derived data be passed on."""
    from pipelines.lineage.graph import read_params
    from pipelines.stages.adapters import manifest_of
    from pipelines.stages.base import Place

    places = [Place(current_profile(), name) for name in read_params(Path())["datasets"]]
    bound = [manifest for place in places if (manifest := manifest_of(place)).present]
    return [f"{item.dataset}: {item.licence}" for item in bound if not item.may_be_shared]
