"""Stage code: for every stage the digests of exactly the code it runs, in ``code/``, which the stage depends on.

Always run, so that DVC sees each change: a module that was edited, imported anew, or came with another package.
"""

from dataclasses import dataclass, field
from pathlib import Path

from hoidata.files.atomic import atomic_folder
from pipelines.lineage.closure import Choice, SourceTree
from pipelines.lineage.graph import read_params
from pipelines.stages.base import Place, write_json

CODE = Path("code")
STAGES_OF_DATASETS = ("raw", "convert", "quality", "annotate", "contact", "surface", "split")
DATASETS = "hoidata.datasets"
# Modules that read files in the folder of a dataset they are given by name, and which.
READERS = {
    "hoidata.dataset_folders": ("facts.toml",),
    "hoidata.splits.definitions": ("splits/*.json",),
    "hoidata.splits.published": ("published.json",),
}


@dataclass(frozen=True)
class Start:
    """Where the code of a stage begins. chosen: by module what it picks by name."""

    module: str
    chosen: dict[str, list[Choice]] = field(default_factory=dict)


def run(place: Place) -> None:
    """Write one file per stage, and per dataset, network or family where that chooses among modules."""
    write_code(Path())


def write_code(root: Path) -> None:
    """Write ``code/`` of the project at ``root`` anew."""
    with atomic_folder(root / CODE) as part:
        for path, digests in code_today(root).items():
            write_json(part / Path(path).relative_to(CODE), digests)


def code_today(root: Path) -> dict[str, dict[str, str]]:
    """What belongs into each file of ``code/`` as the code is now, by its path (``code/convert/grab.json``)."""
    tree = SourceTree(root)
    starts = closures(root, tree).items()
    return {f"{CODE / name}.json": tree.closure([start.module], start.chosen) for name, start in starts}


def closures(root: Path, tree: SourceTree) -> dict[str, Start]:
    """Where the code of each file of ``code/`` begins: the one table of what the stages run."""
    params = read_params(root)
    found, every = {}, {}
    for dataset in params["datasets"]:
        chosen = _chosen_by_dataset(tree, dataset)
        found |= {f"{stage}/{dataset}": _start(stage, chosen) for stage in STAGES_OF_DATASETS}
        every = {module: [*every.get(module, ()), *choices] for module, choices in chosen.items()}
    for network in params["train"]["demo"]:
        found[f"train/{network}"] = _start("train", every | _chosen_by_network(network))
    for family in params["families"]:
        found[f"sample/{family}"] = _start("sample", every | _chosen_by_family(family))
    return found | {stage: _start(stage, every) for stage in ("evaluate", "report")}


def _start(stage: str, chosen: dict[str, list[Choice]]) -> Start:
    return Start(f"pipelines.stages.{stage}", chosen)


def _chosen_by_dataset(tree: SourceTree, name: str) -> dict[str, list[Choice]]:
    """The dataset's adapter, in its folder or registered by another package, and what is read of its folder."""
    package = f"{DATASETS}.{name}"
    modules = tree.modules_below(package) or tree.added("hoidata.adapters", name)
    read = {reader: [Choice(package=package, files=files)] for reader, files in READERS.items()}
    return {f"{DATASETS}.registry": [Choice(tuple(modules))], **read}


def _chosen_by_network(name: str) -> dict[str, list[Choice]]:
    """What the registry of families loads to train a network."""
    return {}


def _chosen_by_family(name: str) -> dict[str, list[Choice]]:
    """What the registry of families loads to sample from a family."""
    return {}
