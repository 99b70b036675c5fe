"""Which adapters there are: the built-in ones and those other packages register.

A package adds one with an entry point: ``[project.entry-points."hoidata.adapters"]  taco = "my_package:TacoAdapter"``.
"""

from dataclasses import fields, is_dataclass
from importlib.metadata import entry_points
from typing import Any

from hoidata.adapters.base import Adapter
from hoidata.errors import BadInput, MissingResource

ENTRY_POINT_GROUP = "hoidata.adapters"
BUILT_IN = {
    "h2o": "hoidata.adapters.h2o:H2OAdapter",
    "grab": "hoidata.adapters.grab:GrabAdapter",
    "arctic": "hoidata.adapters.arctic:ArcticAdapter",
    "manipnet": "hoidata.adapters.manipnet:ManipNetAdapter",
}


def adapter_names() -> list[str]:
    """Names of all known adapters, built-in ones first."""
    added = sorted(point.name for point in entry_points(group=ENTRY_POINT_GROUP) if point.name not in BUILT_IN)
    return [*BUILT_IN, *added]


def get_adapter(name: str, **settings: Any) -> Adapter:
    """A new adapter of that name.

    settings: values for the fields of the adapter's dataclass. Raises MissingResource naming the known adapters, and
    BadInput naming the known settings.
    """
    kind = _kind(name)
    known = _settings(kind)
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise BadInput(
            f"settings of the adapter {name}", f"some of {', '.join(known)}", ", ".join(unknown), "correct it"
        )
    return kind(**settings)


def _settings(kind: Any) -> list[str]:
    return [field.name for field in fields(kind)] if is_dataclass(kind) else []


def _kind(name: str) -> Any:
    if name in BUILT_IN:
        return _load(BUILT_IN[name])
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.name == name:
            return point.load()
    raise MissingResource(f"there is no adapter {name!r}; known ones: {', '.join(adapter_names())}")


def _load(target: str) -> Any:
    from importlib import import_module

    module, _, attribute = target.partition(":")
    return getattr(import_module(module), attribute)
