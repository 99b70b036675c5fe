"""params.yaml as the chosen profile has it: ``profiles.<profile>`` laid over the sections of the same names."""

import re
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.settings import Section, as_section, laid_over, refuse_unknown

# embedded and study: made here, two corpora for two ends; own: the user's files.
PROFILES = ("embedded", "study", "own")
MOST_NESTED = 2000
KEYS = "params.yaml: "
# dvc.yaml itself reads these to write its stages out, from the top of params.yaml alone.
TEMPLATED = (
    *("profile", "profiles", "datasets", "families", "family_datasets", "train.preset", "train.size"),
    *("tables.datasets", "tables.runs"),
)


def read_params(root: Path) -> dict[str, Any]:
    """All sections of the project's params.yaml, as the profile it chooses has them."""
    return chosen_params(read_file(root / "params.yaml"))


def read_file(path: Path) -> dict[str, Any]:
    """params.yaml as it stands there, overlays apart under ``profiles``. Raises BadInput for what is no such file."""
    try:
        values = load_yaml(path.read_bytes())
    except (ValueError, RecursionError, OSError) as error:
        raise BadInput(path, "YAML text", str(error)[:300], "correct it, or restore it with git checkout") from error
    if not isinstance(values, dict):
        raise BadInput(path, "sections with a name each", type(values).__name__, "restore it with git checkout")
    return values


def load_yaml(text: bytes) -> Any:
    """The value of YAML text as DVC reads it: YAML 1.2, in which ``1e-05`` is a number and ``on`` is text.

    Raises ValueError for anything else, RecursionError where the nesting is too deep: the parser in C would end this
    process, so such text is given to the one in Python.
    """
    from ruamel.yaml import YAML, YAMLError

    deep = text.count(b"[") + text.count(b"{") > MOST_NESTED or re.search(rb"[ ?-]{%d}" % MOST_NESTED, text)
    try:
        return YAML(typ="safe", pure=bool(deep)).load(text)
    except (YAMLError, LookupError, TypeError, AttributeError) as error:  # of a tag that does not fit its text
        raise ValueError(str(error)) from error


def chosen_params(values: dict[str, Any]) -> Section:
    """The sections with the chosen profile's overlay: mappings are merged, lists and single values replaced.

    Every entry keeps its full key in the file for error messages. Raises BadInput for a profile or section that is not
    known, and for what dvc.yaml cannot read from an overlay.
    """
    sections = {name: value for name, value in values.items() if name != "profiles"}
    overlays = _mapping(values.get("profiles"), "params.yaml: profiles")
    refuse_unknown(overlays, PROFILES, "params.yaml: profiles")
    for profile, overlay in overlays.items():
        _check(_mapping(overlay, f"params.yaml: profiles.{profile}"), sections, f"params.yaml: profiles.{profile}")
    chosen = _mapping(overlays.get(str(values.get("profile"))), "params.yaml: profiles")
    said = {name: value for name, value in chosen.items() if value is not None}
    return laid_over(as_section(sections, KEYS), as_section(said, f"{KEYS}profiles.{values.get('profile')}."))


def _check(overlay: dict[str, Any], sections: dict[str, Any], where: str) -> None:
    for key in TEMPLATED:
        section, _, name = key.partition(".")
        if section in overlay and (not name or name in _mapping(overlay[section], f"{where}.{section}")):
            remedy = "set it at the top of params.yaml, for all profiles"
            raise BadInput(f"{where}.{key}", "settings of a stage", "what dvc.yaml writes its stages from", remedy)
    refuse_unknown(overlay, [name for name in sections if name not in TEMPLATED], where)
    for name, value in overlay.items():
        if isinstance(sections[name], dict):
            _mapping(value, f"{where}.{name}")


def _mapping(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict | None):
        raise BadInput(where, "keys with values", repr(value)[:80], "correct it")
    return value or {}
