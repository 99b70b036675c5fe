"""Finds the folder of a dataset by name and reads its ``facts.toml``, without importing the adapter.

A dataset is a folder of that name with ``adapter.py``, ``facts.toml`` and optionally ``splits/*.json`` and
``published.json``. Built-in folders are in hoidata/datasets. Users list further ones in the environment variable
HOIDATA_DATASETS, joined by ``:``, or in hoidata.toml of the project folder::

    [datasets]
    paths = ["../kitchen"]
"""

import os
import tomllib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.machine_folder import SETTINGS, machine_folder

BUILT_IN = Path(__file__).with_name("datasets")
VARIABLE = "HOIDATA_DATASETS"
REMEDY = "correct it; hoidata/datasets/README.md shows a whole one"


@dataclass(frozen=True)
class DatasetFacts:
    """Facts about a dataset, from ``facts.toml`` of its folder."""

    name: str  # of the folder
    title: str  # name on pages
    version: str  # of the release that the adapter reads
    licence: str
    may_be_shared: bool  # the licence permits passing on derived data
    where_to_register: str
    needs_mano: bool  # raw files have MANO parameters
    source_fps: float
    paper: str = ""  # authors, title, venue and year
    derives_verbs: bool = False  # the adapter derives verbs from the motion; the files have no action labels
    split: str = ""  # name of the default split; "" if the user has to choose one in params.yaml
    conventions: dict[str, str] = field(default_factory=dict)  # by row of CONVENTIONS.md, one line each
    # ``licence`` and ``may_be_shared`` of arrays under another licence, by their name in dataset cards
    licences: dict[str, dict[str, Any]] = field(default_factory=dict)


# Python types that TOML returns for a field of each type.
_TOML_TYPES: dict[Any, tuple[type, ...]] = {
    str: (str,), bool: (bool,), float: (float, int), dict[str, str]: (dict,), dict[str, dict[str, Any]]: (dict,),
}  # fmt: skip
_LICENCE_ENTRY_TYPES = {"licence": str, "may_be_shared": bool}


def built_in_names() -> list[str]:
    """Names of the datasets that come with hoidata, in alphabetical order."""
    return sorted(path.parent.name for path in BUILT_IN.glob("*/adapter.py"))


def outside_folders() -> dict[str, Path]:
    """The folders that the user lists, by name. A folder cannot replace a built-in dataset."""
    from_environment = [Path(path) for path in os.environ.get(VARIABLE, "").split(os.pathsep) if path]
    listed = from_environment or [machine_folder() / Path(path).expanduser() for path in _listed_in_settings()]
    folders = [path.expanduser().absolute() for path in listed]
    for folder in folders:
        if not (folder / "adapter.py").is_file() or not folder.name.isidentifier():
            got = "no adapter.py" if folder.name.isidentifier() else f"the name {folder.name!r}"
            raise BadInput(folder, "a dataset's folder with its name and an adapter.py", got, f"correct {VARIABLE}")
    return {folder.name: folder for folder in folders if folder.name not in built_in_names()}


def dataset_folder(name: str) -> Path | None:
    """The folder of a dataset; None if it is unknown or registered by another package."""
    return BUILT_IN / name if name in built_in_names() else outside_folders().get(name)


def dataset_facts(name: str) -> DatasetFacts | None:
    """The facts of a dataset; None if it has no folder, or no ``facts.toml`` in it."""
    folder = dataset_folder(name)
    return _read_facts(folder) if folder is not None and (folder / "facts.toml").is_file() else None


def facts_of_adapter(file: str) -> DatasetFacts:
    """The facts of a dataset, given ``__file__`` of its adapter."""
    return _read_facts(Path(file).parent)


def dataset_title(name: str) -> str:
    """The dataset's name on pages."""
    facts = dataset_facts(name)
    return name if facts is None else facts.title


def _read_facts(folder: Path) -> DatasetFacts:
    """Read ``facts.toml`` of a dataset's folder. Raises BadInput that names the wrong or missing entry."""
    path = folder / "facts.toml"
    values = _read_toml(path)
    types = {item.name: _TOML_TYPES[item.type] for item in fields(DatasetFacts) if item.name != "name"}
    if wrong := sorted(values.keys() - types.keys()):
        raise BadInput(path, f"entries among: {', '.join(types)}", ", ".join(wrong), REMEDY)
    for key, value in values.items():
        if type(value) not in types[key]:
            raise BadInput(f"{path}: {key}", types[key][0].__name__, repr(value)[:40], REMEDY)
    for arrays, entry in values.get("licences", {}).items():
        if not isinstance(entry, dict) or {key: type(value) for key, value in entry.items()} != _LICENCE_ENTRY_TYPES:
            raise BadInput(f"{path}: licences.{arrays}", "a licence and may_be_shared", repr(entry)[:80], REMEDY)
    try:
        return DatasetFacts(folder.name, **values)
    except TypeError as error:
        expected = "every fact but paper, derives_verbs, split, conventions and licences"
        raise BadInput(path, expected, str(error), REMEDY) from error


def _listed_in_settings() -> list[str]:
    """``[datasets] paths`` of hoidata.toml; empty without that file."""
    path = machine_folder() / SETTINGS
    if not path.is_file():
        return []
    section = _read_toml(path).get("datasets", {})
    paths = section.get("paths", []) if isinstance(section, dict) else None
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise BadInput(path, "[datasets] with a list of folders called paths", str(section)[:80], "correct it")
    return paths


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as error:  # tomllib's own error is a ValueError
        raise BadInput(path, "TOML text", str(error)[:300], "correct it") from error
