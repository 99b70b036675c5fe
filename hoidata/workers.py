"""One function over many items in worker processes: bounded, and honest about a worker that is killed.

Unlike ``concurrent.futures`` and loky, whose pools break as a whole, it knows which item each worker had when it died
and of what; only that item is done again. Its workers end with their parent.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from hoidata.cluster import is_used_for, on_cluster
from hoidata.errors import BadInput, HoidataError
from hoidata.lifetime import begin_worker, ctrl_c_blocked

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class WorkerLost(BadInput):
    """An item whose worker process died, also when it was tried once more alone. cause: of what, in words."""

    def __init__(self, item: Any, cause: str) -> None:
        self.item, self.cause = item, cause
        got = f"a process that died ({cause}), and so did another one that had nothing else to do"
        remedy = "run it again with more free memory, or look whether its files are damaged"
        super().__init__(str(item), "a worker process that lives until it is done", got, remedy)

    def __reduce__(self) -> tuple:
        return type(self), (self.item, self.cause)


@dataclass
class _Died:
    """In the place of a result. cause: what ended the process, in words."""

    cause: str


@dataclass
class _Worker:
    process: SpawnProcess
    connection: Connection
    item: Any = None


Function = Callable[[Any], Any]


def in_workers(
    function: Function, items: Sequence[Any], jobs: int, lock: int = -1, on_lost: Function | None = None
) -> Iterator[tuple[Any, Any]]:
    """Each item with the function's result for it, in no fixed order; one item per worker at a time.

    jobs: fresh processes, each with one thread; 1 does the work here, where a death ends all. lock: a file descriptor
    each worker keeps open as long as it lives. on_lost: gives the result of an item whose worker died twice, from a
    WorkerLost; without it that is raised, after all others are done. Raises what the function raised. On a cluster,
    where one is chosen (``hoidata.cluster``), chunks of items are given out instead.
    """
    if is_used_for(jobs) and len(items) > 1:
        given_up = partial(_given_up, on_lost)
        yield from on_cluster(function, items, jobs, _answer_alone, lambda *lost: given_up(WorkerLost(*lost)))
        return
    if jobs <= 1:
        with one_thread():
            yield from ((item, function(item)) for item in items)
        return
    lost = []
    for item, result in _shared_out(function, items, jobs, lock):
        if isinstance(result, _Died):
            lost.append(item)
        else:
            yield item, result
    for item in lost:  # alone: it may need all the memory there is
        for _, result in _shared_out(function, [item], 1, lock):
            died = isinstance(result, _Died)
            yield item, _given_up(on_lost, WorkerLost(item, result.cause)) if died else result


def _given_up(on_lost: Function | None, error: WorkerLost) -> Any:
    if on_lost is None:
        raise error
    return on_lost(error)


def in_order(pairs: Iterator[tuple[Any, Any]], items: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
    """The pairs of ``in_workers`` in the order of the items; those that come early are held until their turn."""
    early: dict[Any, Any] = {}
    for item in items:
        while item not in early:
            done, result = next(pairs)
            early[done] = result
        yield item, early.pop(item)


def _shared_out(function: Function, items: Sequence[Any], jobs: int, lock: int) -> Iterator[tuple[Any, Any]]:
    """Each item with its result, or with ``_Died``; the dead worker's place is taken by a fresh one."""
    waiting = iter(items)
    workers = [_start(function, lock) for _ in range(min(jobs, len(items)))]
    try:
        busy = [worker for worker in workers if _give(worker, waiting)]
        while busy:
            for worker in _ready(busy):
                item, result = worker.item, _result_of(worker)
                busy.remove(worker)
                if isinstance(result, _Died):
                    worker.connection.close()
                    workers.remove(worker)
                    worker = _start(function, lock)
                    workers.append(worker)
                yield item, result
                if _give(worker, waiting):
                    busy.append(worker)
    finally:
        # Nothing is lost by killing: what a worker writes appears whole or not at all.
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.process.join()
            worker.connection.close()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch and of BLAS, as in a worker: their number can change the last bit of a fit, and time.

    Several threads of BLAS take five times as long as one on matrices as small as a hand's.
    """
    import torch
    from threadpoolctl import threadpool_limits

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)


def _start(function: Function, lock: int) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, _Descriptor(lock)), daemon=True)
    with ctrl_c_blocked():
        process.start()
    theirs.close()
    # Not among the arguments: a process that died before it read more of them than a pipe holds would be waited for.
    with contextlib.suppress(ConnectionError):
        ours.send(function)
    return _Worker(process, ours)


def _give(worker: _Worker, waiting: Iterator[Any]) -> bool:
    """Hand the worker its next item; False when there is none."""
    worker.item = next(waiting, None)
    if worker.item is None:
        return False
    with contextlib.suppress(ConnectionError):  # it is dead: found out when its answer does not come
        worker.connection.send(worker.item)
    return True


def _ready(busy: list[_Worker]) -> list[_Worker]:
    found = set(wait([worker.connection for worker in busy] + [worker.process.sentinel for worker in busy]))
    return [worker for worker in busy if worker.connection in found or worker.process.sentinel in found]


def _result_of(worker: _Worker) -> Any:
    """The worker's answer. Raises what the function raised, and BadInput for a process that went by itself."""
    try:
        result, problem = worker.connection.recv()
    except (EOFError, OSError):  # OSError: in the middle of its answer
        worker.process.join()
        code = worker.process.exitcode or 0
        if code >= 0:  # no fault of the item: such a process never began (a script without a __main__ guard)
            got = f"exit code {code}"
            raise BadInput(worker.item, "a worker process that starts", got, "look at what it wrote above") from None
        killed = "killed by SIGKILL, as the system does when memory runs out"
        return _Died(killed if code == -signal.SIGKILL else f"signal {signal.Signals(-code).name}")
    if problem is not None:
        raise problem
    return result


class _Descriptor:
    """A file descriptor that a spawned process receives as its own copy; -1 for none."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple:
        return (_Descriptor, (-1,)) if self.number < 0 else (_received, (reduction.DupFd(self.number),))


def _received(copy: Any) -> _Descriptor:
    return _Descriptor(copy.detach())


def _serve(connection: Connection, lock: _Descriptor) -> None:
    """A worker's life. ``lock`` is held by being open until the process ends."""
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))  # read by libraries that the function loads later
    begin_worker()
    try:
        function = connection.recv()
    except EOFError:  # the parent is gone
        return
    if torch := sys.modules.get("torch"):  # loaded with the function
        torch.set_num_threads(1)
    while True:
        try:
            item = connection.recv()
        except EOFError:  # the parent is gone
            return
        connection.send(_answer(function, item))


def _answer_alone(function: Function, item: Any) -> tuple[Any, Exception | None]:
    with one_thread():
        return _answer(function, item)


def _answer(function: Function, item: Any) -> tuple[Any, Exception | None]:
    """The result, or what was raised."""
    try:
        return function(item), None
    except HoidataError as error:
        return None, error
    except Exception:
        return None, RuntimeError(f"{item}: {traceback.format_exc()}")
