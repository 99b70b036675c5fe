"""Lifetime of processes: they end with the process that started them, and within seconds of Ctrl-C or SIGTERM.

Ending at any moment is safe, because files are written atomically.
"""

import _thread
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from types import FrameType
from typing import NoReturn

PR_SET_PDEATHSIG = 1  # of linux/prctl.h
GRACE_S = 8.0
POLL_S = 0.2
INTERRUPTED = "interrupted: finished work is kept; run it again"
_received: list[int] = []


def end_with_parent(parent: int) -> None:
    """Make the kernel kill this process when its parent ends, however it ends. For programs started with ``exec``.

    The end of the thread that started this process counts, too. Linux only.

    Args:
        parent: process id of the parent. If it has ended already, this process ends now.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)


def end_with_starter() -> None:
    """Kill this ``multiprocessing`` process when its parent ends, however it ends."""
    starter = multiprocessing.parent_process()
    assert starter is not None
    _end_after(starter.join)


def init_worker() -> None:
    """Initialise a worker process: it ends with its parent and ignores Ctrl-C, which the parent handles."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    end_with_starter()


@contextmanager
def block_ctrl_c() -> Iterator[None]:
    """Block Ctrl-C in ``multiprocessing`` processes that are started inside, until they unblock it.

    In a terminal Ctrl-C reaches all processes of a command, and a starting interpreter would print a traceback. This
    process receives it at the end of the block.
    """
    resource_tracker.ensure_running()  # which unblocks Ctrl-C in this thread when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_process(pid: int) -> None:
    """Kill this process when the process ``pid`` ends, however it ends."""
    import psutil

    def wait() -> None:
        with suppress(psutil.NoSuchProcess):
            process = psutil.Process(pid)
            while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
                time.sleep(POLL_S)

    _end_after(wait)


def _end_after(wait: Callable[[], object]) -> None:
    """Kill this process when ``wait`` returns; the leader of a process group kills its group."""

    def end() -> None:
        wait()
        kill, target = (os.killpg, 0) if os.getpgrp() == os.getpid() else (os.kill, os.getpid())
        kill(target, signal.SIGKILL)

    threading.Thread(target=end, daemon=True).start()


def run_interruptibly(main: Callable[[], int | None]) -> NoReturn:
    """Run a command and exit with its code; after Ctrl-C with 130, after SIGTERM with 143, and never with a traceback.

    A second signal ends the process immediately. The processes it started must end with it. A signal that the parent
    made this process ignore stays ignored, as Ctrl-C for ``command &`` in a script.
    """
    end_on_signals()
    try:
        sys.exit(main())
    except BaseException as ended:
        if not _received or (isinstance(ended, SystemExit) and not ended.code):
            raise
        print(INTERRUPTED, file=sys.stderr)
        sys.exit(128 + _received[0])
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):  # an exception during shutdown prints a traceback
            if signal.getsignal(number) == _interrupt:
                signal.signal(number, signal.SIG_DFL)


def end_on_signals() -> None:
    """Let Ctrl-C and SIGTERM raise KeyboardInterrupt, and end this process after at most GRACE_S."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _interrupt)
    sys.unraisablehook = _on_unraisable


def _on_unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    """End after an interrupt in a destructor, whose exceptions Python prints and drops."""
    if _received and isinstance(unraisable.exc_value, KeyboardInterrupt):
        _end_now(_received[0])
    sys.__unraisablehook__(unraisable)


def _interrupt(number: int, frame: FrameType | None) -> None:
    # Some third-party modules catch BaseException while they are imported, and continue.
    if _received or _is_importing(frame):
        _end_now(number)
    _received.append(number)
    _thread.start_new_thread(_end_later, (number,))  # threading.Thread takes a lock that this thread may hold
    signal.setitimer(signal.ITIMER_REAL, GRACE_S + 1)  # SIGALRM ends a process in which no Python code can run
    raise KeyboardInterrupt


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _end_later(number: int) -> None:
    time.sleep(GRACE_S)
    _end_now(number)


def _end_now(number: int) -> NoReturn:
    with suppress(OSError):  # no reader
        os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(128 + number)
