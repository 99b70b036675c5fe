"""Clips as JSON values and arrays, and back again: exact in every bit, no pickles.

Whatever fields a clip has, they are kept: a dataclass becomes ``{"kind": name, "fields": ...}``, an array its dtype,
shape and place in one block of bytes. Arrays many sequences share (meshes, personal hands) become a digest.
"""

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np

from hoidata.clips.clip import BodyTrack, CameraTrack, Clip, HandTrack, ObjectTrack, SourceContact, SourceFile
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.recording import HandRecording, OwnHandTrack
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import JointCapsules, Skin, TrackedHand
from hoidata.objects.model import Hinge, ObjectModel

KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        *(Clip, HandTrack, ObjectTrack, CameraTrack, BodyTrack, SourceContact, SourceFile),
        *(ObjectModel, Hinge, Quarantined),
        *(HandRecording, OwnHandTrack, TrackedHand, Skin, JointCapsules, RigidTransform),
    )
}
SHARED = {("ObjectModel", "vertices_m"), ("ObjectModel", "faces"), ("ObjectModel", "part"), ("HandTrack", "template_m")}
_ALIGNMENT = 16


class Packer:
    """Turns values into JSON; their arrays pile up in ``blocks``.

    share: keeps an array elsewhere and gives the name it is found under.
    """

    def __init__(self, share: Callable[[np.ndarray], str]) -> None:
        self.share = share
        self.blocks: list[bytes] = []
        self._length = 0
        self._shared: dict[int, tuple[np.ndarray, str]] = {}

    @property
    def shared(self) -> set[str]:
        """The names of the arrays kept elsewhere."""
        return {name for _, name in self._shared.values()}

    def pack(self, value: Any) -> Any:
        """``value`` as JSON values. Raises TypeError for anything but the parts clips are made of."""
        if value is None or isinstance(value, bool | int | str) or type(value) is float:
            return value
        if isinstance(value, np.ndarray | np.generic):
            return {"array": self._keep(np.asarray(value)), "scalar": isinstance(value, np.generic)}
        if isinstance(value, dict):
            return {"dict": [[key, self.pack(item)] for key, item in value.items()]}
        if isinstance(value, tuple | list):
            return {type(value).__name__: [self.pack(item) for item in value]}
        name = type(value).__name__
        if KINDS.get(name) is not type(value):
            raise TypeError(f"a {name} cannot be part of a clip")
        return {"kind": name, "fields": {field.name: self._field(name, field.name, value) for field in fields(value)}}

    def _field(self, kind: str, name: str, owner: Any) -> Any:
        value = getattr(owner, name)
        if (kind, name) not in SHARED or value is None:
            return self.pack(value)
        # Clips of one sequence share one array object: it is digested once. Held here, so that no other gets its id.
        if id(value) not in self._shared:
            self._shared[id(value)] = value, self.share(value)
        return {"shared": self._shared[id(value)][1]}

    def _keep(self, array: np.ndarray) -> list[Any]:
        if array.dtype.hasobject:
            raise TypeError("an array of Python objects cannot be part of a clip")
        data = array.tobytes()
        place, self._length = self._length, self._length + len(data) + -len(data) % _ALIGNMENT
        self.blocks.append(data + bytes(-len(data) % _ALIGNMENT))
        return [array.dtype.str, list(array.shape), place]


def unpack(value: Any, data: np.ndarray, shared: Callable[[str], np.ndarray]) -> Any:
    """What ``Packer.pack`` was given. data: (byte,) uint8, its blocks joined; shared: an array by its name.

    Raises KeyError, TypeError or ValueError for anything else.
    """
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return _array(value["array"], data)[()] if value["scalar"] else _array(value["array"], data)
    if "shared" in value:
        return shared(value["shared"])
    if "dict" in value:
        return {key: unpack(item, data, shared) for key, item in value["dict"]}
    if "kind" in value:
        parts = {name: unpack(item, data, shared) for name, item in value["fields"].items()}
        return KINDS[value["kind"]](**parts)
    items = [unpack(item, data, shared) for item in value["tuple" if "tuple" in value else "list"]]
    return tuple(items) if "tuple" in value else items


def _array(facts: list[Any], data: np.ndarray) -> np.ndarray:
    dtype, shape, place = np.dtype(facts[0]), facts[1], facts[2]
    if dtype.hasobject:
        raise ValueError("an array of Python objects")
    count = int(np.prod(shape, dtype=np.int64))
    if not count:
        return np.zeros(shape, dtype)
    # A copy: a view would keep the data of the whole sequence as long as one of its arrays lives.
    return np.frombuffer(data, dtype, count, place).reshape(shape).copy()
