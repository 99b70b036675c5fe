"""Runs the DVC graph in parallel: each stage starts as soon as its inputs are ready.

DVC provides the stages, their order and their state.
"""

import contextvars
import json
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from multiprocessing import connection
from pathlib import Path
from types import ModuleType
from typing import Any

from hoidata.errors import BadInput, explain_machine_errors
from hoidata.files.atomic import exclusive
from hoidata.lifetime import block_ctrl_c, end_with_starter
from pipelines.sidecar import RUNS
from pipelines.warm import WarmProcess

CODE = "pipelines/dvc.yaml:code"
RUN = Path(".hoidata/repro")
RWLOCK = Path(".dvc/tmp/rwlock")
LOGS = Path(".hoidata/logs")
# Imported once: importing them in every stage's process takes about a second.
PRELOADED = ["dvc.cli", "dvc.commands.repro", "dvc.repo.reproduce", "dvc.output", "dvc.stage.run"]
TAIL = 15
PROGRESS_S = 5.0  # between two looks at the logs of running stages
STOP_S = 5.0
_START_LOCK = threading.Lock()
_PROBE_BYTES = 1 << 20  # bytes of free space on the disk of the cache that are required before a stage starts
Upstream = Mapping[str, frozenset[str]]
RunStage = Callable[[str], int]


@dataclass
class Run:
    """The outcome of a run."""

    seconds: dict[str, float] = field(default_factory=dict)  # by started stage
    failed: dict[str, int] = field(default_factory=dict)  # exit code by failed stage
    wall: float = 0.0  # seconds of the whole run


def reproduce_in_parallel(
    targets: list[str], jobs: int, wrap: Callable[[RunStage], RunStage] | None = None, force: bool = False
) -> Run:
    """Bring the targets (none: all) up to date with up to ``jobs`` parallel stages; the bytes do not depend on it.

    A failed stage stops only the stages that depend on it. Raises BadInput if another run is in progress.

    Args:
        wrap: decorates the function that runs one stage, for instance as a Prefect task.
    """
    cores = max(1, len(os.sched_getaffinity(0)) // jobs)  # of each stage
    # Exited in reverse order: running stages are stopped before the threads that wait for them.
    with exclusive(RUN, wait_s=0), ThreadPoolExecutor(jobs) as pool, _Children(cores) as children:
        forget_broken_lock()
        run_stage = wrap(children.run) if wrap else children.run
        start, run = time.monotonic(), Run()
        if _timed(CODE, run_stage, run):
            _report_stage(CODE, run, 0)
        else:
            plan = stale_stages(targets, force)
            children.forced = plan.certain if force else frozenset()
            if len(plan.upstream) > jobs:
                children.warm.start()
            run_all(plan.upstream, pool, jobs, run_stage, run)
        run.wall = time.monotonic() - start
        return run


def forget_broken_lock() -> None:
    """Remove DVC's lock file of readers and writers if a killed process left it incomplete.

    An incomplete file would prevent all later runs; a complete one belongs to running processes and stays.
    """
    if not _is_broken(RWLOCK):
        return
    from dvc.lock import make_lock

    # Under DVC's guard lock, so that no process is writing the file now.
    with make_lock(f"{RWLOCK}.lock", tmp_dir=str(RWLOCK.parent)):
        if _is_broken(RWLOCK):
            RWLOCK.unlink()


def _is_broken(path: Path) -> bool:
    try:
        return not isinstance(json.loads(path.read_bytes()), dict)
    except FileNotFoundError:
        return False
    except ValueError:
        return True


@dataclass(frozen=True)
class Plan:
    """The stages that DVC finds changed, and all that depend on them."""

    upstream: Upstream  # each stage with the stages that it waits for
    certain: frozenset[str]  # the changed stages; the others run if a stage before them writes other bytes
    growth: Mapping[str, float] = field(default_factory=dict)  # by training: its steps / those of its last run


def stale_stages(targets: list[str], force: bool = False) -> Plan:
    """The stages that must run for the targets; with ``force``, these count as changed.

    Raises BadInput if a target does not exist, or another DVC command has locked the project.
    """
    from dvc.exceptions import DvcException

    try:
        return _ask_dvc(targets, force)
    except DvcException as error:
        got, remedy = str(error), "`dvc stage list --all` names all targets"
        raise BadInput(" ".join(targets) or "dvc.yaml", "stages that DVC can run", got, remedy) from error


def _ask_dvc(targets: list[str], force: bool) -> Plan:
    import networkx
    from dvc.repo import Repo
    from dvc.repo.reproduce import collect_stages, get_active_graph, plan_repro

    with Repo() as repo, repo.lock:
        graph = get_active_graph(repo.index.graph)
        target_stages = collect_stages(repo, targets or ["dvc.yaml"])
        stages = plan_repro(graph, target_stages)
        needed = graph.subgraph(stages)
        forced = set(target_stages if targets else stages) if force else set()
        changed = [stage for stage in stages if stage.addressing != CODE and (stage in forced or stage.changed())]
        if changed:
            _check_writable(Path(repo.cache.local.path))
        stale = set(changed).union(*(networkx.ancestors(needed, stage) for stage in changed))
        needs = {stage: stale.intersection(needed.successors(stage)) for stage in stages if stage in stale}
        upstream = {stage.addressing: frozenset(other.addressing for other in needs[stage]) for stage in needs}
        return Plan(upstream, frozenset(stage.addressing for stage in changed))


def _check_writable(folder: Path) -> None:
    """Raise MachineError if DVC could not store the outputs of stages."""
    with explain_machine_errors():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder) as stream:
            stream.write(bytes(_PROBE_BYTES))
            stream.flush()


