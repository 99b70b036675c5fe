"""Where ``models`` and ``pipelines`` lie: beside hoidata in a clone, inside it in an installation.

An installation takes no other name than ``hoidata`` from its environment. The ``hoidata`` command finds them by itself;
a script of yours that uses them says ``from hoidata.beside import add_to_path; add_to_path()`` first.
"""

import os
import sys
from pathlib import Path

from hoidata.errors import HoidataError

_HERE = Path(__file__).parent
INSTALLED = "installed"
IS_INSTALLED = (_HERE / INSTALLED).is_dir()
# Also the home of the files that make a project: dvc.yaml, params.yaml, manifests.
FOLDER = _HERE / INSTALLED if IS_INSTALLED else _HERE.parent
PACKAGES = ("models", "pipelines")


def add_to_path() -> None:
    """Make ``models`` and ``pipelines`` those of hoidata, in this process.

    Raises HoidataError where packages of those names from elsewhere were imported before.
    """
    for name in PACKAGES:
        module = sys.modules.get(name)
        homes = [Path(path).resolve() for path in getattr(module, "__path__", [])]
        if module is not None and (FOLDER / name).resolve() not in homes:
            found = homes[0] if homes else getattr(module, "__file__", None)
            raise HoidataError(
                f"another package called {name} ({found}) was imported before hoidata's ({FOLDER / name}); "
                "import hoidata's first, or use the two in processes of their own"
            )
    if sys.path[:1] != [str(FOLDER)]:
        sys.path.insert(0, str(FOLDER))


def home_of(package: str, project: Path) -> Path:
    """The folder one of our packages lies in, as a project runs it: the project, if it is a clone."""
    if (project / "hoidata").is_dir():
        return project
    return FOLDER if package in PACKAGES else _HERE.parent


def python_path() -> dict[str, str]:
    """The variable that lets a child process import them by itself; empty in a clone, whose folder is enough."""
    known = os.environ.get("PYTHONPATH")
    return {"PYTHONPATH": os.pathsep.join(filter(None, (str(FOLDER), known)))} if IS_INSTALLED else {}
