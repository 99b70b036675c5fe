"""Independent formulas for the joints of a posed hand: plain loops over the kinematic chain, rotations by SciPy."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.adapters import RawTree
from hoidata.hands import HandModel, load_embedded_hands
from hoidata.schema import Clip

PARENT = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]
TIP_VERTEX = [317, 445, 673, 556, 745]


def rest_points(model: HandModel, betas=None, template_m=None) -> np.ndarray:
    """(21, 3) joints and tips of the unposed hand in the model's frame."""
    vertices = model.template_m if template_m is None else template_m
    vertices = vertices + model.shape_directions @ (np.zeros(10) if betas is None else np.asarray(betas))
    return np.concatenate((model.joint_regressor @ vertices, vertices[TIP_VERTEX]))


def rigid(rest: np.ndarray, orient, transl) -> np.ndarray:
    """A flat hand turned about its wrist: R (J - J0) + J0 + t, the tips with it."""
    rotation = Rotation.from_rotvec(orient).as_matrix()
    return (rest - rest[0]) @ rotation.T + rest[0] + np.asarray(transl)


def chain(rest: np.ndarray, orient, fingers, transl) -> np.ndarray:
    """(16, 3) joints of a bent hand, bone by bone; fingers: 45 absolute axis-angle numbers."""
    turns = [Rotation.from_rotvec(turn) for turn in np.concatenate((orient, fingers)).reshape(16, 3)]
    places, totals = [rest[0] + np.asarray(transl)], [turns[0]]
    for joint in range(1, 16):
        parent = PARENT[joint]
        places.append(places[parent] + totals[parent].apply(rest[joint] - rest[parent]))
        totals.append(totals[parent] * turns[joint])
    return np.array(places)


def write_box(path: Path, size) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(size).export(path)
    return path


@pytest.fixture
def formula() -> SimpleNamespace:
    return SimpleNamespace(rest_points=rest_points, rigid=rigid, chain=chain)


@pytest.fixture
def hands():
    return load_embedded_hands()


@pytest.fixture
def load_clips(load_all) -> Callable:
    """As ``load_all``, without the stretches left out."""
    return lambda adapter, root: [item for item in load_all(adapter, root) if isinstance(item, Clip)]


@pytest.fixture
def load_all() -> Callable:
    """All clips and left-out stretches of every sequence below a root, as the adapter gives them."""

    def load(adapter, root: Path) -> list:
        keys = adapter.sequences(root)
        return [item for key in keys for item in adapter.load(RawTree(root), key, load_embedded_hands())]

    return load
