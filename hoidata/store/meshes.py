"""Object meshes of a store being written: kept on disk until all are known, then filed under their final names."""

import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.files import sha256_bytes
from hoidata.files.arrays import write_npz
from hoidata.objects.model import ObjectModel
from hoidata.store.fields import OBJECT_ARRAYS
from hoidata.store.mapped import map_npz

MeshKey = tuple[str, str]
_DIGITS = 8


class MeshWriter:
    """Collects the distinct meshes of a store by (name, digest); only their facts stay in memory.

    The key of a mesh in the store is its name. Where several meshes share a name, all of them get the name followed by
    ``#`` and the first 8 digits of their digest: which came first does not matter.
    """

    def __init__(self, folder: Path) -> None:
        self._aside = folder / "meshes.part"
        self._facts: dict[MeshKey, dict[str, Any]] = {}

    def add(self, model: ObjectModel) -> MeshKey:
        arrays = mesh_arrays(model)
        key = model.name, mesh_digest(arrays, model)
        if key not in self._facts:
            write_npz(self._aside / f"{len(self._facts)}.npz", arrays)
            hinge = model.hinge
            self._facts[key] = {
                "n_vertices": len(model.vertices_m),
                "n_faces": len(model.faces),
                "articulated": hinge is not None,
                "hinge_axis": None if hinge is None else hinge.axis.tolist(),
                "hinge_origin_m": None if hinge is None else hinge.origin_m.tolist(),
                "digest": key[1],
            }
        return key

    def names(self) -> dict[MeshKey, str]:
        """The final name of every mesh added so far."""
        meshes_of = Counter(name for name, _ in self._facts)
        return {key: key[0] if meshes_of[key[0]] == 1 else f"{key[0]}#{key[1][:_DIGITS]}" for key in self._facts}

    def finish(self, path: Path) -> list[dict[str, Any]]:
        """Write the arrays of all meshes to ``path``; the rows of objects.parquet."""
        names, members, rows = self.names(), {}, {}
        for number, (key, facts) in enumerate(self._facts.items()):
            name = names[key]
            rows[name] = {"object": name, **facts}
            members |= {f"{name}/{kind}": array for kind, array in map_npz(self._aside / f"{number}.npz").items()}
        write_npz(path, dict(sorted(members.items())))
        shutil.rmtree(self._aside, ignore_errors=True)
        return [rows[name] for name in sorted(rows)]


def mesh_arrays(model: ObjectModel) -> dict[str, np.ndarray]:
    """vertices_m, faces and part in the dtypes of the store."""
    return {f.name: np.ascontiguousarray(getattr(model, f.name), f.dtype) for f in OBJECT_ARRAYS.fields}


def mesh_digest(arrays: dict[str, np.ndarray], model: ObjectModel) -> str:
    """SHA-256 of vertices_m, faces, part and, where there is a hinge, its axis and origin (float64)."""
    hinge = () if model.hinge is None else (model.hinge.axis, model.hinge.origin_m)
    ordered = [arrays[field.name] for field in OBJECT_ARRAYS.fields]
    return sha256_bytes(b"".join(array.tobytes() for array in (*ordered, *map(np.float64, hinge))))
