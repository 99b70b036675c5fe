"""`hoidata up`: a Prefect server for this folder, on the loopback interface, and one process that serves the flows.

All pages open in a browser and all users of the machine can reach that interface. So the server requires the project's
key, refuses other origins, and requires a CSRF token for changes. Only the health check, the empty shell of its pages
and Prefect's API reference are open. Anyone with the key can run code as you. The key is new at each start, readable by
the owner only, and never appears in an argument, a log or a committed file.

A run cannot specify a command, an environment or a folder. The process that serves the flows obeys any server at the
address, so it is killed when our server ends.
"""

import os
import secrets
import signal
import stat
import subprocess
import sys
import tempfile
import time
import tomllib
import urllib.error
import urllib.request
from contextlib import suppress
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import psutil

from hoidata.errors import BadInput, MissingResource
from hoidata.files.atomic import exclusive
from hoidata.lifetime import end_with_parent
from hoidata.package_paths import python_path

KEY_FILE = Path(".prefect/api-key")
START_TIMEOUT_S = 180
STOP_TIMEOUT_S = 4  # shorter than the time that Ctrl-C gives a command


def serve() -> int:
    """Start the server and serve the flows until interrupted; both processes end together. Returns the exit code."""
    url = api_url()
    with exclusive(KEY_FILE, wait_s=0):
        if _answers(f"{url}/health"):
            raise MissingResource(f"another server answers at {url}; stop it, or set PREFECT_API_URL to a free port")
        return _serve(url, server_environment(url, write_key()))


def _serve(url: str, environment: dict[str, str]) -> int:
    server, flows = _start_server(url, environment), None
    try:
        wait_until_healthy(url, server)
        print(f"{_origin(url)} requires a password: the text in {KEY_FILE}, new at each start", flush=True)
        flows = _start([sys.executable, "-m", "pipelines.flows"], environment)
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)  # wait until server or flows end
        return server.poll() or flows.poll() or 1
    except KeyboardInterrupt:
        return 0
    finally:
        if flows is not None:  # first, since without our server it would obey the next one at the address
            flows.kill()
            flows.wait()
        _stop(server)


def stop_running() -> bool:
    """Stop this folder's `hoidata up` and wait until it has ended. Returns whether it was running."""
    try:
        with exclusive(KEY_FILE, wait_s=0):
            return False
    except BadInput:
        with suppress(ProcessLookupError, FileNotFoundError):  # it has just ended
            os.kill(int((KEY_FILE.parent / f".{KEY_FILE.name}.lock").read_text()), signal.SIGTERM)
        with exclusive(KEY_FILE, wait_s=5 * STOP_TIMEOUT_S):
            return True


def _stop(process: subprocess.Popen) -> None:
    """Terminate a process; kill it after ``STOP_TIMEOUT_S``."""
    process.terminate()
    try:
        process.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def api_url() -> str:
    """PREFECT_API_URL, else the address in prefect.toml. Raises BadInput if it is not a loopback address with port."""
    configured = str(tomllib.loads(Path("prefect.toml").read_text())["api"]["url"])
    url = (os.environ.get("PREFECT_API_URL") or configured).rstrip("/")
    if not is_loopback(url) or url != f"{_origin(url)}/api":
        expected = "a loopback address with a port, such as http://127.0.0.1:4200/api"
        raise BadInput("PREFECT_API_URL", expected, url, "unset it, or choose another port of 127.0.0.1")
    return url


def _origin(url: str) -> str:
    """The origin of ``url`` as browsers send it: scheme, host and port."""
    return f"http://{urlsplit(url).netloc}"


def server_environment(url: str, key: str) -> dict[str, str]:
    """The environment of server and flows: the key is required, and analytics are off.

    Prefect's state is in ``.prefect/`` of this folder unless PREFECT_HOME names another one.
    """
    guards = {
        "PREFECT_API_AUTH_STRING": key,
        "PREFECT_SERVER_API_AUTH_STRING": key,
        "PREFECT_SERVER_API_CORS_ALLOWED_ORIGINS": _origin(url),
        "PREFECT_SERVER_API_CSRF_PROTECTION_ENABLED": "true",
        "PREFECT_CLIENT_CSRF_SUPPORT_ENABLED": "true",
        "PREFECT_PLUGINS_ENABLED": "true",  # pipelines.prefect_hook protects the processes of flow runs
        "PREFECT_PLUGINS_SAFE_MODE": "false",
    }
    home = os.environ.get("PREFECT_HOME", str(Path(".prefect").resolve()))
    quiet = {"DO_NOT_TRACK": "1", "PREFECT_SERVER_ANALYTICS_ENABLED": "false"}
    return {**os.environ, **python_path(), **quiet, **guards, "PREFECT_HOME": home, "PREFECT_API_URL": url}


def wait_until_healthy(url: str, server: subprocess.Popen) -> None:
    """Wait until ``server`` itself answers at ``url``. Raises MissingResource if it ends or does not answer in time."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        if server.poll() is not None:
            raise MissingResource(f"the Prefect server ended with exit code {server.returncode}; is {url} taken?")
        if _listens(server, url) and _answers(f"{url}/health"):
            return
        time.sleep(0.5)
    raise MissingResource(f"the Prefect server did not answer at {url} within {START_TIMEOUT_S} s")


def _listens(server: subprocess.Popen, url: str) -> bool:
    """Whether this process listens at the port; another user's process may have taken it."""
    sockets = psutil.Process(server.pid).net_connections("tcp")
    return any(item.status == psutil.CONN_LISTEN and item.laddr.port == urlsplit(url).port for item in sockets)


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=2) as response:
            return response.status == 200
    except (urllib.error.URLError, OSError):
        return False


def _start_server(url: str, environment: dict[str, str]) -> subprocess.Popen:
    """Start the server; its files, such as the database, are readable by the owner only."""
    address = urlsplit(url)
    options = ("--host", str(address.hostname), "--port", str(address.port))
    command = [sys.executable, "-m", "prefect", "server", "start", *options, "--analytics-off"]
    return _start(command, environment, umask=0o077)


def _start(command: list[str], environment: dict[str, str], **options: Any) -> subprocess.Popen:
    """Start a process that ends with this one; otherwise it would send the key to the next server at the address."""
    return subprocess.Popen(command, env=environment, preexec_fn=partial(end_with_parent, os.getpid()), **options)


def write_key(path: Path = KEY_FILE) -> str:
    """Write and return a new key. Its folder is closed to other users first.

    A new key at each start makes an old one worthless that others may have read or received.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    path.parent.chmod(0o700)
    key = f"hoidata:{secrets.token_urlsafe(32)}"
    handle, partial = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)  # mode 0600
    with os.fdopen(handle, "w") as stream:
        stream.write(key)
    os.replace(partial, path)
    return key


def read_key(path: Path = KEY_FILE) -> str | None:
    """The key; None if no server was started. Raises PermissionError if others can read or wrote the file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    with os.fdopen(descriptor) as stream:
        status = os.fstat(descriptor)
        if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077:
            raise PermissionError(f"{path}: expected a file of mode 0600 that is yours; `hoidata up` writes a new one")
        return stream.read()


def is_loopback(url: str | None) -> bool:
    """Whether an address is a loopback IP with a port; not the name "localhost", which may mean two addresses."""
    try:
        address = urlsplit(url or "")
        return bool(address.port) and ip_address(address.hostname or "").is_loopback
    except ValueError:
        return False
