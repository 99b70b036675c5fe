"""The same work on Dask: chunks of items on a cluster of this machine, or on one that runs already.

An optional extra (``pip install 'hoidata[dask]'``). Which cluster is chosen for a process, not for a call: results
never depend on it. Workers need the same environment and the same files at the same paths.
"""

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from hoidata.errors import BadInput, MissingResource

Answer = Callable[[Callable[[Any], Any], Any], tuple[Any, Exception | None]]

LOCAL, DASK = "local", "dask"
CHUNKS_PER_WORKER = 4
PATIENCE_S = 30
_chosen = [LOCAL]


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


def on_cluster(
    function: Callable[[Any], Any], items: Sequence[Any], jobs: int, answer: Answer, lost: Callable[[Any, str], Any]
) -> Iterator[tuple[Any, Any]]:
    """Each item with the function's result for it, in no fixed order; see ``hoidata.workers.in_workers``.

    answer: gives the function's result for an item, and what it raised. jobs: workers of a cluster started here.
    A worker that dies costs its chunk, which others do again; a chunk that has ended several is done item by item.
    lost: gives the result of an item that does so alone.
    """
    from distributed import KilledWorker

    with _client(jobs) as client:
        workers = len(client.scheduler_info()["workers"]) or 1
        size = max(1, math.ceil(len(items) / (CHUNKS_PER_WORKER * workers)))
        chunks = [list(items[start : start + size]) for start in range(0, len(items), size)]

        # The function goes with every chunk: shared by `scatter` it would be lost with the workers that hold it.
        def submitted(chunk: list[Any]) -> Any:
            return client.submit(_work, function, chunk, os.getcwd(), answer, pure=False)

        running = {submitted(chunk): chunk for chunk in chunks}
        while running:
            for future in _done(client, running):
                chunk = running.pop(future)
                try:
                    found = future.result()
                except KilledWorker:  # also of a chunk that was done, whose result went with the worker that held it
                    if len(chunk) == 1:
                        yield chunk[0], lost(chunk[0], "each of several workers it was given to ended")
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
    from distributed import wait

    while True:
        try:
            with client.as_current():
                ended: Any = wait(list(running), timeout=PATIENCE_S, return_when="FIRST_COMPLETED")
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


def _work(
    function: Callable[[Any], Any], chunk: list[Any], folder: str, answer: Answer
) -> list[tuple[Any, Exception | None]]:
    """In a worker: the results of a chunk, or what was raised; paths are those of the one that asks."""
    os.chdir(folder)
    return [answer(function, item) for item in chunk]
