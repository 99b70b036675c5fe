"""Where the folder of a dataset lies, and what stands in its ``facts.toml``: found by name, no adapter is imported.

A dataset is a folder with its name: ``adapter.py``, ``facts.toml`` and, where there are any, ``splits/*.json`` and
``published.json``. Folders stand in hoidata/datasets, or anywhere else and are listed by the user: in the environment
variable HOIDATA_DATASETS (several joined by ``:``), or in hoidata.toml of the project folder::

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
    """What is known of a dataset without reading any of it; each fact stands in its ``facts.toml`` and nowhere else.

    name: of the folder. title: as pages write it. paper: authors, title, venue and year. source_fps: frames per second.
    needs_mano: raw files hold MANO parameters. may_be_shared: the licence lets derived data be passed on.
    split: the one used unless params.yaml chooses another; "" where the user has to choose.
    conventions: what the source means by its numbers, in one line each, by the names of ``CONVENTIONS.md``'s rows.
    licences: ``licence`` and ``may_be_shared`` of arrays that are not under the dataset's, as dataset cards name them.
    """

    name: str
    title: str
    version: str
    licence: str
    may_be_shared: bool
    where_to_register: str
    needs_mano: bool
    source_fps: float
    paper: str = ""
    split: str = ""
    conventions: dict[str, str] = field(default_factory=dict)
    licences: dict[str, dict[str, Any]] = field(default_factory=dict)


# What TOML gives for a field of each type.
_KINDS: dict[Any, tuple[type, ...]] = {
    str: (str,), bool: (bool,), float: (float, int), dict[str, str]: (dict,), dict[str, dict[str, Any]]: (dict,),
}  # fmt: skip
_OF_ARRAYS = {"licence": str, "may_be_shared": bool}


def built_in_names() -> list[str]:
    """Names of the datasets that come with hoidata, in alphabetical order."""
    return sorted(path.parent.name for path in BUILT_IN.glob("*/adapter.py"))


def outside_folders() -> dict[str, Path]:
    """The folders the user lists, by name; a built-in name cannot be taken over."""
    named = [Path(path) for path in os.environ.get(VARIABLE, "").split(os.pathsep) if path]
    listed = named or [machine_folder() / Path(path).expanduser() for path in _listed_in_settings()]
    folders = [path.expanduser().absolute() for path in listed]
    for folder in folders:
        if not (folder / "adapter.py").is_file() or not folder.name.isidentifier():
            got = "no adapter.py" if folder.name.isidentifier() else f"the name {folder.name!r}"
            raise BadInput(folder, "a dataset's folder with its name and an adapter.py", got, f"correct {VARIABLE}")
    return {folder.name: folder for folder in folders if folder.name not in built_in_names()}


def dataset_folder(name: str) -> Path | None:
    """The folder of a dataset; None for one of another package, or that nobody knows."""
    return BUILT_IN / name if name in built_in_names() else outside_folders().get(name)


def dataset_facts(name: str) -> DatasetFacts | None:
    """What is known of a dataset by name; None where it has no folder, or one without ``facts.toml``."""
    folder = dataset_folder(name)
    return _read_facts(folder) if folder is not None and (folder / "facts.toml").is_file() else None


def facts_beside(file: str) -> DatasetFacts:
    """The facts of the dataset in whose folder ``file`` lies: an adapter's ``__file__``."""
    return _read_facts(Path(file).parent)


def dataset_title(name: str) -> str:
    """The dataset's name as pages write it."""
    facts = dataset_facts(name)
    return name if facts is None else facts.title


def _read_facts(folder: Path) -> DatasetFacts:
    """``facts.toml`` of a dataset's folder. Raises BadInput that names the entry that is wrong or missing."""
    path = folder / "facts.toml"
    values = _read_toml(path)
    known = {item.name: _KINDS[item.type] for item in fields(DatasetFacts) if item.name != "name"}
    if wrong := sorted(values.keys() - known.keys()):
        raise BadInput(path, f"entries among: {', '.join(known)}", ", ".join(wrong), REMEDY)
    for key, value in values.items():
        if type(value) not in known[key]:
            raise BadInput(f"{path}: {key}", known[key][0].__name__, repr(value)[:40], REMEDY)
    for kind, own in values.get("licences", {}).items():
        if not isinstance(own, dict) or {name: type(value) for name, value in own.items()} != _OF_ARRAYS:
            raise BadInput(f"{path}: licences.{kind}", "a licence and may_be_shared", repr(own)[:80], REMEDY)
    try:
        return DatasetFacts(folder.name, **values)
    except TypeError as error:
        raise BadInput(path, "every fact but paper, split, conventions and licences", str(error), REMEDY) from error


def _listed_in_settings() -> list[str]:
    """``[datasets] paths`` of hoidata.toml; none without that file."""
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
