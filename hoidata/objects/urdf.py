"""Reader of URDF files (ROS, "URDF XML specification") and PartNet-Mobility folders as objects of two parts.

One movable joint is the object's joint; everything behind it moves. All other joints stay at rest. Visual meshes count;
a link without any has its collision meshes. The file is untrusted: documents with a DTD, and so with entities, are
refused, and meshes must be in the folder. yourdfpy opens any path that a file names, and needs lxml and trimesh[easy].
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation
from trimesh.creation import box, cylinder, icosphere

from hoidata.errors import BadInput
from hoidata.objects.joint_checks import check_limits
from hoidata.objects.mesh import LARGEST_MESH_BYTES, Mesh, joined
from hoidata.objects.model import Hinge
from hoidata.objects.ply import MOST_TRIANGLES

SUFFIX, PARTNET_NAME = ".urdf", "mobility.urdf"
_XACRO_SUFFIX, _EXPAND = ".xacro", "xacro FILE.urdf.xacro > FILE.urdf"
_MAX_BYTES, _MAX_ELEMENTS = 4 << 20, 2000  # of the file; of its links, joints and meshes each
_MOVABLE, _FIXED = ("revolute", "continuous", "prismatic"), ("fixed",)


ReadMesh = Callable[[Path], Mesh]


class Joint(NamedTuple):
    """A joint between two links at its zero position."""

    name: str
    kind: str  # "revolute", "continuous", "prismatic" or "fixed"
    parent: str
    child: str
    parent_from_child: np.ndarray  # (4, 4)
    axis: np.ndarray  # (3,) unit vector, child's frame
    limits: tuple[float, float] | None  # radians or file units


class UrdfObject(NamedTuple):
    """The object of a URDF file, in the frame of its root link and the unit of the file."""

    mesh: Mesh
    part: np.ndarray  # (vertex,) uint8, 1 for what the joint moves
    hinge: Hinge | None  # None without a movable joint
    limits: tuple[float, float] | None  # of the joint, relative to the mesh as read
    notes: list[str]


def find_urdf(path: Path) -> Path | None:
    """The URDF file of a path: the file itself, or the one in a folder or in its subfolder ``urdf``; None without one.

    Raises BadInput for a folder with several, of which none is mobility.urdf, and for a xacro file.
    """
    if path.suffix.lower() == _XACRO_SUFFIX and path.is_file():
        raise BadInput(path, "a URDF file", "a xacro file", f"expand it with xacro first: {_EXPAND}")
    if path.suffix.lower() == SUFFIX and path.is_file():
        return path
    if not path.is_dir():
        return None
    names = [name for folder in (path, path / "urdf") for name in folder.glob("*")]
    files, xacro = (
        sorted(name for name in names if name.suffix.lower() == suffix and name.is_file())
        for suffix in (SUFFIX, _XACRO_SUFFIX)
    )
    if xacro and not files:
        return find_urdf(xacro[0])
    if len(files) > 1 and files[0].with_name(PARTNET_NAME) not in files:
        raise BadInput(path, "one URDF file", ", ".join(item.name for item in files[:5]), "name the file instead")
    return next((item for item in files if item.name == PARTNET_NAME), files[0] if files else None)


def read_urdf(path: Path, root: Path, moving: str, read_mesh: ReadMesh) -> UrdfObject:
    """Read the object of a URDF file.

    Args:
        root: the folder that must contain all meshes; ``package://`` refers to it.
        moving: name of the joint that moves; "" if there is only one.

    Raises BadInput: the file is not a URDF, names a mesh outside of ``root``, or has several movable joints without one
    of the name ``moving``.
    """
    robot = _parse(path)
    joints = [_joint(path, element) for element in _limited(path, robot, "joint")]
    links = {_name(path, element): element for element in _limited(path, robot, "link")}
    poses = _link_poses(path, list(links), joints)
    meshes, collision = _Meshes(path, root.resolve(), read_mesh), list[str]()
    pieces: dict[str, list[Mesh]] = {}
    for name, link in links.items():
        pieces[name] = [meshes.read(element, poses[name]) for element in _geometries(link, "visual")]
        if not pieces[name]:
            pieces[name] = [meshes.read(element, poses[name]) for element in _geometries(link, "collision")]
            collision += [name] if pieces[name] else []
    behind = {joint.name: _links_behind(joint, joints) for joint in joints if joint.kind in _MOVABLE}
    movable = [joint for joint in joints if any(pieces[link] for link in behind.get(joint.name, ()))]
    bare = [joint for joint in joints if joint.name in behind and joint not in movable]
    chosen = _chosen_joint(path, movable, bare, moving)
    notes = [f"no visual mesh, so collision meshes count: {', '.join(collision[:5])}"] if collision else []
    notes += _joint_notes(movable, chosen)
    moves = behind[chosen.name] if chosen else set()
    parts = [joined([mesh for link in links if (link in moves) == is_moving for mesh in pieces[link]])
             for is_moving in (False, True)]  # fmt: skip
    if not len(parts[0].faces):
        got = "none" if not len(parts[1].faces) else f"all of it behind joint {chosen.name!r}" if chosen else "none"
        raise BadInput(path, "geometry that stays", got, "name another joint with --moving" if chosen else "add meshes")
    part = np.repeat(np.array([0, 1], np.uint8), [len(mesh.vertices) for mesh in parts])
    if chosen is None:
        return UrdfObject(parts[0], part, None, None, notes)
    if chosen.limits:
        diagonal = float(np.linalg.norm(np.ptp(joined(parts).vertices, axis=0)))
        check_limits(f"{path}: joint {chosen.name!r}", chosen.kind == "prismatic", chosen.limits, diagonal)
    hinge, limits = _hinge(chosen, poses[chosen.child])
    moved_m = (hinge.turn(np.array([hinge.file_position])) @ parts[1].vertices[None])[0]
    mesh = joined([parts[0], Mesh(moved_m, parts[1].faces)])
    return UrdfObject(mesh, part, hinge, limits, notes)


def _parse(path: Path) -> Element:
    if path.stat().st_size > _MAX_BYTES:
        raise BadInput(path, f"at most {_MAX_BYTES} bytes", f"{path.stat().st_size}", "give the URDF of one object")
    try:
        text = path.read_bytes().decode("utf-8-sig")
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise BadInput(path, "XML without a document type", "one, which may define entities", "remove it")
        robot = ElementTree.fromstring(text)
    except (ElementTree.ParseError, UnicodeDecodeError, ValueError) as error:
        raise BadInput(path, "a URDF file, XML in UTF-8", str(error)[:200], "export it again") from error
    if robot.tag != "robot":
        remedy = f"expand it with xacro first: {_EXPAND}" if "xacro" in text else "give a URDF file"
        raise BadInput(path, "a URDF file, whose root element is robot", str(robot.tag)[:60], remedy)
    if any("xacro" in element.tag or "${" in "".join(element.attrib.values()) for element in robot.iter()):
        raise BadInput(path, "a URDF file", "macros of xacro", f"expand it with xacro first: {_EXPAND}")
    return robot


def _limited(path: Path, robot: Element, tag: str) -> list[Element]:
    elements = robot.findall(tag)
    if len(elements) > _MAX_ELEMENTS:
        raise BadInput(path, f"at most {_MAX_ELEMENTS} elements {tag}", f"{len(elements)}", "give one object")
    names = [_name(path, element) for element in elements]
    if repeated := {name for name in names if names.count(name) > 1}:
        raise BadInput(path, f"each {tag} once", f"several named {min(repeated)!r}", "rename them")
    return elements


def _name(path: Path, element: Element) -> str:
    if name := element.get("name", "")[:200]:
        return name
    raise BadInput(path, f"a name of each {element.tag}", "none", "export it again")


def _numbers(path: Path, element: Element | None, key: str, default: tuple[float, ...]) -> np.ndarray:
    """The numbers of an attribute, as many as in ``default``, which counts if the attribute is missing."""
    text = None if element is None else element.get(key)
    if text is None:
        return np.array(default)
    try:
        values = np.array([float(word) for word in text.split()])
        if values.shape != (len(default),) or not np.isfinite(values).all():
            raise ValueError
    except ValueError as error:
        raise BadInput(f"{path}: {key}", f"{len(default)} finite numbers", text[:60], "export it again") from error
    return values


def _origin(path: Path, element: Element) -> np.ndarray:
    """(4, 4) parent_from_element of an element's origin: xyz, then roll, pitch and yaw about fixed axes."""
    origin, transform = element.find("origin"), np.eye(4)
    transform[:3, 3] = _numbers(path, origin, "xyz", (0.0, 0.0, 0.0))
    transform[:3, :3] = Rotation.from_euler("xyz", _numbers(path, origin, "rpy", (0.0, 0.0, 0.0))).as_matrix()
    return transform


