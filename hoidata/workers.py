"""One function over many items in worker processes: bounded, and honest about a worker that is killed.

Unlike ``concurrent.futures``, it knows which item each worker had when it died, and its workers end with their parent.
"""

import contextlib
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from hoidata.errors import HoidataError


class WorkerLost(HoidataError):
    """A worker process was killed. in_flight: the items the workers had at that moment, that of the dead one first."""

    def __init__(self, cause: str, in_flight: Sequence[Any]) -> None:
        self.cause, self.in_flight = cause, tuple(in_flight)
        super().__init__(f"a worker process was lost ({cause}) at {', '.join(map(str, in_flight)) or 'its start'}")


@dataclass
class _Worker:
    process: SpawnProcess
    connection: Connection
    item: Any = None


Function = Callable[[Any], Any]


def in_workers(function: Function, items: Sequence[Any], jobs: int, lock: int = -1) -> Iterator[tuple[Any, Any]]:
    """Each item with the function's result for it, in no fixed order; one item per worker at a time.

    jobs: fresh processes, each with one thread; 1 does the work here. lock: a file descriptor each worker keeps open
    as long as it lives. Raises WorkerLost for a worker that died, and what the function raised; the others are ended.
    """
    if jobs <= 1 or len(items) < 2:
        with one_thread():
            for item in items:
                yield item, function(item)
        return
    waiting = iter(items)
    workers = [_start(function, lock) for _ in range(min(jobs, len(items)))]
    try:
        busy = [worker for worker in workers if _give(worker, waiting)]
        while busy:
            for worker in _ready(busy):
                yield _result_of(worker, busy)
                if not _give(worker, waiting):
                    busy.remove(worker)
    finally:
        # Nothing is lost by killing: what a worker writes appears whole or not at all.
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.process.join()
            worker.connection.close()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """One torch thread, as in a worker: the number of threads can change the last bit of a fit."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _start(function: Function, lock: int) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(function, theirs, _Descriptor(lock)), daemon=True)
    process.start()
    theirs.close()
    return _Worker(process, ours)


def _give(worker: _Worker, waiting: Iterator[Any]) -> bool:
    """Hand the worker its next item; False when there is none."""
    worker.item = next(waiting, None)
    if worker.item is None:
        return False
    with contextlib.suppress(BrokenPipeError):  # it is dead: found out when its answer does not come
        worker.connection.send(worker.item)
    return True


def _ready(busy: list[_Worker]) -> list[_Worker]:
    found = set(wait([worker.connection for worker in busy] + [worker.process.sentinel for worker in busy]))
    return [worker for worker in busy if worker.connection in found or worker.process.sentinel in found]


def _result_of(worker: _Worker, busy: list[_Worker]) -> tuple[Any, Any]:
    try:
        result, problem = worker.connection.recv()
    except (EOFError, ConnectionError):
        worker.process.join()
        others = [other.item for other in busy if other is not worker]
        raise WorkerLost(_cause(worker.process.exitcode or 0), [worker.item, *others]) from None
    if problem is not None:
        raise problem
    return worker.item, result


def _cause(code: int) -> str:
    if code == -signal.SIGKILL:
        return "killed by SIGKILL, as the system does when memory runs out"
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


class _Descriptor:
    """A file descriptor that a spawned process receives as its own copy; -1 for none."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple:
        return (_Descriptor, (-1,)) if self.number < 0 else (_received, (reduction.DupFd(self.number),))


def _received(copy: Any) -> _Descriptor:
    return _Descriptor(copy.detach())


def _serve(function: Function, connection: Connection, lock: _Descriptor) -> None:
    """A worker's life. ``lock`` is held by being open until the process ends."""
    # Ctrl-C reaches the whole group: the parent decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with one_thread():
        while True:
            try:
                item = connection.recv()
            except EOFError:  # the parent is gone
                return
            connection.send(_answer(function, item))


def _answer(function: Function, item: Any) -> tuple[Any, Exception | None]:
    """The result, or what was raised."""
    try:
        return function(item), None
    except HoidataError as error:
        return None, error
    except Exception:
        return None, RuntimeError(f"{item}: {traceback.format_exc()}")


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
