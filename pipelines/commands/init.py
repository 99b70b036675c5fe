"""``hoidata init``: create a project folder that uses the installed hoidata."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from hoidata.errors import BadInput
from hoidata.package_paths import FOLDER
from pipelines.commands.project import PROFILE

FILES = ("params.yaml", "prefect.toml", ".dvcignore", ".gitignore", ".dvc/config", ".dvc/.gitignore")
APPENDED = (".gitignore",)  # a repository may have one already
GRAPHS = ("dvc.yaml", "pipelines/dvc.yaml", "models/*/dvc.yaml")
PATTERNS = ("manifests/embedded/*.json", "manifests/study/*.json", *GRAPHS)
# In a clone the stages run the clone's code, in a project of `init` that of the installation.
IN_CLONE, INSTALLED = "python -m pipelines.stages", "python -m hoidata stage"


def init(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of the project; it may have other files.", resolve_path=True)
    ],
) -> None:
    """Create a project with the graph, its settings, and manifests of the generated corpora."""
    files = [path.relative_to(FOLDER) for path in _project_files()]
    if existing := [str(path) for path in files if path.name not in APPENDED and (folder / path).exists()]:
        raise BadInput(folder, "a folder without a project", ", ".join(existing[:3]), "choose another folder")
    for path in files:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        with open(folder / path, "a") as stream:
            stream.write((FOLDER / path).read_text().replace(IN_CLONE, INSTALLED))
    params, config = folder / "params.yaml", folder / ".dvc/config"
    params.write_text(PROFILE.sub("profile: embedded", params.read_text(), count=1))
    if not _in_repository(folder):
        config.write_text(config.read_text().replace("[core]\n", "[core]\n    no_scm = true\n"))
    typer.echo(
        f"{folder}: new project. Change into it and run `hoidata repro`, or `hoidata repro convert@embedded-grab`"
    )


def _project_files() -> Iterator[Path]:
    yield from (FOLDER / name for name in FILES)
    for pattern in PATTERNS:
        yield from sorted(FOLDER.glob(pattern))


def _in_repository(folder: Path) -> bool:
    """Whether the folder is in a git repository; creates one if it is not, and git is installed."""
    try:
        result = subprocess.run(["git", "rev-parse", "--is-inside-work-tree"], cwd=folder, capture_output=True)
        return not (result.returncode and subprocess.run(["git", "init", "--quiet"], cwd=folder).returncode)
    except OSError:
        return False
