"""The families whose motions are sampled and measured for a dataset."""

from itertools import chain
from typing import Any

from hoidata.errors import BadInput
from hoidata.settings import check_keys

# By folder of models/: families with stages only for the datasets of ``family_datasets`` in params.yaml.
OPTIONAL_FAMILIES = {
    "manipnet": ("manipnet",),
    "bimart": ("bimart", "bimart-unrefined", "nearest-window", "mean-pose-at-object"),
    "mdm": ("mdm",),
    "imos": ("imos", "imos-true-start"),
    "t2m": ("t2m", "t2m-given-length"),
}
KEY = "family_datasets"


def families_of(params: dict[str, Any], dataset: str) -> list[str]:
    """The families whose motions of a dataset are measured, in the order of tables.

    Raises BadInput for names that have no stages.
    """
    chosen = params.get(KEY) or {}
    check_keys(chosen, list(OPTIONAL_FAMILIES), f"params.yaml: {KEY}")
    for folder, optional in OPTIONAL_FAMILIES.items():
        datasets = chosen.get(folder) or []
        if unknown := [name for name in datasets if name not in params["datasets"]]:
            raise BadInput(f"params.yaml: {KEY}.{folder}", f"names of {params['datasets']}", str(unknown), "correct it")
        if misplaced := [name for name in params["families"] if name in optional]:
            remedy = f"name datasets under {KEY}.{folder} instead, such as {folder}: [{dataset}]"
            raise BadInput("params.yaml: families", f"no family of {KEY}", ", ".join(misplaced), remedy)
    added = [names for folder, names in OPTIONAL_FAMILIES.items() if dataset in (chosen.get(folder) or [])]
    return [*params["families"], *chain(*added)]
