"""Convert mappings (params.yaml, a checkpoint) to frozen settings dataclasses, and back.

The dataclass alone defines name, type and default of a setting. A mapping has only the values that differ.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, asdict, fields, is_dataclass
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from hoidata.errors import BadInput

Config = TypeVar("Config")
NONE = type(None)
# Old and new names of keys of params.yaml. A file with an old name is refused, and the message has the new name.
RENAMED_KEYS = {
    "astray": "perturbed_fraction",
    "drawn_by": "sampled_from",
    "draws": "attempts",
    "floor": "min_std_fraction",
    "guide": "contact_guidance",
    "guide_share": "contact_guidance_fraction",
    "keep": "keep_probability",
    "map_of": "contact_map_target",
    "modulated": "adaptive_norm",
    "most_m": "max_distance_m",
    "object_place": "object_reference_point",
    "object_turn": "object_rotation",
    "parts": "micro_batches",
    "rows": "steps_per_clip",
    "rule": "guidance_rule",
    "max_attempts": "attempts",
    "refined": "refinement",
    "refined_by": "refine",
    "text_input": "verb_input",
    "told": "condition_on_hands",
    "window": "window_frames",
    "windows": "windows_per_clip",
}


class Section(dict[str, Any]):
    """Settings merged from several sections of a file, with the full key of each entry in the file."""

    keys_in_file: Mapping[str, str] = {}  # for error messages only


def build_config(kind: type[Config], values: Mapping[str, Any] | None, source: str) -> Config:
    """Build a settings dataclass, including nested dataclasses and tuples.

    Args:
        kind: the dataclass.
        values: the settings that differ from the defaults.
        source: name of the section for error messages.

    Raises:
        BadInput: an unknown key, a missing value without default, or a value of another type.
    """
    values = _checked_mapping({} if values is None else values, source)
    by_name: dict[str, Field] = {item.name: item for item in fields(kind)}  # pyright: ignore[reportArgumentType]
    check_keys(values, list(by_name), source)
    required = [name for name, item in by_name.items() if item.default is MISSING and item.default_factory is MISSING]
    if missing := [name for name in required if name not in values]:
        raise BadInput(source, f"a value for {', '.join(missing)}", "none", "give one")
    hints = get_type_hints(kind)
    built = {
        name: _value(hints[name], value, key_in_file(values, name, source), by_name[name])
        for name, value in values.items()
    }
    try:
        return kind(**built)
    except BadInput as error:  # raised by __post_init__, which has no access to the full key
        name = error.where.rpartition(".")[2]
        full_key = key_in_file(values, name, source) if name in by_name else error.where
        raise BadInput(full_key, error.expected, error.got, error.remedy) from error


def to_section(values: Mapping[str, Any], prefix: str) -> Section:
    """Convert nested mappings to sections; ``prefix`` precedes their keys in the file."""
    section = Section(
        (name, to_section(value, f"{prefix}{name}.") if isinstance(value, dict) else value)
        for name, value in values.items()
    )
    section.keys_in_file = {name: f"{prefix}{name}" for name in values}
    return section


def merge_settings(base: Mapping[str, Any], overlay: Mapping[str, Any]) -> Section:
    """Merge ``overlay`` into ``base``: mappings are merged, other values replaced; entries keep their full key."""

    def merged(name: str, value: Any) -> Any:
        both = isinstance(base.get(name), dict) and isinstance(value, dict)
        return merge_settings(base[name], value) if both else value

    section = Section({**base, **{name: merged(name, value) for name, value in overlay.items()}})
    section.keys_in_file = {**_keys_in_file(base), **_keys_in_file(overlay)}
    return section


def key_in_file(values: Mapping[str, Any], name: str, source: str) -> str:
    """The full key of an entry for an error message; by default ``name`` in the section ``source``."""
    return _keys_in_file(values).get(name) or f"{source}.{name}"


def _keys_in_file(values: Mapping[str, Any]) -> Mapping[str, str]:
    return values.keys_in_file if isinstance(values, Section) else {}


def require_at_least(source: str, config: Any, name: str, least: float) -> None:
    """Raise BadInput if the setting ``name`` of ``config`` is less than ``least``."""
    if getattr(config, name) < least:
        raise BadInput(f"{source}.{name}", f"{least} or more", str(getattr(config, name)), "correct params.yaml")


def check_keys(values: Mapping[str, Any], allowed: Sequence[str], source: str) -> None:
    """Raise BadInput with the keys that are not allowed and those that are."""
    if unknown := [str(name) for name in values if name not in allowed]:
        section = key_in_file(values, unknown[0], source).removesuffix(f".{unknown[0]}")
        new_names = [f"{name} is now {RENAMED_KEYS[name]}" for name in unknown if RENAMED_KEYS.get(name) in allowed]
        raise BadInput(
            section, f"keys among: {', '.join(allowed)}", ", ".join(unknown), "; ".join(new_names) or "correct it"
        )


def plain_config(config: Any) -> dict[str, Any]:
    """The config as dictionaries, lists and numbers, ready for JSON."""
    return {name: _plain(value) for name, value in asdict(config).items()}


def _value(hint: Any, value: Any, source: str, item: Field | None = None) -> Any:
    origin, choices = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType) and NONE in choices:
        inner = [choice for choice in choices if choice is not NONE]
        return value if value is None or len(inner) > 1 else _value(inner[0], value, source)
    if is_dataclass(hint):
        return build_config(hint, value, source)  # pyright: ignore[reportArgumentType]
    if origin is Literal:
        if value not in choices:
            raise BadInput(source, f"one of {', '.join(map(str, choices))}", repr(value), "choose one of them")
        return value
    if origin in (Mapping, dict):
        return _mapping(choices[1], value, source, item)
    if isinstance(value, list) and hint not in (int, float, bool, str):
        return tuple(_value(choices[0] if choices else Any, item, source) for item in value)
    if origin is tuple and not isinstance(value, tuple):
        raise BadInput(source, "a list", repr(value), "write [...]")
    return _number_or_text(hint, value, source) if hint in (int, float, bool, str) else value


def _mapping(hint: Any, value: Any, source: str, item: Field | None) -> dict[str, Any]:
    """Entries merged with the default ones; entries that are settings must have the names of the default."""
    value = _checked_mapping(value, source)
    default = item.default_factory() if item and item.default_factory is not MISSING else {}
    if not is_dataclass(hint):
        return {**default, **value}
    check_keys(value, list(default), source)
    entries = {name: _checked_mapping(entry, f"{source}.{name}") for name, entry in value.items()}
    merged = {name: merge_settings(asdict(default[name]), entry) for name, entry in entries.items()}
    return {**default, **{name: _value(hint, entry, f"{source}.{name}") for name, entry in merged.items()}}


def _checked_mapping(value: Any, source: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise BadInput(source, "keys with values", repr(value), "correct it")
    return value


def _number_or_text(hint: type, value: Any, source: str) -> Any:
    """``value`` converted to ``hint``. Text that is a number is accepted (``"1e-05"``), and 1e3 for an int."""
    if hint in (int, float) and isinstance(value, str):
        value = _number(value)
    if hint is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    allowed = (int, float) if hint is float else hint
    if not isinstance(value, allowed) or (isinstance(value, bool) and hint is not bool):
        raise BadInput(source, hint.__name__, repr(value), "correct it")
    return hint(value)


def _number(text: str) -> Any:
    """``text`` as a finite number, or unchanged."""
    try:
        number = float(text)
    except ValueError:
        return text
    return number if math.isfinite(number) else text


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value
