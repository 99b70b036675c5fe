"""Ctrl-C and SIGTERM at any moment end a command and its processes within ten seconds, with a message."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from tests.hoidata.test_lifetime import is_at_work, until
from tests.pipelines.test_parallel_repro import PROJECT, tiny_project

pytestmark = pytest.mark.long

MARK = "HOIDATA_TEST_RUN"  # an environment variable that all processes of a run inherit
MOMENTS = range(2 * int(os.environ.get("HOIDATA_CHAOS", "1")))
STUBBORN = """
import signal, sys, time
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)
print("stubborn", flush=True)
time.sleep(60)
"""
# `hoidata repro` without the check of raw files, for a project with other stages.
REPRO = """
from hoidata.lifetime import run_interruptibly
def main():
    from pipelines.parallel_repro import reproduce_in_parallel
    return len(reproduce_in_parallel([], 2).failed)
if __name__ == "__main__":
    run_interruptibly(main)
"""


def processes_of(mark: str) -> list[psutil.Process]:
    """All processes that inherited the mark, whatever their parent is now."""
    processes = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if process.environ().get(MARK) == mark:
                processes.append(process)
    return [process for process in processes if is_at_work(process)]


class Run:
    """A command with a unique mark in its environment; its output goes to a file."""

    def __init__(self, words: list[str], folder: Path, environment: dict[str, str], **options) -> None:
        self.mark = f"{folder}-{time.monotonic_ns()}"
        self.log = folder / f"told-{time.monotonic_ns()}.log"
        with self.log.open("w") as stream:
            self.process = subprocess.Popen(
                words, cwd=folder, env={**environment, MARK: self.mark}, stdout=stream, stderr=stream, **options
            )

    def until_it_handles_signals(self) -> None:
        """Wait until the command handles SIGTERM, which it does not while the interpreter starts."""

        def is_handled() -> bool:
            [caught] = [line for line in self.status().splitlines() if line.startswith("SigCgt")]
            return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)

        until(is_handled, 60)

    def status(self) -> str:
        return Path(f"/proc/{self.process.pid}/status").read_text()

    def ends(self, seconds: float = 10) -> int:
        """Wait until the command and its processes have ended in time, and return the exit code."""
        start = time.monotonic()
        code = self.process.wait(seconds)
        until(lambda: not processes_of(self.mark), max(1, start + seconds - time.monotonic()))
        return code


@pytest.fixture
def stubborn_project(tmp_path: Path) -> Path:
    """A project whose first stage ignores Ctrl-C and SIGTERM."""
    tiny_project(tmp_path)
    (tmp_path / "make.py").write_text(STUBBORN)
    (tmp_path / "repro.py").write_text(REPRO)
    return tmp_path


def stubborn_run(folder: Path, **options) -> Run:
    run = Run([sys.executable, "repro.py"], folder, {**os.environ, "PYTHONPATH": str(PROJECT)}, **options)
    log = folder / ".hoidata/logs/a.log"
    until(lambda: log.is_file() and "stubborn" in log.read_text(), 120)
    return run


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_run_kills_a_stage_that_ignores_signals(stubborn_project, sent):
    run = stubborn_run(stubborn_project)
    run.process.send_signal(sent)
    assert run.ends() == 128 + sent
    assert run.log.read_text().count("run it again") == 1
    assert "Traceback" not in run.log.read_text()


def test_a_second_ctrl_c_ends_a_run_at_once(stubborn_project):
    run = stubborn_run(stubborn_project)
    start = time.monotonic()
    run.process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    run.process.send_signal(signal.SIGINT)
    assert run.ends() == 130
    assert time.monotonic() - start < 4


@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGKILL])
def test_the_stages_of_a_run_in_the_background_of_a_script_end_with_it(stubborn_project, sent):
    """Commands that a script starts with `&` ignore Ctrl-C."""
    run = stubborn_run(stubborn_project, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN))
    run.process.send_signal(sent)
    assert run.ends() == (143 if sent == signal.SIGTERM else -sent)


STAGE = """
import os, time
import pipelines.stages.__main__ as stages
def wait(*_):
    print(os.getpid(), flush=True)
    time.sleep(60)
stages.run_warm = wait
stages.main()
"""
DVC = """
import subprocess, sys
subprocess.run(sys.argv[1:])
"""


@pytest.mark.parametrize("shell", ["dash", "bash"])
@pytest.mark.parametrize("killed", ["DVC", "its shell"])
def test_a_stage_ends_with_the_dvc_that_runs_it(tmp_path, shell, killed):
    """Some shells replace themselves with the command, others stay its parent."""
    (tmp_path / "stage.py").write_text(STAGE)
    command = [sys.executable, "-c", DVC, shell, "-c", f"{sys.executable} {tmp_path / 'stage.py'} raw --dataset grab"]
    environment = {**os.environ, "DVC_STAGE": "raw@embedded-grab", "PYTHONPATH": str(PROJECT)}
    dvc = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    stage = psutil.Process(int(dvc.stdout.readline()))
    (dvc if killed == "DVC" else psutil.Process(stage.ppid())).kill()
    try:
        until(lambda: not is_at_work(stage), 10)
    finally:
        dvc.kill()
        dvc.wait()
        dvc.stdout.close()


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("words", [("hoidata", "repro"), ("hoidata", "synth", "write", "grab")], ids=" ".join)
def test_a_signal_at_any_moment_of_its_start_ends_a_command(project, project_tools, words, sent, moment):
    """Ctrl-C reaches all processes of a command in a terminal, SIGTERM only one."""
    run = Run(list(words), project, project_tools.environment(), start_new_session=True)
    run.until_it_handles_signals()
    time.sleep(random.Random(f"{words} {sent} {moment}").uniform(0, 12))
    if sent == signal.SIGINT:
        os.killpg(run.process.pid, sent)
    else:
        run.process.send_signal(sent)
    code = run.ends()
    output = run.log.read_text()
    assert (code, output.count("run it again"), "Traceback" in output) == (128 + sent, 1, False), output
