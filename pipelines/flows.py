"""The Prefect flow that updates DVC targets with a task per stage, and the deployments of the graph.

``python -m pipelines.flows`` registers the deployments and serves their flows; `hoidata up` starts and stops it.
"""

import asyncio
from pathlib import Path

from prefect import flow, get_run_logger, task
from prefect.artifacts import create_markdown_artifact
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterState, FlowRunFilterStateType
from prefect.client.schemas.objects import StateType
from prefect.deployments.runner import RunnerDeployment
from prefect.runner import Runner
from prefect.schedules import Cron
from prefect.states import Crashed

from hoidata.errors import BadInput
from pipelines.commands.project import current_profile, set_profile
from pipelines.lineage.graph import Stage, read_graph
from pipelines.parallel_repro import RunStage, describe_run, log_of
from pipelines.params import PROFILES, read_params
from pipelines.prefect_server import KEY_FILE
from pipelines.repro import reproduce
from pipelines.run_facts import describe_results

# DVC's message for a stage that the system killed, most often for lack of memory. Such a stage is tried again.
KILLED = "exited with -9"
WHOLE_GRAPH = "full-graph"
# Stages with a deployment each, which also updates the stages before it.
DEPLOYED_STAGES = ("convert", "annotate", "contact", "evaluate")
READY = "ready: run `prefect deployment run annotate-arctic` in another terminal, in this folder"
Targets = dict[str, list[str]]


class StageError(RuntimeError):
    """A stage failed; its log has the reason."""


@flow(name="bring-up-to-date")
def bring_up_to_date(targets: list[str], profile: str = "", jobs: int = 0, force: bool = False) -> None:
    """Update DVC targets.

    Args:
        targets: as for ``dvc repro``, with ``{profile}`` for the profile; empty: the whole graph.
        profile: the profile to choose first, as `hoidata profile` does; empty: the current one.
        jobs: number of parallel stages; 0: one per core, at most 4.
    """
    if profile:
        if profile not in PROFILES:
            raise BadInput("parameter profile", f"one of {', '.join(PROFILES)}", profile, "choose one of these")
        set_profile(profile)
    chosen = current_profile()
    run = reproduce([target.replace("{profile}", chosen) for target in targets], jobs, stages_as_tasks, force)
    create_markdown_artifact(f"```\n{describe_run(run)}\n```", key="stages", description="duration of each stage")
    create_markdown_artifact(describe_results(Path(), chosen), key="results", description="clips and metrics")
    if run.failed:
        raise StageError("; ".join(f"{name} failed, see {log_of(name)}" for name in run.failed))


def stages_as_tasks(run_stage: RunStage) -> RunStage:
    """Wrap ``run_stage`` so that each stage is a Prefect task with state, log and duration."""

    @task(name="stage", task_run_name="{name}", retries=1, retry_condition_fn=_was_killed)
    def stage(name: str) -> None:
        code = run_stage(name)
        text = log_of(name).read_text(errors="replace") if log_of(name).is_file() else ""
        get_run_logger().info(text)
        if code:
            raise StageError(f"{name} ended with exit code {code}: {text[-500:]}")

    def run(name: str) -> int:
        return int(stage(name, return_state=True).is_failed())

    return run


def _was_killed(_task, _run, state) -> bool:
    return KILLED in str(state.message)


def deployment_targets(graph: dict[str, Stage], profile: str, datasets: list[str]) -> Targets:
    """DVC targets by deployment name, such as annotate-arctic, train-grab-text2hoi or evaluate-h2o.

    Targets have ``{profile}`` in place of the profile, which is set when a run starts.
    """
    targets: Targets = {WHOLE_GRAPH: []}
    for dataset in datasets:
        suffix = f"@{profile}-{dataset}"
        for name in graph:
            address, sign, network = name.partition(suffix)
            if not sign or network[:1] not in ("", "-"):
                continue  # a stage of another dataset, or of none
            if key := _deployment_name(address, dataset):
                targets.setdefault(key, []).append(f"{address}@{{profile}}-{dataset}{network}")
    return targets


def _deployment_name(address: str, dataset: str) -> str:
    """The deployment that a stage belongs to; empty if it has none."""
    stage = address.rpartition(":")[2]
    if stage in DEPLOYED_STAGES:
        return f"{stage}-{dataset}"
    return f"train-{dataset}-{Path(address).parent.name}" if stage.split("-")[0] == "train" else ""


def make_deployments(project: Path) -> list[RunnerDeployment]:
    """The deployments of this project's graph, each with an inactive weekly schedule."""
    params = read_params(project)
    targets = deployment_targets(read_graph(project), params["profile"], params["datasets"])
    return [
        RunnerDeployment.from_flow(
            bring_up_to_date,
            name,
            description=f"Updates {', '.join(targets[name]) or 'the report'} and all stages before it.",
            parameters={"targets": targets[name], "profile": "", "jobs": 0, "force": False},
            schedules=[Cron("0 3 * * 1", timezone="UTC", active=False)],
            concurrency_limit=1,
        )
        for name in sorted(targets)
    ]


def end_abandoned_runs() -> None:
    """Mark runs of an earlier `hoidata up` as crashed, since a deployment runs only one at a time.

    Called before flows are served, when no run of this folder can be active.
    """
    active = [StateType.RUNNING, StateType.PENDING, StateType.CANCELLING]
    state = FlowRunFilterState(type=FlowRunFilterStateType(any_=active))
    with get_client(sync_client=True) as client:
        for run in client.read_flow_runs(flow_run_filter=FlowRunFilter(state=state)):
            client.set_flow_run_state(run.id, Crashed(message="its `hoidata up` ended before it did"))
            print(f"{run.name}: its `hoidata up` ended before it did; a new run resumes its work")


def serve_flows() -> None:
    """Register the deployments of this folder and start a process for each requested run.

    The process always runs ``prefect.engine`` with the flow above, whatever the run specifies.
    """
    end_abandoned_runs()
    runner = Runner(pause_on_shutdown=False, limit=None)
    runner._tmp_dir = KEY_FILE.parent.resolve() / "runner"  # Prefect's default is a folder that all users share
    for deployment in make_deployments(Path()):
        runner.add_deployment(deployment)
    print(READY, flush=True)
    asyncio.run(runner.start())


if __name__ == "__main__":
    serve_flows()