def run_all(upstream: Upstream, pool: ThreadPoolExecutor, jobs: int, run_stage: RunStage, run: Run) -> None:
    """Run each stage when its inputs are ready, those with the longest remaining chain first."""
    remaining = _remaining_seconds(upstream, likely_seconds(upstream))
    waiting = dict(upstream)
    running: dict[Future[int], str] = {}
    shown: dict[str, str] = {}  # last progress line by stage
    while waiting or running:
        unfinished = waiting.keys() | set(running.values())
        ready = sorted((name for name in waiting if not waiting[name] & unfinished), key=lambda name: -remaining[name])
        for name in ready[: jobs - len(running)]:
            del waiting[name]
            context = contextvars.copy_context()
            shown[name] = _progress_line(name)  # of an earlier run
            running[pool.submit(context.run, _timed, name, run_stage, run)] = name
        done = wait(running, PROGRESS_S, return_when=FIRST_COMPLETED).done
        for name in running.values():
            if (line := _progress_line(name)) != shown[name]:
                shown[name] = line
                print(f"    {name}: {line}", flush=True)
        for future in done:
            name = running.pop(future)
            if future.result():
                waiting = _without_dependents(waiting, name)
            _report_stage(name, run, len(upstream))


def _progress_line(name: str) -> str:
    """The last line on the progress of a training (``models.common.progress.Line``) in the log of a stage, or ""."""
    try:
        lines = log_of(name).read_text(errors="replace").splitlines()
    except OSError:
        return ""
    return next((line for line in reversed(lines) if line.startswith("step ")), "")


def describe_plan(plan: Plan, jobs: int) -> str:
    """One line per stage of a plan with its likely minutes, and their sum."""
    last = likely_seconds(plan.upstream)
    seconds = {name: value * plan.growth.get(name, 1.0) for name, value in last.items()}

    def minutes(names: Collection[str]) -> str:
        unknown = sum(name not in seconds for name in names)
        return f"{sum(seconds.get(name, 0) for name in names) / 60:.1f} min" + f" and {unknown} unknown" * bool(unknown)

    lines = [
        f"{f'{seconds[name] / 60:.1f} min' if name in seconds else '?':>9}  {name}"
        + ("" if name in plan.certain else "  (if its inputs change)")
        for name in plan.upstream
    ]
    chain = max(_remaining_seconds(plan.upstream, seconds).values(), default=0.0)
    wall = max(chain, sum(seconds.values()) / jobs) / 60
    lines.append(
        f"{len(plan.upstream)} stages: {minutes(plan.upstream)}, {wall:.1f} min with {jobs} in parallel; "
        f"{len(plan.certain)} stages are certain: {minutes(plan.certain)}"
    )
    return "\n".join(lines)


def describe_run(run: Run) -> str:
    """The time per kind of stage, and the failed stages with their logs."""
    kinds: dict[str, list[float]] = {}
    for name, seconds in run.seconds.items():
        kinds.setdefault(name.split(":")[-1].split("@")[0], []).append(seconds)
    by_time = [*sorted(kinds.items(), key=lambda entry: -sum(entry[1])), ("all", list(run.seconds.values()))]
    counts = [(kind, len(times), "stage" if len(times) == 1 else "stages", sum(times)) for kind, times in by_time]
    lines = [f"{kind:16} {count:4} {word:6} {seconds:8.1f} s" for kind, count, word, seconds in counts]
    lines[-1] += f", in {run.wall:.1f} s wall time"
    lines += [f"failed: {name}; full output: {log_of(name)}" for name in run.failed]
    return "\n".join(lines)


def _timed(name: str, run_stage: RunStage, run: Run) -> int:
    start = time.monotonic()
    code = run_stage(name)
    run.seconds[name] = time.monotonic() - start
    if code:
        run.failed[name] = code
    return code


def _report_stage(name: str, run: Run, total: int) -> None:
    """Print one line per finished stage, and the last lines of output of a failed one."""
    done = len(run.seconds) - 1
    print(f"[{done}/{total}] {name}: {'FAILED after ' * (name in run.failed)}{run.seconds[name]:.1f} s", flush=True)
    if name in run.failed:
        lines = log_of(name).read_text(errors="replace").splitlines()[-TAIL:] if log_of(name).is_file() else []
        print("\n".join(f"    {line}" for line in lines), file=sys.stderr, flush=True)


