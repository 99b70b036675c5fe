"""The folder of untracked files of this machine: hoidata.toml, generated raw files, new manifests."""

import os
from pathlib import Path

SETTINGS = "hoidata.toml"


def machine_folder() -> Path:
    """The project folder: the current folder, or the original project of a DVC experiment.

    ``dvc exp run --temp`` and ``--queue`` run in a copy of the tracked files below ``.dvc/tmp``. DVC_ROOT is then the
    original project.
    """
    root = os.environ.get("DVC_ROOT")
    return Path(root) if root and Path.cwd().is_relative_to(Path(root).resolve() / ".dvc/tmp") else Path()
