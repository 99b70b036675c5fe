"""The folder with what belongs to this machine and is not in git: hoidata.toml, generated raw files, new manifests."""

import os
from pathlib import Path

SETTINGS = "hoidata.toml"


def machine_folder() -> Path:
    """The current folder, a project, except in an experiment that DVC runs in a temporary copy.

    ``dvc exp run --temp`` and ``--queue`` copy what git knows to a folder below ``.dvc/tmp``. There it is the project
    the copy was made from, which DVC names in DVC_ROOT.
    """
    root = os.environ.get("DVC_ROOT")
    return Path(root) if root and Path.cwd().is_relative_to(Path(root).resolve() / ".dvc/tmp") else Path()
