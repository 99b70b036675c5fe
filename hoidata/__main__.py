"""``hoidata`` and ``python -m hoidata``; with the word ``stage`` a stage, as dvc.yaml of a project of `init` does."""

import gc
import os
import sys
from importlib import import_module

from hoidata.beside import add_to_path
from hoidata.errors import HoidataError
from hoidata.lifetime import run_interruptibly
from hoidata.processor import same_kernels


def main() -> None:
    """Run the command, with ``models`` and ``pipelines`` of this very hoidata."""
    run_interruptibly(_run)


def _run() -> int | None:
    try:
        add_to_path()
    except HoidataError as error:
        sys.exit(f"hoidata: {error}")
    os.environ.update(same_kernels())
    gc.set_threshold(700, 10, 100)  # imports keep 300,000 objects; going through all of them five times took 0.5 s
    if sys.argv[1:2] == ["stage"]:
        sys.argv.pop(1)
        return import_module("pipelines.stages.__main__").main()
    return import_module("pipelines.cli").main()


if __name__ == "__main__":
    main()
