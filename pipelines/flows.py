"""The Prefect flow: brings DVC targets up to date, a task per stage. Which there are, and their order, is DVC's."""

from pathlib import Path

from prefect import flow, get_run_logger, task
from prefect.artifacts import create_markdown_artifact

from hoidata.errors import BadInput
from pipelines.commands.project import current_profile, set_profile
from pipelines.params import PROFILES
from pipelines.repro import reproduce
from pipelines.run_facts import describe_results
from pipelines.side_by_side import RunStage, describe_run, log_of

# How DVC tells that the system ended a stage, most often for want of memory: worth a second try, unlike its own errors.
KILLED = "exited with -9"


class StageError(RuntimeError):
    """A stage ended with an error; its log says why."""


@flow(name="bring-up-to-date")
def bring_up_to_date(targets: list[str], profile: str = "", jobs: int = 0, force: bool = False) -> None:
    """Bring DVC targets up to date.

    targets: as ``dvc repro`` takes them, ``{profile}`` for the profile; empty: the whole graph.
    profile: the one to choose first, as `hoidata profile` does; empty: the one that is chosen.
    jobs: stages at once; 0: one per core, at most 4. force: run the targets themselves even where nothing changed.
    """
    if profile:
        if profile not in PROFILES:
            raise BadInput("parameter profile", f"one of {', '.join(PROFILES)}", profile, "choose one of these")
        set_profile(profile)
    chosen = current_profile()
    run = reproduce([target.replace("{profile}", chosen) for target in targets], jobs, stages_as_tasks, force)
    create_markdown_artifact(f"```\n{describe_run(run)}\n```", key="stages", description="where the time went")
    create_markdown_artifact(describe_results(Path(), chosen), key="results", description="what there is now")
    if run.failed:
        raise StageError("; ".join(f"{name} failed, see {log_of(name)}" for name in run.failed))


def stages_as_tasks(run_stage: RunStage) -> RunStage:
    """Each stage as a Prefect task with its state, log and duration."""

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
