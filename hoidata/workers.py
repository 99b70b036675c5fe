"""One function over many items in worker processes, or on Dask.

Unlike ``concurrent.futures`` and loky, whose pools break as a whole, it knows which item each worker had when it died
and of what; only that item is done again. Its workers end with their parent.

Dask is an optional extra (``pip install 'hoidata[dask]'``): a cluster of this machine, or one that runs already. It is
chosen for a process, not for a call: results never depend on it. Its workers need the same environment and the same
files at the same paths.
"""

import contextlib
import math
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from hoidata.errors import BadInput, HoidataError, MissingResource
from hoidata.lifetime import begin_worker, ctrl_c_blocked

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
LOCAL, DASK = "local", "dask"
CHUNKS_PER_WORKER = 4
PATIENCE_S = 30
_chosen = [LOCAL]


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
    WorkerLost; without it that is raised, after all others are done. Raises what the function raised. On a cluster
    (``choose_workers``) chunks of items are given out instead.
    """
    if is_used_for(jobs) and len(items) > 1:
        yield from _on_cluster(function, items, jobs, on_lost)
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


def _answer(function: Function, item: Any) -> tuple[Any, Exception | None]:
    """The result, or what was raised."""
    try:
        return function(item), None
    except HoidataError as error:
        return None, error
    except Exception:
        return None, RuntimeError(f"{item}: {traceback.format_exc()}")


def choose_workers(where: str) -> None:
    """Where the workers of this process are from now on.

    where: "local" (processes), "dask" (a Dask cluster started here for each fan-out), or the address of a scheduler
    such as tcp://host:8786. Raises BadInput for anything else, MissingResource without the extra.
    """
    if where not in (LOCAL, DASK) and "://" not in where:
        raise BadInput(
            "workers", f"{LOCAL}, {DASK} or a scheduler's address such as tcp://host:8786", where, "correct it"
        )
    if where != LOCAL:
        try:
            import distributed  # noqa: F401
        except ImportError as error:
            raise MissingResource("workers on Dask need the extra: pip install 'hoidata[dask]'") from error
    _chosen[0] = where


def is_used_for(jobs: int) -> bool:
    """Whether work for so many workers goes to a cluster: one that runs already always, a new one not for a single."""
    return _chosen[0] not in (LOCAL, DASK) or (_chosen[0] == DASK and jobs > 1)


def _on_cluster(
    function: Function, items: Sequence[Any], jobs: int, on_lost: Function | None
) -> Iterator[tuple[Any, Any]]:
    """``in_workers`` on the chosen cluster. jobs: workers of a cluster started here.

    A worker that dies costs its chunk, which others do again; a chunk that has ended several is done item by item.
    """
    from distributed import KilledWorker

    with _client(jobs) as client:
        workers = len(client.scheduler_info()["workers"]) or 1
        size = max(1, math.ceil(len(items) / (CHUNKS_PER_WORKER * workers)))
        chunks = [list(items[start : start + size]) for start in range(0, len(items), size)]

        # The function goes with every chunk: shared by `scatter` it would be lost with the workers that hold it.
        def submitted(chunk: list[Any]) -> Any:
            return client.submit(_work, function, chunk, os.getcwd(), pure=False)

        running = {submitted(chunk): chunk for chunk in chunks}
        while running:
            for future in _done(client, running):
                chunk = running.pop(future)
                try:
                    found = future.result()
                except KilledWorker:  # also of a chunk that was done, whose result went with the worker that held it
                    if len(chunk) == 1:
                        error = WorkerLost(chunk[0], "each of several workers it was given to ended")
                        yield chunk[0], _given_up(on_lost, error)
                    else:
                        running |= {submitted([item]): [item] for item in chunk}
                    continue
                for item, (result, problem) in zip(chunk, found, strict=True):
                    if problem is not None:
                        raise problem
                    yield item, result
                future.release()


def _done(client: Any, running: Iterable[Any]) -> set[Any]:
    """Those that have ended, once one has. Raises BadInput when there is no worker to wait for."""
    from distributed import wait as wait_for

    while True:
        try:
            with client.as_current():
                ended: Any = wait_for(list(running), timeout=PATIENCE_S, return_when="FIRST_COMPLETED")
                return ended.done
        except TimeoutError:
            if not client.scheduler_info()["workers"]:
                remedy = "start one (`dask worker ADDRESS --nthreads 1`) and run it again"
                raise BadInput("workers", "a Dask cluster with a worker", f"none for {PATIENCE_S} s", remedy) from None


def _client(jobs: int) -> Any:
    """A client of the chosen cluster; leaving it ends a cluster that was started for it."""
    from distributed import Client

    if _chosen[0] == DASK:
        # security: TLS with new certificates. Without it any user of this machine could run code as this one.
        started = {"n_workers": jobs, "threads_per_worker": 1, "dashboard_address": None, "security": True}
        return Client(**started, set_as_default=False)
    try:
        return Client(_chosen[0], timeout=PATIENCE_S, set_as_default=False)
    except OSError as error:
        remedy = "start it (`dask scheduler`, `dask worker ADDRESS --nthreads 1`), or set workers to local"
        raise BadInput("workers", f"a Dask scheduler at {_chosen[0]}", str(error)[:200] or "none", remedy) from error


def _work(function: Function, chunk: list[Any], folder: str) -> list[tuple[Any, Exception | None]]:
    """In a worker: the results of a chunk, or what was raised; paths are those of the one that asks."""
    os.chdir(folder)
    with one_thread():
        return [_answer(function, item) for item in chunk]
