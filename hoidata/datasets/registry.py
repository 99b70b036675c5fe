"""Which adapters there are: the built-in ones and those other packages register.

A package adds one with an entry point: ``[project.entry-points."hoidata.adapters"]  taco = "my_package:TacoAdapter"``.
"""

from dataclasses import dataclass, fields, is_dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from hoidata.datasets.base import Adapter
from hoidata.errors import BadInput, MissingResource

ENTRY_POINT_GROUP = "hoidata.adapters"
BUILT_IN = {
    "h2o": "hoidata.datasets.h2o.adapter:H2OAdapter",
    "grab": "hoidata.datasets.grab.adapter:GrabAdapter",
    "arctic": "hoidata.datasets.arctic.adapter:ArcticAdapter",
    "manipnet": "hoidata.datasets.manipnet.adapter:ManipNetAdapter",
    "taco": "hoidata.datasets.taco.adapter:TacoAdapter",
}
# What an adapter states about its dataset (see ``Adapter``); its other fields are settings.
FACTS = (
    "name",
    "version",
    "licence",
    "may_be_shared",
    "where_to_register",
    "needs_mano",
    "source_fps",
    "frame",
    "hand_convention",
    "parts",
)


@dataclass(frozen=True)
class Registered:
    """One known adapter. origin: "built in", or the package and version that registers it.

    settings: the fields that may be given to ``get_adapter``, with their defaults. adapter: one with these defaults,
    or None with the ``problem`` that kept it from being made.
    """

    name: str
    origin: str
    settings: dict[str, Any]
    adapter: Adapter | None
    problem: str = ""


def adapter_names() -> list[str]:
    """Names of all known adapters, built-in ones first."""
    return [*BUILT_IN, *sorted({point.name for point in _added()})]


def registered_adapters() -> list[Registered]:
    """All known adapters in that order; one that cannot be made is listed with its problem."""
    return [_registered(name) for name in adapter_names()]


def get_adapter(name: str, **settings: Any) -> Adapter:
    """A new adapter of that name.

    settings: values for the fields of the adapter's dataclass that are no facts. Raises MissingResource naming the
    known adapters or the package that is broken, and BadInput naming the known settings.
    """
    kind = _kind(name)
    known = _settings(kind)
    unknown = sorted(set(settings) - set(known))
    if unknown:
        expected = f"some of {', '.join(known)}" if known else "none: it has no settings"
        raise BadInput(f"settings of the adapter {name}", expected, ", ".join(unknown), "correct it")
    return kind(**settings)


def _registered(name: str) -> Registered:
    origin = "built in" if name in BUILT_IN else ", ".join(_package(point) for point in _added() if point.name == name)
    try:
        kind = _kind(name)
        return Registered(name, origin, _settings(kind), kind())
    except Exception as error:  # a broken package of others must not hide the adapters that work
        return Registered(name, origin, {}, None, str(error))


def _added() -> list[EntryPoint]:
    """Entry points of other packages; a built-in name cannot be taken over."""
    return [point for point in entry_points(group=ENTRY_POINT_GROUP) if point.name not in BUILT_IN]


def _package(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else "an unnamed package"


def _settings(kind: Any) -> dict[str, Any]:
    if not is_dataclass(kind):
        return {}
    return {field.name: field.default for field in fields(kind) if field.init and field.name not in FACTS}


def _kind(name: str) -> Any:
    if name in BUILT_IN:
        module, _, attribute = BUILT_IN[name].partition(":")
        return getattr(import_module(module), attribute)
    points = [point for point in _added() if point.name == name]
    if not points:
        raise MissingResource(f"there is no adapter {name!r}; known ones: {', '.join(adapter_names())}")
    if len(points) > 1:
        packages = ", ".join(sorted(_package(point) for point in points))
        raise MissingResource(
            f"{len(points)} packages register the adapter {name!r} ({packages}): uninstall all but one"
        )
    try:
        return points[0].load()
    except Exception as error:  # importing a package of others can raise anything
        text = f"{type(error).__name__}: {error}"
        raise MissingResource(f"the adapter {name!r} of {_package(points[0])} cannot be imported: {text}") from error
