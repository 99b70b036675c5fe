"""Stages in forks of a process that has the libraries loaded: loading them takes seconds, a fork milliseconds.

`hoidata repro` holds one ``WarmProcess``. `python -m pipelines.stages` asks it, where the environment names one, to run
the stage in a fork with the folder, environment, output and signals of the one that asks; else it runs it itself.
Only libraries are loaded beforehand: the project's own modules are imported by each stage, as it starts.
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
from hoidata.processor import same_kernels

SOCKET = "HOIDATA_WARM"
PRELOADED = (
    "numpy", "scipy.spatial.transform", "scipy.optimize", "scipy.stats", "pandas", "pyarrow.parquet", "numba", "orjson",
    "torch", "safetensors.torch", "trimesh", "igl", "rich.progress", "ruamel.yaml", "filelock", "threadpoolctl",
)  # fmt: skip
# Read as libraries are loaded. Threads of OpenMP that wait must sleep: spinning ones cost a busy machine ten times as
# much. One thread of BLAS: its matrices are small here, two threads took five times as long and gave other last bits.
ENVIRONMENT = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "0", "OPENBLAS_NUM_THREADS": "1", **same_kernels()}
TAKEN = b"t"
KILLED = 128 + signal.SIGKILL
FORWARDED = (signal.SIGINT, signal.SIGTERM)


class WarmProcess:
    """The process that forks. environment: what a stage needs to find it. It ends with this object or its owner."""

    def __init__(self) -> None:
        self.folder = tempfile.TemporaryDirectory(prefix="hoidata-warm-")  # readable by the user alone
        self.path = str(Path(self.folder.name) / "socket")
        self.environment = {SOCKET: self.path}
        self.process: subprocess.Popen | None = None

    def start(self) -> None:
        """Begin to load the libraries; a stage that asks meanwhile waits as long as it would take itself."""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "pipelines.warm", self.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env={**os.environ, **ENVIRONMENT, **python_path()},
            start_new_session=True,
        )

    def close(self) -> None:
        """End it; stages under way go on."""
        if self.process:
            self.process.kill()
            self.process.communicate()
        self.folder.cleanup()


def run_warm(module: str, arguments: list[str]) -> int | None:
    """Exit code of ``python -m module`` run by the warm process, or None where there is none to ask."""
    path = os.environ.get(SOCKET)
    if not path:
        return None
    with socket.socket(socket.AF_UNIX) as connection:
        try:
            connection.connect(path)
            _ask(connection, {"module": module, "arguments": arguments})
            if connection.recv(1) != TAKEN:
                return None
        except OSError:
            return None
        for number in FORWARDED:
            signal.signal(number, lambda received, _: connection.sendall(bytes([received])))
        answer = connection.recv(1)
        return answer[0] if answer else KILLED


def _ask(connection: socket.socket, asked: dict[str, Any]) -> None:
    environment = {key: value for key, value in os.environ.items() if key != SOCKET}
    body = json.dumps({**asked, "folder": os.getcwd(), "path": sys.path, "environment": environment}).encode()
    socket.send_fds(connection, [struct.pack("!I", len(body))], [0, 1, 2])
    connection.sendall(body)


def serve(path: str, preloaded: Sequence[str] = PRELOADED) -> None:
    """Listen, load the libraries, and fork for each stage that asks, until standard input ends."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(path)
    listener.listen(64)
    threading.Thread(target=_end_with_input, daemon=True).start()
    for name in preloaded:
        import_module(name)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the forks here
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
    """In the fork: run what is asked and send its exit code; a fork that was killed sends nothing."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have started all this to ignore it
    end_on_signals()
    os.setpgrp()
    code = 1
    try:
        request = _receive(connection)
        connection.sendall(TAKEN)
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
    for own, given in enumerate(descriptors):
        os.dup2(given, own)
        os.close(given)
    # Those of this process were opened on /dev/null, and believe that it is what they write to.
    sys.stdout, sys.stderr = (os.fdopen(number, "w", 1, closefd=False) for number in (1, 2))
    return json.loads(body)


def _pass_signals_on(connection: socket.socket) -> None:
    """Signals for the one that asks are for the stage and its workers too; and without it there is no one to answer."""
    with suppress(ConnectionError):  # one that was killed may not have read all: its end is a reset then
        while received := connection.recv(1):
            os.killpg(0, received[0])
    os.killpg(0, signal.SIGKILL)


def _run(request: dict[str, Any]) -> int:
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update({**request["environment"], **ENVIRONMENT})  # its worker processes read it anew
    # The stage's own modules are those that the one that asks would import.
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
