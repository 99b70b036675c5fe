"""Reads a user's mesh or URDF as an object. Unit, up axis and joint are given, or guessed and reported."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os.path import isdir, isfile  # False for a name that is too long, where Path.is_file raises
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from hoidata.errors import BadInput
from hoidata.geometry.rows import distinct_rows
from hoidata.objects.glb import Glb, parse_glb
from hoidata.objects.joint_checks import check_axis_is_near
from hoidata.objects.mesh import Mesh, NamedPieces, checked_mesh, load_named_mesh, read_mesh_bytes
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.objects.stl import parse_stl
from hoidata.objects.urdf import PARTNET_NAME, UrdfObject, find_urdf, read_urdf

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "dm": 0.1, "inch": 0.0254}
SMALLEST_M, LARGEST_M = 0.005, 2.0
GRASPABLE_M = (0.02, 1.0)  # likely sizes of an object that a hand grasps, to guess the unit
UP_AXES = {
    sign + letter: np.eye(3)[axis] * float(f"{sign}1") for axis, letter in enumerate("xyz") for sign in ("", "-")
}
MERGE_PRECISION = 1e8  # vertices of STL and GLB are merged if they agree to 1 / this of the file's unit
GROUND_FRACTION = 1 / 50  # of the height: vertices below it are the footing
CLOSING_TEST_RAD = 0.3  # hinge angle at which the direction of the hinge is tested
CLOSING_FRACTION = 0.01  # a hinge closes if the parts' centres approach by this fraction
Y_UP_RATIO = 1.5  # y is up only if its footing is larger than that of z, the usual axis, by this factor
STABLE_FOOTING = 0.1  # of the outline; with less, an object such as a bowl on its side rolls or rocks
Y_UP_MARGIN_UNSTABLE = 10.0  # factor for y with less footing than that, such as a glass with a narrow foot


@dataclass(frozen=True)
class UserObject:
    """An object read from a user's mesh file."""

    model: ObjectModel  # metres, z up, with the file's origin
    notes: tuple[str, ...]  # assumptions, as sentences for the user
    joint_limits: tuple[float, float] | None = None  # lowest and highest joint position of a URDF, radians or metres


def is_object_path(name: str) -> bool:
    """Whether a text is the path of a file, or of a folder with a URDF file."""
    return isfile(name) or (isdir(name) and find_urdf(Path(name)) is not None)


def unknown_object_words(name: str) -> str:
    """The name, and that it is a folder without a URDF file if it is; for messages on an unknown object."""
    return f"{name}, a folder without a .urdf file" if isdir(name) else name


def read_user_object(
    path: Path, unit: str = "", up: str = "", hinge: str = "", moving: str = "", factor: float = 1.0
) -> UserObject:
    """Read an object from an OBJ, PLY, STL, GLB or URDF file, or from a folder with a URDF file.

    Args:
        unit: "m", "cm", "mm", "dm" or "inch"; metres by default.
        up: the file's axis that points up, such as "z" or "-y"; guessed by default (GLB: y, URDF: z).
        hinge: of a mesh file "px,py,pz dx,dy,dz", a point on the axis and its direction in the file's unit and axes; or
            "dx,dy,dz", the direction of a slide. The mesh must have two pieces, of which the second in the file moves.
            Pieces are the objects, groups, nodes or solids that the file names if there are two, else the shells.
        moving: what moves: the joint of a URDF, or the objects, groups or nodes of a mesh, separated by commas.
        factor: by which the mesh is scaled about its origin.

    Raises:
        BadInput: the size is implausible (the error suggests a unit), or the joint does not fit.
    """
    if moving and not hinge and find_urdf(path) is None:
        raise BadInput("--moving", "--hinge too, the axis of what moves", moving[:80], "give both")
    body = _body(path, hinge, moving)
    mesh, notes = body.mesh, list(body.notes)
    scale = _scale(path, mesh, unit, factor)
    if hinge and body.hinge:
        check_axis_is_near(mesh.vertices, body.hinge, unit or "m", UNITS_M)
    vertices = mesh.vertices * scale
    if not up:
        up, note = _usual_up(path) or guess_up(vertices)
        notes.append(f"{note}; --up chooses another")
    if up not in UP_AXES:
        raise BadInput("--up", f"one of {', '.join(UP_AXES)}", up, "name the axis of the file that points up")
    upright_from_file = _upright_from_file(UP_AXES[up])
    joint, limits = body.hinge, body.limits
    if joint:
        joint = joint.scaled(scale)
        joint = replace(joint, axis=upright_from_file @ joint.axis, origin_m=upright_from_file @ joint.origin_m)
    if joint and joint.is_prismatic and limits:
        limits = (limits[0] * scale, limits[1] * scale)
    stem = path.resolve().parent.name if path.name == PARTNET_NAME else path.stem
    name = stem.encode(errors="backslashreplace").decode()  # bytes that are not text stay legible
    model = ObjectModel(name, vertices @ upright_from_file.T, mesh.faces, part=body.part, hinge=joint)
    if hinge and joint and closes(model):
        notes.append("a growing angle brings the two pieces together; if it is to open them, turn its direction round")
    return UserObject(model, tuple(notes), limits)


