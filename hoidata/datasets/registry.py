"""Which adapters there are: one per dataset folder, and those other packages register.

A folder of hoidata/datasets, or one the user lists (see ``hoidata.dataset_folders``), is a dataset: its ``adapter.py``
holds one class whose name ends in ``Adapter``. A package adds one with an entry point::

    [project.entry-points."hoidata.adapters"]
    kitchen = "kitchen_hoi:KitchenAdapter"
"""

import sys
from dataclasses import dataclass, fields, is_dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from hoidata.dataset_folders import built_in_names, dataset_folder, outside_folders
from hoidata.datasets.base import Adapter
from hoidata.errors import BadInput, MissingResource

ENTRY_POINT_GROUP = "hoidata.adapters"
# What an adapter states about its dataset; its other fields are settings.
FACTS = tuple(name for name, value in vars(Adapter).items() if isinstance(value, property))


@dataclass(frozen=True)
class Registered:
    """One known adapter. origin: "built in", the user's folder, or the package and version that registers it.

    settings: the fields that may be given to ``get_adapter``, with their defaults. adapter: one with these defaults,
    or None with the ``problem`` that kept it from being made.
    """

    name: str
    origin: str
    settings: dict[str, Any]
    adapter: Adapter | None
    problem: str = ""


def adapter_names() -> list[str]:
    """Names of all known adapters: built-in ones, then those of the user's folders, then those of other packages."""
    return [*built_in_names(), *sorted(outside_folders()), *sorted({point.name for point in _added()})]


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
    packages = ", ".join(_package(point) for point in _added() if point.name == name)
    origin = "built in" if name in built_in_names() else packages or str(outside_folders()[name])
    try:
        kind = _kind(name)
        return Registered(name, origin, _settings(kind), kind())
    except Exception as error:  # a broken package of others must not hide the adapters that work
        return Registered(name, origin, {}, None, str(error))


def _added() -> list[EntryPoint]:
    """Entry points of other packages; the name of a folder cannot be taken over."""
    return [point for point in entry_points(group=ENTRY_POINT_GROUP) if dataset_folder(point.name) is None]


def _package(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else "an unnamed package"


def _settings(kind: Any) -> dict[str, Any]:
    if not is_dataclass(kind):
        return {}
    return {field.name: field.default for field in fields(kind) if field.init and field.name not in FACTS}


def _kind(name: str) -> Any:
    if dataset_folder(name) is not None:
        return _kind_of_folder(name)
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


def _kind_of_folder(name: str) -> type:
    """The one adapter class of a dataset's folder."""
    room, above = sys.modules["hoidata.datasets"].__path__, str(Path(str(dataset_folder(name))).parent)
    if above not in room:  # named since this process imported the room
        room.append(above)
    try:
        module = import_module(f"hoidata.datasets.{name}.adapter")
    except BadInput:
        raise
    except Exception as error:  # so can importing a folder of the user's own
        text = f"{type(error).__name__}: {error}"
        raise MissingResource(f"the adapter in {dataset_folder(name)} cannot be imported: {text}") from error
    kinds = [kind for kind in vars(module).values() if isinstance(kind, type) and kind.__module__ == module.__name__]
    found = [kind for kind in kinds if kind.__name__.endswith("Adapter")]
    if len(found) != 1:
        names = ", ".join(kind.__name__ for kind in found) or "none"
        raise BadInput(f"{module.__file__}", "one class whose name ends in Adapter", names, "rename the others")
    return found[0]
