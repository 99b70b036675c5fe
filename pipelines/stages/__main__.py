"""``python -m pipelines.stages STAGE --profile P [--dataset D] [--model M] [--family F]``: what dvc.yaml runs."""

import argparse
import importlib
import os
import sys

STAGES = (
    "code",
    "raw",
    "convert",
    "quality",
    "annotate",
    "contact",
    "surface",
    "split",
    "evaluator",
    "train",
    "sample",
    "evaluate",
    "report",
)


def main() -> int:
    """Run one stage in the current folder; the exit code is 0, or 1 with one line that says what to do."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.stages")
    parser.add_argument("stage", choices=STAGES)
    parser.add_argument("--profile", choices=("embedded", "own"), default="embedded")
    parser.add_argument("--dataset", default="")
    parser.add_argument("--model", default="")
    parser.add_argument("--family", default="")
    options = parser.parse_args()
    # Threads that wait must sleep: spinning ones cost a busy two-core machine ten times the work. Read as torch loads.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("GOMP_SPINCOUNT", "0")
    try:
        module = importlib.import_module(f"pipelines.stages.{options.stage}")
    except ModuleNotFoundError as error:
        print(f"{error}. Activate the environment first: source .venv/bin/activate", file=sys.stderr)
        return 1
    return _run(module, options)


def _run(module, options: argparse.Namespace) -> int:
    from hoidata.errors import HoidataError
    from pipelines.stages.base import Place

    place = Place(options.profile, options.dataset, options.model, options.family)
    try:
        module.run(place)
    except HoidataError as error:
        print(f"{options.stage} of {place}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
