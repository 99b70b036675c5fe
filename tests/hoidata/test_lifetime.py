"""Processes end with their parent, and within seconds of Ctrl-C or SIGTERM, whatever code they run."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from hoidata.lifetime import GRACE_S

WAIT_S = 20
COMMAND = """
import sys
import hoidata.lifetime
from hoidata.lifetime import run_interruptibly
hoidata.lifetime.GRACE_S = {grace}
{globals}
def main():
{body}
if __name__ == "__main__":
    run_interruptibly(main)
"""


def until(holds: Callable[[], bool], seconds: float = WAIT_S) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def is_at_work(process: psutil.Process) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def started(code: str, **options) -> subprocess.Popen:
    """A Python process that has printed its first line; ``first_line`` has the words of that line."""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, **options)
    process.first_line = process.stdout.readline().split()  # pyright: ignore
    return process


GREEDY = """
import time
while True:
    try:
        print('ready', flush=True)
        time.sleep(60)
    except BaseException:
        pass
"""
BY_THE_KERNEL = """
import os, subprocess, sys
from functools import partial
from hoidata.lifetime import end_with_parent
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"],
                         preexec_fn=partial(end_with_parent, os.getpid()))
print(child.pid, flush=True)
child.wait()
"""
BY_A_THREAD = """
import multiprocessing, os, subprocess, sys, time
from hoidata.lifetime import end_with_starter
def work(pipe):
    os.setpgrp()
    end_with_starter()
    other = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    pipe.send((os.getpid(), other.pid))
    time.sleep(60)
context = multiprocessing.get_context("fork")
ours, theirs = context.Pipe()
context.Process(target=work, args=(theirs,)).start()
print(*ours.recv(), flush=True)
time.sleep(60)
"""
BY_NUMBER = """
import os, subprocess, sys, time
watching = "import sys, time; from hoidata import lifetime; lifetime.end_with_process(int(sys.argv[1])); time.sleep(60)"
shell = subprocess.Popen(["sh", "-c", f"{sys.executable} -c '{watching}' {os.getpid()} & echo $!; wait"],
                         stdout=subprocess.PIPE, text=True)
