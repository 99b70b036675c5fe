"""The objects of a recording of OakInk2: parts with their meshes and names, and pairs of parts that have a hinge."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import ObjectTrack
from hoidata.clips.quarantine import Quarantined
from hoidata.datasets.base import RawTree
from hoidata.datasets.gaps import bridge
from hoidata.datasets.hinge import HingeFit, box_corners, hinge_between, hinged_model
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.datasets.oakink2.files import LARGEST_JSON_BYTES, Annotation, read_names, read_roots
from hoidata.datasets.oakink2.words import noun_of
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.objects.mesh import Mesh
from hoidata.objects.model import ObjectModel

OBJECTS = ("object_repair", "object_raw", "object_preview")  # repaired, as scanned, the older name of the latter
TREE = "object_affordance/object_part_tree.json"


class Thing(NamedTuple):
    """A part, or two with a hinge, short gaps in its poses bridged. tracked: (frame,) bool, poses of the source.

    words: None where it has no name. note: how the parts keep to the hinge, or "".
    """

    track: ObjectTrack
    tracked: np.ndarray
    words: str | None
    note: str = ""
    left_out: tuple[Quarantined, ...] = ()


def object_names(raw: RawTree) -> tuple[dict[str, str], dict[str, str]]:
    """Names of objects, and the object each part belongs to."""
    paths = [f"{folder}/obj_desc.json" for folder in OBJECTS]
    path = next((own for own in paths if raw.has(own)), paths[0])
    roots = read_roots(raw.read(TREE, LARGEST_JSON_BYTES), TREE) if raw.has(TREE) else {}
    return read_names(raw.read(path, LARGEST_JSON_BYTES), path), roots


@dataclass
class Scene:
    """The objects of a recording, each made when a primitive first names it."""

    raw: RawTree
    key: str
    path: str
    seen: Annotation
    names: Mapping[str, str]
    roots: Mapping[str, str]
    most_off_mm: int
    most_off_deg: int
    _things: dict[str, Thing] = field(default_factory=dict)

    @property
    def left_out(self) -> list[Quarantined]:
        """Frames in which parts lie too far off their hinge, of the objects made so far."""
        return [reason for thing in _distinct(list(self._things.values())) for reason in thing.left_out]

    def things(self, parts: Sequence[str]) -> list[Thing]:
        """The objects some parts belong to, each once, in the order of the parts; none for parts without poses."""
        return _distinct([self.thing(name) for name in parts if name in self.seen.parts])

    def thing(self, name: str) -> Thing:
        """The object a part belongs to where it has a hinge, else the part alone."""
        if name not in self._things:
            root = self.roots.get(name, name)
            same = [part for part in self.seen.parts if self.roots.get(part, part) == root]
            pair = same if len(same) == 2 else [name]
            joined = self._hinged(root, pair) if len(pair) == 2 else None
            self._things |= dict.fromkeys(pair, joined) if joined else {part: self._part(part) for part in pair}
        return self._things[name]

    def _mesh(self, name: str) -> Mesh:
        """The one mesh in the folder of a part."""
        folders = [f"{folder}/align_ds/{name}" for folder in OBJECTS]
        found = {own: [n for n in self.raw.names(own) if n.lower().endswith((".obj", ".ply"))] for own in folders}
        folder = next((own for own in folders if found[own]), folders[0])
        if len(found[folder]) != 1:
            got = ", ".join(found[folder]) or "none"
            raise BadInput(folder, "one mesh, OBJ or PLY", got, "unpack object_repair.tar or object_raw.tar here")
        return raw_mesh(self.raw, f"{folder}/{found[folder][0]}")

    def _words(self, *ids: str) -> str | None:
        return next((noun_of(self.names[name]) for name in ids if self.names.get(name, "").strip(" _")), None)

    def _part(self, name: str) -> Thing:
        mesh, poses = self._mesh(name), self.seen.parts[name]
        model = ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), np.uint8))
        return Thing(bridge(_track(model, poses.world_from_part), poses.tracked), poses.tracked, self._words(name))

    def _hinged(self, root: str, pair: list[str]) -> Thing | None:
        """Two parts as one object, the one with the bigger surface as its base; None where no hinge fits them.

        At rest both lie as their meshes do, which share a frame; where that fits no hinge, as in the first frame.
        """
        meshes = {name: self._mesh(name) for name in pair}
        base, moving = sorted(pair, key=lambda name: (-_surface_m2(meshes[name]), name))
        tracked = self.seen.parts[base].tracked & self.seen.parts[moving].tracked
        if tracked.sum() < 2:
            return None
        poses = [self.seen.parts[name].world_from_part[tracked] for name in (base, moving)]
        relative = np.linalg.inv(poses[0]) @ poses[1]
        own, faces = meshes[base].vertices, [meshes[name].faces for name in (base, moving)]
        limits = (self.most_off_mm, self.most_off_deg)
        for rest in (np.eye(4), relative[0]):
            moved = meshes[moving].vertices @ rest[:3, :3].T + rest[:3, 3]
            corners = box_corners(own), box_corners(moved)
            found = hinge_between(poses[0], relative @ np.linalg.inv(rest), corners, *limits)
            if found is not None:
                model = hinged_model(root, [own, moved], faces, found[0])
                return self._joined(model, found[1], tracked, self._words(root, base))
        return None

    def _joined(self, model: ObjectModel, fit: HingeFit, tracked: np.ndarray, words: str | None) -> Thing:
        limits, frames = (self.most_off_mm, self.most_off_deg), np.flatnonzero(tracked)
        off, good = fit.off(*limits), tracked.copy()
        good[frames[off]] = False
        name = f"{self.key}/hinge of {model.name}"
        left_out = (fit.left_out(name, self.path, self.seen.frames[frames], *limits),) if off.any() else ()
        # Frames in which one of both is not tracked repeat the one before, until short gaps are bridged.
        source = np.clip(np.searchsorted(frames, np.arange(len(tracked)), side="right") - 1, 0, None)
        track = _track(model, fit.world_from_object[source], fit.hinge_rad[source])
        return Thing(bridge(track, good), good, words, f"{model.name}: {fit.note}", left_out)


def _surface_m2(mesh: Mesh) -> float:
    first, second, third = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(second - first, third - first), axis=1).sum() / 2)


def _distinct(things: Sequence[Thing]) -> list[Thing]:
    return list({id(thing): thing for thing in things}.values())


def _track(model: ObjectModel, poses: np.ndarray, hinge_rad: np.ndarray | None = None) -> ObjectTrack:
    angle = None if hinge_rad is None else hinge_rad.astype(np.float32)
    rotvec, place = rotmat_to_rotvec(poses[:, :3, :3]), poses[:, :3, 3]
    return ObjectTrack(model, rotvec.astype(np.float32), place.astype(np.float32), angle)