def _joint(path: Path, element: Element) -> Joint:
    name, kind, label = _name(path, element), element.get("type", ""), f"{path}: joint {element.get('name')!r}"
    if kind not in (*_MOVABLE, *_FIXED):
        expected = f"a joint of type {', '.join((*_MOVABLE, *_FIXED))}"
        raise BadInput(label, expected, repr(kind[:40]), "replace it, or make it fixed")
    ends = [(element.find(tag), tag) for tag in ("parent", "child")]
    parent, child = ("" if end is None else end.get("link", "")[:200] for end, _ in ends)
    axis = _numbers(path, element.find("axis"), "xyz", (1.0, 0.0, 0.0))
    length = float(np.linalg.norm(axis))
    if kind in _MOVABLE and length < 1e-9:
        raise BadInput(label, "an axis with a direction", "zeros", "correct it")
    limit, limits = element.find("limit"), None
    if kind in ("revolute", "prismatic") and limit is not None and {"lower", "upper"}.intersection(limit.keys()):
        low, high = (float(_numbers(path, limit, key, (0.0,))[0]) for key in ("lower", "upper"))
        if low >= high:
            raise BadInput(label, "a lower limit below the upper one", f"{low:g} and {high:g}", "correct them")
        limits = (low, high)
    return Joint(name, kind, parent, child, _origin(path, element), axis / (length or 1.0), limits)


