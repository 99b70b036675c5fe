"""``hoidata init``: a project of one's own, beside an installed hoidata."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from hoidata.errors import BadInput
from hoidata.package_paths import FOLDER
from pipelines.commands.project import PROFILE

FILES = ("params.yaml", "prefect.toml", ".dvcignore", ".gitignore", ".dvc/config", ".dvc/.gitignore")
ADDED_TO = (".gitignore",)  # a repository may have its own
GRAPHS = ("dvc.yaml", "pipelines/dvc.yaml", "models/*/dvc.yaml")
PATTERNS = ("manifests/embedded/*.json", "manifests/study/*.json", *GRAPHS)
# In a clone the stages run the code that lies there, in a project of `init` that of the installation.
IN_CLONE, INSTALLED = "python -m pipelines.stages", "python -m hoidata stage"


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where; it may hold other things.", resolve_path=True)],
) -> None:
    """Make a project: the graph, its settings, and manifests of the corpora that are made here. Then: hoidata repro."""
    files = [path.relative_to(FOLDER) for path in _delivered()]
    if taken := [str(path) for path in files if path.name not in ADDED_TO and (folder / path).exists()]:
        raise BadInput(folder, "a folder without a project", ", ".join(taken[:3]), "choose another folder")
    for path in files:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        with open(folder / path, "a") as stream:
            stream.write((FOLDER / path).read_text().replace(IN_CLONE, INSTALLED))
    params, config = folder / "params.yaml", folder / ".dvc/config"
    params.write_text(PROFILE.sub("profile: embedded", params.read_text(), count=1))
    if not _in_repository(folder):
        config.write_text(config.read_text().replace("[core]\n", "[core]\n    no_scm = true\n"))
    typer.echo(f"{folder}: a project. Go there, then `hoidata repro`, or a part: `hoidata repro convert@embedded-grab`")


def _delivered() -> Iterator[Path]:
    yield from (FOLDER / name for name in FILES)
    for pattern in PATTERNS:
        yield from sorted(FOLDER.glob(pattern))


def _in_repository(folder: Path) -> bool:
    """Whether the folder is in a git repository; where it is in none, one is made, if git is there."""
    try:
        done = subprocess.run(["git", "rev-parse", "--is-inside-work-tree"], cwd=folder, capture_output=True)
        return not (done.returncode and subprocess.run(["git", "init", "--quiet"], cwd=folder).returncode)
    except OSError:
        return False
