"""Frozen settings dataclasses from plain mappings (params.yaml, a checkpoint) and back.

The dataclass is the one place of a setting's name, type and default; a mapping states only what differs.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, asdict, fields, is_dataclass
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from hoidata.errors import BadInput

Config = TypeVar("Config")
NONE = type(None)
# Old names of keys in params.yaml and their present names: a file with an old one is refused, the new one is named.
RENAMED_KEYS: dict[str, str] = {
    # BimArt
    "window": "window_frames",
    "map_of": "contact_map_target",
    "most_m": "max_distance_m",
    "floor": "min_std_fraction",
    "windows": "windows_per_clip",
    "rule": "guidance_rule",
    "guide": "contact_guidance",
    "guide_share": "contact_guidance_fraction",
    # ManipNet
    "keep": "keep_probability",
    "rows": "steps_per_clip",
    "astray": "perturbed_fraction",
}


class Section(dict[str, Any]):
    """Settings read from a file, with the full key of each entry: the file may hold them in other places than they are
    merged into. ``keys_in_file`` is for errors only.
    """

    keys_in_file: Mapping[str, str] = {}


def build_config(kind: type[Config], values: Mapping[str, Any] | None, where: str) -> Config:
    """``kind`` with the given values over its defaults; nested dataclasses and tuples are rebuilt.

    where: the section's name for errors. Raises BadInput for a key that ``kind`` does not have, listing those it has,
    for one without default that is missing, and for a value of another type.
    """
    values = _checked_mapping({} if values is None else values, where)
    known: dict[str, Field] = {item.name: item for item in fields(kind)}  # pyright: ignore[reportArgumentType]
    refuse_unknown(values, list(known), where)
    needed = [name for name, item in known.items() if item.default is MISSING and item.default_factory is MISSING]
    if missing := [name for name in needed if name not in values]:
        raise BadInput(where, f"a value for {', '.join(missing)}", "none", "give one")
    hints = get_type_hints(kind)
    built = {
        name: _value(hints[name], value, key_in_file(values, name, where), known[name])
        for name, value in values.items()
    }
    try:
        return kind(**built)
    except BadInput as error:  # a check of the dataclass itself, which does not know where its values come from
        name = error.where.rpartition(".")[2]
        place = key_in_file(values, name, where) if name in known else error.where
        raise BadInput(place, error.expected, error.got, error.remedy) from error


def as_section(values: Mapping[str, Any], prefix: str) -> Section:
    """``values`` of a file and the mappings inside, whose keys in the file begin with ``prefix``."""
    section = Section(
        (name, as_section(value, f"{prefix}{name}.") if isinstance(value, dict) else value)
        for name, value in values.items()
    )
    section.keys_in_file = {name: f"{prefix}{name}" for name in values}
    return section


def laid_over(base: Mapping[str, Any], overlay: Mapping[str, Any]) -> Section:
    """``base`` with the entries of ``overlay``: mappings are merged, other values replaced; each keeps its full key."""

    def value_of(name: str, value: Any) -> Any:
        both = isinstance(base.get(name), dict) and isinstance(value, dict)
        return laid_over(base[name], value) if both else value

    section = Section({**base, **{name: value_of(name, value) for name, value in overlay.items()}})
    section.keys_in_file = {**_keys_in_file(base), **_keys_in_file(overlay)}
    return section


def key_in_file(values: Mapping[str, Any], name: str, where: str) -> str:
    """The full key of an entry for an error message; where nothing else is known, ``name`` in the section ``where``."""
    return _keys_in_file(values).get(name) or f"{where}.{name}"


def _keys_in_file(values: Mapping[str, Any]) -> Mapping[str, str]:
    return values.keys_in_file if isinstance(values, Section) else {}


def at_least(where: str, config: Any, name: str, least: float) -> None:
    """Raise BadInput where the setting ``name`` of ``config`` is less than it may be."""
    if getattr(config, name) < least:
        raise BadInput(f"{where}.{name}", f"{least} or more", str(getattr(config, name)), "correct params.yaml")


def refuse_unknown(values: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    """Raise BadInput that names the keys that are not known and lists those that are."""
    if unknown := [str(name) for name in values if name not in known]:
        section = key_in_file(values, unknown[0], where).removesuffix(f".{unknown[0]}")
        new_names = [f"{name} is now {RENAMED_KEYS[name]}" for name in unknown if RENAMED_KEYS.get(name) in known]
        raise BadInput(
            section, f"keys among: {', '.join(known)}", ", ".join(unknown), "; ".join(new_names) or "correct it"
        )


def plain_config(config: Any) -> dict[str, Any]:
    """The config as dictionaries, lists and numbers, ready for JSON."""
    return {name: _plain(value) for name, value in asdict(config).items()}


def _value(hint: Any, value: Any, where: str, item: Field | None = None) -> Any:
    origin, choices = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType) and NONE in choices:
        inner = [choice for choice in choices if choice is not NONE]
        return value if value is None or len(inner) > 1 else _value(inner[0], value, where)
    if is_dataclass(hint):
        return build_config(hint, value, where)  # pyright: ignore[reportArgumentType]
    if origin is Literal:
        if value not in choices:
            raise BadInput(where, f"one of {', '.join(map(str, choices))}", repr(value), "choose one of them")
        return value
    if origin in (Mapping, dict):
        return _mapping(choices[1], value, where, item)
    if isinstance(value, list) and hint not in (int, float, bool, str):
        return tuple(_value(choices[0] if choices else Any, item, where) for item in value)
    if origin is tuple and not isinstance(value, tuple):
        raise BadInput(where, "a list", repr(value), "write [...]")
    return _number_or_text(hint, value, where) if hint in (int, float, bool, str) else value


def _mapping(hint: Any, value: Any, where: str, item: Field | None) -> dict[str, Any]:
    """Entries over the default ones; entries that are settings have the default's names, and its values left out."""
    value = _checked_mapping(value, where)
    default = item.default_factory() if item and item.default_factory is not MISSING else {}
    if not is_dataclass(hint):
        return {**default, **value}
    refuse_unknown(value, list(default), where)
    given = {name: _checked_mapping(entry, f"{where}.{name}") for name, entry in value.items()}
    whole = {name: laid_over(asdict(default[name]), entry) for name, entry in given.items()}
    return {**default, **{name: _value(hint, entry, f"{where}.{name}") for name, entry in whole.items()}}


def _checked_mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise BadInput(where, "keys with values", repr(value), "correct it")
    return value


def _number_or_text(hint: type, value: Any, where: str) -> Any:
    """``value`` as the type asked for. Text and floats that are such a number count: ``"1e-05"``, and 1e3 of an int."""
    if hint in (int, float) and isinstance(value, str):
        value = _number(value)
    if hint is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    allowed = (int, float) if hint is float else hint
    if not isinstance(value, allowed) or (isinstance(value, bool) and hint is not bool):
        raise BadInput(where, hint.__name__, repr(value), "correct it")
    return hint(value)


def _number(text: str) -> Any:
    """The finite number that ``text`` is; the text itself where it is none."""
    try:
        number = float(text)
    except ValueError:
        return text
    return number if math.isfinite(number) else text


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value
