"""The graph side by side: DVC runs single stages as soon as their inputs are ready.

Which stages there are, their order and what is stale is asked of DVC; nothing of it is written down here.
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
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import connection
from pathlib import Path
from types import ModuleType
from typing import Any

from hoidata.errors import BadInput, told_in_words
from hoidata.files.atomic import exclusive, write_whole
from hoidata.lifetime import ctrl_c_blocked, end_with_starter
from pipelines.warm import WarmProcess

CODE = "pipelines/dvc.yaml:code"
RUN = Path(".hoidata/repro")
RWLOCK = Path(".dvc/tmp/rwlock")
LOGS = Path(".hoidata/logs")
DURATIONS = Path(".hoidata/durations.json")
# What every run of a single stage would import anew, about a second each time.
PRELOADED = ["dvc.cli", "dvc.commands.repro", "dvc.repo.reproduce", "dvc.output", "dvc.stage.run"]
TAIL = 15
STOP_S = 5.0
_STARTING = threading.Lock()
_ROOM = 1 << 20  # bytes that must fit beside the cache before anything is begun
Upstream = Mapping[str, frozenset[str]]
RunStage = Callable[[str], int]


@dataclass
class Run:
    """What happened: seconds of each stage that was tried, exit codes of those that failed, seconds in all."""

    seconds: dict[str, float] = field(default_factory=dict)
    failed: dict[str, int] = field(default_factory=dict)
    wall: float = 0.0


def reproduce_side_by_side(
    targets: list[str], jobs: int, wrap: Callable[[RunStage], RunStage] | None = None, force: bool = False
) -> Run:
    """Bring the targets (all when empty) up to date, up to ``jobs`` stages at once. Bytes do not depend on ``jobs``.

    wrap: makes of the function that runs one stage the one that is called for each, for instance a Prefect task.
    force: run the targets (all that is needed when empty) even where DVC finds nothing changed.
    A stage that fails stops what follows from it and nothing else. Raises BadInput when another run is under way here.
    """
    # Left in the opposite order: running stages are stopped before the threads that wait for them are.
    with exclusive(RUN, wait_s=0), ThreadPoolExecutor(jobs) as pool, _Children(max(1, _cores() // jobs)) as children:
        forget_broken_lock()
        run_stage = wrap(children.run) if wrap else children.run
        start, run = time.monotonic(), Run()
        if _timed(CODE, run_stage, run):
            _tell(CODE, run, 0)
        else:
            upstream = stale_stages(targets, children.forced if force else None)
            if len(upstream) > jobs:
                children.warm.start()
            run_all(upstream, pool, jobs, run_stage, run)
            write_whole(DURATIONS, json.dumps({**read_durations(), **run.seconds}, indent=1, sort_keys=True))
        run.wall = time.monotonic() - start
        return run


def forget_broken_lock() -> None:
    """Remove DVC's file of who reads and writes what, where a process that was killed has left half of it.

    It is kept for processes that run; a broken one keeps every later run from starting.
    """
    if not _is_broken(RWLOCK):
        return
    from dvc.lock import make_lock

    # Under DVC's own guard: whoever writes it at this moment has it.
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


def stale_stages(targets: list[str], forced: set[str] | None = None) -> dict[str, frozenset[str]]:
    """Stages the targets need that DVC finds changed, and all that follow from them, each with those it waits for.

    forced: filled with the names of the targets, which then count as changed. Raises BadInput for targets that DVC
    does not know, and while another DVC command holds the project.
    """
    from dvc.exceptions import DvcException

    try:
        return _ask_dvc(targets, forced)
    except DvcException as error:
        got, remedy = str(error), "`dvc stage list --all` names all targets"
        raise BadInput(" ".join(targets) or "dvc.yaml", "stages that DVC can run", got, remedy) from error


def _ask_dvc(targets: list[str], forced: set[str] | None) -> dict[str, frozenset[str]]:
    import networkx
    from dvc.repo import Repo
    from dvc.repo.reproduce import collect_stages, get_active_graph, plan_repro

    with Repo() as repo, repo.lock:
        graph = get_active_graph(repo.index.graph)
        asked = collect_stages(repo, targets or ["dvc.yaml"])
        stages = plan_repro(graph, asked)
        needed = graph.subgraph(stages)
        if forced is not None:
            forced.update(stage.addressing for stage in (asked if targets else stages))
        known = {CODE, *(forced or ())}
        changed = [stage for stage in stages if stage.addressing not in known and stage.changed()]
        changed += [stage for stage in stages if stage.addressing in known - {CODE}]
        if changed:
            _try_writing(Path(repo.cache.local.path))
        stale = set(changed).union(*(networkx.ancestors(needed, stage) for stage in changed))
        return {
            stage.addressing: frozenset(other.addressing for other in needed.successors(stage) if other in stale)
            for stage in stages
            if stage in stale
        }


def _try_writing(folder: Path) -> None:
    """Raise MachineTrouble where DVC could not keep what stages make: they would run for nothing."""
    with told_in_words():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder) as stream:
            stream.write(bytes(_ROOM))
            stream.flush()


def run_all(upstream: Upstream, pool: ThreadPoolExecutor, jobs: int, run_stage: RunStage, run: Run) -> None:
    """Run every stage once those it waits for are done; first the one with the longest way to the end behind it."""
    remaining = _remaining_seconds(upstream, read_durations())
    waiting = dict(upstream)
    running: dict[Future[int], str] = {}
    while waiting or running:
        unfinished = waiting.keys() | set(running.values())
        ready = sorted((name for name in waiting if not waiting[name] & unfinished), key=lambda name: -remaining[name])
        for name in ready[: jobs - len(running)]:
            del waiting[name]
            context = contextvars.copy_context()
            running[pool.submit(context.run, _timed, name, run_stage, run)] = name
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            name = running.pop(future)
            if future.result():
                waiting = _without_followers(waiting, name)
            _tell(name, run, len(upstream))


def describe_run(run: Run) -> str:
    """Where the time went, by kind of stage, and which stages failed."""
    kinds: dict[str, list[float]] = {}
    for name, seconds in run.seconds.items():
        kinds.setdefault(name.split(":")[-1].split("@")[0], []).append(seconds)
    rows = sorted(kinds.items(), key=lambda row: -sum(row[1]))
    lines = [f"{kind:16} {len(seconds):4} stages {sum(seconds):8.1f} s" for kind, seconds in rows]
    lines.append(
        f"{'all':16} {len(run.seconds):4} stages {sum(run.seconds.values()):8.1f} s, in {run.wall:.1f} s by the clock"
    )
    lines += [f"failed: {name}; all it said: {log_of(name)}" for name in run.failed]
    return "\n".join(lines)


def _timed(name: str, run_stage: RunStage, run: Run) -> int:
    start = time.monotonic()
    code = run_stage(name)
    run.seconds[name] = time.monotonic() - start
    if code:
        run.failed[name] = code
    return code


def _tell(name: str, run: Run, number: int) -> None:
    """One line per finished stage, and what a failed one said last."""
    done = len(run.seconds) - 1
    print(f"[{done}/{number}] {name}: {'FAILED after ' * (name in run.failed)}{run.seconds[name]:.1f} s", flush=True)
    if name in run.failed:
        lines = log_of(name).read_text(errors="replace").splitlines()[-TAIL:] if log_of(name).is_file() else []
        print("\n".join(f"    {line}" for line in lines), file=sys.stderr, flush=True)


def _without_followers(waiting: Upstream, failed: str) -> dict[str, frozenset[str]]:
    """The stages that do not wait, directly or through others, for the one that failed."""
    lost = {failed}
    while more := {name for name, needs in waiting.items() if name not in lost and needs & lost}:
        lost |= more
    return {name: needs for name, needs in waiting.items() if name not in lost}


def _remaining_seconds(upstream: Upstream, known: Mapping[str, float]) -> dict[str, float]:
    """For each stage the seconds of the longest chain that starts with it; 1 where nothing is known."""
    followers: dict[str, list[str]] = {name: [] for name in upstream}
    for name, needs in upstream.items():
        for need in needs:
            followers[need].append(name)
    seconds: dict[str, float] = {}

    def fill(name: str) -> float:
        if name not in seconds:
            seconds[name] = known.get(name, 1.0) + max(map(fill, followers[name]), default=0.0)
        return seconds[name]

    for name in upstream:
        fill(name)
    return seconds


def read_durations() -> dict[str, float]:
    """Seconds of every stage when it last ran; nothing where that is not known."""
    try:
        return {str(name): float(value) for name, value in json.loads(DURATIONS.read_text()).items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}  # only the order of stages depends on it


def log_of(name: str) -> Path:
    """Where what a stage printed is kept."""
    return LOGS / f"{name.replace('/', '-').replace(':', '-')}.log"


def _cores() -> int:
    return len(os.sched_getaffinity(0))


class _Children:
    """Processes that run DVC for one stage each, forked from one that has it loaded; none outlives this one's end."""

    def __init__(self, cores: int) -> None:
        self.cores, self.ends = cores, False
        self.context = multiprocessing.get_context("forkserver")
        self.processes: set[Any] = set()
        self.forced: set[str] = set()
        self.warm = WarmProcess()

    def __enter__(self) -> "_Children":
        self.context.set_forkserver_preload(PRELOADED)
        in_main = threading.current_thread() is threading.main_thread()
        if in_main and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:  # commands and Prefect have handlers
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop what is still at work, as after Ctrl-C: the outputs of unfinished stages stay what they were.

        A stage that has not ended after STOP_S is killed.
        """
        with _STARTING:
            self.ends = True
        for number, seconds in ((signal.SIGINT, STOP_S), (signal.SIGKILL, 0)):
            for process in self._at_work(0):
                _signal_group(process.pid, number)
            self._at_work(seconds)
        self.warm.close()

    def _at_work(self, seconds: float) -> list[Any]:
        """The processes that have not ended, after up to so many seconds in which all of them might.

        Their exit codes are left to the threads that wait for them: a second reader would get none.
        """
        deadline, processes = time.monotonic() + seconds, list(self.processes)
        while processes:
            ended = connection.wait([process.sentinel for process in processes], max(0, deadline - time.monotonic()))
            processes = [process for process in processes if process.sentinel not in ended]
            if not ended:
                break
        return processes

    def run(self, name: str) -> int:
        """DVC's exit code for one stage; what it prints goes to the stage's log."""
        LOGS.mkdir(parents=True, exist_ok=True)
        environment = {"HOIDATA_JOBS": str(self.cores), **self.warm.environment}
        process = self.context.Process(
            target=_run_single_stage, args=(Path.cwd(), name, name in self.forced, environment)
        )
        with _without_main():
            if self.ends:
                return 128 + signal.SIGINT
            with ctrl_c_blocked():
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
    """A child that starts meanwhile does not import what this process was started with: Prefect takes a second."""
    with _STARTING:
        main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main


def _run_single_stage(project: Path, name: str, force: bool, environment: dict[str, str]) -> None:
    """In the child: its own group of processes, so that a signal for one stage reaches all of it."""
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
