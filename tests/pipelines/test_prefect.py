"""``prefect deployment run annotate-arctic``, exactly as typed, against the server and worker of `hoidata up`."""

import asyncio
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipelines.prefect_names import only_one, wrap_lookup
from tests.pipelines.prefect_up import hoidata_up

pytestmark = pytest.mark.first
FINISHED = {"Completed", "Failed", "Crashed", "Cancelled"}


class Client:
    """Stands in for Prefect's client: knows two deployments."""

    async def read_deployment_by_name(self, name: str) -> str:
        return f"original {name}"

    async def read_deployments(self, deployment_filter=None):
        known = ("annotate-arctic", "full-graph")
        wanted = deployment_filter.name.any_ if deployment_filter else known
        return [SimpleNamespace(name=name) for name in known if name in wanted]


def test_a_bare_name_finds_its_deployment_and_the_form_with_a_slash_stays_prefects():
    class Wrapped(Client):
        pass

    wrap_lookup(Wrapped)
    assert asyncio.run(Wrapped().read_deployment_by_name("annotate-arctic")).name == "annotate-arctic"
    assert asyncio.run(Wrapped().read_deployment_by_name("a/b")) == "original a/b"
    with pytest.raises(ValueError, match="did you mean annotate-arctic"):
        asyncio.run(Wrapped().read_deployment_by_name("anotate-artic"))


@pytest.mark.parametrize(("found", "message"), [([], "no deployment is named"), ([1, 2], "2 flows have")])
def test_a_name_that_none_or_several_have_is_refused(found, message):
    with pytest.raises(ValueError, match=message):
        only_one("annotate-arctic", found, [])


@pytest.mark.slow
def test_prefect_deployment_run_annotate_arctic_completes(project, project_tools):
    project_tools.make_narrow(project, ["arctic", "manipnet"], ["mean-pose"])  # few deployments are made faster
    with hoidata_up(project, project_tools) as up:
        asked = project_tools.run(project, "prefect", "deployment", "run", "annotate-arctic", **up.settings)
        assert asked.returncode == 0, asked.stdout + asked.stderr
        assert flow_state(project, project_tools, up.settings, 900) == "Completed", up.log.read_text()
        tasks = project_tools.run(project, "prefect", "task-run", "ls", **up.settings, COLUMNS="250").stdout
        assert "annotate@embedded-arctic" in tasks
        artifacts = project_tools.run(project, "prefect", "artifact", "ls", **up.settings, COLUMNS="250").stdout
        assert "results" in artifacts
        assert "stages" in artifacts
        assert project_tools.run(project, "hoidata", "down", **up.settings).stdout == "stopped\n"
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
