"""The objects of the embedded corpora: names of H2O, GRAB and ARCTIC, and synthetic shapes.

Shapes are defined upright (z up, metres). ``standing_deg`` rotates the stored mesh to that orientation. ARCTIC's meshes
are stored with the hinge along (0, 0, -1) through the origin.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.objects.model import Hinge, ObjectModel
from hoidata.synthetic.shapes import Solid, cylinder, revolved, rounded_box, sharp_box, sphere, torus, united

ARCTIC_AXIS = np.array([0.0, 0.0, -1.0])
# x-y-z Euler angles in degrees, from the stored mesh to the upright frame, of objects with a horizontal hinge at the
# far side (canonical x away from the person, y up, z to the right). A vertical hinge, or none, needs no rotation.
HINGE_BEHIND = (90.0, 0.0, 90.0)


@dataclass(frozen=True)
class ObjectSpec:
    """How to build one object."""

    name: str  # as in the file names of the source
    words: str  # noun in sentences
    base: Callable[[], Solid]  # builds the solid, upright
    lid: Callable[[], Solid] | None = None
    stand_m: float = 0.0  # height of the slim support, which leaves space for the fingers below the object
    standing_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x-y-z Euler angles, stored mesh to upright

    @property
    def upright_from_object(self) -> np.ndarray:
        """(3, 3) rotation of the stored mesh to the upright frame."""
        return Rotation.from_euler("xyz", self.standing_deg, degrees=True).as_matrix()


def box_at(size, offset, radius_m=0.004, spacing_m=0.012) -> Callable[[], Solid]:
    return lambda: rounded_box(size, radius_m, spacing_m).moved(offset)


def _cylinder_at(radius_m: float, height_m: float, offset) -> Callable[[], Solid]:
    return lambda: cylinder(radius_m, height_m).moved(offset)


def _bottle(body_m: float, shoulder_m: float, neck_m: float, cap_m: float, height_m: float) -> Callable[[], Solid]:
    """Radii of body, neck and cap; the neck starts at ``shoulder_m`` above the ground, the cap 3 cm below the top."""
    cap = height_m - 0.03
    profile = [
        (0.0, 0.0), (body_m - 0.003, 0.0), (body_m, 0.003), (body_m, shoulder_m - 0.02), (neck_m, shoulder_m + 0.01),
        (neck_m, cap), (cap_m, cap + 0.002), (cap_m, height_m - 0.002), (cap_m - 0.002, height_m), (0.0, height_m),
    ]  # fmt: skip
    return lambda: revolved(profile)


def _milk() -> Solid:
    carton = rounded_box((0.068, 0.068, 0.16)).moved((0, 0, 0.08))
    roof = rounded_box((0.068, 0.02, 0.04)).moved((0, 0, 0.172))
    return united(carton, roof)


def _mug() -> Solid:
    cup = [(0, 0), (0.034, 0), (0.038, 0.004), (0.038, 0.095), (0.036, 0.097), (0.031, 0.095), (0.029, 0.08), (0, 0.08)]
    # A hook handle, open at the bottom and wide enough for four fingers.
    grip = rounded_box((0.022, 0.022, 0.085)).moved((0.079, 0, 0.05))
    arm = rounded_box((0.05, 0.018, 0.014)).moved((0.056, 0, 0.0853))
    return united(revolved(cup), united(grip, arm))


def _wineglass() -> Solid:
    return revolved([
        (0, 0), (0.036, 0), (0.037, 0.004), (0.012, 0.012), (0.009, 0.03), (0.009, 0.075), (0.022, 0.09),
        (0.034, 0.11), (0.037, 0.135), (0.034, 0.17), (0.032, 0.172), (0.029, 0.17), (0.028, 0.155), (0, 0.155),
    ])  # fmt: skip


def _teapot() -> Solid:
    body = revolved([
        (0, 0), (0.045, 0), (0.06, 0.02), (0.064, 0.05), (0.052, 0.085), (0.03, 0.1), (0.012, 0.104), (0.012, 0.12),
        (0, 0.122),
    ])  # fmt: skip
    # A side handle, as on a kyusu: a thick bar to the right.
    bar = cylinder(0.017, 0.13).rotated(tilted(70)).moved((0.108, 0, 0.075))
    spout = cylinder(0.011, 0.06).rotated(tilted(-50))
    return united(body, bar, spout.moved((-0.073, 0, 0.07)))


def tilted(degrees: float) -> np.ndarray:
    """Return the (3, 3) rotation from upright to the person's right."""
    return Rotation.from_euler("y", degrees, degrees=True).as_matrix()