def _without_dependents(waiting: Upstream, failed: str) -> dict[str, frozenset[str]]:
    """The stages that do not depend, directly or indirectly, on the failed one."""
    blocked = {failed}
    while more := {name for name, needs in waiting.items() if name not in blocked and needs & blocked}:
        blocked |= more
    return {name: needs for name, needs in waiting.items() if name not in blocked}


def _remaining_seconds(upstream: Upstream, durations: Mapping[str, float]) -> dict[str, float]:
    """Per stage, the seconds of the longest chain that starts with it; 1 per stage without a known duration."""

    @cache
    def seconds(name: str) -> float:
        dependents = (other for other, needs in upstream.items() if name in needs)
        return durations.get(name, 1.0) + max(map(seconds, dependents), default=0.0)

    return {name: seconds(name) for name in upstream}


def likely_seconds(names: Iterable[str]) -> dict[str, float]:
    """The seconds of the last complete run of each stage, else the mean of its kind; unknown stages are missing."""
    last, by_kind = dict[str, float](), dict[str, list[float]]()
    for path in sorted(RUNS.glob("*.json")):
        with suppress(OSError, ValueError, TypeError, KeyError):  # estimates need no record
            record = json.loads(path.read_bytes())
            if record["ended"] == "complete":
                last[record["stage"]] = float(record["seconds"])
                by_kind.setdefault(record["stage"].partition("@")[0], []).append(last[record["stage"]])
    means = {kind: sum(seconds) / len(seconds) for kind, seconds in by_kind.items()}
    likely = {name: last.get(name, means.get(name.partition("@")[0])) for name in names}
    return {name: seconds for name, seconds in likely.items() if seconds is not None}


def log_of(name: str) -> Path:
    """The log file of a stage."""
    return LOGS / f"{name.replace('/', '-').replace(':', '-')}.log"


class _Children:
    """Child processes that run DVC for one stage each, forked from a process that has imported DVC.

    No child outlives the ``with`` block.
    """

    def __init__(self, cores: int) -> None:
        self.cores, self.ends = cores, False
        self.context = multiprocessing.get_context("forkserver")
        self.processes: set[Any] = set()
        self.forced = frozenset[str]()
        self.warm = WarmProcess()

    def __enter__(self) -> "_Children":
        self.context.set_forkserver_preload(PRELOADED)
        in_main = threading.current_thread() is threading.main_thread()
        if in_main and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:  # commands and Prefect have handlers
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop running stages as Ctrl-C does: outputs of unfinished stages do not change.

        A stage that has not ended after STOP_S is killed.
        """
        with _START_LOCK:
            self.ends = True
        for number, seconds in ((signal.SIGINT, STOP_S), (signal.SIGKILL, 0)):
            for process in self._at_work(0):
                _signal_group(process.pid, number)
            self._at_work(seconds)
        self.warm.close()

    def _at_work(self, seconds: float) -> list[Any]:
        """The processes that are still running after waiting for up to ``seconds``.

        It does not read exit codes: the threads that wait for the processes need them, and only one reader gets them.
        """
        deadline, processes = time.monotonic() + seconds, list(self.processes)
        while processes:
            ended = connection.wait([process.sentinel for process in processes], max(0, deadline - time.monotonic()))
            processes = [process for process in processes if process.sentinel not in ended]
            if not ended:
                break
        return processes

    def run(self, name: str) -> int:
        """Run one stage and return DVC's exit code; its output goes to the log of the stage."""
        LOGS.mkdir(parents=True, exist_ok=True)
        environment = {"HOIDATA_JOBS": str(self.cores), **self.warm.environment}
        arguments = (Path.cwd(), name, name in self.forced, environment)
        process = self.context.Process(target=_run_single_stage, args=arguments)
        with _without_main():
            if self.ends:
                return 128 + signal.SIGINT
            with block_ctrl_c():
                process.start()
            self.processes.add(process)
        process.join()
        return process.exitcode or 0


def _signal_group(leader: int, number: int) -> None:
    with suppress(ProcessLookupError):  # it has just ended
        try:
            os.killpg(leader, number)
        except ProcessLookupError:  # it has just started, has no group yet and runs no stage
            os.kill(leader, signal.SIGKILL)


@contextmanager
def _without_main() -> Iterator[None]:
    """Within this block, new children do not import the main module of this process; Prefect's takes a second."""
    with _START_LOCK:
        main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main


def _run_single_stage(project: Path, name: str, force: bool, environment: dict[str, str]) -> None:
    """Run one stage in the child, in a new process group, so that a signal reaches all processes of the stage."""
    from dvc.cli import main

    os.chdir(project)
    os.environ.update(environment)
    with log_of(name).open("wb") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in `hoidata repro &` of a script
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    os.setpgrp()
    end_with_starter()
    sys.exit(main(["--wait-for-lock", "repro", "--single-item", *["--force"] * force, name]))
