"""The graph as DVC resolves it: all dependencies exist, and the recorded code is the code that runs."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from hoidata.datasets.registry import adapter_names
from pipelines.lineage.graph import Stage, read_graph
from pipelines.params import read_params
from pipelines.stages.__main__ import STAGES
from pipelines.stages.code import code_today
from pipelines.stages.families import OPTIONAL_FAMILIES

PROJECT = Path(__file__).parents[2]
# Calls of a module that imports dynamically; its choice must be in pipelines/stages/code.py.
IMPORTERS = {"import_module", "__import__", "spec_from_file_location"}
NEVER_OF_A_STAGE = (
    "hoidata/conformance/",
    "hoidata/store_check/",
    "pipelines/lineage/tree.py",
)
# Prints the files of the project's packages that a stage's module loads.
LOADED = """
import json, sys
from importlib import import_module
for name in json.loads(sys.argv[1]):
    import_module(name)
files = {getattr(module, "__file__", None) for module in list(sys.modules.values())}
print(json.dumps(sorted(filter(None, files))))
"""


@pytest.fixture(scope="module")
def graph() -> dict[str, Stage]:
    return read_graph(PROJECT)


@pytest.fixture(scope="module")
def code() -> dict[str, dict[str, str]]:
    return code_today(PROJECT)


def test_all_dependencies_are_committed_or_outputs_of_stages(graph, code):
    outputs = {out for stage in graph.values() for out in stage.outs}
    parents = {parent.as_posix() for out in outputs for parent in Path(out).parents}
    for stage in graph.values():
        assert [path for path in stage.code if path not in code] == []
        assert [path for path in stage.data if path not in outputs | parents and not (PROJECT / path).exists()] == []


def test_all_stages_depend_on_the_code_of_their_module(graph, code):
    for stage in graph.values():
        if stage.outs != ("code",):
            assert stage.code
            for file in stage.code:
                assert f"pipelines/stages/{file.split('/')[1].removesuffix('.json')}.py" in code[file]


def test_only_modules_with_a_choice_import_dynamically(code):
    modules = set()
    for file in {file for digests in code.values() for file in digests if file.endswith(".py")}:
        nodes = ast.walk(ast.parse((PROJECT / file).read_bytes()))
        if {getattr(node, "attr", getattr(node, "id", "")) for node in nodes} & IMPORTERS:
            modules.add(file)
    assert modules == {"hoidata/datasets/registry.py"}


@pytest.mark.long
@pytest.mark.parametrize("name", ["convert/manipnet", "train/refiner", "report"])
def test_importing_a_closure_loads_no_file_outside_of_it(code, name):
    files = [path for path in code[f"code/{name}.json"] if path.endswith(".py")]
    modules = [path.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for path in files]
    command = [sys.executable, "-c", LOADED, json.dumps(modules)]
    result = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True)
    loaded = {Path(path) for path in json.loads(result.stdout)}
    ours = {path.relative_to(PROJECT).as_posix() for path in loaded if path.is_relative_to(PROJECT)}
    ours = {path for path in ours if path.split("/")[0] in ("hoidata", "models", "pipelines")}
    assert ours - {"models/registry.py"} == set(files)  # a registry: its selection counts, its text does not


def test_packages_that_change_no_result_are_in_no_stage(code):
    files = {file for digests in code.values() for file in digests}
    assert [file for file in files if file.startswith(NEVER_OF_A_STAGE)] == []


def test_a_dataset_without_settings_needs_no_line_in_params(tmp_path):
    (tmp_path / "params.yaml").write_text("{datasets: [taco], families: [], train: {demo: {}}}")
    assert code_today(tmp_path)["code/convert/taco.json"]["params.yaml convert.adapters.taco"] == "null"


def test_all_datasets_in_params_have_an_adapter():
    assert set(read_params(PROJECT)["datasets"]) <= set(adapter_names())


def test_all_sections_of_params_belong_to_a_stage():
    sections = {name for name, value in read_params(PROJECT).items() if isinstance(value, dict)}
    assert sections <= {*STAGES, "family_datasets"}  # the templates of dvc.yaml use the latter


def test_all_stages_have_the_profile_in_their_outputs(graph):
    for stage in graph.values():
        assert all("embedded" in out.split("/") for out in stage.outs if out != "code")


def test_the_graph_names_no_dataset_and_no_raw_data():
    text = (PROJECT / "dvc.yaml").read_text()
    assert len(text.splitlines()) <= 220
    stages = str(yaml.safe_load(text)["stages"])
    assert [name for name in (*adapter_names(), ".hoidata") if name in stages] == []


def test_a_family_that_is_off_has_no_stage_and_one_dataset_turns_it_on(graph, project, project_tools):
    assert len(graph) <= 80
    assert [name for name in graph if name.split("/")[1:2] in ([name] for name in OPTIONAL_FAMILIES)] == []
    params = yaml.safe_load((project / "params.yaml").read_text())
    params["family_datasets"] = {name: ["arctic"] for name in OPTIONAL_FAMILIES}
    project_tools.write_params(project, params)
    added = {out for name, stage in read_graph(project).items() if name not in graph for out in stage.outs}
    sampled = {f"samples/embedded/arctic/{name}" for names in OPTIONAL_FAMILIES.values() for name in names}
    networks = "manipnet", "bimart-contact", "bimart-motion", "mdm", "imos", "t2m-movement", "t2m", "t2m-length"
    trained = {f"checkpoints/embedded/arctic/{name}" for name in networks}
    assert added == sampled | trained | {"samples/embedded/arctic/controls-bimart"}


def test_deployments_are_the_stages_of_the_graph_by_dataset_and_family(graph):
    from pipelines.flows import deployment_targets

    params = read_params(PROJECT)
    targets = deployment_targets(graph, params["profile"], params["datasets"])
    assert targets["full-graph"] == []
    assert targets["annotate-arctic"] == ["annotate@{profile}-arctic"]
    assert targets["evaluate-h2o"] == ["evaluate@{profile}-h2o"]
    assert sorted(targets["train-grab-text2hoi"]) == [
        f"models/text2hoi/dvc.yaml:train-{network}@{{profile}}-grab"
        for network in ("contact", "diffusion", "length", "refiner")
    ]
    assert {
        target.replace("{profile}", params["profile"]) for targets in targets.values() for target in targets
    } <= set(graph)