def _body(path: Path, hinge: str, moving: str) -> UrdfObject:
    """Mesh, parts and joint of a file, in its unit and axes."""
    if urdf := find_urdf(path):
        if hinge:
            raise BadInput(
                "--hinge", "no hinge with a URDF, which has joints", hinge[:80], "--moving JOINT chooses one"
            )
        root = path if path.is_dir() else path.parent
        return read_urdf(urdf, root, moving, read_mesh_file)
    file = _read(path)
    if not hinge:
        mesh = _joined(file)
        return UrdfObject(mesh, np.zeros(len(mesh.vertices), np.uint8), None, None, [])
    joint = _hinge(hinge)
    mesh, part, (stays, moves) = _in_two_pieces(
        path, file, [name.strip() for name in moving.split(",") if name.strip()]
    )
    verb = "slides" if joint.is_prismatic else "turns about the hinge"
    if stays and moves:
        return UrdfObject(mesh, part, joint, None, [f"{moves!r} {verb}, {stays!r} stays"])
    moving_vertices = mesh.vertices[part == 1]
    middle = (moving_vertices.min(axis=0) + moving_vertices.max(axis=0)) / 2
    centre = ", ".join(f"{value:.3g}" for value in np.round(middle, 6) + 0.0)  # no "-0"
    note = f"the second of two pieces without names of their own, with its centre at {centre} in the file, {verb}"
    return UrdfObject(mesh, part, joint, None, [note])


def _usual_up(path: Path) -> tuple[str, str] | None:
    if find_urdf(path):
        return "z", "z is up, as usual in URDF files"
    return ("y", "y is up, as in every GLB file") if path.suffix.lower() == ".glb" else None  # by the specification


def closes(model: ObjectModel) -> bool:
    """Whether the centre of an articulated object's moving part approaches that of its base as the angle grows."""
    base, moving = (masses.centre_m for masses in model.masses)
    angles_rad = np.array([-CLOSING_TEST_RAD, CLOSING_TEST_RAD]) * model.joint_scale
    before, after = articulate(moving[None], np.ones(1), model.hinge, angles_rad)[:, 0]
    return bool(np.linalg.norm(after - base) < (1 - CLOSING_FRACTION) * np.linalg.norm(before - base))


def guess_up(vertices_m: np.ndarray) -> tuple[str, str]:
    """Guess the up axis of a mesh, "z" or "y" (if the footing is clearly larger), with the reason as a sentence."""
    on_z, on_y = footing(vertices_m, 2), footing(vertices_m, 1)
    if on_y > Y_UP_RATIO * on_z and (on_y > STABLE_FOOTING or on_y > Y_UP_MARGIN_UNSTABLE * on_z):
        return "y", f"up: y (it stands on {on_y:.0%} of its outline; with z up on {on_z:.0%})"
    if on_z < STABLE_FOOTING:
        return "z", "up: z, assumed: it stands firmly with neither y nor z up"
    return "z", f"up: z (it stands on {on_z:.0%} of its outline)"


def footing(vertices_m: np.ndarray, axis: int) -> float:
    """Fraction of the outline seen from above (area of its convex hull) that touches the ground, 0 to 1."""
    height = vertices_m[:, axis]
    flat = np.delete(vertices_m, axis, axis=1)
    low = height <= height.min() + GROUND_FRACTION * np.ptp(height)
    return _hull_area(flat[low]) / max(_hull_area(flat), 1e-12)


def thinned(model: ObjectModel, max_faces: int) -> ObjectModel:
    """Simplify an object for display to about ``max_faces`` faces: vertices in one cell of a grid are merged."""
    cells = 256
    while len(model.faces) > max_faces and cells > 8:
        model, cells = _clustered(model, cells), cells // 2
    return model


def _clustered(model: ObjectModel, cells: int) -> ObjectModel:
    size = np.ptp(model.vertices_m, axis=0).max() / cells
    keys = np.column_stack((np.floor((model.vertices_m - model.vertices_m.min(axis=0)) / size), model.part))
    first, cell = distinct_rows(keys)
    faces = cell[model.faces]
    has_area = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return ObjectModel(model.name, model.vertices_m[first], faces[has_area], part=model.part[first], hinge=model.hinge)


