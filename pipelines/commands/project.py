"""The project folder and its settings, as commands find them."""

import json
import os
import re
import subprocess
import tomllib
from pathlib import Path

from hoidata.errors import MissingResource
from pipelines.params import PROFILES, read_params

PROFILE = re.compile("^profile: .*", re.MULTILINE)
FILTER = "hoidata-profile"
CHOSEN = "hoidata-profile.sed"


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
    """Set the profile line of params.yaml, for this copy of the project alone; False when it said so already."""
    path = Path("params.yaml")
    text, before = path.read_text(), current_profile()
    _keep_profile_from_git(profile)
    if before != profile:
        path.write_text(PROFILE.sub(profile_line(profile), text, count=1))
    return before != profile


def profile_line(profile: str) -> str:
    """Equally long for all profiles: git looks closer at a file of the same size before it calls it changed."""
    return f"profile: {profile}  # or {', '.join(name for name in PROFILES if name != profile)}"


def _keep_profile_from_git(profile: str) -> None:
    """A filter of this clone (see gitattributes): git stores the line as delivered and checks out what is chosen."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], check=True, capture_output=True, text=True).stdout.strip()

    try:
        chosen = Path(git("rev-parse", "--git-path", CHOSEN))
    except (OSError, subprocess.CalledProcessError):
        return  # no git here, no work tree to keep clean
    chosen.write_text(f"s/{PROFILE.pattern}/{profile_line(profile)}/\n")
    git("config", f"filter.{FILTER}.clean", f"sed -e 's/{PROFILE.pattern}/{profile_line('embedded')}/'")
    git("config", f"filter.{FILTER}.smudge", f'sed -e "$(cat "$(git rev-parse --git-path {CHOSEN})" 2>/dev/null)"')


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
