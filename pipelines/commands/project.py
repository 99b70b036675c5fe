"""The project folder, its profile, and the hand model that a command uses."""

import json
import os
import re
import sys
import tomllib
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from hoidata.errors import BadInput, MissingResource
from pipelines.params import read_params

if TYPE_CHECKING:
    from rich.console import Console

    from hoidata.hands import HandPair

PROFILE = re.compile(r"^profile: *\S+", re.MULTILINE)


def table_console(width: int = 140) -> "Console":
    """A console as wide as the terminal, else ``width`` characters."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else width)


def enter_project() -> Path:
    """Change into the project folder, the nearest one with dvc.yaml at or above the current folder, and return it.

    Raises MissingResource outside of a project.
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
    """The profile that params.yaml chooses."""
    return read_params(Path())["profile"]


def set_profile(profile: str) -> bool:
    """Set the profile in params.yaml. Returns False if it was set already."""
    path = Path("params.yaml")
    if current_profile() == profile:
        return False
    text, changed = PROFILE.subn(f"profile: {profile}", path.read_text(), count=1)
    if not changed:
        raise BadInput(path, "a line `profile: NAME`", "none", "add it at the top of the file")
    path.write_text(text)
    return True


def remember_root(name: str, root: Path) -> None:
    """Register a raw folder in hoidata.toml, which git ignores; other sections stay unchanged."""
    path = Path("hoidata.toml")
    text = path.read_text() if path.is_file() else ""
    settings = tomllib.loads(text)
    roots = {**settings.get("roots", {}), name: str(root)}
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in sorted(roots.items())]
    head = "# Where your raw files lie. Written by `hoidata raw scan`.\n[roots]\n"
    # The section ends at the next line, not character, that begins with a bracket: a path may have one.
    others = re.sub(rf"({re.escape(head)}|^\[roots\]\n)(?:(?!\[).*\n?)*", "", text, flags=re.MULTILINE)
    path.write_text(f"{others.rstrip()}\n\n".lstrip() + head + "".join(lines))


def chosen_hands(choice: str) -> "HandPair":
    """The hand model for "embedded", for a folder of MANO files, or for "": registered MANO files, else embedded."""
    from hoidata.hands import load_embedded_hands, load_mano_hands
    from pipelines.stages.base import HAND, registered_root

    folder = Path(choice) if choice not in ("", "embedded") else (registered_root(HAND) if not choice else None)
    return load_embedded_hands() if folder is None else load_mano_hands(folder)


def store_in(data: Path) -> Path:
    """The store of an annotated dataset; a store itself is returned."""
    return data if (data / "meta").is_dir() else data / "clips"


def hands_of_data(data: Path) -> "HandPair":
    """The hand model of a store or annotated dataset: the embedded one, or the user's MANO files."""
    from hoidata.store.store import read_info

    digest = read_info(store_in(data))["hand_model"]["digest"]
    with suppress(MissingResource):
        enter_project()  # its hoidata.toml names the user's MANO files
    return hands_of(digest, str(data))


def hands_of(digest: str, source: str) -> "HandPair":
    """The hand model with a digest: the embedded one, or the user's MANO files. Raises MissingResource if neither has.

    Args:
        source: the store or folder of checkpoints that was made with it, for the error message.
    """
    candidates = (chosen_hands(choice) for choice in ("embedded", ""))  # MANO files are read only if needed
    matching = next((hands for hands in candidates if hands.digest == digest), None)
    if matching is None:
        raise MissingResource(
            f"{source} was made with a hand ({digest[:12]}) that is not here; name the folder of the MANO files in "
            "HOIDATA_MANO, or register it in a project: `hoidata raw scan mano --root FOLDER`"
        )
    return matching
