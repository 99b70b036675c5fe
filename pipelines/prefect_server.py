"""A Prefect server, work pool, deployments and worker for this folder, all on the loopback interface."""

import os
import signal
import subprocess
import sys
import time
import tomllib
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import urlparse

from hoidata.errors import MissingResource

START_TIMEOUT_S = 180
STOP_TIMEOUT_S = 15
POOL = "local"


def serve() -> int:
    """Start the server, deploy, and work until interrupted; server and worker end together. Returns the exit code."""
    url, environment = api_url(), server_environment()
    if _answers(f"{url}/health"):
        raise MissingResource(f"another server answers at {url}; stop it, or set PREFECT_API_URL to a free port")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    running = [_start_server(url, environment)]
    try:
        wait_until_healthy(url, running[0])
        deploy(environment)
        running.append(subprocess.Popen(_prefect("worker", "start", "--pool", POOL), env=environment))
        print("ready: run `prefect deployment run annotate-arctic` in another terminal, in this folder", flush=True)
        return running[1].wait()
    except KeyboardInterrupt:
        return 0
    finally:
        for process in reversed(running):
            _stop(process)


def _stop(process: subprocess.Popen) -> None:
    """Ask a process to end; one that waits for its clients longer than STOP_TIMEOUT_S is ended."""
    process.terminate()
    try:
        process.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def api_url() -> str:
    """PREFECT_API_URL, else the address in prefect.toml."""
    configured = str(tomllib.loads(Path("prefect.toml").read_text())["api"]["url"])
    return os.environ.get("PREFECT_API_URL") or configured


def server_environment() -> dict[str, str]:
    """Prefect's state in ``.prefect/`` of this folder unless PREFECT_HOME says otherwise; nothing is reported home."""
    home = os.environ.get("PREFECT_HOME", str(Path(".prefect").resolve()))
    quiet = {"DO_NOT_TRACK": "1", "PREFECT_SERVER_ANALYTICS_ENABLED": "false"}
    return {**os.environ, **quiet, "PREFECT_HOME": home, "PREFECT_API_URL": api_url()}


def deploy(environment: dict[str, str]) -> None:
    """Make the work pool (again) and the deployments of prefect.yaml."""
    pool = _prefect("work-pool", "create", POOL, "--type", "process", "--overwrite")
    for command in (pool, _prefect("--no-prompt", "deploy", "--all")):
        code = subprocess.run(command, env=environment, stdin=subprocess.DEVNULL).returncode
        if code:
            raise MissingResource(f"`{' '.join(command[2:])}` ended with exit code {code}; its output says why")


def wait_until_healthy(url: str, server: subprocess.Popen) -> None:
    """Wait for the server's health endpoint. Raises MissingResource when it ends or stays silent."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        if server.poll() is not None:
            raise MissingResource(f"the Prefect server ended with exit code {server.returncode}; is {url} taken?")
        if _answers(f"{url}/health"):
            return
        time.sleep(0.5)
    raise MissingResource(f"the Prefect server did not answer at {url} within {START_TIMEOUT_S} s")


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=2) as response:
            return response.status == 200
    except (urllib.error.URLError, OSError):
        return False


def _start_server(url: str, environment: dict[str, str]) -> subprocess.Popen:
    address = urlparse(url)
    where = ("--host", address.hostname or "127.0.0.1", "--port", str(address.port or 4200))
    return subprocess.Popen(_prefect("server", "start", *where, "--analytics-off"), env=environment)


def _prefect(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "prefect", *arguments]
