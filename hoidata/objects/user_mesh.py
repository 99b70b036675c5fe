"""An object from a mesh somebody has: its unit, which way is up, its hinge; each is told, or found and said."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from hoidata.errors import BadInput
from hoidata.geometry.rows import distinct_rows
from hoidata.objects.glb import Glb, parse_glb
from hoidata.objects.mesh import LARGEST_MESH_BYTES, Mesh, NamedPieces, checked_mesh, load_named_mesh
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.objects.stl import parse_stl

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "dm": 0.1, "inch": 0.0254}
SMALLEST_M, LARGEST_M = 0.005, 2.0
HELD_M = (0.02, 1.0)  # sizes a hand is likely to be asked to hold, for guesses of a unit
UP_AXES = {
    sign + letter: np.eye(3)[axis] * float(f"{sign}1") for axis, letter in enumerate("xyz") for sign in ("", "-")
}
MERGED_PER_UNIT = 1e8  # vertices of STL and GLB are one where they agree to this fraction of the file's unit
METRES_AND_Y_UP = (".glb",)  # by the glTF 2.0 specification
NEAR_GROUND = 1 / 50  # of the height: vertices this low carry the object
SLIGHTLY_RAD, NEARER = 0.3, 0.01  # a turn that shows where a hinge leads, and how much nearer is meant
CLEARLY = 1.5  # standing on y must give so much more footing than on z, which most datasets use
STANDS = 0.1  # of its outline: an object that rolls or rocks on y, as a bowl on its side, does not stand there ...
FAR_MORE = 10.0  # ... unless on z it has hardly any footing, as a glass with a narrow foot that lies


@dataclass(frozen=True)
class UserObject:
    """model: metres, z up, its origin where the file has it. notes: what was assumed, in words a person reads."""

    model: ObjectModel
    notes: tuple[str, ...]


def read_user_object(path: Path, unit: str = "", up: str = "", hinge: str = "") -> UserObject:
    """An object from an OBJ, PLY, STL or GLB file.

    unit: "m", "cm", "mm", "dm" or "inch"; metres where not told. up: "z", "-y", ...; found where not told (GLB: y).
    hinge: "px,py,pz dx,dy,dz", a point on the axis and its direction in the file's own unit and axes, for a mesh of two
    pieces of which the second in the file moves. The pieces are the objects, groups, nodes or solids that the file
    names where these are two, and else the shells.
    Raises BadInput for a size that cannot be meant, naming the unit that may be, and for a hinge that does not fit.
    """
    file = _read(path)
    mesh, part, pieces = _in_two_pieces(path, file) if hinge else (_joined(file), None, ("", ""))
    scale, notes = _scale(path, mesh, unit), list[str]()
    vertices = mesh.vertices * scale
    if not up:
        up, note = ("y", "y is up, as in every GLB file") if _is_gltf(path) else found_up(vertices)
        notes.append(f"{note}; --up chooses another")
    if up not in UP_AXES:
        raise BadInput("--up", f"one of {', '.join(UP_AXES)}", up, "name the axis of the file that points up")
    turn = _upright_from_file(UP_AXES[up])
    joint = _hinge(hinge, scale, turn) if hinge else None
    part = np.zeros(len(vertices), np.uint8) if part is None else part
    name = path.stem.encode(errors="backslashreplace").decode()  # bytes that are no text stay legible
    model = ObjectModel(name, vertices @ turn.T, mesh.faces, part, joint)
    if all(pieces):
        notes.append(f"{pieces[1]!r} turns about the hinge, {pieces[0]!r} stays")
    if joint and closes(model):
        notes.append("a growing angle brings the two pieces together; if it is to open them, turn its direction round")
    return UserObject(model, tuple(notes))


def closes(model: ObjectModel) -> bool:
    """Whether the middle of an articulated object's moving part comes nearer to that of its base as its angle grows."""
    base, moving = (masses.centre_m for masses in model.masses)
    before, after = articulate(moving[None], np.ones(1), model.hinge, np.array([-SLIGHTLY_RAD, SLIGHTLY_RAD]))[:, 0]
    return bool(np.linalg.norm(after - base) < (1 - NEARER) * np.linalg.norm(before - base))


def found_up(vertices_m: np.ndarray) -> tuple[str, str]:
    """Which axis of a mesh points up, and why: "z", or "y" where the object then stands on clearly more ground."""
    on_z, on_y = footing(vertices_m, 2), footing(vertices_m, 1)
    if on_y > CLEARLY * on_z and (on_y > STANDS or on_y > FAR_MORE * on_z):
        return "y", f"up: y (it stands on {on_y:.0%} of its outline; with z up on {on_z:.0%})"
    if on_z < STANDS:
        return "z", "up: z, assumed: it stands firmly with neither y nor z up"
    return "z", f"up: z (it stands on {on_z:.0%} of its outline)"


