"""Fuzz every parser: ``python -m fuzz`` (``make fuzz``). Results and inputs that failed lie in ``.fuzz/``.

python -m fuzz --jobs 2 --executions 50000            the whole run
python -m fuzz --only obj --seconds 10                one parser for ten seconds
python -m fuzz --replay obj .fuzz/obj/crash-0123      one input that failed, with its traceback
"""

import argparse
import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from fuzz.engine import Outcome, check_call, fuzz
from fuzz.targets import all_targets, scratch_folder
from hoidata.lifetime import begin_worker

LEAST_LINES = 0.9
MOST_MIB = 1024
FOLDER = Path(".fuzz")


def main() -> int:
    arguments = _arguments()
    if arguments.replay:
        name, path = arguments.replay
        with scratch_folder():
            check_call(all_targets()[name], Path(path).read_bytes())
        return 0
    started = time.perf_counter()
    names = arguments.only or list(all_targets())
    # Forked: what all parsers import is imported once.
    with ProcessPoolExecutor(arguments.jobs, multiprocessing.get_context("fork"), begin_worker) as pool:
        outcomes = []
        for outcome in pool.map(_fuzzed, names, [arguments] * len(names)):
            outcomes.append(outcome)
            print(_line(outcome), flush=True)
    total, minutes = sum(outcome.executions for outcome in outcomes), (time.perf_counter() - started) / 60
    print(f"{total:,} runs of {len(outcomes)} parsers in {minutes:.1f} min with {arguments.jobs} processes")
    found = [(outcome.name, problem) for outcome in outcomes for problem in problems(outcome, arguments.full)]
    for name, problem in found:
        print(f"FAILED {name}: {problem}")
    return 1 if found else 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--executions", type=int, default=50_000, help="of each parser")
    parser.add_argument("--seconds", type=float, default=3600.0, help="at most, for each parser")
    parser.add_argument("--only", nargs="+", metavar="PARSER")
    parser.add_argument("--full", action="store_true", help="fail where a parser's lines were not reached")
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--replay", nargs=2, metavar=("PARSER", "FILE"))
    return parser.parse_args()


def _fuzzed(name: str, arguments: argparse.Namespace) -> Outcome:
    with scratch_folder():
        return fuzz(all_targets()[name], arguments.seed, arguments.executions, arguments.seconds, arguments.folder)


def problems(outcome: Outcome, full: bool) -> list[str]:
    """Why a parser fails its part; with ``full``, lines that were not reached count."""
    found = []
    if outcome.fault:
        found.append(f"{outcome.fault}  ->  python -m fuzz --replay {outcome.name} {outcome.input_path}")
    if full and outcome.lines - len(outcome.missing) < LEAST_LINES * outcome.lines:
        found.append(f"lines not reached: {' '.join(outcome.missing)}")
    if outcome.peak_mib > MOST_MIB:
        found.append(f"{outcome.peak_mib} MiB of memory")
    return found


def _line(outcome: Outcome) -> str:
    share = 100 * (1 - len(outcome.missing) / max(1, outcome.lines))
    return (
        f"{outcome.name:24} {outcome.executions:9,} runs {outcome.seconds:7.1f} s  lines {share:5.1f} % of"
        f" {outcome.lines:3}  peak {outcome.peak_mib:4} MiB  {outcome.fault or 'no fault'}"
    )


if __name__ == "__main__":
    sys.exit(main())
