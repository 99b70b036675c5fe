"""Reading triangle meshes exactly as stored, and their mass properties."""

import io
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import trimesh
from scipy.spatial import QhullError

from hoidata.errors import BadInput
from hoidata.objects.ply import MOST_CORNERS, MOST_TRIANGLES, MOST_VERTICES, parse_ply
from hoidata.objects.solid import encloses

LARGEST_MESH_BYTES = 64 << 20  # a million vertices as text, which take fifteen times as much when read
_MOST = f"at most {MOST_VERTICES} vertices, {MOST_TRIANGLES} triangles and {MOST_CORNERS} corners of one face"
_MOST_INDEX = 2**31
_FLAT = 1e-9  # of the cube around a mesh: what encloses less has no inside
_MOST_NAMES = 10_000  # of objects or groups; further ones count as one
_FARTHEST = 1e9  # in any unit; areas and volumes of such a mesh still fit into a float


class Mesh(NamedTuple):
    """vertices: (vertex, 3) float64 in the file's own unit and order; faces: (face, 3) int64."""

    vertices: np.ndarray
    faces: np.ndarray


class NamedPieces(NamedTuple):
    """How a file divides its faces.

    kind: "objects", "groups" and so on. names: of the pieces. of_face: (face,) the number of its piece.
    """

    kind: str
    names: list[str]
    of_face: np.ndarray


class MassProperties(NamedTuple):
    """A solid of 1 kg and even density.

    volume_m3; centre_m (3,), in the mesh frame; inertia_kg_m2 (3, 3) about the centre of mass, mesh axes.
    source: "solid" from the mesh itself, "convex hull" where the mesh is open or encloses nothing. Where that hull is
    flat, volume and inertia are 0.
    """

    volume_m3: float
    centre_m: np.ndarray
    inertia_kg_m2: np.ndarray
    source: Literal["solid", "convex hull"]


def load_mesh(path: str | Path) -> Mesh:
    """Vertices and triangles of an OBJ or PLY file; polygons become fans.

    Vertices are neither merged, reordered nor dropped, so that per-vertex files (part ids, contacts) keep their
    meaning. Raises BadInput on anything that is not a finite triangle mesh.
    """
    return load_named_mesh(path)[0]


def load_named_mesh(path: str | Path) -> tuple[Mesh, list[NamedPieces]]:
    """The same, and the objects and groups that an OBJ file names: a PLY file has neither."""
    path = Path(path)
    if not path.is_file():
        raise BadInput(path, "a mesh file", "nothing there")
    if path.stat().st_size > LARGEST_MESH_BYTES:
        raise BadInput(path, f"at most {LARGEST_MESH_BYTES} bytes", f"{path.stat().st_size}", "decimate the mesh")
    reader = {".obj": _read_obj, ".ply": _read_ply}.get(path.suffix.lower())
    if reader is None:
        raise BadInput(path, "a mesh named .obj or .ply", path.suffix or "no suffix", "convert the mesh")
    try:
        mesh, pieces = reader(path)
    except (ValueError, OSError) as error:
        raise BadInput(path, "a readable mesh", f"{type(error).__name__}: {error}") from error
    return checked_mesh(path, mesh), pieces


def _read_obj(path: Path) -> tuple[Mesh, list[NamedPieces]]:
    # A byte order mark, which some programs write, would hide the first line.
    return _parse_named_obj(path.read_text(encoding="utf-8-sig", errors="replace"), path)


def parse_obj(text: str, path: str | Path) -> Mesh:
    """Vertices and triangles of an OBJ file's text, as ``load_mesh`` reads them; ``path`` names it in errors."""
    return checked_mesh(path, _parse_named_obj(text, path)[0])


def _parse_named_obj(text: str, path: str | Path) -> tuple[Mesh, list[NamedPieces]]:
    # Own reader: trimesh splits and reorders vertices where faces carry texture or normal indices.
    found = _plain_triangles(text)
    mesh, names = _any_polygons(text, path) if found is None else found
    return mesh, [own.pieces(len(mesh.faces)) for own in names.values()]


class _Names:
    """Where the names of objects or of groups begin, in faces. kind: what they are names of."""

    def __init__(self, kind: str) -> None:
        self.kind, self.name, self.number = kind, "", dict[str, int]()
        self.begins, self.numbers = array("q"), array("q")
        self.face = 0

    def begin(self, line: str, face: int) -> None:
        """Take the name in a line such as "o lid"; it begins with the face of this number."""
        self._end(face)
        self.name = " ".join(line.split()[1:])[:60] if len(line) < 1000 else line[1:61].strip()
        self.face = face

    def _end(self, face: int) -> None:
        if face == self.face:  # a name without faces is none
            return
        if self.name not in self.number and len(self.number) < _MOST_NAMES:
            self.number[self.name] = len(self.number)
        self.begins.append(self.face)
        self.numbers.append(self.number.get(self.name, _MOST_NAMES))

    def pieces(self, n_faces: int) -> NamedPieces:
        self._end(n_faces)
        counts = np.diff(np.append(np.array(self.begins, np.int64), n_faces))
        return NamedPieces(self.kind, list(self.number), np.array(self.numbers, np.int64).repeat(counts))


def _obj_names() -> dict[str, _Names]:
    return {"o": _Names("objects"), "g": _Names("groups")}