def _link_poses(path: Path, links: list[str], joints: list[Joint]) -> dict[str, np.ndarray]:
    """(4, 4) root_from_link of each link with all joints at zero. Raises BadInput unless the links form one tree."""
    children: dict[str, list[Joint]] = {name: [] for name in links}
    for joint in joints:
        if joint.parent not in children or joint.child not in children:
            missing = joint.parent if joint.parent not in children else joint.child
            raise BadInput(f"{path}: joint {joint.name!r}", "two links of the file", repr(missing), "correct its links")
        children[joint.parent].append(joint)
    roots = sorted(set(links) - {joint.child for joint in joints})
    if len(roots) != 1 or len(joints) != len(links) - 1:
        got = f"{len(links)} links, {len(joints)} joints, roots: {', '.join(roots[:5]) or 'none'}"
        raise BadInput(path, "one root link, and one joint to each other link", got, "correct the joints")
    poses, pending = {roots[0]: np.eye(4)}, [roots[0]]
    while pending:
        for joint in children[name := pending.pop()]:
            poses[joint.child] = poses[name] @ joint.parent_from_child
            pending.append(joint.child)
    if len(poses) < len(links):
        raise BadInput(path, "joints from the root link to all others", "a loop", "correct the joints")
    return poses


def _links_behind(joint: Joint, joints: list[Joint]) -> set[str]:
    behind, pending = {joint.child}, [joint.child]
    while pending:
        name = pending.pop()
        further = [other.child for other in joints if other.parent == name]
        behind |= set(further)
        pending += further
    return behind


def _chosen_joint(path: Path, movable: list[Joint], bare: list[Joint], moving: str) -> Joint | None:
    """The joint that moves, or None if all are fixed. ``bare``: joints that move no mesh, for the message."""
    named = [joint for joint in movable if joint.name == moving]
    if named or (len(movable) == 1 and not moving):
        return (named or movable)[0]
    if not movable and not bare and not moving:
        return None
    if bare and not movable and not moving:
        source, expected = f"{path}: joint {bare[0].name!r}", f"a mesh in its link {bare[0].child!r}"
        raise BadInput(source, expected, "none", "add a visual or collision mesh; or make the joint fixed")
    names = [f"{joint.name} ({joint.kind})" for joint in movable]
    names += [f"{joint.name} (its link {joint.child} has no mesh)" for joint in bare]
    listed = ", ".join(names[:20]) or "none"
    expected = "the name of a movable joint" if moving else "one movable joint"
    remedy = "--moving NAME chooses the joint that moves; the others stay at rest"
    raise BadInput(path, expected, f"{moving!r}; there are: {listed}" if moving else listed, remedy)


def _joint_notes(movable: list[Joint], chosen: Joint | None) -> list[str]:
    if chosen is None:
        return ["the URDF has no movable joint: the object is rigid"]
    others = ", ".join(joint.name for joint in movable if joint is not chosen)
    notes = [f"joint {chosen.name!r} ({chosen.kind}) moves" + (f"; at rest: {others}" if others else "")]
    if chosen.limits and not chosen.limits[0] <= 0 <= chosen.limits[1]:
        notes.append(f"joint {chosen.name!r} rests at its limit nearest to zero, since zero is beyond its limits")
    return notes