def _hammer() -> Solid:
    handle = cylinder(0.0165, 0.2).rotated(tilted(90))
    head = rounded_box((0.034, 0.09, 0.036), 0.003).moved((-0.105, 0, 0))
    return united(handle, head).moved((0, 0, 0.02))


def _lightbulb() -> Solid:
    return revolved([
        (0, 0), (0.012, 0), (0.014, 0.004), (0.014, 0.028), (0.022, 0.045), (0.031, 0.065), (0.0335, 0.082),
        (0.031, 0.098), (0.022, 0.11), (0.01, 0.1155), (0, 0.1165),
    ])  # fmt: skip


def _flashlight() -> Solid:
    upright = revolved([
        (0, 0), (0.017, 0), (0.019, 0.003), (0.019, 0.12), (0.03, 0.145), (0.03, 0.168), (0.028, 0.17), (0, 0.17),
    ])  # fmt: skip
    return upright.moved((0, 0, -0.085)).rotated(tilted(90)).moved((0, 0, 0.03))


def _bowl() -> Solid:
    return revolved([
        (0, 0), (0.035, 0), (0.05, 0.012), (0.068, 0.045), (0.072, 0.065), (0.069, 0.067), (0.062, 0.06), (0, 0.042),
    ])  # fmt: skip


def _cone_cup() -> Solid:
    return revolved([
        (0, 0), (0.028, 0), (0.03, 0.003), (0.038, 0.105), (0.04, 0.106), (0.04, 0.116), (0.037, 0.12), (0, 0.12),
    ])  # fmt: skip


def _spray() -> Solid:
    body = revolved([(0, 0), (0.03, 0), (0.033, 0.003), (0.033, 0.1), (0.018, 0.13), (0.018, 0.16), (0, 0.16)])
    head = rounded_box((0.028, 0.075, 0.03)).moved((0, -0.012, 0.172))
    return united(body, head)


def _ketchup_bottle() -> Solid:
    return revolved([
        (0, -0.15), (0.027, -0.15), (0.03, -0.147), (0.033, -0.06), (0.026, -0.012), (0.022, -0.0005), (0, -0.0005),
    ]).moved((0, -0.024, 0))  # fmt: skip


def _mixer_base() -> Solid:
    column = rounded_box((0.07, 0.065, 0.15)).moved((0, -0.033, -0.076))
    foot = rounded_box((0.11, 0.19, 0.03)).moved((0, -0.095, -0.15))
    return united(column, foot)


H2O_OBJECTS = (
    ObjectSpec("book", "book", lambda: sharp_box((0.15, 0.03, 0.21)).moved((0, 0, 0.105))),
    ObjectSpec("espresso", "espresso", box_at((0.058, 0.05, 0.12), (0, 0, 0.06))),
    ObjectSpec("lotion", "lotion", _bottle(0.03, 0.125, 0.013, 0.017, 0.18)),
    ObjectSpec("spray", "spray", _spray),
    ObjectSpec("milk", "milk", _milk),
    ObjectSpec("cocoa", "cocoa", _cylinder_at(0.037, 0.13, (0, 0, 0.065))),
    ObjectSpec("chips", "chips", _cylinder_at(0.035, 0.2, (0, 0, 0.1))),
    ObjectSpec("cappuccino", "cappuccino", _cone_cup),
)

GRAB_OBJECTS = (
    ObjectSpec("cubelarge", "large cube", box_at((0.09, 0.09, 0.09), (0, 0, 0.045), 0.003)),
    ObjectSpec("cubemedium", "medium cube", lambda: sharp_box((0.06, 0.06, 0.06)).moved((0, 0, 0.03)), stand_m=0.04),
    ObjectSpec("spherelarge", "large sphere", lambda: sphere(0.06, 48).moved((0, 0, 0.06))),
    ObjectSpec("spheremedium", "medium sphere", lambda: sphere(0.04).moved((0, 0, 0.04))),
    ObjectSpec("cylinderlarge", "large cylinder", _cylinder_at(0.042, 0.14, (0, 0, 0.07))),
    ObjectSpec("cylindermedium", "medium cylinder", _cylinder_at(0.03, 0.1, (0, 0, 0.05))),
    ObjectSpec("toruslarge", "large torus", lambda: torus(0.06, 0.02).moved((0, 0, 0.02)), stand_m=0.06),
    ObjectSpec("apple", "apple", lambda: sphere(0.038).moved((0, 0, 0.038))),
    ObjectSpec("mug", "mug", _mug),
    ObjectSpec("wineglass", "wine glass", _wineglass),
    ObjectSpec("waterbottle", "water bottle", _bottle(0.034, 0.16, 0.014, 0.016, 0.21)),
    ObjectSpec("teapot", "teapot", _teapot),
    ObjectSpec("hammer", "hammer", _hammer, stand_m=0.06),
    ObjectSpec("lightbulb", "light bulb", _lightbulb),
    ObjectSpec("flashlight", "flashlight", _flashlight, stand_m=0.06),
    ObjectSpec("bowl", "bowl", _bowl),
)


