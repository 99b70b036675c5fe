"""The stages that DVC runs again after a change, on a copy of the project in which all stages were up to date.

``python -m tests.pipelines.test_price_of_a_change`` updates the table in ARCHITECTURE.md.
"""

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from pipelines.lineage.graph import Stage, read_graph
from pipelines.parallel_repro import CODE
from pipelines.params import read_file, read_params

PROJECT = Path(__file__).parents[2]
ARCHITECTURE = PROJECT / "ARCHITECTURE.md"
BEGIN, END = "<!-- price of a change: made by its test -->", "<!-- end of the price of a change -->"
DATASETS = ["grab", "h2o"]
TOY_STAGE = """vars: [../../params.yaml]
stages:
  sample:
    wdir: ../..
    matrix: {profile: ["${profile}"], dataset: "${datasets}", family: [toy]}
    cmd: python -m pipelines.stages sample --profile ${item.profile} --dataset ${item.dataset} --family toy
    deps: [code/sample/toy.json, "data/${item.profile}/${item.dataset}/clips"]
    outs: ["samples/${item.profile}/${item.dataset}/toy"]
"""

pytestmark = pytest.mark.long


def touch(*paths: str) -> Callable[[Path], None]:
    """Append a line to existing files."""

    def edit(project: Path) -> None:
        for path in paths:
            file = project / path
            file.write_text(file.read_text() + ("\n" if file.suffix == ".md" else "\n# touched\n"))

    return edit


def set_params(project: Path, **values: object) -> None:
    params = yaml.safe_load((project / "params.yaml").read_text())
    (project / "params.yaml").write_text(yaml.safe_dump({**params, **values}, sort_keys=False))


def add_family(project: Path) -> None:
    folder = project / "models" / "toy"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "family.py").write_text("TOY = None\n")
    (folder / "dvc.yaml").write_text(TOY_STAGE)
    registry = project / "models" / "registry.py"
    text = registry.read_text()
    assert "FAMILIES = {" in text
    registry.write_text(text.replace("FAMILIES = {", 'FAMILIES = {\n    "toy": "models.toy.family:TOY",'))
    set_params(project, families=[*read_params(project)["families"], "toy"])


def add_dataset(project: Path) -> None:
    folder = project / "hoidata" / "datasets" / "toy"
    folder.mkdir()
    for name in ("__init__.py", "adapter.py", "facts.toml"):
        (folder / name).touch()
    manifest = project / "manifests" / "embedded" / "grab.json"
    (manifest.parent / "toy.json").write_text(manifest.read_text())
    set_params(project, datasets=[*DATASETS, "toy"])


def set_adapter(project: Path) -> None:
    params = read_params(project)
    set_params(project, convert={**params["convert"], "adapters": {"h2o": {"margin_frames": 3}}})


def set_in_embedded(project: Path) -> None:
    profiles = read_file(project / "params.yaml")["profiles"]
    set_params(project, profiles={**profiles, "embedded": {**profiles["embedded"], "sample": {"samples": 3}}})


@dataclass(frozen=True)
class Change:
    """An edit, in words and as a function of the project, and the stages that it makes stale (``stages_in_words``)."""

    words: str
    edit: Callable[[Path], None]
    runs: str


