"""Reads triangle meshes without changing vertices, and computes their mass properties."""

import io
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import trimesh
from scipy.spatial import QhullError

from hoidata.errors import BadInput
from hoidata.geometry.rows import distinct_rows
from hoidata.objects.ply import MOST_CORNERS, MOST_TRIANGLES, MOST_VERTICES, parse_ply
from hoidata.objects.solid import encloses
from hoidata.objects.stl import parse_stl

LARGEST_MESH_BYTES = 64 << 20  # a million vertices as text, which take fifteen times as much memory
_MOST = f"at most {MOST_VERTICES} vertices, {MOST_TRIANGLES} triangles and {MOST_CORNERS} corners of one face"
_MOST_INDEX = 2**31
_FLAT_VOLUME = 1e-9  # fraction of the bounding cube's volume below which a mesh counts as flat
_MOST_NAMES = 10_000  # of objects or groups; all further names are one piece
_MAX_COORDINATE = 1e9  # in any unit; areas and volumes of such a mesh still fit into a float


class Mesh(NamedTuple):
    """A triangle mesh in the unit and vertex order of its file."""

    vertices: np.ndarray  # (vertex, 3) float64
    faces: np.ndarray  # (face, 3) int64


class NamedPieces(NamedTuple):
    """A division of a file's faces into pieces."""

    kind: str  # what the pieces are: "objects", "groups", ...
    names: list[str]  # of the pieces; empty for pieces without names
    of_face: np.ndarray  # (face,) index of each face's piece
    parents: Sequence[int] = ()  # by piece, the piece with which it moves, or -1; empty if none does


class MassProperties(NamedTuple):
    """Mass properties of a solid of 1 kg and uniform density, in the mesh frame."""

    volume_m3: float  # 0 for a flat convex hull
    centre_m: np.ndarray  # (3,)
    inertia_kg_m2: np.ndarray  # (3, 3) about the centre of mass; 0 for a flat convex hull
    source: Literal["solid", "convex hull"]  # "convex hull" replaces a mesh that is open or encloses nothing


def load_mesh(path: str | Path) -> Mesh:
    """Read vertices and triangles of an OBJ, PLY or STL file; polygons become fans.

    The reader does not merge, reorder or drop vertices, because per-vertex files (part ids, contacts) index them. Only
    equal corners of an STL file, which has no shared vertices, are merged and sorted. Raises BadInput: the file holds
    no finite triangle mesh.
    """
    return load_named_mesh(path)[0]


def load_named_mesh(path: str | Path) -> tuple[Mesh, list[NamedPieces]]:
    """Read a mesh as ``load_mesh`` does, with the named objects and groups of an OBJ file, and the solids of an STL."""
    path = Path(path)
    data = read_mesh_bytes(path)
    pieces = list[NamedPieces]()
    try:
        match path.suffix.lower():
            case ".obj":  # a byte order mark, which some programs write, would hide the first line
                text = data.decode("utf-8-sig", "replace")
                del data  # 64 MiB of the largest files
                mesh, pieces = _parse_named_obj(text, path)
            case ".ply":
                mesh = Mesh(*parse_ply(data))
            case ".stl":
                corners, solid, names = parse_stl(data)
                first, number = distinct_rows(corners)
                mesh, pieces = Mesh(corners[first], number.reshape(-1, 3)), [NamedPieces("solids", names, solid)]
            case _:
                remedy = "read .glb with hoidata.objects.user_mesh.read_mesh_file; convert others"
                raise BadInput(path, "a mesh named .obj, .ply or .stl", path.suffix or "no suffix", remedy)
    except ValueError as error:
        raise BadInput(path, "a readable mesh", f"{type(error).__name__}: {error}") from error
    return checked_mesh(path, mesh), pieces


def read_mesh_bytes(path: Path, remedy: str = "download it again") -> bytes:
    """The bytes of a mesh file. Raises BadInput without a readable file (with ``remedy``), or if it is too large."""
    if not path.is_file():
        raise BadInput(path, "a mesh file", "nothing there", remedy)
    if path.stat().st_size > LARGEST_MESH_BYTES:
        raise BadInput(path, f"at most {LARGEST_MESH_BYTES} bytes", f"{path.stat().st_size}", "decimate the mesh")
    try:
        return path.read_bytes()
    except OSError as error:
        raise BadInput(path, "a readable mesh", f"{type(error).__name__}: {error}") from error


def parse_obj(text: str, path: str | Path) -> Mesh:
    """Parse the text of an OBJ file as ``load_mesh`` does; ``path`` names the file in errors."""
    return checked_mesh(path, _parse_named_obj(text, path)[0])


def _parse_named_obj(text: str, path: str | Path) -> tuple[Mesh, list[NamedPieces]]:
    """Parse vertices and polygons line by line. Raises BadInput with the number of a wrong line.

    trimesh has another result: it splits and reorders vertices where faces carry texture or normal indices, counts
    relative indices from the last vertex of the file, and reads index 0 as the first vertex.
    """
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    names = {"o": _FaceNames(), "g": _FaceNames()}
    for number, line in _joined_lines(text):
        words = line.split(maxsplit=MOST_CORNERS + 1)
        if words and words[0] in names:
            names[words[0]].begin(line, len(faces))
        if not words or words[0] not in ("v", "f"):
            continue
        if len(words) > MOST_CORNERS + 1 or len(vertices) > MOST_VERTICES or len(faces) > MOST_TRIANGLES:
            raise BadInput(f"{path}:{number}", _MOST, "more", "decimate the mesh")
        try:
            if words[0] == "v":
                vertices.append([float(word) for word in words[1:4]])
                corners = []
            else:
                corners = [_vertex_number(word, len(vertices)) for word in words[1:]]
        except ValueError as error:
            raise BadInput(f"{path}:{number}", "numbers after 'v' or 'f'", repr(line[:60].strip())) from error
        if len(words) < 4:
            expected = "3 coordinates per vertex and 3 or more corners per face"
            raise BadInput(f"{path}:{number}", expected, repr(line[:60].strip()), "export the mesh again")
        faces.extend((corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1))
    mesh = Mesh(np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64).reshape(-1, 3))
    return mesh, [names["o"].pieces("objects", len(faces)), names["g"].pieces("groups", len(faces))]


