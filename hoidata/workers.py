"""Apply one function to many items in worker processes, or on Dask.

The pools of ``concurrent.futures`` and loky break as a whole when a worker dies. This one repeats only the item of the
dead worker, and reports the cause. Workers end with their parent.

Dask is an optional extra (``pip install 'hoidata[dask]'``): a local cluster, or a running one. It is chosen per
process, not per call, since results do not depend on it. Its workers need the same environment and the same files at
the same paths.
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
from hoidata.lifetime import block_ctrl_c, init_worker

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
LOCAL, DASK = "local", "dask"
CHUNKS_PER_WORKER = 4
PATIENCE_S = 30
_chosen = [LOCAL]


class WorkerDied(BadInput):
    """An item whose worker process died twice, the second time without other workers. cause: why the process ended."""

    def __init__(self, item: Any, cause: str) -> None:
        self.item, self.cause = item, cause
        got = f"a process that died ({cause}), twice"
        remedy = "run it again with more free memory, or check whether its files are damaged"
        super().__init__(str(item), "a worker process that finishes it", got, remedy)

    def __reduce__(self) -> tuple:
        return type(self), (self.item, self.cause)


@dataclass
class _Died:
    """Result of an item whose worker process died."""

    cause: str  # why the process ended


@dataclass
class _Worker:
    process: SpawnProcess
    connection: Connection
    item: Any = None


Function = Callable[[Any], Any]


def map_in_workers(
    function: Function, items: Sequence[Any], jobs: int, lock: int = -1, on_worker_died: Function | None = None
) -> Iterator[tuple[Any, Any]]:
    """Yield each item with the function's result, in no fixed order; exceptions of the function are raised.

    A worker has one item at a time; on a cluster (``choose_workers``) a chunk of items.

    Args:
        function: applied to each item.
        items: the items.
        jobs: number of new processes, each with one thread; 1 works in this process.
        lock: a file descriptor that each worker keeps open until it ends; -1 for none.
        on_worker_died: result of an item whose worker died twice, from its WorkerDied. By default the error is raised
            after all other items.
    """
    if uses_cluster(jobs) and len(items) > 1:
        yield from _on_cluster(function, items, jobs, on_worker_died)
        return
    if jobs <= 1:
        with one_thread():
            yield from ((item, function(item)) for item in items)
        return
    lost = []
    for item, result in _distributed(function, items, jobs, lock):
        if isinstance(result, _Died):
            lost.append(item)
        else:
            yield item, result
    for item in lost:  # without other workers: it may need all memory
        for _, result in _distributed(function, [item], 1, lock):
            died = isinstance(result, _Died)
            yield item, _result_of_lost(on_worker_died, WorkerDied(item, result.cause)) if died else result


def _result_of_lost(on_worker_died: Function | None, error: WorkerDied) -> Any:
    if on_worker_died is None:
        raise error
    return on_worker_died(error)


def in_order(pairs: Iterator[tuple[Any, Any]], items: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
    """Sort the pairs of ``map_in_workers`` into the order of the items; early results are buffered."""
    early: dict[Any, Any] = {}
    for item in items:
        while item not in early:
            done, result = next(pairs)
            early[done] = result
        yield item, early.pop(item)


def _distributed(function: Function, items: Sequence[Any], jobs: int, lock: int) -> Iterator[tuple[Any, Any]]:
    """Yield each item with its result or ``_Died``; a dead worker is replaced by a new one."""
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
        # Killing is safe: workers write files atomically.
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.process.join()
            worker.connection.close()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch and BLAS to one thread, as in a worker: the number of threads can change the last bit of a fit.

    Several BLAS threads take five times as long as one on matrices of the size of a hand.
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
    with block_ctrl_c():
        process.start()
    theirs.close()
    # Not among the arguments: if the process dies before it reads more than a pipe buffers, start() would block.
    with contextlib.suppress(ConnectionError):
        ours.send(function)
    return _Worker(process, ours)


def _give(worker: _Worker, waiting: Iterator[Any]) -> bool:
    """Send the worker its next item; False after the last one."""
    worker.item = next(waiting, None)
    if worker.item is None:
        return False
    with contextlib.suppress(ConnectionError):  # the worker is dead, which `_result_of` notices
        worker.connection.send(worker.item)
    return True


def _ready(busy: list[_Worker]) -> list[_Worker]:
    """Workers with a result, and dead ones; waits for the first."""
    ready = set(wait([worker.connection for worker in busy] + [worker.process.sentinel for worker in busy]))
    return [worker for worker in busy if worker.connection in ready or worker.process.sentinel in ready]


def _result_of(worker: _Worker) -> Any:
    """The worker's result. Raises the function's exception, and BadInput for a process that exited by itself."""
    try:
        result, problem = worker.connection.recv()
    except (EOFError, OSError):  # OSError: while it sends its result
        worker.process.join()
        code = worker.process.exitcode or 0
        if code >= 0:  # not caused by the item: the process did not start (a script without a __main__ guard)
            got = f"exit code {code}"
            raise BadInput(worker.item, "a worker process that starts", got, "read its messages above") from None
        killed = "killed by SIGKILL, as the system does when memory runs out"
        return _Died(killed if code == -signal.SIGKILL else f"signal {signal.Signals(-code).name}")
    if problem is not None:
        raise problem
    return result


class _Descriptor:
    """A file descriptor that is duplicated for a spawned process; -1 for none."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple:
        return (_Descriptor, (-1,)) if self.number < 0 else (_received, (reduction.DupFd(self.number),))


