"""An object from a mesh somebody has: its unit, which way is up, its hinge; each is told, or found and said."""

import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from hoidata.errors import BadInput
from hoidata.geometry.rows import distinct_rows
from hoidata.objects.mesh import LARGEST_MESH_BYTES, Mesh, checked_mesh, load_mesh
from hoidata.objects.model import Hinge, ObjectModel, articulate

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "dm": 0.1, "inch": 0.0254}
SMALLEST_M, LARGEST_M = 0.005, 2.0
HELD_M = (0.02, 1.0)  # sizes a hand is likely to be asked to hold, for guesses of a unit
UP_AXES = {
    sign + letter: np.eye(3)[axis] * float(f"{sign}1") for axis, letter in enumerate("xyz") for sign in ("", "-")
}
LARGEST_GLB_JSON, MOST_SHOWN = 4 << 20, 5_000_000
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
    pieces of which the second in the file moves.
    Raises BadInput for a size that cannot be meant, naming the unit that may be, and for a hinge that does not fit.
    """
    mesh = read_mesh_file(path, joined=not hinge)
    scale, notes = _scale(path, mesh, unit), list[str]()
    vertices = mesh.vertices * scale
    if not up:
        up, note = ("y", "y is up, as in every GLB file") if _is_gltf(path) else found_up(vertices)
        notes.append(f"{note}; --up tells it otherwise")
    if up not in UP_AXES:
        raise BadInput("--up", f"one of {', '.join(UP_AXES)}", up, "name the axis of the file that points up")
    turn = _upright_from_file(UP_AXES[up])
    joint = _hinge(hinge, scale, turn) if hinge else None
    part = _second_piece(path, mesh) if joint else np.zeros(len(vertices), np.uint8)
    name = path.stem.encode(errors="backslashreplace").decode()  # bytes that are no text stay legible
    model = ObjectModel(name, vertices @ turn.T, mesh.faces, part, joint)
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
        return "y", f"y is taken for up: so it stands on {on_y:.0%} of its outline, with z up on {on_z:.0%}"
    if on_z < STANDS:
        return "z", "z is taken for up: neither so nor with y up it clearly stands"
    return "z", f"z is taken for up: so it stands on {on_z:.0%} of its outline"


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


def read_mesh_file(path: Path, joined: bool = True) -> Mesh:
    """Vertices and triangles of an OBJ, PLY, STL or GLB file in its own unit and axes.

    Of STL and GLB, vertices in the same place become one, of different nodes only where ``joined``; a GLB's nodes stand
    where its scene puts them.
    Raises BadInput for a file that holds no finite triangle mesh.
    """
    if path.suffix.lower() not in (".stl", ".glb"):
        return load_mesh(path)
    if not path.is_file():
        raise BadInput(path, "a mesh file", "nothing there", "correct the path")
    if path.stat().st_size > LARGEST_MESH_BYTES:
        raise BadInput(path, f"at most {LARGEST_MESH_BYTES} bytes", f"{path.stat().st_size}", "decimate the mesh")
    if _is_gltf(path):
        _check_glb(path)
    try:
        # From bytes and without a resolver: a GLB cannot make the reader open another file.
        scene = trimesh.load_scene(io.BytesIO(path.read_bytes()), file_type=path.suffix[1:].lower())
        pieces = [scene.to_mesh()] if joined else _in_order(scene)
        for piece in pieces:
            piece.merge_vertices(merge_tex=True, merge_norm=True)
        mesh = trimesh.util.concatenate(pieces)
        assert isinstance(mesh, trimesh.Trimesh)
    except Exception as error:  # whatever a foreign parser raises on a damaged file
        got = f"{type(error).__name__}: {str(error)[:200]}"
        raise BadInput(path, "a readable mesh", got, "export it anew") from error
    return checked_mesh(path, Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)))


def _in_order(scene: trimesh.Scene) -> list[trimesh.Trimesh]:
    """The scene's meshes where it puts them, in the order of the file; trimesh walks its nodes the other way round."""
    order = {name: number for number, name in enumerate(scene.geometry)}
    meshes = [own for own in scene.dump() if isinstance(own, trimesh.Trimesh)]
    return sorted(meshes, key=lambda own: order[own.metadata["name"]])


def _check_glb(path: Path) -> None:
    """Refuse a GLB that states more numbers than it holds, or shows a mesh again and again: trimesh would make them."""
    size = path.stat().st_size
    with open(path, "rb") as stream:
        length = int.from_bytes(stream.read(20)[12:16], "little")
        text = stream.read(min(length, LARGEST_GLB_JSON + 1))
    try:
        if len(text) > LARGEST_GLB_JSON:
            raise ValueError(f"more than {LARGEST_GLB_JSON} bytes of JSON")
        tree = json.loads(text)
        counts = [int(accessor["count"]) for accessor in tree.get("accessors", ())]
        sizes = [sum(counts[number] for number in _accessors(mesh)) for mesh in tree.get("meshes", ())]
        shown = sum(sizes[node["mesh"]] for node in tree.get("nodes", ()) if "mesh" in node)
        if sum(counts) > size or shown > max(size, MOST_SHOWN):
            raise ValueError(f"{max(sum(counts), shown)} corners in {size} bytes")
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        got = f"{type(error).__name__}: {str(error)[:200]}"
        raise BadInput(path, "a readable mesh", got, "export the mesh alone, anew") from error


def _accessors(mesh: dict) -> list[int]:
    """Of a glTF mesh the numbers of the arrays of positions and corners."""
    named = [(part["attributes"].get("POSITION"), part.get("indices")) for part in mesh["primitives"]]
    return [number for pair in named for number in pair if number is not None]


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


def _second_piece(path: Path, mesh: Mesh) -> np.ndarray:
    """(vertex,) 1 for the second of two pieces that share no vertex, in the order of the file.

    Vertices are joined where they coincide, as many files repeat them along seams; if that makes one piece of all, as
    of a lid that lies on its box, only those that the file itself has as one.
    """
    ways = [_pieces(mesh.faces, own) for own in (distinct_rows(mesh.vertices).number, np.arange(len(mesh.vertices)))]
    found = [list(dict.fromkeys(piece[mesh.faces[:, 0]].tolist())) for piece in ways]
    way = 1 if len(found[0]) == 1 else 0
    if len(found[way]) != 2:
        remedy = "give a mesh of a base and one moving piece that share no vertex"
        raise BadInput(path, "two separate pieces for --hinge", f"{len(found[0])}", remedy)
    return (ways[way] == found[way][1]).astype(np.uint8)


def _pieces(faces: np.ndarray, same: np.ndarray) -> np.ndarray:
    """(vertex,) number of the piece each is of. same: (vertex,), equal for those that are one."""
    faces, count = same[faces], int(same.max()) + 1
    rows, columns = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    return connected_components(links, directed=False)[1][same]


def _hull_area(points: np.ndarray) -> float:
    """Area of the convex hull of points (n, 2); 0 where they span none."""
    try:
        return float(ConvexHull(points).volume) if len(points) > 2 else 0.0
    except QhullError:
        return 0.0