print(shell.stdout.readline().strip(), flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("how", [BY_THE_KERNEL, BY_A_THREAD, BY_NUMBER], ids=["kernel", "thread", "number"])
def test_a_process_ends_when_its_parent_is_killed(how: str) -> None:
    parent = started(how)
    children = [psutil.Process(int(word)) for word in parent.first_line]  # pyright: ignore
    assert children
    assert all(map(is_at_work, children))
    parent.kill()
    parent.wait()
    parent.stdout.close()
    until(lambda: not any(map(is_at_work, children)))


def test_a_process_whose_parent_has_ended_already_does_not_run() -> None:
    gone = subprocess.Popen(["true"])
    gone.wait()
    code = f"from hoidata.lifetime import end_with_parent; end_with_parent({gone.pid}); print('began')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (-signal.SIGKILL, "")


def command(folder: Path, body: str, before: str = "", grace: float = GRACE_S) -> list[str]:
    lines = "".join(f"    {line}\n" for line in body.strip().splitlines())
    path = folder / "command.py"
    path.write_text(COMMAND.format(body=lines, globals=before, grace=grace))
    return [sys.executable, str(path)]


def interrupted(arguments: list[str], *numbers: int, **options) -> tuple[int, str, float]:
    """Exit code, stderr, and seconds from the first signal to the end."""
    process = subprocess.Popen(
        arguments,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": "."},
        **options,
    )
    try:
        assert process.stdout.readline() == "ready\n"
        start = time.monotonic()
        for number in numbers:
            process.send_signal(number)
            time.sleep(0.3)
        _, stderr = process.communicate(timeout=30)
        return process.returncode, stderr, time.monotonic() - start
    finally:
        process.kill()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_command_prints_one_message(tmp_path: Path, number: int, code: int) -> None:
    arguments = command(tmp_path, "import time\nprint('ready', flush=True)\ntime.sleep(60)")
    exit_code, stderr, _ = interrupted(arguments, number)
    assert (exit_code, stderr) == (code, "interrupted: finished work is kept; run it again\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_module_that_catches_all_exceptions_at_import_cannot_swallow_a_signal(tmp_path: Path, number) -> None:
    (tmp_path / "greedy.py").write_text(GREEDY)
    exit_code, stderr, seconds = interrupted(command(tmp_path, "import greedy"), number)
    assert (exit_code, stderr.count("\n")) == (128 + number, 1)
    assert seconds < GRACE_S


def test_an_interrupt_in_a_destructor_is_not_dropped(tmp_path: Path) -> None:
    before = """
import time
class Slow:
    def __del__(self):
        print('ready', flush=True)
        time.sleep(60)
"""
    exit_code, stderr, seconds = interrupted(command(tmp_path, "Slow()\ntime.sleep(60)", before), signal.SIGINT)
    assert (exit_code, stderr.count("\n"), seconds < GRACE_S) == (130, 1, True)


CTRL_C_DURING_START = """
import multiprocessing, os, signal, sys
from hoidata.lifetime import init_worker, block_ctrl_c
if __name__ == "__main__":
    signal.signal(signal.SIGINT, lambda *_: None)
    process = multiprocessing.get_context("spawn").Process(target=init_worker)
    with block_ctrl_c():
        process.start()
    for _ in range(200):
        os.kill(process.pid, signal.SIGINT)
    process.join()
    print(process.exitcode)
"""


@pytest.mark.slow
def test_ctrl_c_while_a_worker_process_starts_is_handled_by_its_parent(tmp_path: Path) -> None:
    (tmp_path / "starts.py").write_text(CTRL_C_DURING_START)
    arguments = [sys.executable, str(tmp_path / "starts.py")]
    done = subprocess.run(arguments, env={**os.environ, "PYTHONPATH": "."}, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("0\n", "")


@pytest.mark.slow
def test_code_that_catches_all_exceptions_ends_after_the_grace_period(tmp_path: Path) -> None:
    exit_code, stderr, seconds = interrupted(command(tmp_path, GREEDY, grace=1.0), signal.SIGTERM)
    assert (exit_code, stderr.count("\n"), seconds >= 1) == (143, 1, True)
    assert GRACE_S + 1 < 10


def test_a_second_signal_ends_a_command_immediately(tmp_path: Path) -> None:
    exit_code, _, seconds = interrupted(command(tmp_path, GREEDY), signal.SIGINT, signal.SIGINT)
    assert (exit_code, seconds < GRACE_S) == (130, True)


@pytest.mark.slow
def test_code_that_blocks_the_interpreter_lock_ends_as_soon(tmp_path: Path) -> None:
    """An endless regular expression keeps the interpreter lock, so that no handler and no thread can run."""
    slow = "print('ready', flush=True)\ntry:\n    time.sleep(60)\nfinally:\n    re.match('(a+)+$', 'a' * 60 + 'b')"
    exit_code, _, _ = interrupted(command(tmp_path, slow, "import re, time", grace=1.0), signal.SIGINT)
    assert exit_code in (130, -signal.SIGALRM)


def test_a_signal_that_the_parent_ignores_stays_ignored(tmp_path: Path) -> None:
    arguments = command(tmp_path, "import time\nprint('ready', flush=True)\ntime.sleep(1)\nreturn 0")
    exit_code, stderr, _ = interrupted(
        arguments, signal.SIGINT, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN)
    )
    assert (exit_code, stderr) == (0, "")


def test_an_error_after_an_interrupt_has_no_traceback_and_one_without_a_signal_has(tmp_path: Path) -> None:
    body = "import time\nprint('ready', flush=True)\ntry:\n    time.sleep({})\nfinally:\n    raise ValueError('odd')"
    exit_code, stderr, _ = interrupted(command(tmp_path, body.format(60)), signal.SIGINT)
    assert (exit_code, stderr.count("\n")) == (130, 1)
    exit_code, stderr, _ = interrupted(command(tmp_path, body.format(0)))
    assert (exit_code, "ValueError: odd" in stderr) == (1, True)
