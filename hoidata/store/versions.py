"""Stores of other schema versions: which are read, and what is filled in for fields they do not have."""

from pathlib import Path
from typing import Any

import pandas as pd

from hoidata.errors import BadInput
from hoidata.store.fields import SCHEMA_VERSION, Version, parse_version

CURRENT = parse_version(SCHEMA_VERSION)

# What a clip of a store before 1.1 has in the columns 1.1 added.
_COLUMNS_1_1: dict[str, Any] = {
    "hands_from": "parameters",
    "fit_error_m": None,
    "camera_name": None,
    "camera_intrinsics": None,
    "camera_row": -1,
    "body_row": -1,
    "expression_row": -1,
    "source_contact_row": -1,
    "source_contact_count": 0,
}
_NOT_RECORDED = "not recorded: converted with schema 1.0"


def checked_version(folder: str | Path, text: Any) -> Version:
    """The (major, minor) version of a store that this code reads.

    Raises BadInput for another major version; its text names the command that helps.
    """
    path = Path(folder) / "meta" / "info.json"
    try:
        version = parse_version(text)
    except (ValueError, AttributeError) as error:
        raise BadInput(path, "a schema_version like 1.1.0", repr(text), "run the conversion again") from error
    if version[0] != CURRENT[0]:
        command = f"hoidata migrate {folder}"
        newer = f"upgrade hoidata (pip install --upgrade hoidata), then run: {command}"
        remedy = newer if version[0] > CURRENT[0] else f"run: {command}"
        raise BadInput(path, f"schema version {SCHEMA_VERSION}", text, remedy)
    return version


def filled_sequences(table: pd.DataFrame, version: Version) -> pd.DataFrame:
    """The table of clips with the columns that later minor versions added."""
    if version >= (1, 1):
        return table
    filled = table.assign(**{name: [value] * len(table) for name, value in _COLUMNS_1_1.items()})
    filled["gravity_note"] = [_NOT_RECORDED if value is None else "" for value in table["gravity"]]
    return filled


def filled_info(info: dict[str, Any], version: Version) -> dict[str, Any]:
    """The facts with those later minor versions require; what was not recorded is said to be unknown."""
    if version >= (1, 1):
        return info
    rest = {key: value for key, value in info.items() if key not in ("frame_notes", "hand_notes")}
    added = {
        "dataset_version": "not recorded",
        "synthetic": False,
        "source_fps": 0.0,
        "licence": "not recorded",
        "may_be_shared": False,
        "hand_model": {"name": "not recorded", "digest": ""},
        "frame": {
            "handedness": "right",
            "up_axis": None,
            "gravity": "unknown",
            "note": info.get("frame_notes", _NOT_RECORDED),
        },
        "hand_convention": {"left_shape": "unknown", "note": info.get("hand_notes", _NOT_RECORDED)},
    }
    return added | rest