def _plain_triangles(text: str) -> tuple[Mesh, dict[str, _Names]] | None:
    """What is written as "v x y z" and "f a b c", in half the time of line by line; None of any other file."""
    vertex_lines: list[str] = []
    face_lines: list[str] = []
    names = _obj_names()
    own = {"v ": (vertex_lines, MOST_VERTICES), "f ": (face_lines, MOST_TRIANGLES)}
    for line in io.StringIO(text, newline=None):
        if (kind := own.get(line[:2])) is not None:
            lines, most = kind
            if len(lines) >= most or (not lines and len(line.split(maxsplit=4)) != 4):
                return None
            lines.append(line)
        elif (word := "".join(line.split(maxsplit=1)[:1])) in names:
            names[word].begin(line, len(face_lines))
        elif word in ("v", "f"):
            return None
    try:
        faces = np.array(list(map(_position_index, _numbers_of(face_lines))), dtype=np.int64).reshape(-1, 3)
        if faces.min(initial=1) < 1 or faces.max(initial=1) >= _MOST_INDEX:
            return None
        vertices = np.array(list(map(float, _numbers_of(vertex_lines))), dtype=np.float64).reshape(-1, 3)
    except (ValueError, OverflowError):
        return None
    return Mesh(vertices, faces - 1), names


def _numbers_of(lines: list[str]) -> list[str]:
    """The three words behind the letter of each line, one after another. Raises ValueError where there are not three.

    Where lines have other lengths, yet three on average, a letter is left among the words, which is no number.
    """
    words = "".join(lines).split(maxsplit=4 * len(lines))
    if len(words) != 4 * len(lines):
        raise ValueError("not three numbers in every line")
    del words[::4]
    return words


def _any_polygons(text: str, path: str | Path) -> tuple[Mesh, dict[str, _Names]]:
    """Every vertex and polygon of an OBJ file, line by line. Raises BadInput with the number of a wrong line."""
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    names = _obj_names()
    for number, line in _whole_lines(text):
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
                corners = [_obj_index(word, len(vertices)) for word in words[1:]]
        except ValueError as error:
            raise BadInput(f"{path}:{number}", "numbers after 'v' or 'f'", repr(line[:60].strip())) from error
        if len(words) < 4:
            wanted = "3 coordinates per vertex and 3 or more corners per face"
            raise BadInput(f"{path}:{number}", wanted, repr(line[:60].strip()), "export the mesh anew")
        faces.extend((corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1))
    return Mesh(np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64).reshape(-1, 3)), names


def _whole_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines with their numbers; a vertex or face that ends with a backslash goes on in the next line."""
    begun: list[str] = []
    for number, line in enumerate(io.StringIO(text, newline=None), 1):
        if line.endswith("\\\n") and (begun or line.lstrip()[:1] in ("v", "f")) and len(begun) <= MOST_CORNERS:
            begun.append(line[:-2])
        elif begun:
            yield number, " ".join((*begun, line))
            begun = []
        else:
            yield number, line
    if begun:
        yield number, " ".join(begun)


def _position_index(word: str) -> int:
    """The first of a corner's indices, before those of texture and normal."""
    return int(word.partition("/")[0])


def _obj_index(word: str, n_vertices: int) -> int:
    """OBJ counts from 1; negative indices count back from the last vertex read."""
    index = _position_index(word)
    if index == 0 or abs(index) >= _MOST_INDEX:
        raise ValueError(f"corner {word[:40]}")
    return index - 1 if index > 0 else n_vertices + index


def _read_ply(path: Path) -> tuple[Mesh, list[NamedPieces]]:
    return Mesh(*parse_ply(path.read_bytes())), []


def checked_mesh(path: str | Path, mesh: Mesh) -> Mesh:
    """The mesh, if it is a finite triangle mesh with area; ``path`` names it in errors. Raises BadInput."""
    vertices, faces = mesh
    if not len(vertices):
        raise BadInput(path, "a mesh with vertices", "none", "export the mesh anew")
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise BadInput(path, "a mesh with vertices of 3 coordinates", f"an array of shape {vertices.shape}")
    if not np.isfinite(vertices).all():
        raise BadInput(path, "finite vertices", "NaN or infinity")
    if np.abs(vertices).max() > _FARTHEST:
        raise BadInput(path, f"coordinates up to {_FARTHEST:g}", f"{np.abs(vertices).max():g}", "check the mesh's unit")
    if not len(faces):
        raise BadInput(path, "a mesh with faces", f"{len(vertices)} vertices and no face")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise BadInput(path, f"face corners from 0 to {len(vertices) - 1}", f"{faces.min()} to {faces.max()}")
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    if not np.cross(b - a, c - a).any():
        raise BadInput(path, "faces with area", f"{len(faces)} faces without", "repair the mesh")
    return mesh


def mass_properties(vertices_m: np.ndarray, faces: np.ndarray) -> MassProperties:
    """Volume, centre of mass and inertia of the solid a mesh bounds, for 1 kg.

    vertices_m: (vertex, 3); faces: (face, 3). A mesh turned inside out is turned back. An open mesh, or one that
    encloses less than 0.1 % of its convex hull (two opposite shells), is replaced by that hull, and says so.
    """
    mesh = trimesh.Trimesh(vertices_m, faces, process=True)
    with np.errstate(invalid="ignore", divide="ignore"):  # of what is flat, trimesh divides by no volume
        solid = mesh.is_watertight and encloses(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        try:
            used = mesh if solid else mesh.convex_hull
        except QhullError:  # fewer than four places
            used = mesh
        if used.volume < 0:
            used.invert()
        volume = float(used.volume)
    if volume <= _FLAT * np.ptp(mesh.vertices, axis=0).max() ** 3:
        return MassProperties(0.0, mesh.vertices.mean(axis=0), np.zeros((3, 3)), "convex hull")
    inertia = np.asarray(used.moment_inertia) / volume
    return MassProperties(volume, np.asarray(used.center_mass), inertia, "solid" if solid else "convex hull")
