"""Fuzz the parsers: ``python -m fuzz`` (``make fuzz``). Logs and inputs that failed are stored in ``.fuzz/``.

python -m fuzz --jobs 2 --executions 50000            every parser
python -m fuzz obj --seconds 10                       one parser for ten seconds, in this process
python -m fuzz obj --replay .fuzz/obj/crash-0123      one input that failed, with its traceback
"""

import argparse
import multiprocessing
import os
import re
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from fuzz.engine import check_call, fuzz
from fuzz.targets import all_targets


def main() -> int:
    arguments = _arguments()
    targets = all_targets()
    if arguments.replay:
        with tempfile.TemporaryDirectory() as scratch:
            check_call(targets[arguments.parser], arguments.replay.read_bytes(), Path(scratch))
        return 0
    if arguments.parser:
        _fuzzed(arguments.parser, arguments)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(arguments.jobs) as pool:
        return max(pool.map(_in_a_process, targets, [arguments] * len(targets)))


def _fuzzed(name: str, arguments: argparse.Namespace, log: Path | None = None) -> None:
    """Fuzz one parser in this process, which libFuzzer ends; log: file for its output."""
    if log:
        descriptor = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
    limits = arguments.seed, arguments.executions, arguments.seconds
    fuzz(name, all_targets()[name], *limits, arguments.folder)


def _in_a_process(name: str, arguments: argparse.Namespace) -> int:
    log = arguments.folder / f"{name}.log"
    # Forked, so that the parsers' modules are imported once.
    process = multiprocessing.get_context("fork").Process(target=_fuzzed, args=(name, arguments, log))
    process.start()
    process.join()
    text = log.read_text(errors="replace")
    runs = re.search(r"^stat::number_of_executed_units: +(\d+)$", text, re.MULTILINE)
    result = "no fault" if not process.exitcode else f"FAILED, see {log}:\n{text[-3000:]}"
    print(f"{name:24} {int(runs[1]) if runs else 0:9,} runs  {result}", flush=True)
    return int(process.exitcode != 0)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("parser", nargs="?", choices=list(all_targets()))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--executions", type=int, default=50_000, help="of each parser")
    parser.add_argument("--seconds", type=int, default=600, help="at most, for each parser")
    parser.add_argument("--folder", type=Path, default=Path(".fuzz"))
    parser.add_argument("--replay", type=Path, metavar="FILE")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
