"""``prefect deployment run annotate-arctic``, exactly as typed, against the server and worker of `hoidata up`."""

import asyncio
import signal
import socket
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipelines.prefect_names import only_one, wrap_lookup

FINISHED = {"Completed", "Failed", "Crashed", "Cancelled"}


class Client:
    """Stands in for Prefect's client: knows two deployments."""

    async def read_deployment_by_name(self, name: str) -> str:
        return f"original {name}"

    async def read_deployments(self, deployment_filter):
        wanted = deployment_filter.name.any_
        return [SimpleNamespace(name=name) for name in ("annotate-arctic", "full-graph") if name in wanted]


def test_a_bare_name_finds_its_deployment_and_the_form_with_a_slash_stays_prefects():
    class Wrapped(Client):
        pass

    wrap_lookup(Wrapped)
    assert asyncio.run(Wrapped().read_deployment_by_name("annotate-arctic")).name == "annotate-arctic"
    assert asyncio.run(Wrapped().read_deployment_by_name("a/b")) == "original a/b"


@pytest.mark.parametrize(("found", "message"), [([], "no deployment is named"), ([1, 2], "2 flows have")])
def test_a_name_that_none_or_several_have_is_refused(found, message):
    with pytest.raises(ValueError, match=message):
        only_one("annotate-arctic", found)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for_line(log: Path, text: str, process: subprocess.Popen, seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while text not in log.read_text():
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.5)


@pytest.mark.slow
def test_prefect_deployment_run_annotate_arctic_completes(project, tmp_path, project_tools):
    settings = {
        "PREFECT_API_URL": f"http://127.0.0.1:{free_port()}/api",
        "PREFECT_HOME": str(tmp_path / "prefect"),
    }
    log = tmp_path / "up.log"
    with log.open("w") as stream:
        up = subprocess.Popen(
            ["hoidata", "up"], cwd=project, env=project_tools.environment(**settings), stdout=stream, stderr=stream
        )
    try:
        wait_for_line(log, "ready: run `prefect deployment run annotate-arctic`", up, 180)
        asked = project_tools.run(project, "prefect", "deployment", "run", "annotate-arctic", **settings)
        assert asked.returncode == 0, asked.stdout + asked.stderr
        assert flow_state(project, project_tools, settings, 300) == "Completed", log.read_text()
    finally:
        up.send_signal(signal.SIGTERM)
        up.wait(60)
    assert (project / "data/embedded/arctic/annotation/text.parquet").is_file()
    assert not (project / "checkpoints").exists()


def flow_state(project: Path, project_tools, settings: dict[str, str], seconds: float) -> str:
    """The state of the one flow run, once it has ended."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        shown = project_tools.run(project, "prefect", "flow-run", "ls", **settings, COLUMNS="250").stdout.split()
        if ended := FINISHED & {word.capitalize() for word in shown}:
            return ended.pop()
        time.sleep(3)
    return "still running"
