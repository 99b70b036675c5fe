"""Which adapters there are: the built-in ones and those other packages register.

A package adds one with an entry point: ``[project.entry-points."hoidata.adapters"]  taco = "my_package:TacoAdapter"``.
"""

from importlib.metadata import entry_points

from hoidata.adapters.base import Adapter
from hoidata.errors import MissingResource

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


def get_adapter(name: str) -> Adapter:
    """A new adapter of that name with its default settings. Raises MissingResource naming the known ones."""
    if name in BUILT_IN:
        return _load(BUILT_IN[name])()
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.name == name:
            return point.load()()
    raise MissingResource(f"there is no adapter {name!r}; known ones: {', '.join(adapter_names())}")


def _load(target: str) -> type:
    from importlib import import_module

    module, _, attribute = target.partition(":")
    return getattr(import_module(module), attribute)
