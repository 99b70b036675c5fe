"""Read MANO files (Romero et al. 2017) without chumpy and without executing their pickles.

The released files are Python 2 pickles with chumpy and SciPy objects. These are read as inert records and evaluated
here. The widespread correction of the left hand's shape directions is not applied: H2O, GRAB and ARCTIC were fitted
with the unmodified file.
"""

from pathlib import Path
from typing import Any

import numpy as np

from hoidata.errors import BadInput, MissingResource
from hoidata.files import ARRAYS, Record, restricted_load
from hoidata.hands.model import N_SHAPE, HandModel, HandPair, Side, checked_model

MANO_SITE = "https://mano.is.tue.mpg.de"
FILE_NAMES: dict[Side, str] = {"left": "MANO_LEFT.pkl", "right": "MANO_RIGHT.pkl"}
_MAX_BYTES = 64 << 20
_REMEDY = f"download mano_v1_2.zip again from {MANO_SITE} and take models/MANO_LEFT.pkl and MANO_RIGHT.pkl from it"
ROOT_SENTINEL = 2**32 - 1


class _Ch(Record):
    """A chumpy array: its value is ``state["x"]``."""


class _Select(Record):
    """A chumpy selection: elements ``idxs`` of the flattened ``a``, shaped ``preferred_shape``."""


class _Csc(Record):
    """A SciPy compressed-column matrix."""


_ALLOW = {
    **ARRAYS,
    ("chumpy.ch", "Ch"): _Ch,
    ("chumpy.reordering", "Select"): _Select,
    ("scipy.sparse.csc", "csc_matrix"): _Csc,
    ("scipy.sparse._csc", "csc_matrix"): _Csc,
}
# Field of HandModel: key of a MANO file.
MANO_KEYS = {
    "template_m": "v_template",
    "shape_directions": "shapedirs",
    "pose_directions": "posedirs",
    "joint_regressor": "J_regressor",
    "skin_weights": "weights",
    "parents": "kintree_table",
    "faces": "f",
    "mean_pose": "hands_mean",
    "components": "hands_components",
}


def load_mano_hands(folder: str | Path) -> HandPair:
    """Load both hands of a MANO download, named "mano".

    folder: the folder of MANO_LEFT.pkl and MANO_RIGHT.pkl, or the unpacked ``mano_v1_2``.
    Raises MissingResource for a missing file, and BadInput for a file that is not a MANO file.
    """
    return HandPair(left=_load_side(Path(folder), "left"), right=_load_side(Path(folder), "right"))


def _load_side(folder: Path, side: Side) -> HandModel:
    path = _find(folder, FILE_NAMES[side])
    with open(path, "rb") as stream:
        content = restricted_load(stream, _ALLOW, encoding="latin1", path=path, max_bytes=_MAX_BYTES)
    if not isinstance(content, dict):
        raise BadInput(path, "a dict of arrays", type(content).__name__, _REMEDY)
    model = checked_model(str(path), _REMEDY, side=side, name="mano", **_fields(path, content))
    _check_side(path, model)
    return model


def _find(folder: Path, name: str) -> Path:
    for parent in (folder, folder / "models", folder / "mano_v1_2" / "models"):
        if (parent / name).is_file():
            return parent / name
    raise MissingResource(
        f"{folder}: expected {name} of the MANO hand model, found none; register at {MANO_SITE}, download "
        f"mano_v1_2.zip, unpack it and give its 'models' folder (MANO may not be redistributed, so hoidata has no copy)"
    )


def _fields(path: Path, content: dict[str, Any]) -> dict[str, np.ndarray]:
    absent = sorted(key for key in MANO_KEYS.values() if key not in content)
    if absent:
        raise BadInput(path, f"the keys {sorted(MANO_KEYS.values())}", f"a dict without {absent}", _REMEDY)
    values = {field: _dense(f"{path}: {key}", content[key]) for field, key in MANO_KEYS.items()}
    values["shape_directions"] = values["shape_directions"][..., :N_SHAPE]
    values["parents"] = _parents(values["parents"])
    return values


def _dense(source: str, value: Any) -> np.ndarray:
    """Evaluate a record; a plain array is returned unchanged."""
    try:
        if isinstance(value, _Ch):
            return _dense(source, value.state["x"])
        if isinstance(value, _Select):
            flat = _dense(source, value.state["a"]).ravel()
            return flat[np.asarray(value.state["idxs"])].reshape(value.state["preferred_shape"])
        if isinstance(value, _Csc):
            return _dense_csc(value.state)
        if isinstance(value, np.ndarray):
            return value
    except (KeyError, IndexError, TypeError, ValueError, RecursionError) as error:
        got = f"{type(error).__name__}: {error}"
        raise BadInput(source, "a chumpy or SciPy object as MANO has them", got, _REMEDY) from None
    raise BadInput(source, "an array", type(value).__name__, _REMEDY)


def _dense_csc(state: dict[str, Any]) -> np.ndarray:
    # Not by SciPy, whose matrices end the process with a segmentation fault for some wrong arrays.
    rows, columns = (int(length) for length in state["_shape"])
    if not (0 < rows <= 1024 and 0 < columns <= 1024):
        raise ValueError(f"matrix of shape {(rows, columns)}")
    data, row_index, start = (np.asarray(state[key]) for key in ("data", "indices", "indptr"))
    if start.shape != (columns + 1,) or start[0] != 0 or start[-1] != len(row_index) or len(row_index) != len(data):
        raise ValueError("column pointers that do not fit the data")
    if (np.diff(start) < 0).any() or (len(row_index) and not 0 <= row_index.min() <= row_index.max() < rows):
        raise ValueError("row indices outside the matrix")
    dense = np.zeros((rows, columns))
    np.add.at(dense, (row_index, np.repeat(np.arange(columns), np.diff(start))), data)
    return dense


def _parents(table: np.ndarray) -> np.ndarray:
    if table.ndim != 2 or table.dtype.kind not in "iu":
        return table
    parents = table[0].astype(np.int64)
    return np.where(parents == ROOT_SENTINEL, -1, parents)


def _check_side(path: Path, model: HandModel) -> None:
    """In MANO's rest pose the right hand's fingers point to -x, the left hand's to +x."""
    joints = model.joint_regressor @ model.template_m
    points_to_minus_x = joints[4, 0] < joints[0, 0]
    if points_to_minus_x != (model.side == "right"):
        remedy = "restore the original names of the two files"
        raise BadInput(path, f"a {model.side} hand", "fingers that point in the direction of the other hand's", remedy)
