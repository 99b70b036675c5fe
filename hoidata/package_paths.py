"""Where the packages ``models`` and ``pipelines`` are: next to hoidata in a clone, inside hoidata in an installation.

An installation occupies only the import name ``hoidata``. The ``hoidata`` command adds the other packages to the path.
A script that uses them first runs ``from hoidata.package_paths import add_to_path; add_to_path()``.
"""

import os
import sys
from pathlib import Path

from hoidata.errors import HoidataError

_HOIDATA = Path(__file__).parent
INSTALLED = "installed"
IS_INSTALLED = (_HOIDATA / INSTALLED).is_dir()
# Also has the files of a project: dvc.yaml, params.yaml, manifests.
FOLDER = _HOIDATA / INSTALLED if IS_INSTALLED else _HOIDATA.parent
PACKAGES = ("models", "pipelines")


def add_to_path() -> None:
    """Make ``models`` and ``pipelines`` importable in this process.

    Raises HoidataError if other packages of those names are imported already.
    """
    for name in PACKAGES:
        module = sys.modules.get(name)
        folders = [Path(path).resolve() for path in getattr(module, "__path__", [])]
        if module is not None and (FOLDER / name).resolve() not in folders:
            imported_from = folders[0] if folders else getattr(module, "__file__", None)
            raise HoidataError(
                f"another package called {name} ({imported_from}) was imported before hoidata's ({FOLDER / name}); "
                "import hoidata's first, or use the two packages in separate processes"
            )
    if sys.path[:1] != [str(FOLDER)]:
        sys.path.insert(0, str(FOLDER))


def package_home(package: str, project: Path) -> Path:
    """The folder that has ``package`` when a project runs it: the project, if it is a clone."""
    if (project / "hoidata").is_dir():
        return project
    return FOLDER if package in PACKAGES else _HOIDATA.parent


def python_path() -> dict[str, str]:
    """PYTHONPATH with which a child process finds ``models`` and ``pipelines``; empty in the folder of a clone."""
    if not IS_INSTALLED and Path.cwd() == FOLDER:
        return {}
    return {"PYTHONPATH": os.pathsep.join(filter(None, (str(FOLDER), os.environ.get("PYTHONPATH"))))}
