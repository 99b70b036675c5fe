"""``python -m pipelines.prefect_abandoned``: runs whose `hoidata up` is no more are said to have crashed.

Nobody else ends them where the server went first, and each would keep its deployment's only place for ever.
"""

from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterState, FlowRunFilterStateType
from prefect.client.schemas.objects import StateType
from prefect.states import Crashed

UNDER_WAY = [StateType.RUNNING, StateType.PENDING, StateType.CANCELLING]


def end_abandoned_runs() -> None:
    """For the moment before a worker starts, when nothing can be under way in this folder."""
    state = FlowRunFilterState(type=FlowRunFilterStateType(any_=UNDER_WAY))
    with get_client(sync_client=True) as client:
        for run in client.read_flow_runs(flow_run_filter=FlowRunFilter(state=state)):
            client.set_flow_run_state(run.id, Crashed(message="its `hoidata up` ended before it did"))
            print(f"{run.name}: its `hoidata up` ended before it did; a new run completes what it began")


if __name__ == "__main__":
    end_abandoned_runs()
