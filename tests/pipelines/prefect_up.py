"""A running `hoidata up` in a copy of the project, for tests."""

import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import psutil

START_S = 600  # a busy machine is slow
STOP_S = 60


@contextmanager
def hoidata_up(project: Path, tools: SimpleNamespace) -> Iterator[SimpleNamespace]:
    """A running `hoidata up`: ``url``, ``settings`` (variables for `prefect`), ``log`` and ``process``."""
    url = f"http://127.0.0.1:{free_port()}/api"
    settings = {"PREFECT_API_URL": url}
    log = project.parent / "up.log"
    with log.open("w") as stream:
        up = subprocess.Popen(
            ["hoidata", "up"], cwd=project, env=tools.environment(**settings), stdout=stream, stderr=stream
        )
    try:
        wait_until(lambda: "ready: run `prefect deployment run annotate-arctic`" in log.read_text(), START_S, up, log)
        yield SimpleNamespace(url=url, settings=settings, log=log, project=project, process=up)
    finally:
        up.send_signal(signal.SIGTERM)
        up.wait(STOP_S)


def running_engine(project: Path, tools: SimpleNamespace, up: SimpleNamespace) -> psutil.Process:
    """Start the deployment annotate-arctic, and return the process of its flow when it runs stages."""
    result = tools.run(project, "prefect", "deployment", "run", "annotate-arctic", **up.settings)
    assert result.returncode == 0, result.stdout + result.stderr
    wait_until(lambda: any(engine.children() for engine in engines(up)), START_S, up.process, up.log)
    return next(engine for engine in engines(up) if engine.children())


def engines(up: SimpleNamespace) -> list[psutil.Process]:
    """The processes of flow runs."""
    family = psutil.Process(up.process.pid).children(recursive=True)
    return [process for process in family if "prefect.engine" in process.cmdline()]


def wait_until(holds, seconds: float, process: subprocess.Popen, log: Path) -> None:
    """Wait until a condition holds; fails if ``process`` ends before."""
    deadline = time.monotonic() + seconds
    while not holds():
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.5)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
