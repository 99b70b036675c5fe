"""``hoidata share``: whether ``dvc push`` sends what was made from the data."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hoidata.errors import MissingResource
from pipelines.commands.project import current_profile, enter_project
from pipelines.params import read_params

# The remote all derived outputs belong to: by .dvc/config the cache they lie in, so that nothing is sent.
DERIVED = "derived"


def share(
    on: Annotated[bool, typer.Option("--on/--off", help="Let `dvc push` send it, or keep it here.")],
) -> None:
    """Let `dvc push` send clips and everything made from them, or keep them on this machine (as delivered).

    Most of these datasets forbid passing on what is derived from them. Whether you may is yours to know.
    """
    enter_project()
    for line in _terms() if on else ():
        typer.echo(line)
    typer.echo(f".dvc/config.local: what is derived from data {f'goes to {_lead_out()}' if on else _keep_here()}")


def _lead_out() -> str:
    """Make the project's default remote, with all its options, that of derived outputs too; returns its address."""
    config = _config()
    name = config["core"].get("remote")
    if name is None:
        raise MissingResource("no remote to share with; add one first: `dvc remote add --default NAME ADDRESS`")
    with config.edit("local") as local:
        local["remote"][DERIVED] = dict(config["remote"][name])
    return str(config["remote"][name]["url"])


def _keep_here() -> str:
    with _config().edit("local") as local:
        local["remote"].pop(DERIVED, None)
    return "stays here"


def _config() -> Any:
    from dvc.config import Config

    return Config(dvc_dir=str(Path(".dvc").absolute()))


def _terms() -> list[str]:
    """One line per dataset of the current profile whose licence does not let derived data be passed on."""
    from pipelines.stages.adapters import manifest_of
    from pipelines.stages.base import StagePaths

    runs = [StagePaths(current_profile(), name) for name in read_params(Path())["datasets"]]
    bound = [manifest for paths in runs if (manifest := manifest_of(paths)).present]
    return [f"{item.dataset}: {item.licence}" for item in bound if not item.may_be_shared]
