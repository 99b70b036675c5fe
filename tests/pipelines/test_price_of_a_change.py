"""What runs again after a change, as DVC says on a copy of the project in which everything was up to date.

``python -m tests.pipelines.test_price_of_a_change`` writes the table of ARCHITECTURE.md anew.
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
from pipelines.params import read_file, read_params
from pipelines.side_by_side import CODE

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
    """Append a line to files that are there."""

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
    set_params(project, convert={**params["convert"], "adapters": {"grab": {"margin_frames": 3}}})


def set_in_embedded(project: Path) -> None:
    profiles = read_file(project / "params.yaml")["profiles"]
    set_params(project, profiles={**profiles, "embedded": {**profiles["embedded"], "sample": {"samples": 3}}})


@dataclass(frozen=True)
class Change:
    """An edit in words and as a function of the project, and the stages DVC must name (as in ``stages_in_words``)."""

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
    Change("its settings: `convert.adapters.grab`", set_adapter, "convert of grab"),
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
        "report; annotate, contact, controls, convert, evaluate, evaluator, quality, raw, sample, split, train, "
        "train-diffusion, train-refiner of toy",
    ),
    Change("the sentences: `hoidata/annotation/sentences.py`", touch("hoidata/annotation/sentences.py"), "annotate"),
    Change(
        "conformance kit, store checks, lineage, docs",
        touch("hoidata/conformance/check.py", "hoidata/store_check/check.py", "pipelines/lineage/tree.py", "README.md"),
        "nothing",
    ),
)


@contextlib.contextmanager
def up_to_date_project(folder: Path) -> Iterator[Path]:
    """A copy of the committed files, the current folder meanwhile, in which each output is a stand-in DVC knows."""
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
    """The stage itself, on the copy's own code."""
    run(sys.executable, "-m", "pipelines.stages", "code")


def stale_stages() -> set[str]:
    """What DVC would run, but for ``code``, which always runs."""
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
    """``convert of grab``: the datasets only where not all of them are meant, families where not all."""
    families = read_params(Path())["families"]
    of: dict[str, set[str]] = {}
    for name in names:
        stage, _, rest = name.rpartition(":")[2].partition("@")
        dataset = rest.removeprefix("embedded").strip("-").partition("-")[0]
        asked = {Path(out).name for out in graph[name].outs if out.startswith("samples/")} & set(families)
        of.setdefault(stage, set()).add(dataset)
        of.setdefault(f"families of {stage}", set()).update(asked)
    groups: dict[str, list[str]] = {}
    for stage in sorted(key for key in of if not key.startswith("families of ")):
        asked = of[f"families of {stage}"]
        shown = f"{stage} ({', '.join(sorted(asked))})" if asked and asked != set(families) else stage
        where = "" if of[stage] in ({""}, set(datasets)) else f" of {', '.join(sorted(of[stage]))}"
        groups.setdefault(where, []).append(shown)
    return "; ".join(f"{', '.join(stages)}{where}" for where, stages in sorted(groups.items())) or "nothing"


def price(change: Change) -> tuple[str, ...]:
    """What DVC runs again after the change, and what may follow, in words; the copy is as before afterwards."""
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
def test_a_change_runs_again_what_it_concerns_and_nothing_else(prices, change):
    assert prices[change.words][0] == change.runs


def test_a_metric_and_a_page_never_train_or_sample(prices):
    for change in CHANGES[:2]:
        assert not {"train", "sample"} & set(" ".join(prices[change.words]).replace(",", "").split())


def test_the_table_of_the_architecture_is_this_one(prices):
    assert table(prices) in ARCHITECTURE.read_text(), "run python -m tests.pipelines.test_price_of_a_change"


@pytest.mark.filterwarnings("ignore:_NoneStep")  # pygtrie's, as DVC calls it
def test_all_stages_run_before_the_report_which_asks_for_parent_folders(copy):
    from dvc.repo import Repo

    with Repo() as repo:
        stages = {stage.addressing: stage for stage in repo.index.stages}
        behind, waiting = set(), ["report@embedded"]
        while waiting:
            found = {stage.addressing for stage in repo.index.graph.successors(stages[waiting.pop()])} - behind
            behind |= found
            waiting += found
    assert behind == stages.keys() - {"report@embedded"}


@pytest.mark.parametrize("folder", ["data", "checkpoints", "samples", "metrics"])
def test_another_output_of_any_stage_makes_the_report_anew(copy, folder):
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
    """Put the table of today into ARCHITECTURE.md."""
    with tempfile.TemporaryDirectory() as folder, up_to_date_project(Path(folder)):
        made = table({change.words: price(change) for change in CHANGES})
    before, _, rest = ARCHITECTURE.read_text().partition(BEGIN)
    ARCHITECTURE.write_text(before + made + rest.partition(END)[2])


if __name__ == "__main__":
    write_table()
