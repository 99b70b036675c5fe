"""One function over many items in worker processes, some of which die. Spawned processes import this module."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from functools import partial
from pathlib import Path

import psutil
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from hoidata.errors import BadInput
from hoidata.workers import WorkerDied, map_in_workers
from tests.hoidata.test_lifetime import is_at_work, until


def squared(item: int) -> int:
    return item * item


def deadly(item: int) -> int:
    if item == 3:
        os.kill(os.getpid(), signal.SIGSEGV)
    return squared(item)


def deadly_once(path: Path) -> str:
    """Ends its process at the first call with a path."""
    if not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return path.name


def squared_with_ballast(_ballast: bytes, item: int) -> int:
    return item * item


def broken(item: int) -> int:
    return 1 // (item - 3)


def blas_threads(_: int) -> int:
    import numpy as np

    np.ones((2, 2)) @ np.ones((2, 2))
    return max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")


@pytest.mark.slow
def test_an_item_that_kills_each_process_is_lost_and_all_others_are_done():
    results = dict(map_in_workers(deadly, range(6), 2, on_worker_died=lambda error: f"{error.item}: {error.cause}"))
    assert results == {0: 0, 1: 1, 2: 4, 3: "3: signal SIGSEGV", 4: 16, 5: 25}
    done = []
    with pytest.raises(WorkerDied, match=r"3: expected.*SIGSEGV"):
        done.extend(item for item, _ in map_in_workers(deadly, range(6), 2))
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_an_item_whose_process_dies_once_is_repeated(tmp_path):
    paths = [tmp_path / str(number) for number in range(3)]
    assert dict(map_in_workers(deadly_once, paths, 2)) == {path: path.name for path in paths}


@pytest.mark.slow
def test_a_process_that_dies_before_it_reads_its_function_is_replaced():
    """The function is larger than the buffer of a pipe, so that the parent could block while it writes."""
    killed, over = [], threading.Event()

    def kill_the_first() -> None:
        while not killed and not over.wait(0.001):
            # Search all children: process ids wrap around, so the newest child may not be the last one.
            for child in psutil.Process().children():
                with suppress(psutil.Error):
                    if not killed and "spawn_main" in " ".join(child.cmdline()):
                        child.kill()
                        killed.append(child.pid)

    signal.signal(signal.SIGALRM, lambda *_: pytest.fail("waits for a dead process"))
    killer = threading.Thread(target=kill_the_first)
    killer.start()
    signal.alarm(60)
    try:
        assert dict(map_in_workers(partial(squared_with_ballast, bytes(1 << 20)), range(4), 2)) == {
            0: 0,
            1: 1,
            2: 4,
            3: 9,
        }
    finally:
        signal.alarm(0)
        over.set()
        killer.join()
    assert killed


@pytest.mark.slow
def test_an_exception_of_the_function_names_the_item_and_ends_the_workers():
    with pytest.raises(RuntimeError, match=r"3: Traceback(?s:.)*ZeroDivisionError"):
        list(map_in_workers(broken, range(6), 2))
    assert not multiprocessing.active_children()


WORKERS = """
import os, time
from hoidata.workers import map_in_workers
def work(item):
    print(os.getpid(), flush=True)
    time.sleep(60)
if __name__ == "__main__":
    list(map_in_workers(work, range(2), 2))
"""
POOL = """
import os, time
from pathlib import Path
from types import SimpleNamespace
from hoidata import lifetime
from hoidata.conformance.trials import Trials
class Key:
    def __reduce__(self):
        return waiting, ()
def waiting():
    print(os.getpid(), flush=True)
    time.sleep(60)
def main():
    Trials(None, Path(), Path(), [SimpleNamespace(key=Key(), needed=[])], None).in_worker()
if __name__ == "__main__":
    lifetime.GRACE_S = 1
    lifetime.run_interruptibly(main)
"""


@pytest.mark.long
@pytest.mark.parametrize(("code", "count"), [(WORKERS, 2), (POOL, 1)], ids=["workers", "pool of adapters check"])
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT])
def test_worker_processes_end_with_their_parent(tmp_path, code, count, sent):
    (tmp_path / "script.py").write_text(code)
    starter = subprocess.Popen(
        [sys.executable, tmp_path / "script.py"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    workers = [psutil.Process(int(starter.stdout.readline())) for _ in range(count)]
    starter.send_signal(sent)
    until(lambda: not any(map(is_at_work, workers)), 30)
    starter.kill()
    starter.communicate()


def test_one_job_works_in_this_process():
    assert list(map_in_workers(squared, range(3), 1)) == [(0, 0), (1, 1), (2, 4)]


def test_one_job_uses_one_blas_thread_and_restores_the_number():
    with threadpool_limits(2, user_api="blas"):
        assert list(map_in_workers(blas_threads, [0], 1)) == [(0, 1)]
        assert blas_threads(0) == 2


def test_a_lost_worker_can_be_pickled():
    import pickle

    error = pickle.loads(pickle.dumps(WorkerDied("grab/s1/1", "signal SIGSEGV")))
    assert isinstance(error, BadInput)
    assert (error.where, error.cause) == ("grab/s1/1", "signal SIGSEGV")