CHANGES = (
    Change("a metric: `hoidata/metrics/touch.py`", touch("hoidata/metrics/touch.py"), "evaluate, report"),
    Change("a page: `pipelines/pages/glb.py`", touch("pipelines/pages/glb.py"), "report"),
    Change(
        "a network: `models/text2hoi/refiner.py`",
        touch("models/text2hoi/refiner.py"),
        "sample (other-prompt, text2hoi, text2hoi-coarse), train-refiner",
    ),
    Change(
        "a family is added: `models/toy/`, its row, its word",
        add_family,
        "evaluate, report, sample (toy)",
    ),
    Change(
        "an adapter: `hoidata/datasets/grab/adapter.py`",
        touch("hoidata/datasets/grab/adapter.py"),
        "convert, raw of grab",
    ),
    Change("settings of one: `convert.adapters.h2o`", set_adapter, "convert of h2o"),
    Change(
        "a setting of one profile: `profiles.embedded.sample`",
        set_in_embedded,
        "controls, sample",
    ),
    Change(
        "a named split: `hoidata/datasets/grab/splits/text2hoi.json`",
        lambda project: (project / "hoidata/datasets/grab/splits/text2hoi.json").write_text("{}"),
        "split of grab",
    ),
    Change(
        "a dataset is added: `hoidata/datasets/toy/`, its word",
        add_dataset,
        "report; annotate, contact, controls, convert, evaluate, evaluator, quality, raw, sample, split, "
        "train-contact, train-diffusion, train-length, train-refiner of toy",
    ),
    Change(
        "the sentences: `hoidata/annotation/sentences.py`",
        touch("hoidata/annotation/sentences.py"),
        "annotate, sample (other-prompt, text2hoi, text2hoi-coarse)",
    ),
    Change(
        "conformance kit, store checks, lineage, docs",
        touch("hoidata/conformance/check.py", "hoidata/store_check/check.py", "pipelines/lineage/tree.py", "README.md"),
        "nothing",
    ),
)


@contextlib.contextmanager
def up_to_date_project(folder: Path) -> Iterator[Path]:
    """A copy of the committed files as the current folder, with a fake file for each output that DVC accepts."""
    from dvc.repo import Repo

    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=PROJECT, check=True, capture_output=True, text=True,
    )  # fmt: skip
    for name in filter(None, listed.stdout.split("\0")):
        if not name.startswith(("tests/", "bench/", "fuzz/")) and (PROJECT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((PROJECT / name).read_bytes())
    set_params(folder, profile="embedded", datasets=DATASETS)
    with contextlib.chdir(folder):
        run("git", "init", "-q")
        write_code()
        for path in (path for stage in read_graph(Path()).values() for path in stage.outs if path != "code"):
            write_stand_in(Path(path))
        with Repo() as repo:
            repo.commit(force=True)
        run("git", "add", "-A")
        run("git", "-c", "user.name=t", "-c", "user.email=t@localhost", "commit", "-qm", "up to date")
        yield folder


def write_stand_in(path: Path) -> None:
    file = path if path.suffix else path / "stand-in"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"{path}\n")


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


def write_code() -> None:
    """Run the stage code with the code of the copy."""
    run(sys.executable, "-m", "pipelines.stages", "code")


def stale_stages() -> set[str]:
    """The stages that DVC would run, except ``code``, which always runs."""
    from dvc.repo import Repo

    write_code()
    with Repo() as repo:
        return set(repo.status()) - {CODE}


def what_follows(stages: set[str], graph: dict[str, Stage]) -> set[str]:
    """The stages that depend on an output of these, directly or not."""
    reached = set(stages)
    while more := {stage.name for stage in graph.values() if reads_from(stage, reached, graph)} - reached:
        reached |= more
    return reached - stages


def reads_from(stage: Stage, makers: set[str], graph: dict[str, Stage]) -> bool:
    outs = [out for name in makers if name in graph for out in graph[name].outs]
    return any(f"{out}/".startswith(f"{dep}/") or f"{dep}/".startswith(f"{out}/") for dep in stage.data for out in outs)