def footing(vertices_m: np.ndarray, axis: int) -> float:
    """How much of the object's outline seen from above (area of its convex hull) touches the ground, 0 to 1."""
    height = vertices_m[:, axis]
    flat = np.delete(vertices_m, axis, axis=1)
    low = height <= height.min() + NEAR_GROUND * np.ptp(height)
    return _hull_area(flat[low]) / max(_hull_area(flat), 1e-12)


def thinned(model: ObjectModel, most_faces: int) -> ObjectModel:
    """The object with at most about ``most_faces`` faces, for drawing: vertices of one cell of a grid become one."""
    cells = 256
    while len(model.faces) > most_faces and cells > 8:
        model, cells = _clustered(model, cells), cells // 2
    return model


def _clustered(model: ObjectModel, cells: int) -> ObjectModel:
    size = np.ptp(model.vertices_m, axis=0).max() / cells
    keys = np.column_stack((np.floor((model.vertices_m - model.vertices_m.min(axis=0)) / size), model.part))
    first, cell = distinct_rows(keys)
    faces = cell[model.faces]
    apart = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return ObjectModel(model.name, model.vertices_m[first], faces[apart], model.part[first], model.hinge)


def read_mesh_file(path: Path) -> Mesh:
    """Vertices and triangles of an OBJ, PLY, STL or GLB file in its own unit and axes.

    Of STL and GLB, vertices in the same place become one; a GLB's nodes stand where its scene puts them.
    Raises BadInput for a file that holds no finite triangle mesh.
    """
    return _joined(_read(path))


class _MeshFile(NamedTuple):
    """mesh: as stored. source: (vertex,) of STL and GLB which solid or node it belongs to; None of OBJ and PLY, whose
    faces share vertices. pieces: the divisions that the file names.
    """

    mesh: Mesh
    source: np.ndarray | None
    pieces: list[NamedPieces]


def _read(path: Path) -> _MeshFile:
    suffix = path.suffix.lower()
    if suffix in (".obj", ".ply"):
        mesh, pieces = load_named_mesh(path)
        return _MeshFile(mesh, None, pieces)
    if suffix not in (".stl", ".glb"):
        raise BadInput(path, "a mesh named .obj, .ply, .stl or .glb", path.suffix or "no suffix", "convert the mesh")
    if not path.is_file():
        raise BadInput(path, "a mesh file", "nothing there", "correct the path")
    if path.stat().st_size > LARGEST_MESH_BYTES:
        raise BadInput(path, f"at most {LARGEST_MESH_BYTES} bytes", f"{path.stat().st_size}", "decimate the mesh")
    data = path.read_bytes()
    mesh, pieces = _of_glb(parse_glb(data, path)) if suffix == ".glb" else _of_stl(path, data)
    checked_mesh(path, mesh)
    source = np.zeros(len(mesh.vertices), np.int64)
    source[mesh.faces] = pieces[0].of_face[:, None]
    return _MeshFile(mesh, source, pieces)


def _of_stl(path: Path, data: bytes) -> tuple[Mesh, list[NamedPieces]]:
    try:
        corners, solid, names = parse_stl(data)
    except ValueError as error:
        raise BadInput(path, "a readable mesh", f"{type(error).__name__}: {error}", "export it again") from error
    return Mesh(corners, np.arange(len(corners)).reshape(-1, 3)), [NamedPieces("solids", names, solid)]


def _of_glb(glb: Glb) -> tuple[Mesh, list[NamedPieces]]:
    mesh = Mesh(glb.vertices, glb.faces)
    return mesh, [NamedPieces("nodes", glb.names, glb.node), NamedPieces("branches of nodes", glb.names, glb.branch)]


def _joined(file: _MeshFile) -> Mesh:
    """The mesh with the vertices of STL and GLB merged where they coincide; those that no face uses are dropped."""
    if file.source is None:
        return file.mesh
    used, corner = np.unique(file.mesh.faces, return_inverse=True)
    first, number = distinct_rows(np.round(file.mesh.vertices[used] * MERGED_PER_UNIT))
    return Mesh(file.mesh.vertices[used[first]], number[corner].reshape(-1, 3))


def _in_two_pieces(path: Path, file: _MeshFile) -> tuple[Mesh, np.ndarray, tuple[str, str]]:
    """The mesh, (vertex,) 1 for the second of its two pieces in the order of the file, and the names of the pieces.

    Vertices that both pieces use are doubled. Raises BadInput where no division of the file gives two pieces.
    """
    divisions = _divisions(file)
    two = _first_of_two(divisions)
    if two is None:
        counts = dict.fromkeys((own.kind, len(_order(own))) for own in divisions)
        got = ", ".join(f"{count} {kind}" for kind, count in counts if count > 1) or "one shell"
        remedy = "export a base and what moves as two objects or nodes; each may have any number of shells"
        raise BadInput(path, "two separate pieces for --hinge", got, remedy)
    moves = two.of_face == _order(two)[1]
    faces = file.mesh.faces
    key, place, number = np.unique(
        2 * _own_vertices(file)[faces] + moves[:, None], return_index=True, return_inverse=True
    )
    mesh = Mesh(file.mesh.vertices[faces.ravel()[place]], number.reshape(-1, 3))
    return mesh, (key % 2).astype(np.uint8), _names(two)


