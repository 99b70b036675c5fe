"""Stage code: digests of the code that each stage runs, as files in ``code/`` that the stages depend on.

It always runs, so that DVC sees each change: an edited module, a new import, another version of a package. The files
also have settings of params.yaml that DVC cannot track: those of one dataset, which concern only its stages, and those
that the chosen profile overrides.
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
# Modules that read files in a dataset's folder, and the patterns of these files.
READERS = {
    "hoidata.dataset_folders": ("facts.toml",),
    "hoidata.splits.definitions": ("splits/*.json", "published.json"),
}


# Sections of params.yaml with a key per dataset. DVC cannot depend on such a key, because it may be absent.
SECTIONS_OF_DATASETS = {"convert": ("convert", "adapters"), "split": ("split",)}


@dataclass(frozen=True)
class Start:
    """The module where the code of a stage begins."""

    module: str
    chosen: dict[str, list[Choice]] = field(default_factory=dict)  # run-time choices, by module


def run(paths: StagePaths) -> None:
    """Write one file per stage, or per stage and dataset, network or family if that selects modules.

    Also writes missing manifests, which the graph depends on; they mark the datasets as absent.
    """
    params = read_params(Path())
    for name in params["datasets"]:
        families_of(params, name)  # raises for names without stages
    runs = [StagePaths(params["profile"], name) for name in params["datasets"]]
    if not all(path.is_file() for paths in runs for path in (paths.manifest, paths.hand_manifest)):
        from pipelines.stages.adapters import ensure_manifests  # imports adapters, which is slow

        ensure_manifests(params["profile"], params["datasets"])
    write_code(Path())


def write_code(root: Path) -> None:
    """Replace ``code/`` of the project at ``root``."""
    with atomic_folder(root / CODE) as partial:
        for path, digests in code_today(root).items():
            write_json(partial / Path(path).relative_to(CODE), digests)


def code_today(root: Path, only: Collection[str] | None = None) -> dict[str, dict[str, str]]:
    """The content of the files of ``code/`` for the present code, by path (``code/convert/grab.json``).

    Args:
        only: paths of the files to compute; None for all.
    """
    plain = read_file(root / "params.yaml")
    params = chosen_params(plain)
    tree = SourceTree(root, {f"{DATASETS}.{name}": folder for name, folder in outside_folders().items()})
    starts = {f"{CODE / name}.json": (name, start) for name, start in closures(params, tree).items()}
    contents = {
        path: tree.closure([start.module], start.chosen)
        | dataset_settings(params, name)
        | profile_settings(plain, params, name)
        for path, (name, start) in starts.items()
        if only is None or path in only
    }
    tree.save_imports()
    return contents


def closures(params: dict[str, Any], tree: SourceTree) -> dict[str, Start]:
    """The start module and choices for each file of ``code/``, by its path without suffix."""
    starts, all_choices = {}, {}
    for dataset in params["datasets"]:
        chosen = _chosen_by_dataset(tree, dataset)
        starts |= {f"{stage}/{dataset}": _start(stage, chosen) for stage in STAGES_OF_DATASETS}
        all_choices = {module: [*all_choices.get(module, ()), *choices] for module, choices in chosen.items()}
    sizes = [section for section in params["train"].values() if isinstance(section, dict)]
    for network in dict.fromkeys([*NETWORKS, *(name for section in sizes for name in section)]):
        starts[f"train/{network}"] = _start("train", all_choices | _families(network_modules(network)))
    for family in dict.fromkeys([*family_names(), *params["families"]]):
        starts[f"sample/{family}"] = _start("sample", all_choices | _families([family_module(family)]))
    controls = (params.get("controls") or {}).get("families") or []
    starts["controls"] = _start("controls", all_choices | _families([family_module(family) for family in controls]))
    all_choices |= _families([family_module(family) for family in params["families"]])
    return starts | {stage: _start(stage, all_choices) for stage in ("evaluator", "evaluate", "report")}


def _families(modules: list[str]) -> dict[str, list[Choice]]:
    """The choice of ``models.registry``: a new family does not change the digests of the others."""
    return {"models.registry": [Choice(tuple(modules), is_registry=True)]}


def _start(stage: str, chosen: dict[str, list[Choice]]) -> Start:
    return Start(f"pipelines.stages.{stage}", chosen)


def dataset_settings(params: dict[str, Any], name: str) -> dict[str, str]:
    """The settings of the dataset of a file of ``code/``, as JSON; ``{}`` equals an absent key."""
    stage, _, dataset = name.partition("/")
    if stage not in SECTIONS_OF_DATASETS:
        return {}
    keys, value = (*SECTIONS_OF_DATASETS[stage], dataset), params
    for key in keys:
        value = (value or {}).get(key)
    return {f"params.yaml {'.'.join(keys)}": canonical_json(value or None)}


def profile_settings(plain: dict[str, Any], params: dict[str, Any], name: str) -> dict[str, str]:
    """The settings of a file's stages, as JSON, if the chosen profile overrides them; else empty.

    Args:
        name: the file of ``code/``, without suffix.
    """
    settings = _settings_read(params, name)
    if settings == _settings_read(plain, name):
        return {}
    return {f"params.yaml profiles.{params['profile']}.{name.partition('/')[0]}": canonical_json(settings)}


def _settings_read(params: dict[str, Any], name: str) -> Any:
    """The sections that a stage reads, without the settings per dataset."""
    stage, _, name_in_stage = name.partition("/")
    section = params.get(stage) or {}
    if stage == "train":
        chosen = (section.get(str(section.get(kind))) or {} for kind in ("preset", "size"))
        return section.get("seed"), *(settings.get(name_in_stage) for settings in chosen)
    if stage in SECTIONS_OF_DATASETS:
        return section.get("margin_frames")
    return (section, params.get("sample")) if stage == "controls" else section


def _chosen_by_dataset(tree: SourceTree, name: str) -> dict[str, list[Choice]]:
    """The choices of one dataset: the modules of its adapter, and the files that are read in its folder."""

    def adapter_modules(dataset: str) -> list[str]:
        return tree.modules_below(f"{DATASETS}.{dataset}") or tree.entry_point_modules("hoidata.adapters", dataset)

    modules = adapter_modules(name)
    if not modules:  # a variant, such as arctic-whole
        name = name.partition("-")[0]
        modules = adapter_modules(name)
    package = f"{DATASETS}.{name}"
    readers = {reader: [Choice(package=package, files=files)] for reader, files in READERS.items()}
    return {f"{DATASETS}.registry": [Choice(tuple(modules))], **readers}