def _received(copy: Any) -> _Descriptor:
    return _Descriptor(copy.detach())


def _serve(connection: Connection, lock: _Descriptor) -> None:
    """Main loop of a worker process. ``lock`` is a descriptor that stays open until the process ends."""
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))  # read by libraries that the function loads later
    init_worker()
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
    """The result or the exception."""
    try:
        return function(item), None
    except HoidataError as error:
        return None, error
    except Exception:
        return None, RuntimeError(f"{item}: {traceback.format_exc()}")


def choose_workers(backend: str) -> None:
    """Choose the kind of workers for all later calls in this process.

    Args:
        backend: "local" (processes), "dask" (a Dask cluster started per call), or the address of a running scheduler
            such as tcp://host:8786.

    Raises:
        BadInput: another backend.
        MissingResource: Dask is not installed.
    """
    if backend not in (LOCAL, DASK) and "://" not in backend:
        raise BadInput(
            "workers", f"{LOCAL}, {DASK} or a scheduler's address such as tcp://host:8786", backend, "correct it"
        )
    if backend != LOCAL:
        try:
            import distributed  # noqa: F401
        except ImportError as error:
            raise MissingResource("workers on Dask need the extra: pip install 'hoidata[dask]'") from error
    _chosen[0] = backend


def uses_cluster(jobs: int) -> bool:
    """Whether work for ``jobs`` workers goes to a cluster; a new cluster is not started for a single worker."""
    return _chosen[0] not in (LOCAL, DASK) or (_chosen[0] == DASK and jobs > 1)


def _on_cluster(
    function: Function, items: Sequence[Any], jobs: int, on_worker_died: Function | None
) -> Iterator[tuple[Any, Any]]:
    """``map_in_workers`` on the chosen cluster. jobs: number of workers of a cluster started here.

    The chunk of a dead worker is repeated by others. A chunk that ends several workers is split into single items.
    """
    from distributed import KilledWorker

    with _client(jobs) as client:
        workers = len(client.scheduler_info()["workers"]) or 1
        size = max(1, math.ceil(len(items) / (CHUNKS_PER_WORKER * workers)))
        chunks = [list(items[start : start + size]) for start in range(0, len(items), size)]

        # The function is sent with each chunk: after `scatter` it would be lost with the workers that store it.
        def submitted(chunk: list[Any]) -> Any:
            return client.submit(_work, function, chunk, os.getcwd(), pure=False)

        running = {submitted(chunk): chunk for chunk in chunks}
        while running:
            for future in _done(client, running):
                chunk = running.pop(future)
                try:
                    results = future.result()
                except KilledWorker:  # also for a finished chunk whose worker died with the result
                    if len(chunk) == 1:
                        error = WorkerDied(chunk[0], "several workers ended with it")
                        yield chunk[0], _result_of_lost(on_worker_died, error)
                    else:
                        running |= {submitted([item]): [item] for item in chunk}
                    continue
                for item, (result, problem) in zip(chunk, results, strict=True):
                    if problem is not None:
                        raise problem
                    yield item, result
                future.release()


def _done(client: Any, running: Iterable[Any]) -> set[Any]:
    """Wait for the first futures to finish. Raises BadInput if the cluster has no worker."""
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
    """A client of the chosen cluster; closing it ends a cluster that was started for it."""
    from distributed import Client

    if _chosen[0] == DASK:
        # security: TLS with new certificates. Without it any user of this machine could run code as this user.
        options = {"n_workers": jobs, "threads_per_worker": 1, "dashboard_address": None, "security": True}
        return Client(**options, set_as_default=False)
    try:
        return Client(_chosen[0], timeout=PATIENCE_S, set_as_default=False)
    except OSError as error:
        remedy = "start it (`dask scheduler`, `dask worker ADDRESS --nthreads 1`), or set workers to local"
        raise BadInput("workers", f"a Dask scheduler at {_chosen[0]}", str(error)[:200] or "none", remedy) from error


def _work(function: Function, chunk: list[Any], folder: str) -> list[tuple[Any, Exception | None]]:
    """Results or exceptions of a chunk, in a cluster worker; ``folder`` is the working folder of the client."""
    os.chdir(folder)
    with one_thread():
        return [_answer(function, item) for item in chunk]
