"""A pre-imported worker process that runs stages in forks: importing the libraries takes seconds, a fork milliseconds.

`hoidata repro` starts one ``WarmProcess``. If the environment names one, `python -m pipelines.stages` requests that it
runs the stage in a fork, with the folder, environment, output and signals of the requesting process. Otherwise it runs
the stage itself. Only libraries are pre-imported; each stage imports the project's modules.
"""

import atexit
import json
import os
import runpy
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from hoidata.lifetime import end_on_signals
from hoidata.package_paths import python_path
from hoidata.processor import portable_kernels

SOCKET = "HOIDATA_WARM"
PRELOADED = (
    "numpy", "scipy.spatial.transform", "scipy.optimize", "scipy.stats", "pandas", "pyarrow.parquet", "numba", "orjson",
    "torch", "safetensors.torch", "trimesh", "igl", "rich.progress", "ruamel.yaml", "filelock", "threadpoolctl",
    # Imported by the first optimiser and by the first compiled function.
    "torch._dynamo", "numba.core.inline_closurecall", "numba.cpython.charseq",
)  # fmt: skip
# Libraries read these on import. Idle OpenMP threads must sleep: spinning ones cost ten times as much on a busy
# machine. BLAS gets one thread: for small matrices two take five times as long, and change the last bits.
ENVIRONMENT = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "0", "OPENBLAS_NUM_THREADS": "1", **portable_kernels()}
ACCEPTED = b"t"
KILLED = 128 + signal.SIGKILL
FORWARDED = (signal.SIGINT, signal.SIGTERM)


class WarmProcess:
    """The pre-imported process. It ends with this object and with the process that owns it."""

    def __init__(self) -> None:
        self.folder = tempfile.TemporaryDirectory(prefix="hoidata-warm-")  # readable by the user alone
        self.path = str(Path(self.folder.name) / "socket")
        self.environment = {SOCKET: self.path}  # for stages, to find this process
        self.process: subprocess.Popen | None = None

    def start(self) -> None:
        """Start the process, which then imports the libraries; a stage that sends a request meanwhile waits."""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "pipelines.warm", self.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env={**os.environ, **ENVIRONMENT, **python_path()},
            start_new_session=True,
        )

    def close(self) -> None:
        """Kill the process; running stages continue."""
        if self.process:
            self.process.kill()
            self.process.communicate()
        self.folder.cleanup()


def run_warm(module: str, arguments: list[str]) -> int | None:
    """Run ``python -m module`` in a fork of the warm process. Returns the exit code, or None without such a process."""
    path = os.environ.get(SOCKET)
    if not path:
        return None
    with socket.socket(socket.AF_UNIX) as connection:
        try:
            connection.connect(path)
            _send_request(connection, {"module": module, "arguments": arguments})
            if connection.recv(1) != ACCEPTED:
                return None
        except OSError:
            return None
        for number in FORWARDED:
            signal.signal(number, lambda received, _: connection.sendall(bytes([received])))
        answer = connection.recv(1)
        return answer[0] if answer else KILLED


def _send_request(connection: socket.socket, request: dict[str, Any]) -> None:
    environment = {key: value for key, value in os.environ.items() if key != SOCKET}
    body = json.dumps({**request, "folder": os.getcwd(), "path": sys.path, "environment": environment}).encode()
    socket.send_fds(connection, [struct.pack("!I", len(body))], [0, 1, 2])
    connection.sendall(body)


def serve(path: str, preloaded: Sequence[str] = PRELOADED) -> None:
    """Listen, import the libraries, and fork for each request until standard input ends."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(path)
    listener.listen(64)
    threading.Thread(target=_end_with_input, daemon=True).start()
    for name in preloaded:
        import_module(name)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel reaps the forks
    while True:
        connection, _ = listener.accept()
        if os.fork() == 0:
            listener.close()
            _answer(connection)
        connection.close()


def _end_with_input() -> None:
    os.read(0, 1)
    os._exit(0)


def _answer(connection: socket.socket) -> None:
    """Run a request in the fork and send the exit code; a fork that is killed sends nothing."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have started us with SIGINT ignored
    end_on_signals()
    os.setpgrp()
    code = 1
    try:
        request = _receive(connection)
        connection.sendall(ACCEPTED)
        threading.Thread(target=_pass_signals_on, args=(connection,), daemon=True).start()
        code = _run(request)
    except BaseException:
        traceback.print_exc()
    finally:
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        with suppress(OSError):
            connection.sendall(bytes([code]))
        os._exit(code)


def _receive(connection: socket.socket) -> dict[str, Any]:
    head, descriptors, _, _ = socket.recv_fds(connection, 4, 3)
    body = b""
    while len(body) < struct.unpack("!I", head)[0]:
        body += connection.recv(1 << 16)
    for number, descriptor in enumerate(descriptors):
        os.dup2(descriptor, number)
        os.close(descriptor)
    # The streams of this process were opened on /dev/null, so they are opened again.
    sys.stdout, sys.stderr = (os.fdopen(number, "w", 1, closefd=False) for number in (1, 2))
    return json.loads(body)


def _pass_signals_on(connection: socket.socket) -> None:
    """Pass signals of the requesting process on to the stage and its workers; kill them when that process ends."""
    with suppress(ConnectionError):  # a killed process may not have read everything, which resets the connection
        while received := connection.recv(1):
            os.killpg(0, received[0])
    os.killpg(0, signal.SIGKILL)


def _run(request: dict[str, Any]) -> int:
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update({**request["environment"], **ENVIRONMENT})  # worker processes read them again
    # The stage imports the project's modules from the same path as the requesting process.
    sys.path[:] = request["path"]
    for name in [name for name in sys.modules if name.partition(".")[0] == "pipelines"]:
        del sys.modules[name]
    sys.argv = [request["module"], *request["arguments"]]
    try:
        runpy.run_module(request["module"], run_name="__main__", alter_sys=True)
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    return 0


if __name__ == "__main__":
    serve(sys.argv[1])
