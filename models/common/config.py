"""Frozen config dataclasses from plain mappings (params.yaml, a checkpoint) and back; unknown keys fail."""

from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from typing import Any, TypeVar, get_type_hints

from hoidata.errors import BadInput

Config = TypeVar("Config")


def build_config(kind: type[Config], values: Mapping[str, Any] | None, where: str) -> Config:
    """``kind`` with the given values over its defaults; nested dataclasses and tuples are rebuilt.

    Raises BadInput for a key that ``kind`` does not have, or a value of another type.
    """
    values = values or {}
    known = {item.name for item in fields(kind)}  # pyright: ignore[reportArgumentType]
    if unknown := sorted(set(values) - known):
        raise BadInput(where, f"keys among {sorted(known)}", ", ".join(unknown), "correct it")
    hints = get_type_hints(kind)
    return kind(**{name: _value(hints[name], value, f"{where}.{name}") for name, value in values.items()})


def plain_config(config: Any) -> dict[str, Any]:
    """The config as dictionaries, lists and numbers, ready for JSON."""
    return {name: _plain(value) for name, value in asdict(config).items()}


def _value(hint: Any, value: Any, where: str) -> Any:
    if is_dataclass(hint):
        return build_config(hint, value, where)  # pyright: ignore[reportArgumentType]
    if isinstance(value, list):
        return tuple(value)
    if hint in (int, float, bool, str):
        allowed = (int, float) if hint is float else hint
        if not isinstance(value, allowed) or (isinstance(value, bool) and hint is not bool):
            raise BadInput(where, hint.__name__, repr(value), "correct it")
        return hint(value)
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value