def hinged(
    name: str, words: str, width: float, depth: float, base: float, lid: float, stand_m: float = 0.0
) -> ObjectSpec:
    """Two slabs with the hinge at the back: width along the hinge, depth towards the person, heights of both."""
    base_solid = box_at((width, depth, base), (0, -depth / 2, -base / 2 - 0.0005), 0.003, 0.014)
    lid_solid = box_at((width, depth, lid), (0, -depth / 2, lid / 2 + 0.0005), 0.003, 0.014)
    return hinged_behind(name, words, base_solid, lid_solid, stand_m)


def hinged_behind(
    name: str, words: str, base: Callable[[], Solid], lid: Callable[[], Solid], stand_m: float = 0.0
) -> ObjectSpec:
    """An object with the hinge at the back."""
    return ObjectSpec(name, words, base, lid, stand_m=stand_m, standing_deg=HINGE_BEHIND)


ARCTIC_OBJECTS = (
    hinged("box", "box", 0.17, 0.13, 0.08, 0.04),
    hinged("laptop", "laptop", 0.24, 0.18, 0.022, 0.018, 0.08),
    hinged("notebook", "notebook", 0.15, 0.2, 0.018, 0.016, 0.08),
    hinged("phone", "phone", 0.056, 0.09, 0.016, 0.012, 0.08),
    ObjectSpec(
        "microwave",
        "microwave",
        box_at((0.2, 0.13, 0.13), (0.1, 0.0655, 0.065), 0.003, 0.013),
        box_at((0.2, 0.018, 0.13), (0.1, -0.0095, 0.065), 0.003, 0.013),
    ),
    hinged_behind("ketchup", "ketchup", _ketchup_bottle, _cylinder_at(0.022, 0.03, (0, -0.024, 0.0155))),
    hinged_behind(
        "waffleiron",
        "waffle iron",
        _cylinder_at(0.085, 0.04, (0, -0.085, -0.0205)),
        _cylinder_at(0.085, 0.03, (0, -0.085, 0.0155)),
        stand_m=0.06,
    ),
    hinged_behind("mixer", "mixer", _mixer_base, box_at((0.06, 0.19, 0.06), (0, -0.095, 0.0305))),
    hinged_behind(
        "capsulemachine",
        "capsule machine",
        box_at((0.1, 0.16, 0.16), (0, -0.08, -0.0805), 0.004, 0.015),
        box_at((0.09, 0.15, 0.02), (0, -0.075, 0.0105)),
    ),
)

OBJECTS = {"h2o": H2O_OBJECTS, "grab": GRAB_OBJECTS, "arctic": ARCTIC_OBJECTS}


def object_spec(dataset: str, name: str) -> ObjectSpec:
    return {spec.name: spec for spec in OBJECTS[dataset]}[name]


def object_model(dataset: str, name: str) -> ObjectModel:
    """Build an object of the catalogue, metres."""
    return model_of(object_spec(dataset, name))


@lru_cache(maxsize=64)
def model_of(spec: ObjectSpec) -> ObjectModel:
    """Build an object, metres, once per process. Vertices of the base come first, then those of the lid."""
    base = spec.base()
    vertices, faces, part = [base.vertices_m], [base.faces], [np.zeros(len(base.vertices_m), dtype=np.uint8)]
    hinge = None
    if spec.lid is not None:
        lid = spec.lid()
        vertices.append(lid.vertices_m)
        faces.append(lid.faces + len(base.vertices_m))
        part.append(np.ones(len(lid.vertices_m), dtype=np.uint8))
        hinge = Hinge(ARCTIC_AXIS, np.zeros(3))
    # Rounded so that the files reproduce the ground truth exactly.
    stored = np.concatenate(vertices) @ spec.upright_from_object
    return ObjectModel(spec.name, np.round(stored, 7), np.concatenate(faces), np.concatenate(part), hinge=hinge)
