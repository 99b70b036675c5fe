"""The project folder and its settings, as commands find them."""

import os
from pathlib import Path

from hoidata.errors import MissingResource


def enter_project() -> Path:
    """Make the project folder (the nearest one with dvc.yaml, from here upwards) the current folder; returns it.

    Raises MissingResource outside of any project.
    """
    here = Path.cwd()
    for folder in (here, *here.parents):
        if (folder / "dvc.yaml").is_file() and (folder / "params.yaml").is_file():
            os.chdir(folder)
            return folder
    raise MissingResource(f"no hoidata project (a folder with dvc.yaml) at or above {here}; change into one")


def current_profile() -> str:
    """The profile params.yaml chooses."""
    from pipelines.lineage.graph import read_params

    return read_params(Path())["profile"]


def set_profile(profile: str) -> bool:
    """Set the profile line of params.yaml, comments untouched; False when it said so already."""
    path = Path("params.yaml")
    lines = path.read_text().splitlines(keepends=True)
    changed = [f"profile: {profile}\n" if line.startswith("profile:") else line for line in lines]
    if changed == lines:
        return False
    path.write_text("".join(changed))
    return True


def remember_root(name: str, root: Path) -> None:
    """Note a raw folder in hoidata.toml, which version control ignores; its other sections stay."""
    import json
    import re
    import tomllib

    path = Path("hoidata.toml")
    text = path.read_text() if path.is_file() else ""
    settings = tomllib.loads(text)
    roots = {**settings.get("roots", {}), name: str(root)}
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in sorted(roots.items())]
    head = "# Where your raw files lie. Written by `hoidata raw scan`.\n[roots]\n"
    others = re.sub(rf"({re.escape(head)}|^\[roots\]\n)[^\[]*", "", text, flags=re.MULTILINE)
    path.write_text(f"{others.rstrip()}\n\n".lstrip() + head + "".join(lines))
