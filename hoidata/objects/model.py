"""The canonical object: a triangle mesh in metres, its parts, and the hinge between them."""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import IDENTITY, RigidTransform
from hoidata.objects.mesh import MassProperties, mass_properties
from hoidata.objects.solid import NoSolid, Solid, close_cut, solid_of

_CHUNK_FRAMES = 16
SEAM = 2  # in ``ObjectModel.face_part``: a triangle with corners on both parts


@dataclass(frozen=True)
class Hinge:
    """The joint of an articulated object, which moves a point p of the moving part.

    Revolute: angle q moves it to ``R(axis * q) (p - origin) + origin``. Prismatic: displacement q moves it to
    ``p + axis * q``.
    """

    axis: np.ndarray  # (3,) unit vector, object frame
    origin_m: np.ndarray  # (3,) a point on the axis, object frame; zeros for a prismatic joint
    is_prismatic: bool = False
    file_position: float = 0.0  # of the URDF's joint where the mesh rests, which counts as 0; radians or metres

    @property
    def unit(self) -> str:
        """The unit of joint positions."""
        return "m" if self.is_prismatic else "rad"

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """Axis, and origin of a revolute joint: the stored arrays, from which digests are computed."""
        return (self.axis,) if self.is_prismatic else (self.axis, self.origin_m)

    def scaled(self, factor: float) -> "Hinge":
        """The joint of the object scaled about the origin of its frame."""
        file_position = self.file_position * (factor if self.is_prismatic else 1.0)
        return replace(self, origin_m=factor * self.origin_m, file_position=file_position)

    def turn(self, hinge_rad: np.ndarray) -> RigidTransform:
        """``object_from_part`` of the moving part at joint positions (frame,), radians; metres if prismatic."""
        along = np.asarray(self.axis, dtype=np.float64) * np.asarray(hinge_rad, dtype=np.float64)[..., None]
        if self.is_prismatic:
            return RigidTransform(np.broadcast_to(np.eye(3), (*along.shape, 3)), along)
        return RigidTransform(rotvec_to_rotmat(along), self.origin_m, self.origin_m)

    def node_motion(self, hinge_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Translations (frame, 3) and axis-angles (frame, 3) of a scene node at ``origin_m`` that moves the part."""
        along = self.axis * np.asarray(hinge_rad)[:, None]
        origin_m = np.broadcast_to(self.origin_m, along.shape)
        return (origin_m + along, np.zeros_like(along)) if self.is_prismatic else (origin_m, along)


@dataclass(frozen=True)
class ObjectModel:
    """A rigid or hinged object in its object frame. Do not change its arrays: derived values are cached."""

    name: str
    vertices_m: np.ndarray  # (vertex, 3) at hinge angle 0
    faces: np.ndarray  # (face, 3) int
    part: np.ndarray  # (vertex,) uint8, 0 = base, 1 = the part that the hinge moves
    hinge: Hinge | None = None

    @property
    def is_articulated(self) -> bool:
        """Whether the object has a hinge."""
        return self.hinge is not None

    @cached_property
    def face_part(self) -> np.ndarray:
        """(face,) uint8, the part of each face; ``SEAM`` if its corners are on both parts.

        A seam triangle belongs to neither part, because its corners move apart with the hinge.
        """
        if not self.is_articulated:
            return np.zeros(len(self.faces), np.uint8)
        corners = self.part[self.faces]
        return np.where((corners == corners[:, :1]).all(axis=1), corners[:, 0], SEAM).astype(np.uint8)

    @cached_property
    def scale_m(self) -> float:
        """Distance of the farthest vertex from the mean of all vertices, the ``s_obj`` of Text2HOI, Sec. 3.1."""
        return float(np.linalg.norm(self.vertices_m - self.vertices_m.mean(axis=0), axis=1).max())

    def scaled(self, factor: float) -> "ObjectModel":
        """The object, scaled about the origin of its frame."""
        hinge = self.hinge and self.hinge.scaled(factor)
        return replace(self, vertices_m=factor * self.vertices_m, hinge=hinge)

    @property
    def parts(self) -> list[int]:
        """Indices of the parts that have faces; [0] for a rigid object."""
        return [int(part) for part in np.unique(self.face_part) if part != SEAM] if self.is_articulated else [0]

    @property
    def seam_triangles(self) -> int:
        """Number of triangles that span both parts. Distances and sampled points exclude them."""
        return int((self.face_part == SEAM).sum())

    @cached_property
    def joint_scale(self) -> float:
        """Joint position that counts as one radian: 1 for a hinge, the moving part's radius in metres for a slide.

        Networks and measures of motion know angles. A hinge moves a point at this distance as far as the slide.
        """
        if self.hinge is None or not self.hinge.is_prismatic:
            return 1.0
        moving_m = self.vertices_m[self.part == 1]
        return float(np.linalg.norm(moving_m - moving_m.mean(axis=0), axis=1).max())

    def vertices_of(self, part: int) -> np.ndarray:
        """(vertex, 3) vertices of one part, hinge angle 0."""
        return self.vertices_m[self.part == part] if self.is_articulated else self.vertices_m

    def faces_of(self, part: int) -> np.ndarray:
        """(face, 3) faces of one part."""
        return self.faces[self.face_part == part] if self.is_articulated else self.faces

    def part_mesh(self, part: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (vertex, 3), object frame, and faces (face, 3) of one part, without unused vertices."""
        used, corners = np.unique(self.faces_of(part), return_inverse=True)
        return self.vertices_m[used], corners.reshape(-1, 3)

    @cached_property
    def closed_parts(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """By part, vertices (vertex, 3) and faces (face, 3), with the cut between the parts closed.

        A surface without such a cut is unchanged. The closing triangles bound a volume; they are not part of the
        object's surface.
        """
        return {
            part: close_cut(self.vertices_m, self.faces_of(part), self.faces[self.face_part != part])
            for part in self.parts
        }

    @cached_property
    def solids(self) -> dict[int, Solid | NoSolid]:
        """By part, its solid, or the reason why it has none. Raises BadInput for a mesh without triangles."""
        return {part: solid_of(*mesh) for part, mesh in self.closed_parts.items()}

    @cached_property
    def masses(self) -> tuple[MassProperties, ...]:
        """Volume, centre of mass and inertia of each of ``parts``, for 1 kg: of the repaired solid, if any."""
        repaired = {part: s[:2] for part, s in self.solids.items() if isinstance(s, Solid) and s.repairs}
        return tuple(mass_properties(*mesh) for mesh in {**self.closed_parts, **repaired}.values())

    @cached_property
    def digest(self) -> str:
        """SHA-256 of name, mesh, parts and hinge."""
        hinge = () if self.hinge is None else self.hinge.arrays
        digest = hashlib.sha256(self.name.encode())
        for array in (self.vertices_m, self.faces, self.part, *hinge):
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def object_from_part(self, part: int, hinge_rad: np.ndarray | None) -> RigidTransform:
        """Pose of a part relative to its rest pose (hinge angle 0), in which its mesh is stored.

        Args:
            part: 0 for the base, whose pose is the identity; 1 for the part that the hinge moves.
            hinge_rad: (frame,), required for part 1.

        Raises BadInput: part 1 is requested without angles.
        """
        if part == 0 or self.hinge is None:
            return IDENTITY
        if hinge_rad is None:
            raise BadInput(f"motion of {self.name!r}", "a hinge angle for every frame", "none", "give the angles")
        return self.hinge.turn(hinge_rad)

    def lowest_m(self, world_from_object: RigidTransform, hinge_rad: np.ndarray | None, up: np.ndarray) -> np.ndarray:
        """Height of the lowest vertex in each frame, (frame,) along ``up`` above the world's origin.

        world_from_object: (frame,) poses. hinge_rad: (frame,), None for a rigid object. up: (3,) unit vector, world.
        """
        lowest = []
        for part in self.parts:
            world_from_part = world_from_object @ self.object_from_part(part, hinge_rad)
            vertices_m = self.vertices_of(part)
            # height = up @ (R v + t) = (up @ R) @ v + up @ t: no vertex is transformed to the world.
            up_in_part, origins_m = up @ world_from_part.rotation, world_from_part.translation @ up
            starts = range(0, len(up_in_part), _CHUNK_FRAMES)
            heights_m = [(vertices_m @ up_in_part[start : start + _CHUNK_FRAMES].T).min(axis=0) for start in starts]
            lowest.append(np.concatenate([np.zeros(0), *heights_m]) + origins_m)
        return np.minimum.reduce(lowest)


def joint_vectors(model: ObjectModel) -> tuple[np.ndarray, np.ndarray]:
    """Rotation axis (3,) and displacement (3,) in metres per radian of ``ObjectTrack.joint_angle_rad``, or zeros."""
    axis = np.zeros(3) if model.hinge is None else model.hinge.axis
    is_prismatic = model.hinge is not None and model.hinge.is_prismatic
    return (np.zeros(3), axis * model.joint_scale) if is_prismatic else (axis, np.zeros(3))


def articulate(points_m: np.ndarray, part: np.ndarray, hinge: Hinge | None, hinge_rad: np.ndarray | None) -> np.ndarray:
    """Points of an object at each hinge angle, object frame.

    Args:
        points_m: (point, 3) at hinge angle 0.
        part: (point,) 0 or 1.
        hinge: None for a rigid object.
        hinge_rad: (frame,), None for a rigid object.

    Returns (frame, point, 3); (1, point, 3) for a rigid object.
    """
    if hinge is None or hinge_rad is None:
        return points_m[None]
    return np.where(part[None, :, None] == 1, hinge.turn(hinge_rad) @ points_m, points_m[None])
