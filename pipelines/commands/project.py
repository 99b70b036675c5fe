"""The project folder, its settings and the hand to compute with, as commands find them."""

import json
import os
import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

from hoidata.errors import BadInput, MissingResource
from pipelines.params import read_params

if TYPE_CHECKING:
    from hoidata.hands import HandPair

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


def chosen_hands(choice: str) -> "HandPair":
    """``embedded``, or the folder of MANO's files; for nothing those that are registered, else the embedded one."""
    from hoidata.hands import load_embedded_hands, load_mano_hands
    from pipelines.stages.base import HAND, own_root

    folder = Path(choice) if choice not in ("", "embedded") else (own_root(HAND) if not choice else None)
    return load_embedded_hands() if folder is None else load_mano_hands(folder)


def hands_of(digest: str, what: str) -> "HandPair":
    """The hand of a digest that ``what`` was made with: the embedded one, or the user's MANO files.

    Raises MissingResource where it is neither.
    """
    each = (chosen_hands(choice) for choice in ("embedded", ""))  # the second is not looked for where the first fits
    found = next((hands for hands in each if hands.digest == digest), None)
    if found is None:
        raise MissingResource(
            f"{what} was made with a hand ({digest[:12]}) that is not here; name the folder of the MANO files in "
            "HOIDATA_MANO, or register it in a project: `hoidata raw scan mano --root FOLDER`"
        )
    return found
