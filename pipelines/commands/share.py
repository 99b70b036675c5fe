"""``hoidata share``: whether ``dvc push`` sends data derived from the raw files.

Derived outputs have a separate address: a folder in the shared remote, next to its other files. DVC keeps an index per
address, and does not notice when an output moves to another remote with the same address. So an address must either
always or never have derived outputs.
"""

from pathlib import Path
from typing import Annotated, Any

import typer

from hoidata.errors import MissingResource
from pipelines.commands.project import current_profile, enter_project
from pipelines.params import read_params

# The remote of all derived outputs. In .dvc/config it is the local cache, so that nothing is sent. Also the name of
# their folder on a shared remote.
DERIVED = "derived"


def share(
    on: Annotated[
        bool, typer.Option("--on/--off", help="Whether `dvc push` sends derived data and `dvc pull` fetches it.")
    ],
) -> None:
    """Choose whether `dvc push` sends clips and data derived from them, or keeps them on this machine (the default).

    The choice is stored in this copy of the project only; a clone needs `--on` before `dvc pull` fetches the data. Most
    of these datasets forbid sharing derived data. You are responsible for keeping their licences.
    """
    enter_project()
    for line in _terms() if on else ():
        typer.echo(line)
    from dvc.config import Config

    config: Any = Config(dvc_dir=str(Path(".dvc").absolute()))
    if on:
        choice = f"goes to {_share_derived(config)}"
    else:
        choice = "stays here"
        with config.edit("local") as local:
            local["remote"].pop(DERIVED, None)
    typer.echo(f".dvc/config.local: derived data {choice}")


def _share_derived(config: Any) -> str:
    """Set the remote of derived outputs to a folder of the project's default remote. Returns its address."""
    name = config["core"].get("remote")
    if name is None:
        raise MissingResource("no remote to share with; add one first: `dvc remote add --default NAME ADDRESS`")
    shared = config["remote"][name]
    address = f"{str(shared['url']).rstrip('/')}/{DERIVED}"
    with config.edit("local") as local:
        local["remote"][DERIVED] = {**shared, "url": address}
    return address


def _terms() -> list[str]:
    """One line per dataset of the current profile whose licence forbids sharing derived data."""
    from pipelines.stages.adapters import manifest_of
    from pipelines.stages.base import StagePaths

    runs = [StagePaths(current_profile(), name) for name in read_params(Path())["datasets"]]
    manifests = [manifest_of(paths) for paths in runs]
    return [f"{item.dataset}: {item.licence}" for item in manifests if item.present and not item.may_be_shared]
