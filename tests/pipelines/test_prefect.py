"""The hook that Prefect loads, and runs whose server ended; test_prefect_security.py has a server."""

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


def test_whoever_types_a_wrong_name_gets_an_answer_and_no_traceback(monkeypatch):
    class Wrapped(Client):
        pass

    wrap_lookup(Wrapped)
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/prefect", "deployment", "run", "anotate-artic"])
    with pytest.raises(SystemExit, match="did you mean annotate-arctic"):
        asyncio.run(Wrapped().read_deployment_by_name("anotate-artic"))


@pytest.mark.parametrize(("found", "message"), [([], "no deployment is named"), ([1, 2], "2 flows have")])
def test_a_name_that_none_or_several_have_is_refused(found, message):
    with pytest.raises(ValueError, match=message):
        only_one("annotate-arctic", found, [])


@pytest.mark.slow
@pytest.mark.parametrize("between", ["", "sh"])
def test_a_process_of_a_flow_run_begins_only_below_its_starter(between):
    """The process that serves the flows may have ended before its flow run has imported Prefect."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    code = "import prefect; print('began', end='')"
    words = ["sh", "-c", f'{sys.executable} -c "{code}"; exit $?'] if between else [sys.executable, "-c", code]
    told = {}
    for starter in (gone.pid, os.getpid()):
        environment = {**os.environ, SERVING: str(starter), "PREFECT__FLOW_RUN_ID": "any"}
        told[starter] = subprocess.run(words, cwd=PROJECT, env=environment, capture_output=True, text=True).stdout
    assert told == {gone.pid: "", os.getpid(): "began"}


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


@pytest.mark.slow
@pytest.mark.parametrize("guarded", [True, False])
def test_a_result_that_a_server_names_is_never_unpickled_in_this_folder(tmp_path, guarded):
    """Without the hook that prefect.toml switches on, it is, and code runs."""
    harm = tmp_path / "harm"
    words = [sys.executable, "-c", STATE_WITH_A_STORED_RESULT, str(harm)]
    settings = {"PREFECT_LOGGING_LEVEL": "CRITICAL", **({} if guarded else {"PREFECT_PLUGINS_ENABLED": "false"})}
    environment = {**os.environ, "PREFECT_HOME": str(tmp_path / "home"), **settings}
    done = subprocess.run(words, cwd=PROJECT, env=environment, capture_output=True, text=True)
    assert harm.exists() is not guarded, done.stdout + done.stderr
    assert ("no stored result" in done.stdout) is guarded


@pytest.mark.slow
def test_runs_that_were_under_way_have_crashed_and_finished_or_waiting_ones_stay_what_they_are():
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
    told = [(state.type.value, state.message or "") for state in after if state]
    assert [kind for kind, _ in told] == ["CRASHED", "CRASHED", "COMPLETED", "SCHEDULED"]
    assert "hoidata up" in told[0][1]
