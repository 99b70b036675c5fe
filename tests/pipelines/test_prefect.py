"""The bare name in ``prefect deployment run annotate-arctic``; test_prefect_security.py types it."""

import asyncio
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipelines.prefect_names import WORKER, only_one, wrap_lookup

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
def test_a_process_of_a_flow_run_begins_only_below_its_worker(between):
    """The worker may have ended before its flow run has imported Prefect."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    code = "import prefect; print('began', end='')"
    words = ["sh", "-c", f'{sys.executable} -c "{code}"; exit $?'] if between else [sys.executable, "-c", code]
    told = {}
    for worker in (gone.pid, os.getpid()):
        environment = {**os.environ, WORKER: str(worker), "PREFECT__FLOW_RUN_ID": "any"}
        told[worker] = subprocess.run(words, cwd=PROJECT, env=environment, capture_output=True, text=True).stdout
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
