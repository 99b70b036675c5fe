"""One object's surface, ready for many questions: is a place nearer than a threshold, how far is it, how deep inside.

Places are given in the object frame; each part answers in its own rest frame, where its surface never changes, so one
index serves every frame of every clip at every hinge angle.
"""

import hashlib
from collections import OrderedDict

import numpy as np

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.objects.distance import closest_points, signed_distance
from hoidata.objects.model import ObjectModel

_KEPT = 8
_indices: OrderedDict[str, "SurfaceIndex"] = OrderedDict()


def surface_index(model: ObjectModel) -> "SurfaceIndex":
    """The index of a model; the few used last are kept, by what the mesh, its parts and its hinge are."""
    key = _digest(model)
    if key not in _indices:
        _indices[key] = SurfaceIndex(model)
    _indices.move_to_end(key)
    while len(_indices) > _KEPT:
        _indices.popitem(last=False)
    return _indices[key]


class SurfaceIndex:
    """The surface of one object; of a hinged one that of both parts, at the angle each frame has.

    solid_note: None, or a sentence about parts that enclose no solid, so that nothing can be inside them.
    """

    def __init__(self, model: ObjectModel) -> None:
        self.model = model
        self.parts = [int(part) for part in np.unique(model.face_part)] if model.is_articulated else [0]
        self._faces = {part: self._part_faces(part) for part in self.parts}
        self.solid_note: str | None = None

    def within(self, places_m: np.ndarray, hinge_rad: np.ndarray | None, threshold_m: float) -> np.ndarray:
        """(frame, place) bool: the distance to the surface is less than ``threshold_m``.

        places_m: (frame, place, 3), object frame, metres. hinge_rad: (frame,) for a hinged object, else None.
        """
        return self.distance_m(places_m, hinge_rad) < threshold_m

    def distance_m(self, places_m: np.ndarray, hinge_rad: np.ndarray | None, most_m: float = np.inf) -> np.ndarray:
        """(frame, place) float64 distance to the surface, metres, never negative; infinite where it exceeds ``most_m``.

        Arguments as in ``within``.
        """
        distance = np.full(places_m.shape[:2], np.inf)
        for part in self.parts:
            local = self._local(places_m, hinge_rad, part)
            found = closest_points(self.model.vertices_m, self._faces[part], local.reshape(-1, 3))
            np.minimum(distance, found.distance_m.reshape(distance.shape), out=distance)
        return np.where(distance <= most_m, distance, np.inf)

    def depth_m(self, places_m: np.ndarray, hinge_rad: np.ndarray | None) -> np.ndarray:
        """(frame, place) float64 metres inside the solid, 0 outside; of two parts, how deep in the one it is deeper in.

        Arguments as in ``within``. Raises BadInput where no part encloses a solid.
        """
        depth = np.zeros(places_m.shape[:2])
        for part in self.parts:
            local = self._local(places_m, hinge_rad, part)
            found = signed_distance(self.model.vertices_m, self._faces[part], local.reshape(-1, 3))
            np.maximum(depth, -found.distance_m.reshape(depth.shape), out=depth)
        return depth

    def _part_faces(self, part: int) -> np.ndarray:
        return self.model.faces[self.model.face_part == part] if self.model.is_articulated else self.model.faces

    def _local(self, places_m: np.ndarray, hinge_rad: np.ndarray | None, part: int) -> np.ndarray:
        """The places in the part's rest frame."""
        places = np.asarray(places_m, dtype=np.float64)
        hinge = self.model.hinge
        if part == 0 or hinge is None:
            return places
        if hinge_rad is None:
            raise BadInput(self.model.name, "hinge angles", "none", "give the angle of every frame")
        turn = rotvec_to_rotmat(hinge.axis[None] * np.asarray(hinge_rad, dtype=np.float64)[:, None])
        return (places - hinge.origin_m) @ turn + hinge.origin_m


def _digest(model: ObjectModel) -> str:
    hinge = () if model.hinge is None else (model.hinge.axis, model.hinge.origin_m)
    arrays = (model.vertices_m, model.faces, model.part, *hinge)
    digest = hashlib.sha256(model.name.encode())
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