class _FaceNames:
    """Collects the names of objects or of groups, and the face at which each name begins."""

    def __init__(self) -> None:
        self.piece_of_name = {"": 0}
        self.first_faces, self.pieces_in_order = array("q", [0]), array("q", [0])

    def begin(self, line: str, face: int) -> None:
        """Start the piece that a line such as "o lid" names, with the face of this number."""
        name = " ".join(line.split()[1:])[:60] if len(line) < 1000 else line[1:61].strip()
        if name not in self.piece_of_name and len(self.piece_of_name) < _MOST_NAMES:
            self.piece_of_name[name] = len(self.piece_of_name)
        self.first_faces.append(face)
        self.pieces_in_order.append(self.piece_of_name.get(name, _MOST_NAMES))

    def pieces(self, kind: str, n_faces: int) -> NamedPieces:
        """The pieces of a file with this many faces."""
        counts = np.diff(np.append(np.array(self.first_faces, np.int64), n_faces))
        return NamedPieces(kind, list(self.piece_of_name), np.array(self.pieces_in_order, np.int64).repeat(counts))


def _joined_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines with their numbers. A vertex or face line that ends with a backslash continues in the next line."""
    unfinished: list[str] = []
    for number, line in enumerate(io.StringIO(text, newline=None), 1):
        if (
            line.endswith("\\\n")
            and (unfinished or line.lstrip()[:1] in ("v", "f"))
            and len(unfinished) <= MOST_CORNERS
        ):
            unfinished.append(line[:-2])
        elif unfinished:
            yield number, " ".join((*unfinished, line))
            unfinished = []
        else:
            yield number, line
    if unfinished:
        yield number, " ".join(unfinished)


def _vertex_number(corner: str, n_vertices: int) -> int:
    """The vertex of a corner such as "3/1/2", counted from 0. OBJ counts from 1, or back from the last vertex read."""
    index = int(corner.partition("/")[0])
    if index == 0 or abs(index) >= _MOST_INDEX:
        raise ValueError(f"corner {corner[:40]}")
    return index - 1 if index > 0 else n_vertices + index


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh with the vertices and faces of several, in their order."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([np.zeros((0, 3)), *(mesh.vertices for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(vertices, np.concatenate([np.zeros((0, 3), np.int64), *faces]))


def checked_mesh(path: str | Path, mesh: Mesh) -> Mesh:
    """Return the mesh, or raise BadInput if it is not a finite triangle mesh with area; errors name ``path``."""
    vertices, faces = mesh
    if not len(vertices):
        raise BadInput(path, "a mesh with vertices", "none", "export the mesh again")
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise BadInput(path, "a mesh with vertices of 3 coordinates", f"an array of shape {vertices.shape}")
    if not np.isfinite(vertices).all():
        raise BadInput(path, "finite vertices", "NaN or infinity")
    if np.abs(vertices).max() > _MAX_COORDINATE:
        raise BadInput(
            path, f"coordinates up to {_MAX_COORDINATE:g}", f"{np.abs(vertices).max():g}", "check the mesh's unit"
        )
    if not len(faces):
        raise BadInput(path, "a mesh with faces", f"{len(vertices)} vertices and no face")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise BadInput(path, f"face corners from 0 to {len(vertices) - 1}", f"{faces.min()} to {faces.max()}")
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    if not np.cross(b - a, c - a).any():
        raise BadInput(path, "faces with area", f"{len(faces)} faces without", "repair the mesh")
    return mesh


def mass_properties(vertices_m: np.ndarray, faces: np.ndarray) -> MassProperties:
    """Volume, centre of mass and inertia of the solid a mesh (vertex, 3), (face, 3) bounds, for 1 kg.

    Inverted triangles are flipped. The convex hull replaces an open mesh, and a mesh that encloses less than 0.1 % of
    its hull, such as two opposite shells.
    """
    mesh = trimesh.Trimesh(vertices_m, faces, process=True)
    with np.errstate(invalid="ignore", divide="ignore"):  # trimesh divides by the volume, 0 for a flat mesh
        solid = mesh.is_watertight and encloses(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        try:
            body = mesh if solid else mesh.convex_hull
        except QhullError:  # fewer than four distinct points
            body = mesh
        if body.volume < 0:
            body.invert()
        volume = float(body.volume)
    if volume <= _FLAT_VOLUME * np.ptp(mesh.vertices, axis=0).max() ** 3:
        return MassProperties(0.0, mesh.vertices.mean(axis=0), np.zeros((3, 3)), "convex hull")
    inertia = np.asarray(body.moment_inertia) / volume
    return MassProperties(volume, np.asarray(body.center_mass), inertia, "solid" if solid else "convex hull")