def stages_in_words(names: set[str], datasets: list[str], graph: dict[str, Stage]) -> str:
    """Stage names such as ``convert of grab``; datasets and families are listed only if some are missing."""
    families = read_params(Path())["families"]
    members: dict[str, set[str]] = {}
    for name in names:
        stage, _, run = name.rpartition(":")[2].partition("@")
        dataset = run.removeprefix("embedded").strip("-").partition("-")[0]
        sampled = {Path(out).name for out in graph[name].outs if out.startswith("samples/")} & set(families)
        members.setdefault(stage, set()).add(dataset)
        members.setdefault(f"families of {stage}", set()).update(sampled)
    groups: dict[str, list[str]] = {}
    for stage in sorted(key for key in members if not key.startswith("families of ")):
        sampled = members[f"families of {stage}"]
        shown = f"{stage} ({', '.join(sorted(sampled))})" if sampled and sampled != set(families) else stage
        suffix = "" if members[stage] in ({""}, set(datasets)) else f" of {', '.join(sorted(members[stage]))}"
        groups.setdefault(suffix, []).append(shown)
    return "; ".join(f"{', '.join(stages)}{suffix}" for suffix, stages in sorted(groups.items())) or "nothing"


def price(change: Change) -> tuple[str, ...]:
    """The stages that DVC runs again after a change, and those that may follow, in words; then reverts the change."""
    change.edit(Path())
    try:
        stale, datasets, graph = stale_stages(), read_params(Path())["datasets"], read_graph(Path())
        return tuple(stages_in_words(names, datasets, graph) for names in (stale, what_follows(stale, graph)))
    finally:
        run("git", "reset", "-q", "--hard")
        run("git", "clean", "-fdq")


def table(prices: dict[str, tuple[str, ...]]) -> str:
    rows = [f"| {words} | {runs} | {follows} |" for words, (runs, follows) in prices.items()]
    return "\n".join(
        [BEGIN, "| you touch | runs again | follows, if that gives other bytes |", "|---|---|---|", *rows, END]
    )


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Iterator[Path]:
    with up_to_date_project(tmp_path_factory.mktemp("price")) as folder:
        yield folder


@pytest.fixture(scope="module")
def prices(copy: Path) -> dict[str, tuple[str, ...]]:
    return {change.words: price(change) for change in CHANGES}


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.words)
def test_a_change_runs_exactly_the_stages_again_that_it_concerns(prices, change):
    assert prices[change.words][0] == change.runs


def test_a_change_of_a_metric_or_page_never_trains_or_samples(prices):
    for change in CHANGES[:2]:
        assert not {"train", "sample"} & set(" ".join(prices[change.words]).replace(",", "").split())


def test_the_table_in_architecture_is_up_to_date(prices):
    assert table(prices) in ARCHITECTURE.read_text(), "run python -m tests.pipelines.test_price_of_a_change"


@pytest.mark.filterwarnings("ignore:_NoneStep")  # raised by pygtrie, which DVC uses
def test_all_stages_run_before_the_report_which_depends_on_parent_folders(copy):
    from dvc.repo import Repo

    with Repo() as repo:
        stages = {stage.addressing: stage for stage in repo.index.stages}
        visited, waiting = set(), ["report@embedded"]
        while waiting:
            upstream = {stage.addressing for stage in repo.index.graph.successors(stages[waiting.pop()])} - visited
            visited |= upstream
            waiting += upstream
    assert visited == stages.keys() - {"report@embedded"}


@pytest.mark.parametrize("folder", ["data", "checkpoints", "samples", "metrics"])
def test_a_changed_output_of_any_stage_runs_the_report_again(copy, folder):
    from dvc.repo import Repo

    path = next(path for path in sorted((copy / folder).rglob("*")) if path.is_file())
    text = path.read_text()
    path.write_text("{}")
    try:
        with Repo() as repo:
            assert "report@embedded" in repo.status(targets=["report@embedded"])
    finally:
        path.write_text(text)


def write_table() -> None:
    """Write the current table to ARCHITECTURE.md."""
    with tempfile.TemporaryDirectory() as folder, up_to_date_project(Path(folder)):
        table_text = table({change.words: price(change) for change in CHANGES})
    before, _, rest = ARCHITECTURE.read_text().partition(BEGIN)
    ARCHITECTURE.write_text(before + table_text + rest.partition(END)[2])


if __name__ == "__main__":
    write_table()