def _hinge(joint: Joint, root_from_child: np.ndarray) -> tuple[Hinge, tuple[float, float] | None]:
    """Joint in the root's frame, and its limits relative to its position at rest, the permitted one nearest to zero."""
    axis = root_from_child[:3, :3] @ joint.axis
    is_prismatic = joint.kind == "prismatic"
    rest = 0.0 if joint.limits is None else min(max(0.0, joint.limits[0]), joint.limits[1])
    hinge = Hinge(axis, np.zeros(3) if is_prismatic else root_from_child[:3, 3], is_prismatic, rest)
    return hinge, joint.limits and (joint.limits[0] - rest, joint.limits[1] - rest)


def _geometries(link: Element, tag: str) -> Iterator[Element]:
    return (element for element in link.findall(tag) if element.find("geometry") is not None)


class _Meshes:
    """Reads the geometry of links. Files are read once; their sizes are limited together."""

    def __init__(self, path: Path, root: Path, read_mesh: ReadMesh) -> None:
        self.path, self.root, self.read_mesh = path, root, read_mesh
        self.files: dict[Path, Mesh] = {}
        self.n_bytes = self.n_triangles = self.n_meshes = 0

    def read(self, element: Element, root_from_link: np.ndarray) -> Mesh:
        """The mesh of a visual or collision element, in the root's frame."""
        geometry = element.find("geometry")
        assert geometry is not None
        mesh = self._shape(geometry)
        self.n_triangles, self.n_meshes = self.n_triangles + len(mesh.faces), self.n_meshes + 1
        if self.n_triangles > MOST_TRIANGLES or self.n_meshes > _MAX_ELEMENTS:
            expected = f"at most {MOST_TRIANGLES} triangles in {_MAX_ELEMENTS} meshes"
            raise BadInput(self.path, expected, "more", "decimate the meshes")
        transform = root_from_link @ _origin(self.path, element)
        return Mesh(mesh.vertices @ transform[:3, :3].T + transform[:3, 3], mesh.faces)

    def _shape(self, geometry: Element) -> Mesh:
        shape = next(iter(geometry), None)
        kind = "nothing" if shape is None else str(shape.tag)
        if shape is not None and kind == "mesh":
            return self._scaled(shape)
        sizes = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}
        if shape is None or kind not in sizes:
            raise BadInput(self.path, "a mesh, box, cylinder or sphere", kind[:40], "export the geometry as a mesh")
        default = (math.nan,) * (3 if kind == "box" else 1)
        values = np.concatenate([_numbers(self.path, shape, key, default) for key in sizes[kind]])
        if not (values > 0).all():
            raise BadInput(
                f"{self.path}: {kind}", f"a {' and a '.join(sizes[kind])} above 0", f"{values}", "correct it"
            )
        create = {"box": box, "cylinder": lambda size: cylinder(*size), "sphere": lambda size: icosphere(3, *size)}
        primitive = create[kind](values)
        return Mesh(np.asarray(primitive.vertices, np.float64), np.asarray(primitive.faces, np.int64))

    def _scaled(self, shape: Element) -> Mesh:
        mesh, scale = self._file(shape.get("filename", "")), _numbers(self.path, shape, "scale", (1.0, 1.0, 1.0))
        if not scale.all():
            raise BadInput(f"{self.path}: scale", "factors other than 0", f"{scale}", "correct it")
        return Mesh(mesh.vertices * scale, mesh.faces if scale.prod() > 0 else mesh.faces[:, ::-1])

    def _file(self, name: str) -> Mesh:
        file = self._inside(name)
        if file not in self.files:
            self.n_bytes += file.stat().st_size
            if self.n_bytes > LARGEST_MESH_BYTES:
                raise BadInput(self.path, f"at most {LARGEST_MESH_BYTES} bytes of meshes", "more", "decimate them")
            self.files[file] = self.read_mesh(file)
        return self.files[file]

    def _inside(self, name: str) -> Path:
        """The mesh file of a name in the URDF. ``package://NAME/`` is the folder, or its subfolder NAME."""
        package, _, rest = name.removeprefix("package://").partition("/")
        folder = self.root if name.startswith("package://") else self.path.resolve().parent
        candidates = [rest, f"{package}/{rest}"] if name.startswith("package://") else [name.removeprefix("file://")]
        label = f"{self.path}: mesh {name[:100]!r}"
        try:
            files = [(folder / candidate).resolve() for candidate in candidates]
            existing = [file for file in files if file.is_file()]
        except (OSError, ValueError, RuntimeError) as error:
            raise BadInput(label, "a file name", str(error)[:100], "correct it") from error
        if not all(file.is_relative_to(self.root) for file in files):
            remedy = "copy it into the folder, or give the folder that contains both"
            raise BadInput(label, f"a file in {self.root}", "one outside of it", remedy)
        if not existing:
            raise BadInput(label, f"a file in {self.root}", "no such file", "add it, or give the folder that has it")
        return existing[0]
