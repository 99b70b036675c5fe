"""Stage code: for every stage the digests of exactly the code it runs, in ``code/``, which the stage depends on.

Always run, so that DVC sees each change: a module that was edited, imported anew, or came with another package.
What params.yaml sets for one dataset stands there too, so that it concerns that dataset's stages only; and what the
chosen profile sets otherwise than all profiles do, which DVC does not see in the sections.
"""

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hoidata.dataset_folders import outside_folders
from hoidata.files.atomic import atomic_folder, canonical_json
from models.registry import NETWORKS, family_module, family_names, network_modules
from pipelines.lineage.closure import Choice, SourceTree
from pipelines.params import chosen_params, read_file, read_params
from pipelines.stages.base import StagePaths, write_json
from pipelines.stages.families import families_of

CODE = Path("code")
STAGES_OF_DATASETS = ("raw", "convert", "quality", "annotate", "contact", "split")
DATASETS = "hoidata.datasets"
# Modules that read files in the folder of a dataset they are given by name, and which.
READERS = {
    "hoidata.dataset_folders": ("facts.toml",),
    "hoidata.splits.definitions": ("splits/*.json", "published.json"),
}


# Sections of params.yaml that hold a key per dataset. It may be absent, which DVC does not allow of a parameter.
SECTIONS_OF_DATASETS = {"convert": ("convert", "adapters"), "split": ("split",)}


@dataclass(frozen=True)
class Start:
    """Where the code of a stage begins. chosen: by module what it picks by name."""

    module: str
    chosen: dict[str, list[Choice]] = field(default_factory=dict)


def run(paths: StagePaths) -> None:
    """Write one file per stage, and per dataset, network or family where that chooses among modules.

    Manifests the graph depends on and nobody has written are written too: those datasets are absent.
    """
    params = read_params(Path())
    for name in params["datasets"]:
        families_of(params, name)  # refuses names without stages
    runs = [StagePaths(params["profile"], name) for name in params["datasets"]]
    if not all(path.is_file() for paths in runs for path in (paths.manifest, paths.hand_manifest)):
        from pipelines.stages.adapters import ensure_manifests  # imports adapters, which takes longer than all the rest

        ensure_manifests(params["profile"], params["datasets"])
    write_code(Path())


def write_code(root: Path) -> None:
    """Write ``code/`` of the project at ``root`` anew."""
    with atomic_folder(root / CODE) as partial:
        for path, digests in code_today(root).items():
            write_json(partial / Path(path).relative_to(CODE), digests)


def code_today(root: Path, only: Collection[str] | None = None) -> dict[str, dict[str, str]]:
    """What belongs into each file of ``code/`` as the code is now, by its path (``code/convert/grab.json``).

    only: these files alone.
    """
    plain = read_file(root / "params.yaml")
    params = chosen_params(plain)
    tree = SourceTree(root, {f"{DATASETS}.{name}": folder for name, folder in outside_folders().items()})
    starts = {f"{CODE / name}.json": (name, start) for name, start in closures(params, tree).items()}
    found = {
        path: tree.closure([start.module], start.chosen)
        | own_settings(params, name)
        | profile_settings(plain, params, name)
        for path, (name, start) in starts.items()
        if only is None or path in only
    }
    tree.keep_imports()
    return found


def closures(params: dict[str, Any], tree: SourceTree) -> dict[str, Start]:
    """Where the code of each file of ``code/`` begins: the one table of what the stages run."""
    found, every = {}, {}
    for dataset in params["datasets"]:
        chosen = _chosen_by_dataset(tree, dataset)
        found |= {f"{stage}/{dataset}": _start(stage, chosen) for stage in STAGES_OF_DATASETS}
        every = {module: [*every.get(module, ()), *choices] for module, choices in chosen.items()}
    sizes = [section for section in params["train"].values() if isinstance(section, dict)]
    for network in dict.fromkeys([*NETWORKS, *(name for section in sizes for name in section)]):
        found[f"train/{network}"] = _start("train", every | _families(network_modules(network)))
    for family in dict.fromkeys([*family_names(), *params["families"]]):
        found[f"sample/{family}"] = _start("sample", every | _families([family_module(family)]))
    rows = (params.get("controls") or {}).get("families") or []
    found["controls"] = _start("controls", every | _families([family_module(family) for family in rows]))
    every |= _families([family_module(family) for family in params["families"]])
    return found | {stage: _start(stage, every) for stage in ("evaluator", "evaluate", "report")}


def _families(modules: list[str]) -> dict[str, list[Choice]]:
    """Of the table of all families only what is picked here counts: one more row concerns no other family."""
    return {"models.registry": [Choice(tuple(modules), is_table=True)]}


def _start(stage: str, chosen: dict[str, list[Choice]]) -> Start:
    return Start(f"pipelines.stages.{stage}", chosen)


def own_settings(params: dict[str, Any], name: str) -> dict[str, str]:
    """What params.yaml sets for the one dataset of a file of ``code/``, as JSON; nothing and ``{}`` are the same."""
    stage, _, dataset = name.partition("/")
    if stage not in SECTIONS_OF_DATASETS:
        return {}
    keys, value = (*SECTIONS_OF_DATASETS[stage], dataset), params
    for key in keys:
        value = (value or {}).get(key)
    return {f"params.yaml {'.'.join(keys)}": canonical_json(value or None)}


def profile_settings(plain: dict[str, Any], params: dict[str, Any], name: str) -> dict[str, str]:
    """What the stages of a file of ``code/`` read, as JSON, where the chosen profile has it otherwise.

    plain: params.yaml without the overlay; params: with it.
    """
    found = _settings_read(params, name)
    if found == _settings_read(plain, name):
        return {}
    return {f"params.yaml profiles.{params['profile']}.{name.partition('/')[0]}": canonical_json(found)}


def _settings_read(params: dict[str, Any], name: str) -> Any:
    """The sections a stage reads, but for what it reads of a section of datasets."""
    stage, _, of = name.partition("/")
    section = params.get(stage) or {}
    if stage == "train":
        return section.get("seed"), *_trained(section, of)
    if stage in SECTIONS_OF_DATASETS:
        return section.get("margin_frames")
    return (section, params.get("sample")) if stage == "controls" else section


def _trained(section: dict[str, Any], network: str) -> list[Any]:
    """A network's settings by preset and by size."""
    return [(section.get(str(section.get(kind))) or {}).get(network) for kind in ("preset", "size")]


def _chosen_by_dataset(tree: SourceTree, name: str) -> dict[str, list[Choice]]:
    """The dataset's adapter, in its folder or registered by another package, and what is read of its folder."""
    added = tree.modules_below(f"{DATASETS}.{name}") or tree.added("hoidata.adapters", name)
    name = name if added else name.partition("-")[0]  # a variant, such as arctic-whole
    package = f"{DATASETS}.{name}"
    modules = added or tree.modules_below(package) or tree.added("hoidata.adapters", name)
    read = {reader: [Choice(package=package, files=files)] for reader, files in READERS.items()}
    return {f"{DATASETS}.registry": [Choice(tuple(modules))], **read}
