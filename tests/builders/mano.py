"""MANO files as users have them, of any hand model."""

import pickle
from pathlib import Path

import numpy as np

from hoidata.hands import PARENTS, HandModel
from hoidata.hands.mano import MANO_KEYS, ROOT_SENTINEL
from hoidata.hands.model import N_ROTATIONS


def write_mano_pickle(model: HandModel, path: str | Path) -> None:
    """Write a model in the layout of a MANO file, as plain arrays (pickle protocol 2, about 3.9 MB).

    For tests of the user-file path and for tools that read MANO; never write a real MANO hand with it to share it.
    """
    content = {key: getattr(model, field) for field, key in MANO_KEYS.items()} | {
        "J": model.joint_regressor @ model.template_m,
        "kintree_table": np.array([[ROOT_SENTINEL, *PARENTS[1:]], range(N_ROTATIONS)], dtype=np.int64),
        "f": model.faces.astype(np.uint32),
        "hands_coeffs": np.zeros((1, len(model.mean_pose))),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }
    Path(path).write_bytes(pickle.dumps(content, protocol=2))
