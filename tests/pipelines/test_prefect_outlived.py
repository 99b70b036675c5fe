"""After `hoidata up` is killed, none of its processes connects to another user's server at its port."""

import subprocess
import sys
import time
from urllib.parse import urlsplit

import psutil
import pytest

from tests.pipelines.prefect_up import hoidata_up, running_engine

pytestmark = pytest.mark.first
NOBODY = 65534
LISTEN_S = 10
# Another user listens at the port when it is free, and prints the data that arrive.
LISTENER = f"""
import os, socket, sys, time
if os.geteuid() == 0:
    os.setgid({NOBODY})
    os.setuid({NOBODY})
deadline = time.monotonic() + 30
while True:
    try:
        listener = socket.create_server(("127.0.0.1", int(sys.argv[1])))
        break
    except OSError:
        assert time.monotonic() < deadline, "the port is not free"
listener.settimeout({LISTEN_S})
print("took the port", flush=True)
try:
    connection, _ = listener.accept()
    print(connection.recv(65536))
except TimeoutError:
    pass
"""


@pytest.mark.long
def test_a_flow_ends_with_a_killed_hoidata_up_and_sends_nothing_to_another_server_at_its_port(tmp_path, project_tools):
    """As root, the other server runs as another user; otherwise as the same one, which the flow cannot distinguish."""
    project = project_tools.copy_project(tmp_path / "project")
    project_tools.make_narrow(project, ["arctic", "manipnet"], ["mean-pose"])
    with hoidata_up(project, project_tools) as up:
        engine = running_engine(project, project_tools, up)
        family = [*psutil.Process(up.process.pid).children(recursive=True), engine]
        words = [sys.executable, "-I", "-c", LISTENER, str(urlsplit(up.url).port)]
        stranger = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        time.sleep(1)
        up.process.kill()
        _, alive = psutil.wait_procs(family, 10)
        assert not alive, alive
        assert stranger.communicate(timeout=60)[0] == "took the port\n"
