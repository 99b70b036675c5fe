"""dvc.yaml names exactly the code each stage runs: a forgotten dependency would leave stale results standing."""

from functools import lru_cache
from pathlib import Path

import grimp
import pytest
import yaml

from hoidata.datasets.registry import adapter_names
from pipelines.lineage.graph import read_graph, read_params
from pipelines.stages.__main__ import STAGES

PROJECT = Path(__file__).parents[2]


@lru_cache
def import_graph() -> grimp.ImportGraph:
    return grimp.build_graph("hoidata", "models", "pipelines")


def imported_files(stage: str) -> set[str]:
    """Every own file a stage's module imports, directly or not, and its own."""
    module = f"pipelines.stages.{stage}"
    return {path_of(name) for name in {*import_graph().find_upstream_modules(module), module}}


def path_of(module: str) -> str:
    base = module.replace(".", "/")
    return f"{base}.py" if (PROJECT / f"{base}.py").is_file() else f"{base}/__init__.py"


def stage_file(command: str) -> str:
    return command.split()[3]


def is_covered(file: str, deps: tuple[str, ...]) -> bool:
    return any(file == dep or file.startswith(f"{dep}/") for dep in deps)


ONE_OF_EACH = {name.partition("@")[0]: stage for name, stage in read_graph(PROJECT).items()}


@pytest.mark.parametrize("name", sorted(ONE_OF_EACH))
def test_stage_depends_on_all_code_it_imports(name):
    stage = ONE_OF_EACH[name]
    files = imported_files(stage_file(stage.command))
    assert sorted(file for file in files if not is_covered(file, stage.code)) == []


@pytest.mark.parametrize("name", sorted(ONE_OF_EACH))
def test_stage_depends_on_no_code_it_does_not_import(name):
    stage = ONE_OF_EACH[name]
    files = imported_files(stage_file(stage.command))
    unused = [dep for dep in stage.code if not any(is_covered(file, (dep,)) for file in files)]
    assert unused == []


def test_every_dependency_of_the_graph_is_made_by_a_stage_or_committed():
    graph = read_graph(PROJECT)
    made = {out for stage in graph.values() for out in stage.outs}
    missing = {path for stage in graph.values() for path in stage.deps if path not in made}
    assert sorted(path for path in missing if not (PROJECT / path).exists()) == []


def test_every_dataset_of_the_params_has_adapter_manifests_and_a_place_in_the_report():
    datasets = read_params(PROJECT)["datasets"]
    assert set(datasets) <= set(adapter_names())
    for profile in ("embedded", "own"):
        assert all((PROJECT / "manifests" / profile / f"{name}.json").is_file() for name in datasets)
    report = read_graph(PROJECT)["report@embedded"]
    assert {f"metrics/embedded/{name}.json" for name in datasets} <= set(report.deps)


def test_every_section_of_the_params_belongs_to_a_stage():
    sections = {name for name, value in read_params(PROJECT).items() if isinstance(value, dict)}
    assert sections <= set(STAGES)


def test_every_stage_command_names_its_own_profile_so_that_profiles_never_share_outputs():
    for stage in read_graph(PROJECT).values():
        assert all("embedded" in out.split("/") for out in stage.outs)


def test_our_reading_of_the_graph_is_dvcs_own():
    from dvc.repo import Repo

    with Repo(PROJECT) as repo:
        theirs = {
            stage.addressing: (
                stage.cmd,
                {dep.def_path for dep in stage.deps if not hasattr(dep, "params")},
                {out.def_path for out in stage.outs},
            )
            for stage in repo.index.stages
        }
    ours = {name: (stage.command, set(stage.deps), set(stage.outs)) for name, stage in read_graph(PROJECT).items()}
    assert ours == theirs


def test_raw_data_never_enters_the_graph():
    stages = yaml.safe_load((PROJECT / "dvc.yaml").read_text())["stages"]
    assert ".hoidata" not in str(stages)
