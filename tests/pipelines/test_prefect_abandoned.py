"""A run whose server went is ended by the next one, and no other run is."""

import pytest

pytestmark = pytest.mark.slow


def test_runs_that_were_under_way_have_crashed_and_finished_or_waiting_ones_stay_what_they_are():
    from prefect import flow
    from prefect.client.orchestration import get_client
    from prefect.states import Completed, Pending, Running, Scheduled
    from prefect.testing.utilities import prefect_test_harness

    from pipelines.prefect_abandoned import end_abandoned_runs

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
