"""params.yaml with the overlay of the chosen profile: ``profiles.<profile>`` overrides the other sections."""

import re
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.settings import Section, check_keys, merge_settings, to_section

# embedded and study are generated corpora; own has the user's files.
PROFILES = ("embedded", "study", "own")
MAX_NESTING = 2000
KEYS = "params.yaml: "
# Keys that the templates of dvc.yaml use. DVC reads them from the top level, so a profile cannot override them.
TEMPLATED = ("profile", "profiles", "datasets", "families", "family_datasets", "train.preset", "train.size")


def read_params(root: Path) -> dict[str, Any]:
    """All sections of the project's params.yaml, with the overlay of the chosen profile."""
    return chosen_params(read_file(root / "params.yaml"))


def read_file(path: Path) -> dict[str, Any]:
    """The content of params.yaml, without applying overlays. Raises BadInput for a malformed file."""
    try:
        values = load_yaml(path.read_bytes())
    except (ValueError, RecursionError, OSError) as error:
        raise BadInput(path, "YAML text", str(error)[:300], "correct it, or restore it with git checkout") from error
    if not isinstance(values, dict):
        raise BadInput(path, "named sections", type(values).__name__, "restore it with git checkout")
    return values


def load_yaml(text: bytes) -> Any:
    """Parse YAML as DVC does: YAML 1.2, in which ``1e-05`` is a number and ``on`` is text.

    Raises ValueError if the text is not YAML, RecursionError if the nesting is too deep: the parser in C would crash on
    such text, so it goes to the one in Python.
    """
    from ruamel.yaml import YAML, YAMLError

    deep = text.count(b"[") + text.count(b"{") > MAX_NESTING or re.search(rb"[ ?-]{%d}" % MAX_NESTING, text)
    try:
        return YAML(typ="safe", pure=bool(deep)).load(text)
    except (YAMLError, LookupError, TypeError, AttributeError) as error:  # the last three: a tag does not fit its value
        raise ValueError(str(error)) from error


def chosen_params(values: dict[str, Any]) -> Section:
    """The sections with the chosen profile's overlay: mappings are merged, lists and single values replaced.

    Raises BadInput, with the full key in the file, for unknown profiles or sections and keys that none can override.
    """
    sections, path = {name: value for name, value in values.items() if name != "profiles"}, f"{KEYS}profiles"
    overlays = _mapping(values.get("profiles"), path)
    check_keys(overlays, PROFILES, path)
    for profile, overlay in overlays.items():
        _check_overlay(_mapping(overlay, f"{path}.{profile}"), sections, f"{path}.{profile}")
    chosen = _mapping(overlays.get(str(values.get("profile"))), path)
    overlay_values = {name: value for name, value in chosen.items() if value is not None}
    return merge_settings(to_section(sections, KEYS), to_section(overlay_values, f"{path}.{values.get('profile')}."))


def _check_overlay(overlay: dict[str, Any], sections: dict[str, Any], path: str) -> None:
    for key in TEMPLATED:
        section, _, name = key.partition(".")
        if section in overlay and (not name or name in _mapping(overlay[section], f"{path}.{section}")):
            remedy = "set it at the top of params.yaml, for all profiles"
            raise BadInput(f"{path}.{key}", "settings of a stage", "a key that dvc.yaml uses", remedy)
    check_keys(overlay, [name for name in sections if name not in TEMPLATED], path)
    for name, value in overlay.items():
        if isinstance(sections[name], dict):
            _mapping(value, f"{path}.{name}")


def _mapping(value: Any, path: str) -> dict[str, Any]:
    if not isinstance(value, dict | None):
        raise BadInput(path, "keys with values", repr(value)[:80], "correct it")
    return value or {}
