"""Stage code: digests of the code that each stage runs, as files in ``code/`` that the stages depend on.

It always runs, so that DVC sees each change: an edited module, a new import, another version of a package. The files
also have settings of params.yaml that DVC cannot track: those of one dataset, which concern only its stages, and those
that the chosen profile overrides.
"""

from collections.abc import Collection, Iterable
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
Chosen = dict[str, list[Choice]]  # run-time choices, by module


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
    """The content of the files of ``code/`` (``only`` these paths, such as ``code/convert/grab.json``), by path."""
    plain = read_file(root / "params.yaml")
    params = chosen_params(plain)
    tree = SourceTree(root, {f"{DATASETS}.{name}": folder for name, folder in outside_folders().items()})
    contents = {
        f"{CODE / name}.json": tree.closure([f"pipelines.stages.{name.partition('/')[0]}"], chosen)
        | dataset_settings(params, name)
        | profile_settings(plain, params, name)
        for name, chosen in choices_of_stages(params, tree).items()
        if only is None or f"{CODE / name}.json" in only
    }
    tree.save_imports()
    return contents


def choices_of_stages(params: dict[str, Any], tree: SourceTree) -> dict[str, Chosen]:
    """The run-time choices for each file of ``code/``, by its path without suffix, which begins with the stage."""
    choices: dict[str, Chosen] = {}
    common: Chosen = {}  # the choices of all datasets
    for dataset in params["datasets"]:
        chosen = _chosen_by_dataset(tree, dataset)
        choices |= {f"{stage}/{dataset}": chosen for stage in STAGES_OF_DATASETS}
        common = {module: [*common.get(module, ()), *others] for module, others in chosen.items()}
    sizes = [section for section in params["train"].values() if isinstance(section, dict)]
    for network in dict.fromkeys([*NETWORKS, *(name for section in sizes for name in section)]):
        choices[f"train/{network}"] = common | _families(network_modules(network))
    for family in dict.fromkeys([*family_names(), *params["families"]]):
        choices[f"sample/{family}"] = common | _families([family_module(family)])
    controls = (params.get("controls") or {}).get("families") or []
    choices["controls"] = common | _families(map(family_module, controls))
    common |= _families(map(family_module, params["families"]))
    return choices | dict.fromkeys(("evaluator", "evaluate", "report"), common)


def _families(modules: Iterable[str]) -> Chosen:
    """The choice of ``models.registry``: a new family does not change the digests of the others."""
    return {"models.registry": [Choice(tuple(modules), is_registry=True)]}


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
    """The settings of the stages of a file of ``code/``, as JSON, if the chosen profile overrides them; else empty."""
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


def _chosen_by_dataset(tree: SourceTree, name: str) -> Chosen:
    """The choices of one dataset: the modules of its adapter, and the files that are read in its folder."""
    package, modules = "", list[str]()
    for dataset in dict.fromkeys((name, name.partition("-")[0])):  # a variant, such as arctic-whole, has no modules
        package = f"{DATASETS}.{dataset}"
        modules = tree.modules_below(package) or tree.entry_point_modules("hoidata.adapters", dataset)
        if modules:
            break
    readers = {reader: [Choice(package=package, files=files)] for reader, files in READERS.items()}
    return {f"{DATASETS}.registry": [Choice(tuple(modules))], **readers}
