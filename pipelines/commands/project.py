"""The project folder and its settings, as commands find them."""

import json
import os
import re
import tomllib
from pathlib import Path

from hoidata.errors import BadInput, MissingResource
from pipelines.params import read_params

PROFILE = re.compile(r"^profile: *\S+", re.MULTILINE)


def enter_project() -> Path:
    """Make the project folder (the nearest one with dvc.yaml, from here upwards) the current folder; returns it.

    Raises MissingResource outside of any project.
    """
    here = Path.cwd()
    for folder in (here, *here.parents):
        if (folder / "dvc.yaml").is_file() and (folder / "params.yaml").is_file():
            os.chdir(folder)
            return folder
    raise MissingResource(
        f"no hoidata project (a folder with dvc.yaml) at or above {here}; change into one, or `hoidata init DIR`"
    )


def current_profile() -> str:
    """The profile params.yaml chooses."""
    return read_params(Path())["profile"]


def set_profile(profile: str) -> bool:
    """Set the profile in params.yaml, a change that git and DVC see as any other; False when it said so already."""
    path = Path("params.yaml")
    if current_profile() == profile:
        return False
    text, changed = PROFILE.subn(f"profile: {profile}", path.read_text(), count=1)
    if not changed:
        raise BadInput(path, "a line `profile: NAME`", "none", "add it at the top of the file")
    path.write_text(text)
    return True


def remember_root(name: str, root: Path) -> None:
    """Note a raw folder in hoidata.toml, which version control ignores; its other sections stay."""
    path = Path("hoidata.toml")
    text = path.read_text() if path.is_file() else ""
    settings = tomllib.loads(text)
    roots = {**settings.get("roots", {}), name: str(root)}
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in sorted(roots.items())]
    head = "# Where your raw files lie. Written by `hoidata raw scan`.\n[roots]\n"
    others = re.sub(rf"({re.escape(head)}|^\[roots\]\n)[^\[]*", "", text, flags=re.MULTILINE)
    path.write_text(f"{others.rstrip()}\n\n".lstrip() + head + "".join(lines))
