"""Finds adapters: one per dataset folder, and those that other packages register.

Dataset folders are in hoidata/datasets or listed by the user (see ``hoidata.dataset_folders``). Their ``adapter.py``
has one class whose name ends in ``Adapter``. A package registers an adapter with an entry point::

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
# Properties that state facts about the dataset; the other fields of an adapter are settings.
FACTS = tuple(name for name, value in vars(Adapter).items() if isinstance(value, property))


@dataclass(frozen=True)
class Registered:
    """An adapter with its settings, or the problem that prevents creating it."""

    name: str
    origin: str  # "built in", the user's folder, or the package and version that registers it
    settings: dict[str, Any]  # arguments of ``get_adapter`` with their defaults
    adapter: Adapter | None  # with default settings; None if there is a problem
    problem: str = ""


def adapter_names() -> list[str]:
    """Names of all adapters: built in, then from the user's folders, then from other packages."""
    return [*built_in_names(), *sorted(outside_folders()), *sorted({point.name for point in _foreign_entry_points()})]


def registered_adapters() -> list[Registered]:
    """All adapters in the order of ``adapter_names``, with the problem of each that cannot be created."""
    return [_registered(name) for name in adapter_names()]


def get_adapter(name: str, **settings: Any) -> Adapter:
    """Create the adapter of a dataset. settings: its dataclass fields, except those that state facts.

    Raises MissingResource for an unknown adapter or a broken package, BadInput for an unknown setting.
    """
    kind = _adapter_class(name)
    defaults = _settings(kind)
    unknown = sorted(set(settings) - set(defaults))
    if unknown:
        expected = f"some of {', '.join(defaults)}" if defaults else "none: it has no settings"
        raise BadInput(f"settings of the adapter {name}", expected, ", ".join(unknown), "correct it")
    return kind(**settings)


def _registered(name: str) -> Registered:
    packages = ", ".join(_package(point) for point in _foreign_entry_points() if point.name == name)
    origin = "built in" if name in built_in_names() else packages or str(outside_folders()[name])
    try:
        kind = _adapter_class(name)
        return Registered(name, origin, _settings(kind), kind())
    except Exception as error:  # a broken package must not hide the working adapters
        return Registered(name, origin, settings={}, adapter=None, problem=str(error))


def _foreign_entry_points() -> list[EntryPoint]:
    """Entry points of other packages. A package cannot replace a dataset that has a folder."""
    return [point for point in entry_points(group=ENTRY_POINT_GROUP) if dataset_folder(point.name) is None]


def _package(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else "an unnamed package"


def _settings(kind: Any) -> dict[str, Any]:
    if not is_dataclass(kind):
        return {}
    return {field.name: field.default for field in fields(kind) if field.init and field.name not in FACTS}


def _adapter_class(name: str) -> Any:
    if dataset_folder(name) is not None:
        return _class_in_folder(name)
    points = [point for point in _foreign_entry_points() if point.name == name]
    if not points:
        raise MissingResource(f"there is no adapter {name!r}; known ones: {', '.join(adapter_names())}")
    if len(points) > 1:
        packages = f"{len(points)} packages register the adapter {name!r} ({', '.join(sorted(map(_package, points)))})"
        raise MissingResource(f"{packages}: uninstall all but one")
    try:
        return points[0].load()
    except Exception as error:  # importing foreign code can raise anything
        text = f"{type(error).__name__}: {error}"
        raise MissingResource(f"the adapter {name!r} of {_package(points[0])} cannot be imported: {text}") from error


def _class_in_folder(name: str) -> type:
    """The one adapter class of a dataset's folder."""
    search_path, parent = sys.modules["hoidata.datasets"].__path__, str(Path(str(dataset_folder(name))).parent)
    if parent not in search_path:  # the user listed the folder after this process imported hoidata.datasets
        search_path.append(parent)
    try:
        module = import_module(f"hoidata.datasets.{name}.adapter")
    except BadInput:
        raise
    except Exception as error:  # importing a user's folder can raise anything
        text = f"{type(error).__name__}: {error}"
        raise MissingResource(f"the adapter in {dataset_folder(name)} cannot be imported: {text}") from error
    classes = [kind for kind in vars(module).values() if isinstance(kind, type) and kind.__module__ == module.__name__]
    adapters = [kind for kind in classes if kind.__name__.endswith("Adapter")]
    if len(adapters) != 1:
        names = ", ".join(kind.__name__ for kind in adapters) or "none"
        raise BadInput(f"{module.__file__}", "one class whose name ends in Adapter", names, "rename the others")
    return adapters[0]