def two_pieces(path: Path) -> tuple[str, str] | None:
    """The names of the two pieces of which ``--hinge`` turns the second ("" where unnamed); None of any other mesh."""
    two = _first_of_two(_divisions(_read(path)))
    return None if two is None else _names(two)


def _first_of_two(divisions: list[NamedPieces]) -> NamedPieces | None:
    return next((own for own in divisions if len(_order(own)) == 2), None)


def _names(two: NamedPieces) -> tuple[str, str]:
    first, second = _order(two)
    return (two.names[first], two.names[second]) if two.names else ("", "")


def _order(pieces: NamedPieces) -> list[int]:
    """The numbers of the pieces in the order of the file."""
    numbers, first = np.unique(pieces.of_face, return_index=True)
    return numbers[np.argsort(first)].tolist()


def _divisions(file: _MeshFile) -> list[NamedPieces]:
    """The ways to divide a mesh into pieces, the most telling first: what the file names, then its shells.

    A shell is what shares vertices. Vertices are joined where they coincide, as many files repeat them along seams; if
    that makes one piece of all, as of a lid that lies on its box, only those that the file itself has as one.
    """
    coinciding = distinct_rows(np.round(file.mesh.vertices * MERGED_PER_UNIT)).number
    return [*file.pieces, *(_shells(file.mesh.faces, own) for own in (coinciding, _own_vertices(file)))]


def _own_vertices(file: _MeshFile) -> np.ndarray:
    """(vertex,) equal for vertices that the file has as one: in STL and GLB, those of a solid or node that coincide."""
    if file.source is None:
        return np.arange(len(file.mesh.vertices))
    return distinct_rows(np.column_stack((np.round(file.mesh.vertices * MERGED_PER_UNIT), file.source))).number


def _is_gltf(path: Path) -> bool:
    return path.suffix.lower() in METRES_AND_Y_UP


def _scale(path: Path, mesh: Mesh, unit: str) -> float:
    """Metres per unit of the file."""
    if unit and unit not in UNITS_M:
        raise BadInput("--unit", f"one of {', '.join(UNITS_M)}", unit, "name the unit of the file's numbers")
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    metres = longest * UNITS_M[unit or "m"]
    if SMALLEST_M <= metres <= LARGEST_M:
        return UNITS_M[unit or "m"]
    likely = [
        f"--unit {name} makes it {_size(longest * factor)}"
        for name, factor in UNITS_M.items()
        if name != (unit or "m") and HELD_M[0] <= longest * factor <= HELD_M[1]
    ]
    expected = f"a longest side of {SMALLEST_M:g} to {LARGEST_M:g} m"
    raise BadInput(path, expected, f"{metres:.4g} m in {unit or 'm'}", "; ".join(likely) or "scale the mesh to metres")


def _size(metres: float) -> str:
    return f"{metres * 100:.3g} cm"


def _upright_from_file(up: np.ndarray) -> np.ndarray:
    """(3, 3) turn that takes ``up`` to +z: about x for y, about y for x, so that the other axes stay axes."""
    if up[2]:
        return np.diag([1.0, up[2], up[2]])
    along = int(np.flatnonzero(up)[0])
    turn = np.zeros((3, 3))
    turn[2, along] = up[along]
    turn[along, 2] = -up[along]
    turn[1 - along, 1 - along] = 1.0
    return turn


def _hinge(text: str, scale: float, turn: np.ndarray) -> Hinge:
    try:
        point, direction = (np.array([float(number) for number in word.split(",")]) for word in text.split())
        if point.shape != (3,) or direction.shape != (3,) or not np.isfinite([point, direction]).all():
            raise ValueError
        length = np.linalg.norm(direction)
        if length < 1e-9:
            raise ValueError
    except ValueError as error:
        remedy = 'write a point on the axis, then its direction, like "0,0.1,0.05 1,0,0"'
        raise BadInput("--hinge", "two times three numbers", text[:80], remedy) from error
    return Hinge(turn @ direction / length, turn @ point * scale)


def _shells(faces: np.ndarray, same: np.ndarray) -> NamedPieces:
    """The connected components of a mesh. same: (vertex,), equal for vertices that are one."""
    faces, count = same[faces], int(same.max()) + 1
    rows, columns = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    return NamedPieces("shells", [], connected_components(links, directed=False)[1][faces[:, 0]])


def _hull_area(points: np.ndarray) -> float:
    """Area of the convex hull of points (n, 2); 0 where they span none."""
    try:
        return float(ConvexHull(points).volume) if len(points) > 2 else 0.0
    except QhullError:
        return 0.0
