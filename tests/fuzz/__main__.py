"""Fuzz every parser: ``python -m tests.fuzz`` (``make fuzz``). Results and inputs that failed lie in ``.fuzz/``.

python -m tests.fuzz --jobs 2 --executions 50000            the whole run; equal seeds give equal inputs
python -m tests.fuzz --only obj --seconds 10                one parser for ten seconds
python -m tests.fuzz --replay obj .fuzz/obj/0123.bin        one input that failed, with its traceback
"""

import argparse
import json
import multiprocessing
import sys
import time
from dataclasses import asdict
from pathlib import Path

from tests.fuzz.engine import Outcome, Watched, fuzz, peak_bytes, save_fault
from tests.fuzz.targets import all_targets, removed_scratch

LEAST_LINES = 0.9
HANG_S = 30.0
FOLDER = Path(".fuzz")


def main() -> int:
    arguments = _arguments()
    if arguments.replay:
        name, path = arguments.replay
        print(all_targets()[name].run(Path(path).read_bytes()))
        return 0
    started = time.perf_counter()
    names = arguments.only or list(all_targets())
    outcomes = _run_all(names, arguments)
    _report(outcomes, time.perf_counter() - started, arguments)
    return 1 if any(problems(outcome, arguments.full) for outcome in outcomes) else 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--executions", type=int, default=50_000, help="of each parser")
    parser.add_argument("--seconds", type=float, default=3600.0, help="at most, for each parser")
    parser.add_argument("--only", nargs="+", metavar="PARSER")
    parser.add_argument("--full", action="store_true", help="fail where a parser's lines were not reached")
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--replay", nargs=2, metavar=("PARSER", "FILE"))
    return parser.parse_args()


def _work(name: str, arguments: argparse.Namespace, result: Path) -> None:
    """One parser, in the process its parent watches."""
    outcome = fuzz(all_targets()[name], arguments.seed, arguments.executions, arguments.seconds, arguments.folder)
    result.parent.mkdir(parents=True, exist_ok=True)
    result.write_text(json.dumps(asdict(outcome)))
    removed_scratch()


def _run_all(names: list[str], arguments: argparse.Namespace) -> list[Outcome]:
    waiting, running, outcomes = list(names), {}, {}
    while waiting or running:
        while waiting and len(running) < arguments.jobs:
            name = waiting.pop(0)
            running[name] = _Running(name, arguments)
        time.sleep(0.05)
        for name, worker in list(running.items()):
            outcome = worker.outcome()
            if outcome is not None:
                outcomes[name] = outcome
                del running[name]
                print(_line(outcome), flush=True)
    return [outcomes[name] for name in names]


class _Running:
    """A worker process and the input it is at; ended when it stays at one input for too long."""

    def __init__(self, name: str, arguments: argparse.Namespace) -> None:
        self.name, self.folder = name, arguments.folder
        self.result = self.folder / "outcomes" / f"{name}.json"
        self.result.unlink(missing_ok=True)
        self.current = self.folder / "running" / name
        self.current.unlink(missing_ok=True)
        # Forked: what all parsers import is imported once.
        self.process = multiprocessing.get_context("fork").Process(target=_work, args=(name, arguments, self.result))
        self.process.start()
        self.seen, self.since = -1, time.monotonic()

    def outcome(self) -> Outcome | None:
        """What the worker found, once it has ended (or had to be ended)."""
        if self.process.is_alive():
            return self._hung()
        if self.result.is_file():
            return Outcome(**json.loads(self.result.read_text()))
        return self._fault(f"the process ended with {self.process.exitcode}")

    def _hung(self) -> Outcome | None:
        number, _ = Watched.read(self.current)
        if number != self.seen:
            self.seen, self.since = number, time.monotonic()
        if time.monotonic() - self.since < HANG_S:
            return None
        self.process.kill()
        self.process.join()
        return self._fault(f"no end after {HANG_S:.0f} s")

    def _fault(self, what: str) -> Outcome:
        number, data = Watched.read(self.current)
        path = save_fault(self.folder, self.name, data)
        return Outcome(self.name, number, faults=[{"what": what, "path": str(path)}])


def problems(outcome: Outcome, full: bool) -> list[str]:
    """Why a parser fails its part; with ``full``, lines that were not reached count."""
    found = [
        f"{fault['what']}  ->  python -m tests.fuzz --replay {outcome.name} {fault['path']}" for fault in outcome.faults
    ]
    if full and outcome.lines and outcome.reached < LEAST_LINES * outcome.lines:
        found.append(f"lines not reached: {' '.join(outcome.missing)}")
    if outcome.peak_bytes > 1 << 30:
        found.append(f"{outcome.peak_bytes >> 20} MiB of memory")
    return found


def _line(outcome: Outcome) -> str:
    share = 100 * outcome.reached / max(1, outcome.lines)
    return (
        f"{outcome.name:24} {outcome.executions:9,} runs {outcome.accepted:9,} accepted {outcome.seconds:7.1f} s"
        f"  lines {share:5.1f} % of {outcome.lines:3}  slowest {1e3 * outcome.slowest_s:6.1f} ms"
        f"  peak {outcome.peak_bytes >> 20:4} MiB  faults {len(outcome.faults)}"
    )


def _report(outcomes: list[Outcome], seconds: float, arguments: argparse.Namespace) -> None:
    total = sum(outcome.executions for outcome in outcomes)
    peak = max(peak_bytes(), *(outcome.peak_bytes for outcome in outcomes))
    slowest = max(outcome.slowest_s for outcome in outcomes)
    print(
        f"{total:,} runs of {len(outcomes)} parsers in {seconds / 60:.1f} min with {arguments.jobs} processes,"
        f" seed {arguments.seed}; slowest call {1e3 * slowest:.0f} ms, most memory {peak >> 20} MiB"
    )
    for outcome in outcomes:
        for problem in problems(outcome, arguments.full):
            print(f"FAILED {outcome.name}: {problem}")


if __name__ == "__main__":
    sys.exit(main())
