"""The plugin that Prefect loads, and runs whose server has ended; test_prefect_security.py starts a server."""

import asyncio
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipelines.prefect_hook import SERVING, only_one, wrap_lookup

PROJECT = Path(__file__).parents[2]


class Client:
    """A fake of Prefect's client with two deployments."""

    async def read_deployment_by_name(self, name: str) -> str:
        return f"original {name}"

    async def read_deployments(self, deployment_filter=None):
        names = ("annotate-arctic", "full-graph")
        requested = deployment_filter.name.any_ if deployment_filter else names
        return [SimpleNamespace(name=name) for name in names if name in requested]


def test_a_bare_name_finds_its_deployment_and_a_name_with_a_slash_is_passed_on():
    class Wrapped(Client):
        pass

    wrap_lookup(Wrapped)
    assert asyncio.run(Wrapped().read_deployment_by_name("annotate-arctic")).name == "annotate-arctic"
    assert asyncio.run(Wrapped().read_deployment_by_name("a/b")) == "original a/b"
    with pytest.raises(ValueError, match="did you mean annotate-arctic"):
        asyncio.run(Wrapped().read_deployment_by_name("anotate-artic"))


def test_a_wrong_name_on_the_command_line_gives_a_message_and_no_traceback(monkeypatch):
    class Wrapped(Client):
        pass

    wrap_lookup(Wrapped)
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/prefect", "deployment", "run", "anotate-artic"])
    with pytest.raises(SystemExit, match="did you mean annotate-arctic"):
        asyncio.run(Wrapped().read_deployment_by_name("anotate-artic"))


@pytest.mark.parametrize(("matches", "message"), [([], "no deployment is named"), ([1, 2], "2 flows have")])
def test_an_unknown_or_ambiguous_name_is_refused(matches, message):
    with pytest.raises(ValueError, match=message):
        only_one("annotate-arctic", matches, [])


@pytest.mark.slow
@pytest.mark.parametrize("between", ["", "sh"])
def test_a_flow_run_starts_only_as_a_descendant_of_its_starter(between):
    """The process that serves the flows may end while its flow run imports Prefect."""
    ended = subprocess.Popen(["true"])
    ended.wait()
    code = "import prefect; print('began', end='')"
    command = ["sh", "-c", f'{sys.executable} -c "{code}"; exit $?'] if between else [sys.executable, "-c", code]
    outputs = {}
    for starter in (ended.pid, os.getpid()):
        environment = {**os.environ, SERVING: str(starter), "PREFECT__FLOW_RUN_ID": "any"}
        outputs[starter] = subprocess.run(command, cwd=PROJECT, env=environment, capture_output=True, text=True).stdout
    assert outputs == {ended.pid: "", os.getpid(): "began"}


STATE_WITH_A_STORED_RESULT = """
import os, sys
from pathlib import Path
from prefect.client.schemas.objects import State, StateType
from prefect.results import ResultStore

class Harm:
    def __reduce__(self):
        return os.mkdir, (sys.argv[1],)

store = ResultStore(persist_result=True)
record = store.create_result_record(Harm(), key="harm")
store.persist_result_record(record)
state = State(type=StateType.COMPLETED, data=record.metadata)
try:
    state.result(raise_on_failure=False)
except Exception as error:
    print(error)
"""


@pytest.mark.long
@pytest.mark.parametrize("guarded", [True, False])
def test_a_stored_result_is_never_unpickled(tmp_path, guarded):
    """Without the plugin that prefect.toml enables, the result is unpickled and its code runs."""
    harm = tmp_path / "harm"
    words = [sys.executable, "-c", STATE_WITH_A_STORED_RESULT, str(harm)]
    settings = {"PREFECT_LOGGING_LEVEL": "CRITICAL", **({} if guarded else {"PREFECT_PLUGINS_ENABLED": "false"})}
    environment = {**os.environ, "PREFECT_HOME": str(tmp_path / "home"), **settings}
    done = subprocess.run(words, cwd=PROJECT, env=environment, capture_output=True, text=True)
    assert harm.exists() is not guarded, done.stdout + done.stderr
    assert ("no stored result" in done.stdout) is guarded


@pytest.mark.long
def test_active_runs_are_marked_as_crashed_and_finished_or_scheduled_ones_are_unchanged():
    from prefect import flow
    from prefect.client.orchestration import get_client
    from prefect.states import Completed, Pending, Running, Scheduled
    from prefect.testing.utilities import prefect_test_harness

    from pipelines.flows import end_abandoned_runs

    @flow
    def some() -> None: ...

    with prefect_test_harness(server_startup_timeout=120), get_client(sync_client=True) as client:
        began = [Running(), Pending(), Completed(), Scheduled()]
        runs = [client.create_flow_run(some, state=state) for state in began]
        end_abandoned_runs()
        after = [client.read_flow_run(run.id).state for run in runs]
    states = [(state.type.value, state.message or "") for state in after if state]
    assert [kind for kind, _ in states] == ["CRASHED", "CRASHED", "COMPLETED", "SCHEDULED"]
    assert "hoidata up" in states[0][1]
