"""What every stage shares: where things lie, its section of params.yaml, the hand of the profile, and being empty."""

import json
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from hoidata.errors import BadInput, MissingResource
from hoidata.files.atomic import atomic_folder, canonical_json
from hoidata.files.written import EMPTY, read_json
from hoidata.files.written import empty_reason as empty_reason  # for the stages
from hoidata.machine_folder import SETTINGS, machine_folder
from hoidata.settings import build_config
from pipelines.params import chosen_params, read_file

if TYPE_CHECKING:
    from hoidata.hands import HandPair

HAND = "hand"
OWN = "own"
Settings = TypeVar("Settings")


class _At:
    """A path of a stage run, from a pattern with the run's fields."""

    def __init__(self, pattern: str) -> None:
        self.pattern = pattern

    def __get__(self, paths: "StagePaths", owner: type) -> Path:
        return Path(self.pattern.format(**vars(paths)))


@dataclass(frozen=True)
class StagePaths:
    """Where the files of one stage run lie, relative to the project folder (the current folder)."""

    profile: str
    dataset: str = ""
    model: str = ""
    family: str = ""

    manifest = _At("manifests/{profile}/{dataset}.json")
    hand_manifest = _At(f"manifests/{{profile}}/{HAND}.json")
    generated_raw = _At(".hoidata/raw/{profile}/{dataset}")
    data = _At("data/{profile}/{dataset}")
    raw_manifest = _At("data/{profile}/{dataset}/raw.json")
    clips = _At("data/{profile}/{dataset}/clips")
    quality = _At("data/{profile}/{dataset}/quality")
    annotation = _At("data/{profile}/{dataset}/annotation")
    contact = _At("data/{profile}/{dataset}/contact")
    splits = _At("data/{profile}/{dataset}/splits")
    checkpoints = _At("checkpoints/{profile}/{dataset}")
    checkpoint = _At("checkpoints/{profile}/{dataset}/{model}")
    training = _At(".hoidata/training/{profile}/{dataset}/{model}")
    evaluators = _At("evaluators/{profile}/{dataset}")
    samples = _At("samples/{profile}/{dataset}/{family}")
    metrics = _At("metrics/{profile}/{dataset}")
    measured = _At(".hoidata/measured/{profile}/{dataset}/{family}.json")
    report = _At("report/{profile}")

    @property
    def is_generated(self) -> bool:
        """Whether the raw files are made by this project, with the embedded hand."""
        return self.profile != OWN

    def __str__(self) -> str:
        return "-".join(filter(None, (self.profile, self.dataset, self.model, self.family)))


def load_settings(kind: type[Settings], section: str, path: Path = Path("params.yaml")) -> Settings:
    """One section of params.yaml over the library's defaults. Raises BadInput as ``build_config`` does."""
    return build_config(kind, read_section(section, path), f"{path}: {section}")


def read_section(section: str, path: Path = Path("params.yaml")) -> dict[str, Any]:
    """One section of params.yaml as the chosen profile has it; an empty one where nothing is chosen."""
    return chosen_params(read_file(path)).get(section) or {}


def root_variable(name: str) -> str:
    """The environment variable that names the raw folder of a dataset, or of the MANO files."""
    return f"HOIDATA_{'MANO' if name == HAND else name.upper()}"


def own_root(name: str) -> Path | None:
    """The user's raw folder of ``name``: its environment variable, else hoidata.toml's [roots], else None."""
    if value := os.environ.get(root_variable(name)):
        return Path(value)
    root = _registered_roots(machine_folder() / SETTINGS).get(name)
    return None if root is None else Path(root)


def _registered_roots(path: Path) -> dict[str, str]:
    """[roots] of hoidata.toml; none without that file."""
    remedy = "correct it, or register the folders anew with `hoidata raw scan`"
    try:
        roots = tomllib.loads(path.read_text(encoding="utf-8")).get("roots", {}) if path.is_file() else {}
    except (ValueError, RecursionError, OSError) as error:  # tomllib's own error is a ValueError
        raise BadInput(path, "TOML text", str(error)[:300], remedy) from error
    if not isinstance(roots, dict) or not all(isinstance(root, str) and "\0" not in root for root in roots.values()):
        raise BadInput(path, "[roots] with one folder per name", str(roots)[:80], remedy)
    return roots


def raw_root(paths: StagePaths) -> Path:
    """The raw folder of a dataset that is present. Raises MissingResource with what to do when it is not there."""
    if paths.is_generated:
        root = paths.generated_raw if paths.generated_raw.is_dir() else machine_folder() / paths.generated_raw
        remedy = f"write it again with `hoidata synth write {paths.dataset} --profile {paths.profile}`"
    else:
        root = own_root(paths.dataset)
        remedy = f"set {root_variable(paths.dataset)}, or run `hoidata raw scan {paths.dataset} --root PATH`"
    if root is None or not root.is_dir():
        raise MissingResource(f"the raw files of {paths.dataset} ({paths.profile}) are not at {root}; {remedy}")
    return root


def load_hands(profile: str) -> "HandPair":
    """The hand of the profile: the user's MANO files where its manifest lists some, else the embedded one."""
    from hoidata.hands import load_embedded_hands, load_mano_hands

    if StagePaths(profile).is_generated or not hand_is_present(profile):
        return load_embedded_hands()
    root = own_root(HAND)
    if root is None or not root.is_dir():
        raise MissingResource(f"the MANO files are not at {root}; set {root_variable(HAND)} to their folder")
    return load_mano_hands(root)


def hand_is_present(profile: str) -> bool:
    """Whether the profile has a hand of its own: the embedded one, or MANO files that were scanned."""
    path = StagePaths(profile).hand_manifest
    return path.is_file() and bool(read_json(path, {"present": bool})["present"])


def note_empty(folder: Path, reason: str) -> None:
    """Note in a stage's output why there is nothing in it for the stages after it."""
    (folder / EMPTY).write_text(canonical_json({"reason": reason}) + "\n")
    print(f"empty: {reason}")


def write_empty(folder: Path, reason: str) -> None:
    """An output that holds nothing but the reason."""
    with atomic_folder(folder) as partial:
        note_empty(partial, reason)


def print_counts(paths: StagePaths, counts: Mapping[str, int]) -> None:
    """What a stage says of a run that went well."""
    print(f"{paths}: {', '.join(f'{count} {name}' for name, count in counts.items())}")


def write_json(path: Path, values: Any) -> None:
    """Readable JSON with sorted keys."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n")


def jobs() -> int:
    """Worker processes to use: HOIDATA_JOBS, else the cores this process may run on. Never changes results."""
    return int(os.environ.get("HOIDATA_JOBS", 0)) or len(os.sched_getaffinity(0))
