"""``hoidata share``: whether ``dvc push`` sends what was made from the data.

Derived outputs have an address of their own, a folder beside the other files of the shared remote. DVC keeps an index
of what belongs to an address and does not notice when an output gets another remote with the same address; so no
address may ever hold derived outputs at one time and only the others at another.
"""

from pathlib import Path
from typing import Annotated, Any

import typer

from hoidata.errors import MissingResource
from pipelines.commands.project import current_profile, enter_project
from pipelines.params import read_params

# The remote of all derived outputs: by .dvc/config the cache they are stored in, so that nothing is sent. Also the name
# of their folder on a shared remote.
DERIVED = "derived"


def share(
    on: Annotated[bool, typer.Option("--on/--off", help="Let `dvc push` send it and `dvc pull` fetch it, or not.")],
) -> None:
    """Let `dvc push` send clips and everything made from them, or keep them on this machine (as delivered).

    The choice holds for this copy of the project; a clone needs `--on` too before `dvc pull` fetches them. Most of
    these datasets forbid passing on what is derived from them. Whether you may is yours to know.
    """
    enter_project()
    for line in _terms() if on else ():
        typer.echo(line)
    typer.echo(f".dvc/config.local: what is derived from data {f'goes to {_lead_out()}' if on else _keep_here()}")


def _lead_out() -> str:
    """Give derived outputs a folder of the project's default remote, with all its options; returns the address."""
    config = _config()
    name = config["core"].get("remote")
    if name is None:
        raise MissingResource("no remote to share with; add one first: `dvc remote add --default NAME ADDRESS`")
    shared = config["remote"][name]
    address = f"{str(shared['url']).rstrip('/')}/{DERIVED}"
    with config.edit("local") as local:
        local["remote"][DERIVED] = {**shared, "url": address}
    return address


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
