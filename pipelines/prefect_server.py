"""A Prefect server, work pool, deployments and worker for this folder, all on the loopback interface.

Every page open in a browser and every user of the machine reaches that interface, so the server answers nobody without
the project's key (``prefect_key``; only the health check, the empty shell of its pages and Prefect's API reference are
open), no other origin, and no change without a CSRF token. Its work pool has no variable, so a run cannot bring a
command, an environment or a folder of its own. And since the worker obeys whoever answers at the address, only our own
server may, as long as the worker lives.
"""

import os
import signal
import subprocess
import sys
import time
import tomllib
import urllib.error
import urllib.request
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import psutil

from hoidata.beside import python_path
from hoidata.errors import BadInput, MissingResource
from hoidata.files.atomic import exclusive
from hoidata.lifetime import end_with_parent
from pipelines.deployments import write_deployments
from pipelines.prefect_key import KEY_FILE, is_loopback, write_key

START_TIMEOUT_S = 180
STOP_TIMEOUT_S = {"worker": 4, "server": 3}  # together less than what Ctrl-C leaves a command
POOL = "local"
POOL_TEMPLATE = Path(__file__).with_name("prefect_pool.json")


def serve() -> int:
    """Start the server, deploy, and work until interrupted; server and worker end together. Returns the exit code."""
    url = api_url()
    with exclusive(KEY_FILE, wait_s=0):
        if _answers(f"{url}/health"):
            raise MissingResource(f"another server answers at {url}; stop it, or set PREFECT_API_URL to a free port")
        return _serve(url, server_environment(url, write_key()))


def _serve(url: str, environment: dict[str, str]) -> int:
    server, worker = _start_server(url, environment), None
    try:
        wait_until_healthy(url, server)
        deploy(environment)
        worker = _start(_prefect("worker", "start", "--pool", POOL), environment)
        print(f"{_origin(url)} asks for a password: the text in {KEY_FILE}, new at every start")
        print("ready: run `prefect deployment run annotate-arctic` in another terminal, in this folder", flush=True)
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)  # until server or worker ends
        return server.poll() or worker.poll() or 1
    except KeyboardInterrupt:
        return 0
    finally:
        if worker is not None:
            # Without its server it would obey whoever listens at the address next, and so would the flow it runs.
            _stop(worker, STOP_TIMEOUT_S["worker"] if server.poll() is None else 0)
        _stop(server, STOP_TIMEOUT_S["server"])


def stop_running() -> bool:
    """Stop this folder's `hoidata up`, if there is one, and wait until it has ended; whether there was one."""
    try:
        with exclusive(KEY_FILE, wait_s=0):
            return False
    except BadInput:
        with suppress(ProcessLookupError, FileNotFoundError):  # it has just ended by itself
            os.kill(int((KEY_FILE.parent / f".{KEY_FILE.name}.lock").read_text()), signal.SIGTERM)
        with exclusive(KEY_FILE, wait_s=3 * sum(STOP_TIMEOUT_S.values())):
            return True


def _stop(process: subprocess.Popen, patience_s: float) -> None:
    """Ask a process to end; one that has not ended after ``patience_s`` is killed."""
    process.terminate()
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def api_url() -> str:
    """PREFECT_API_URL, else the address in prefect.toml. Raises BadInput unless it is a port of this machine alone."""
    configured = str(tomllib.loads(Path("prefect.toml").read_text())["api"]["url"])
    url = (os.environ.get("PREFECT_API_URL") or configured).rstrip("/")
    if not is_loopback(url) or url != f"{_origin(url)}/api":
        expected = "a loopback address with a port, such as http://127.0.0.1:4200/api"
        raise BadInput("PREFECT_API_URL", expected, url, "unset it, or choose another port of 127.0.0.1")
    return url


def _origin(url: str) -> str:
    """What a browser calls the server at ``url``: scheme, host and port."""
    return f"http://{urlsplit(url).netloc}"


def server_environment(url: str, key: str) -> dict[str, str]:
    """What server, worker and deployments run with: only who has the key is let in, nothing is reported home.

    Prefect's state is in ``.prefect/`` of this folder unless PREFECT_HOME says otherwise.
    """
    guards = {
        "PREFECT_API_AUTH_STRING": key,
        "PREFECT_SERVER_API_AUTH_STRING": key,
        "PREFECT_SERVER_API_CORS_ALLOWED_ORIGINS": _origin(url),
        "PREFECT_SERVER_API_CSRF_PROTECTION_ENABLED": "true",
        "PREFECT_CLIENT_CSRF_SUPPORT_ENABLED": "true",
        "PREFECT_PLUGINS_ENABLED": "true",  # pipelines.prefect_names guards the processes of flow runs
        "PREFECT_PLUGINS_SAFE_MODE": "false",
    }
    home = os.environ.get("PREFECT_HOME", str(Path(".prefect").resolve()))
    quiet = {"DO_NOT_TRACK": "1", "PREFECT_SERVER_ANALYTICS_ENABLED": "false"}
    return {**os.environ, **python_path(), **quiet, **guards, "PREFECT_HOME": home, "PREFECT_API_URL": url}


def deploy(environment: dict[str, str]) -> None:
    """Make the work pool (again) and the deployments of this project's graph, and end runs of earlier servers."""
    template = ("--base-job-template", str(POOL_TEMPLATE))
    pool = _prefect("work-pool", "create", POOL, "--type", "process", "--overwrite", *template)
    deployments = _prefect("--no-prompt", "deploy", "--all", "--prefect-file", str(write_deployments(Path())))
    abandoned = [sys.executable, "-m", "pipelines.prefect_abandoned"]
    for command in (abandoned, pool, deployments):
        code = _start(command, environment, stdin=subprocess.DEVNULL).wait()
        if code:
            raise MissingResource(f"`{' '.join(command[2:])}` ended with exit code {code}; its output says why")


def wait_until_healthy(url: str, server: subprocess.Popen) -> None:
    """Wait until ``server``, and no stranger, answers at ``url``. Raises MissingResource when it ends or never does."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        if server.poll() is not None:
            raise MissingResource(f"the Prefect server ended with exit code {server.returncode}; is {url} taken?")
        if _listens(server, url) and _answers(f"{url}/health"):
            return
        time.sleep(0.5)
    raise MissingResource(f"the Prefect server did not answer at {url} within {START_TIMEOUT_S} s")


def _listens(server: subprocess.Popen, url: str) -> bool:
    """Whether it is this process that has the port: another user may have taken it while it started."""
    sockets = psutil.Process(server.pid).net_connections("tcp")
    return any(found.status == psutil.CONN_LISTEN and found.laddr.port == urlsplit(url).port for found in sockets)


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=2) as response:
            return response.status == 200
    except (urllib.error.URLError, OSError):
        return False


def _start_server(url: str, environment: dict[str, str]) -> subprocess.Popen:
    """The server; what it writes, its database above all, is for the owner alone."""
    address = urlsplit(url)
    where = ("--host", str(address.hostname), "--port", str(address.port))
    command = _prefect("server", "start", *where, "--analytics-off")
    return _start(command, environment, umask=0o077)


def _start(command: list[str], environment: dict[str, str], **options: Any) -> subprocess.Popen:
    """A process that ends with this one: alone it would send the key to whoever listens at the address next."""
    return subprocess.Popen(command, env=environment, preexec_fn=partial(end_with_parent, os.getpid()), **options)


def _prefect(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "prefect", *arguments]