def read_mesh_file(path: Path) -> Mesh:
    """Read vertices and triangles of an OBJ, PLY, STL or GLB file, in the file's unit and axes.

    Vertices that no face uses are dropped, and coinciding vertices of STL and GLB merged. The nodes of a GLB are in
    the frame of its scene. Raises BadInput: the file holds no finite triangle mesh.
    """
    return _joined(_read(path))


class _MeshFile(NamedTuple):
    """A mesh with the divisions that its file names."""

    mesh: Mesh  # as stored
    source: np.ndarray | None  # (vertex,) index of its solid (STL) or node (GLB); None for OBJ and PLY
    pieces: list[NamedPieces]


def _read(path: Path) -> _MeshFile:
    suffix = path.suffix.lower()
    if suffix in (".obj", ".ply"):
        mesh, pieces = load_named_mesh(path)
        return _MeshFile(mesh, None, pieces)
    if suffix not in (".stl", ".glb"):
        raise BadInput(path, "a mesh named .obj, .ply, .stl or .glb", path.suffix or "no suffix", "convert the mesh")
    data = read_mesh_bytes(path, "correct the path")
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
    divisions = {"nodes": glb.node, "branches of nodes": glb.branch}
    return mesh, [NamedPieces(kind, glb.names, of_face, glb.parents) for kind, of_face in divisions.items()]


def _joined(file: _MeshFile) -> Mesh:
    """Drop unused vertices, which belong to no surface, and merge coinciding vertices of STL and GLB."""
    used, corner = np.unique(file.mesh.faces, return_inverse=True)
    mesh = Mesh(file.mesh.vertices[used], corner.reshape(-1, 3))
    if file.source is None:
        return mesh
    first, number = distinct_rows(np.round(mesh.vertices * MERGE_PRECISION))
    return Mesh(mesh.vertices[first], number[mesh.faces])


def _in_two_pieces(path: Path, file: _MeshFile, moving: Sequence[str]) -> tuple[Mesh, np.ndarray, tuple[str, str]]:
    """Divide a mesh into two pieces, in the order of the file. Vertices that both pieces use are duplicated.

    moving: names of the objects, groups or nodes that are the second piece; by default there must be two pieces.
    Returns the mesh, (vertex,) 1 for vertices of the second piece, and the names of the pieces. Raises BadInput: no
    division of the file has two pieces.
    """
    divisions = _divisions(file)
    pieces = _named_as_moving(path, file, moving) if moving else _division_into_two(divisions)
    if pieces is None:
        counts = dict.fromkeys((division.kind, len(_order(division))) for division in divisions)
        got = ", ".join(f"{count} {kind}" for kind, count in counts if count > 1) or "one shell"
        remedy = "export a base and what moves as two objects or nodes; or name what moves: --moving NAME,NAME"
        raise BadInput(path, "two separate pieces for --hinge", got, remedy)
    stays, moves_number = (0, 1) if moving else _order(pieces)
    moves = pieces.of_face == moves_number
    faces = file.mesh.faces
    key, first_use, number = np.unique(
        2 * _merged_within_source(file)[faces] + moves[:, None], return_index=True, return_inverse=True
    )
    mesh = Mesh(file.mesh.vertices[faces.ravel()[first_use]], number.reshape(-1, 3))
    names = (pieces.names[stays], pieces.names[moves_number]) if pieces.names else ("", "")
    return mesh, (key % 2).astype(np.uint8), names


def _named_as_moving(path: Path, file: _MeshFile, moving: Sequence[str]) -> NamedPieces:
    """The division into the named pieces, which move, and all others. Raises BadInput that lists the names."""
    for pieces in file.pieces:
        names_of = {number: _names_upwards(pieces, number) for number in _order(pieces)} if pieces.names else {}
        numbers = [number for number, names in names_of.items() if set(names) & set(moving)]
        if set(moving) <= {name for names in names_of.values() for name in names} and len(numbers) < len(names_of):
            moves = np.isin(pieces.of_face, numbers)
            others = [names_of[number][0] for number in names_of if number not in numbers]
            names = [", ".join(others), ", ".join(names_of[number][0] for number in numbers)]
            return NamedPieces(pieces.kind, names, moves.astype(np.int64))
    listed = "; ".join(
        f"{pieces.kind}: {', '.join(pieces.names[number] for number in _order(pieces)[:20])}"
        for pieces in file.pieces
        if pieces.names
    )
    raise BadInput(
        path,
        "names of some pieces for --moving",
        f"{', '.join(moving)}; there are: {listed or 'none'}",
        "name what moves",
    )


def _names_upwards(pieces: NamedPieces, number: int) -> list[str]:
    """The name of a piece, then those of the nodes above it, with which it moves."""
    names = [pieces.names[number]] if number < len(pieces.names) else [""]
    while pieces.parents and (number := pieces.parents[number]) >= 0:
        names.append(pieces.names[number])
    return names


