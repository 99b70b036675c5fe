"""``python -m pipelines.stages STAGE --profile P [--dataset D] [--model M] [--family F]``: run one stage."""

import argparse
import importlib
import os
import sys
from dataclasses import replace
from io import TextIOWrapper
from pathlib import Path

import psutil

from hoidata.lifetime import end_with_process, run_interruptibly
from pipelines.warm import ENVIRONMENT, run_warm

STAGES = (
    "code", "raw", "convert", "quality", "annotate", "contact", "split",
    "evaluator", "train", "sample", "controls", "evaluate", "report",
)  # fmt: skip


def main() -> int:
    """Run one stage in the current folder. Returns the exit code, 0 or 1; an error is one line with a remedy.

    A stage that DVC started is killed when DVC ends.
    """
    if "DVC_STAGE" in os.environ:
        _end_with_dvc()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a file name need not be UTF-8
    parser = argparse.ArgumentParser(prog="python -m pipelines.stages")
    parser.add_argument("stage", choices=STAGES)
    help_on_profile = "must be the profile that params.yaml chooses, whose settings are used"
    parser.add_argument("--profile", default="", help=help_on_profile)
    for name in ("--dataset", "--model", "--family"):
        parser.add_argument(name, default="")
    options = parser.parse_args()
    if (code := run_warm("pipelines.stages", sys.argv[1:])) is not None:
        return code
    os.environ.update(ENVIRONMENT)
    return _run(importlib.import_module(f"pipelines.stages.{options.stage}"), options)


def _end_with_dvc() -> None:
    """End with DVC, which started either this process or the shell that runs this stage as its only command."""
    parent = psutil.Process(os.getppid())
    end_with_process(parent.pid)
    if " ".join(sys.argv[1:]) in " ".join(parent.cmdline()[-1:]):
        end_with_process(parent.ppid())


def _run(module, options: argparse.Namespace) -> int:
    from hoidata.errors import BadInput, HoidataError, explain_machine_errors
    from hoidata.workers import choose_workers
    from pipelines.params import read_params
    from pipelines.sidecar import noted_run
    from pipelines.stages.base import StagePaths

    paths = StagePaths(options.profile, options.dataset, options.model, options.family)
    try:
        params = read_params(Path())
        chosen = params["profile"]
        if paths.profile not in ("", chosen):
            raise BadInput("--profile", f"{chosen}, which params.yaml chooses", paths.profile, "set it in params.yaml")
        choose_workers(os.environ.get("HOIDATA_WORKERS") or str(params.get("workers", "local")))
        with explain_machine_errors(), noted_run(f"{options.stage}@{paths}"):
            module.run(replace(paths, profile=chosen))
    except HoidataError as error:
        print(f"{options.stage} of {paths}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    run_interruptibly(main)
