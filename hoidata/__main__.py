"""Entry point of ``hoidata`` and ``python -m hoidata``; ``hoidata stage`` runs one DVC stage of a project."""

import gc
import os
import sys
from importlib import import_module

from hoidata.errors import HoidataError
from hoidata.lifetime import run_interruptibly
from hoidata.package_paths import add_to_path
from hoidata.processor import portable_kernels


def main() -> None:
    """Run the command with the packages ``models`` and ``pipelines`` of this hoidata."""
    run_interruptibly(_run)


def _run() -> int | None:
    try:
        add_to_path()
    except HoidataError as error:
        sys.exit(f"hoidata: {error}")
    os.environ.update(portable_kernels())
    # Imports keep 300,000 objects. Fewer full collections save 0.5 s.
    gc.set_threshold(700, 10, 100)
    if sys.argv[1:2] == ["stage"]:
        sys.argv.pop(1)
        return import_module("pipelines.stages.__main__").main()
    return import_module("pipelines.cli").main()


if __name__ == "__main__":
    main()