def piece_names(path: Path) -> tuple[str, str] | None:
    """Names of the two pieces of which ``--hinge`` rotates the second ("" if unnamed); None for any other mesh."""
    pieces = _division_into_two(_divisions(_read(path)))
    if pieces is None:
        return None
    first, second = _order(pieces)
    return (pieces.names[first], pieces.names[second]) if pieces.names else ("", "")


def _division_into_two(divisions: list[NamedPieces]) -> NamedPieces | None:
    return next((division for division in divisions if len(_order(division)) == 2), None)


def _order(pieces: NamedPieces) -> list[int]:
    """Indices of the pieces in the order of the file."""
    numbers, first = np.unique(pieces.of_face, return_index=True)
    return numbers[np.argsort(first)].tolist()


def _divisions(file: _MeshFile) -> list[NamedPieces]:
    """All divisions of a mesh into pieces, the most meaningful first: named pieces, then shells.

    A shell is a set of triangles connected by vertices. The first count of shells merges coinciding vertices, because
    files often repeat vertices along seams. That also joins a closed lid to its box, so the second count does not.
    """
    coinciding = distinct_rows(np.round(file.mesh.vertices * MERGE_PRECISION)).number
    return [*file.pieces, *(_shells(file.mesh.faces, same) for same in (coinciding, _merged_within_source(file)))]


def _merged_within_source(file: _MeshFile) -> np.ndarray:
    """(vertex,) label, equal for the same vertex; in STL and GLB, for coinciding vertices of one solid or node."""
    if file.source is None:
        return np.arange(len(file.mesh.vertices))
    return distinct_rows(np.column_stack((np.round(file.mesh.vertices * MERGE_PRECISION), file.source))).number


def _scale(path: Path, mesh: Mesh, unit: str, factor: float) -> float:
    """Metres per unit of the file times ``factor``, after a check of the mesh's size."""
    if unit and unit not in UNITS_M:
        raise BadInput("--unit", f"one of {', '.join(UNITS_M)}", unit, "name the unit of the file's numbers")
    longest = factor * float(np.ptp(mesh.vertices, axis=0).max())
    longest_m = longest * UNITS_M[unit or "m"]
    if SMALLEST_M <= longest_m <= LARGEST_M:
        return factor * UNITS_M[unit or "m"]
    likely = [
        f"--unit {name} makes it {longest * factor * 100:.3g} cm"
        for name, factor in UNITS_M.items()
        if name != (unit or "m") and GRASPABLE_M[0] <= longest * factor <= GRASPABLE_M[1]
    ]
    expected = f"a longest side of {SMALLEST_M:g} to {LARGEST_M:g} m"
    raise BadInput(
        path, expected, f"{longest_m:.4g} m in {unit or 'm'}", "; ".join(likely) or "scale the mesh to metres"
    )


def _upright_from_file(up: np.ndarray) -> np.ndarray:
    """(3, 3) rotation that takes the axis ``up`` to +z, about x for y and about y for x."""
    if up[2]:
        return np.diag([1.0, up[2], up[2]])
    along = int(np.flatnonzero(up)[0])
    rotation = np.zeros((3, 3))
    rotation[2, along] = up[along]
    rotation[along, 2] = -up[along]
    rotation[1 - along, 1 - along] = 1.0
    return rotation


def _hinge(text: str) -> Hinge:
    """The joint in the unit and axes of the file: a hinge, or a slide without a point on its axis."""
    try:
        vectors = [np.array([float(number) for number in word.split(",")]) for word in text.split()]
        point, direction = vectors if len(vectors) != 1 else (np.zeros(3), vectors[0])
        if point.shape != (3,) or direction.shape != (3,) or not np.isfinite([point, direction]).all():
            raise ValueError
        length = np.linalg.norm(direction)
        if length < 1e-9:
            raise ValueError
    except ValueError as error:
        remedy = 'write a point on the axis, then its direction, like "0,0.1,0.05 1,0,0"; a slide has only a direction'
        raise BadInput("--hinge", "two times three numbers", text[:80], remedy) from error
    return Hinge(direction / length, point, len(vectors) == 1)


def _shells(faces: np.ndarray, same: np.ndarray) -> NamedPieces:
    """The connected components of a mesh; ``same`` (vertex,) is equal for merged vertices."""
    faces, count = same[faces], int(same.max()) + 1
    rows, columns = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    return NamedPieces("shells", [], connected_components(links, directed=False)[1][faces[:, 0]])


def _hull_area(points: np.ndarray) -> float:
    """Area of the convex hull of points (n, 2); 0 for collinear points."""
    try:
        return float(ConvexHull(points).volume) if len(points) > 2 else 0.0
    except QhullError:
        return 0.0
