"""Objects, grasp regions (handle, rim, body, top) and plan of the corpus ``study``.

A region is defined for the right hand, or for both hands. Left hands use its mirror image, so each object has a plane
of symmetry. Names are those of GRAB and ARCTIC; most shapes are those of the embedded corpora.

Verbs are crossed with objects, hands and regions, over disjoint subjects. In contrast to the embedded corpora, object
and hand do not determine the verb. Verb, object and hand do not determine the grasped region.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, HandType
from hoidata.synthetic.actions import DATASET_IDS
from hoidata.synthetic.catalogue import ObjectSpec, box_at, hinged, hinged_behind, object_spec, tilted
from hoidata.synthetic.grasps import Approach, GraspSpec
from hoidata.synthetic.paths import Key, Motion, Swing, still, there_and_back
from hoidata.synthetic.shapes import Solid, cylinder, revolved, rounded_box, united


@dataclass(frozen=True)
class Region:
    """A grasp region of an object."""

    name: str
    grasp: GraspSpec
    yaw_deg: float = 0.0  # rotation of the object on the table

    def standing(self, spec: ObjectSpec) -> ObjectSpec:
        """Return the spec of the object, rotated for this region."""
        if not self.yaw_deg:
            return spec
        rotation = Rotation.from_euler("z", self.yaw_deg, degrees=True).as_matrix() @ spec.upright_from_object
        return replace(spec, standing_deg=tuple(Rotation.from_matrix(rotation).as_euler("xyz", degrees=True)))


@dataclass(frozen=True)
class StudyObject:
    """An object and its grasp regions."""

    spec: ObjectSpec
    one: tuple[Region, ...]  # regions for one hand
    two: tuple[Region, ...]  # regions for both hands
    lids: tuple[tuple[Region, ...], tuple[Region, ...]] = ((), ())  # regions to move the lid, with one and two hands
    across: bool = False  # plane of symmetry: y = 0, as with a handle to the right, or x = 0

    def regions(self, verb: str, n_hands: int) -> tuple[Region, ...]:
        """Return the regions that ``n_hands`` hands can grasp for a verb."""
        return self.lids[n_hands - 1] if verb in ("open", "close") else (self.one, self.two)[n_hands - 1]

    def mirror(self, region: Region) -> np.ndarray:
        """Return the (3, 3) reflection of the object frame that maps the surface to itself.

        It maps the object, mirrored in x, to the object rotated on the table.
        """
        upright = region.standing(self.spec).upright_from_object
        rotation = Rotation.from_euler("z", (180 if self.across else 0) - 2 * region.yaw_deg, degrees=True).as_matrix()
        return upright.T @ rotation.T @ np.diag([-1.0, 1.0, 1.0]) @ upright

    def stands_alike(self, right: Region, left: Region) -> bool:
        """Whether a right hand at one region and a left hand at the other, mirrored, need the same yaw."""
        return (180 * self.across - left.yaw_deg - right.yaw_deg) % 360 == 0

    @property
    def all_regions(self) -> tuple[Region, ...]:
        return (*self.one, *self.two, *self.lids[0], *self.lids[1])


Vector = tuple[float, float, float]


def _one(name: str, direction: Vector, through: Vector | None, width=0.3, blend=(0.0, 0.8), yaw=0.0) -> Region:
    return Region(name, GraspSpec((("right", Approach(direction, width, through, blend)),)), yaw)


def _two(name: str, left: tuple, right: tuple, yaw=0.0) -> Region:
    """left, right: (direction, target point) of each hand."""
    hands = (Approach(direction, 0.25, target, (0, 0.7)) for direction, target in (left, right))
    return Region(name, GraspSpec(tuple(zip(SIDES, hands, strict=True))), yaw)


def _lid(name: str, direction: Vector) -> Region:
    approach = Approach(direction, blend=(0, 0.9), part=1)
    return Region(name, GraspSpec((("right", approach),), ANGLES[0], ANGLES))


def _base_and_lid(name: str, base: Vector, lid: Vector) -> Region:
    hands = (Approach(direction, 0.45, part=part) for part, direction in enumerate((base, lid)))
    return Region(name, GraspSpec(tuple(zip(SIDES, hands, strict=True)), ANGLES[0], ANGLES))


# Hinge angles, from closed to open, at which a grasp of the lid must be stable.
ANGLES = (0.4, 0.65, 0.9)


def _frying_pan() -> Solid:
    pan = revolved([
        (0, 0), (0.06, 0), (0.068, 0.006), (0.08, 0.045), (0.078, 0.047), (0.073, 0.045), (0.064, 0.012), (0, 0.012),
    ])  # fmt: skip
    return united(pan, cylinder(0.014, 0.13).rotated(tilted(80)).moved((0.138, 0, 0.05)))


def _flashlight() -> Solid:
    return revolved([
        (0, 0), (0.032, 0), (0.034, 0.002), (0.034, 0.035), (0.021, 0.06), (0.021, 0.177), (0.019, 0.18), (0, 0.18),
    ])  # fmt: skip


def _waffle_iron_half(height_m: float, at_m: float) -> Solid:
    """Half of a round waffle iron, with half of the handle at the front."""
    plate, grip = cylinder(0.07, height_m), rounded_box((0.024, 0.1, 0.016)).moved((0, -0.11, 0))
    return united(plate, grip).moved((0, -0.072, at_m))


def _waffle_iron_base() -> Solid:
    return united(_waffle_iron_half(0.03, -0.0155), cylinder(0.035, 0.06).moved((0, -0.072, -0.055)))


_FRYING_PAN = ObjectSpec("fryingpan", "frying pan", _frying_pan)
_FLASHLIGHT = ObjectSpec("flashlight", "flashlight", _flashlight)
_LOW, _HIGH = (0.85, -0.4, 0.2), (0.85, -0.35, 0.35)
_ABOVE = (0.25, -0.35, 1.0)
_LEFT, _RIGHT = (-1.0, -0.15, 0.15), (1.0, -0.15, 0.15)


GRAB_STUDY = (
    StudyObject(
        object_spec("grab", "mug"),
        (
            _one("handle", (1, -0.35, 0.2), (0.079, 0, 0.045), 0.35, (0.0, 0.9)),
            _one("body", _LOW, (0, 0, 0.04), yaw=180),
            _one("top", _ABOVE, (0, 0, 0.09), blend=(0.2, 1.0), yaw=180),
        ),
        (
            _two("handle and body", (_LEFT, (0, 0, 0.045)), ((1, -0.35, 0.2), (0.079, 0, 0.045))),
            _two("sides", (_LEFT, (0, 0, 0.05)), (_RIGHT, (0, 0, 0.05)), 90),
        ),
        across=True,
    ),
    StudyObject(
        object_spec("grab", "waterbottle"),
        (_one("body", _LOW, (0, 0, 0.055)), _one("shoulder", _HIGH, (0, 0, 0.145)), _one("cap", _ABOVE, (0, 0, 0.2))),
        (
            _two("low and high", (_LEFT, (0, 0, 0.05)), (_RIGHT, (0, 0, 0.15))),
            _two("sides", (_LEFT, (0, 0, 0.1)), (_RIGHT, (0, 0, 0.1))),
        ),
    ),
    StudyObject(
        object_spec("grab", "teapot"),
        (_one("handle", (0.5, -0.4, 0.9), (0.125, 0, 0.08)), _one("lid", _ABOVE, (0, 0, 0.1), yaw=180)),
        (
            _two("handle and body", (_LEFT, (-0.02, 0, 0.05)), ((0.5, -0.4, 0.9), (0.125, 0, 0.08))),
            _two("sides", (_LEFT, (0, 0, 0.05)), (_RIGHT, (0, 0, 0.05)), 90),
        ),
        across=True,
    ),
    StudyObject(
        object_spec("grab", "wineglass"),
        (_one("stem", _LOW, (0, 0, 0.055)), _one("bowl", _HIGH, (0, 0, 0.135)), _one("rim", _ABOVE, (0, 0, 0.165))),
        (
            _two("stem and bowl", (_LEFT, (0, 0, 0.05)), (_RIGHT, (0, 0, 0.14))),
            _two("sides of the bowl", (_LEFT, (0, 0, 0.135)), (_RIGHT, (0, 0, 0.135))),
        ),
    ),
    StudyObject(
        _FRYING_PAN,
        (
            _one("handle", (0.6, -0.5, 0.8), (0.155, 0, 0.055)),
            _one("rim", (0.9, -0.3, 0.4), (0.07, 0, 0.035), blend=(0.2, 1.0), yaw=180),
        ),
        (
            _two("handle and rim", (_LEFT, (-0.05, 0, 0.03)), ((0.6, -0.5, 0.8), (0.155, 0, 0.055))),
            _two("both rims", (_LEFT, None), (_RIGHT, None), 90),
        ),
        across=True,
    ),
    StudyObject(
        object_spec("grab", "cylinderlarge"),
        (_one("low", _LOW, (0, 0, 0.045)), _one("top", _ABOVE, (0, 0, 0.13), blend=(0.2, 1.0))),
        (
            _two("low and high", (_LEFT, (0, 0, 0.035)), (_RIGHT, (0, 0, 0.105))),
            _two("sides", (_LEFT, (0, 0, 0.07)), (_RIGHT, (0, 0, 0.07))),
        ),
    ),
    StudyObject(
        object_spec("grab", "cubelarge"),
        (_one("side", _LOW, None), _one("top", _ABOVE, None, blend=(0.2, 1.0))),
        (
            _two("sides", (_LEFT, None), (_RIGHT, None)),
            _two("front and back", ((-0.6, 0.8, 0.2), None), ((0.6, -0.8, 0.2), None)),
        ),
    ),
    StudyObject(
        _FLASHLIGHT,
        (_one("head", _LOW, (0, 0, 0.03)), _one("tube", _HIGH, (0, 0, 0.12)), _one("end", _ABOVE, (0, 0, 0.17))),
        (
            _two("head and tube", (_LEFT, (0, 0, 0.025)), (_RIGHT, (0, 0, 0.13))),
            _two("both on the tube", (_LEFT, (0, 0, 0.09)), (_RIGHT, (0, 0, 0.15))),
        ),
    ),
)

_BOX = hinged("box", "box", 0.1, 0.07, 0.07, 0.035)
_WAFFLE_IRON = hinged_behind("waffleiron", "waffle iron", _waffle_iron_base, lambda: _waffle_iron_half(0.026, 0.0135))
_CAPSULE_MACHINE = hinged_behind(
    "capsulemachine",
    "capsule machine",
    box_at((0.07, 0.11, 0.14), (0, -0.055, -0.0705), 0.004, 0.015),
    box_at((0.066, 0.1, 0.025), (0, -0.05, 0.013)),
)
_PARTS = ((-1.0, -0.3, 0.0), (1.0, -0.4, 0.4))


def _hinged_object(spec: ObjectSpec, *more: Region) -> StudyObject:
    """Return an object with regions to carry it closed, and regions to move its lid."""
    return StudyObject(
        spec,
        (_one("side", _LOW, None), _one("top", _ABOVE, None, blend=(0.2, 1.0)), *more),
        (_two("sides", (_LEFT, None), (_RIGHT, None)), _two("side and top", (_LEFT, None), (_ABOVE, None))),
        (
            (_lid("side of the lid", (1, -0.4, 0.4)), _lid("front of the lid", (0.1, -1, 0.5))),
            (
                _base_and_lid("side of base and lid", *_PARTS),
                _base_and_lid("base and front of the lid", (-1.0, -0.1, 0.0), (0.1, -1.0, 0.5)),
            ),
        ),
    )


ARCTIC_STUDY = tuple(
    _hinged_object(spec)
    for spec in (_BOX, object_spec("arctic", "ketchup"), object_spec("arctic", "mixer"), _CAPSULE_MACHINE, _WAFFLE_IRON)
)
STUDY_OBJECTS = {"grab": GRAB_STUDY, "arctic": ARCTIC_STUDY}


StudySize = Literal["study", "study-small"]
_UP = (0.0, 0.0, 0.17)
_REST, _TILTED = (0.0, 0.0, 0.0), (-25.0, 0.0, 0.0)


@dataclass(frozen=True)
class StudyVerb:
    """A verb and its object motion."""

    intent: str  # as in the files of GRAB
    length: float  # mean frames of contact at 30 fps
    motion: Motion  # hinge values are fractions of the range
    two_hands: Motion | None = None  # motion with both hands, if different
    heading_deg: float = 0.0  # maximum rotation of the path about the vertical

    def motion_of(self, hand: HandType) -> Motion:
        return self.two_hands if hand == "both" and self.two_hands is not None else self.motion


def _turned(degrees: float) -> Motion:
    return Motion((Key(0), Key(0.15), *still(0.85, 1, _REST, (0, 0, degrees))))


def _moving_lid(start: float, stop: float) -> tuple[Motion, Motion]:
    """Return the motions on the table, and lifted between two hands."""
    up, on_table = (0.0, 0.0, 0.09), (_REST, _REST)
    lifted = (Key(0.4, up, _TILTED, start), Key(0.62, up, _TILTED, stop))
    return (
        Motion((*still(0, 0.35, *on_table, start), *still(0.65, 1, *on_table, stop))),
        Motion((*still(0, 0.1, *on_table, start), *lifted, *still(0.95, 1, *on_table, stop))),
    )


_SHOWN = (0, -0.1, 0.17)
VERBS = {
    "lift": StudyVerb("lift", 52, there_and_back(*still(0.45, 0.6, (0, 0, 0.2)))),
    "place": StudyVerb("place", 50, Motion((Key(0), Key(0.1), Key(0.35, (0.05, 0.02, 0.07)),
        Key(0.65, (0.15, 0.06, 0.07)), *still(0.92, 1, (0.2, 0.07, 0)))), heading_deg=30),
    "push": StudyVerb("push", 42, Motion((Key(0), Key(0.15), *still(0.85, 1, (0, 0.16, 0)))), heading_deg=50),
    "turn": StudyVerb("turn", 44, _turned(70)),
    "pass": StudyVerb("pass", 54, Motion((Key(0), Key(0.1), Key(0.42, (0, 0.1, 0.17)), Key(0.62, (0, 0.18, 0.17)),
        *still(0.93, 1, (0, 0.25, 0)))), heading_deg=20),
    "pour": StudyVerb("pour", 76, there_and_back(Key(0.26, _UP), *still(0.45, 0.7, (-0.06, 0.05, 0.2), (0, -80, 0)),
        Key(0.84, (0, 0, 0.14)))),
    "drink": StudyVerb("drink", 80, there_and_back(Key(0.28, (0, -0.12, 0.22)),
        *still(0.44, 0.66, (0, -0.18, 0.26), (42, 0, 0)), Key(0.8, (0, -0.12, 0.2)))),
    "shake": StudyVerb("shake", 72, there_and_back(*still(0.22, 0.8, _UP), swing=Swing(0.22, 0.8, 4, (0, 0, 0.03)))),
    "inspect": StudyVerb("inspect", 84, there_and_back(Key(0.2, _SHOWN), Key(0.38, _SHOWN, (18, 0, 60)),
        Key(0.62, _SHOWN, (18, 0, -60)), Key(0.78, _SHOWN))),
    "hand over": StudyVerb("offhand", 88, Motion((Key(0), Key(0.08), Key(0.32, (-0.05, 0, 0.15)),
        Key(0.68, (-0.05, 0.02, 0.15)), *still(0.92, 1, (-0.14, 0.05, 0)))), heading_deg=20),
    "open": StudyVerb("open", 54, *_moving_lid(0, 1)),
    "close": StudyVerb("close", 50, *_moving_lid(1, 0)),
    "screw": StudyVerb("screw", 44, _turned(-70)),
    "unscrew": StudyVerb("unscrew", 44, _turned(70)),
}  # fmt: skip
HANDOVER = "hand over"
# Their sense of rotation is part of the verb, also for left hands. Each is the reverse of the other.
SCREWING = ("screw", "unscrew")

# The verbs of each object, for all hands. Two hands also hand over objects without a lid, except _TOO_SHORT ones.
_VERBS_OF = {
    "mug": "lift place push pass pour drink",
    "waterbottle": "unscrew screw pass pour drink shake",
    "teapot": "unscrew place push screw pour inspect",
    "wineglass": "lift place pass pour drink inspect",
    "fryingpan": "lift place push pour shake inspect",
    "cylinderlarge": "lift unscrew screw pass shake inspect",
    "cubelarge": "place push screw unscrew shake inspect",
    "flashlight": "place screw pass unscrew shake inspect",
    "box": "open close lift push inspect",
    "ketchup": "open close lift shake place",
    "mixer": "open close lift push place",
    "capsulemachine": "open close lift turn inspect",
    "waffleiron": "open close lift turn shake",
}

_TOO_SHORT = {"cubelarge"}

# Subjects and their numbers of clips. Test and validation subjects are those of the named splits of both datasets.
_SHARES = {
    "grab": {**dict.fromkeys(("s1", "s2", "s3", "s4", "s5", "s8"), 74), "s6": 24, "s7": 24, "s9": 72, "s10": 192},
    "arctic": {**dict.fromkeys(("s01", "s02", "s04", "s06", "s08", "s09"), 34), "s07": 24, "s05": 40, "s10": 96},
}
_SMALL_SHARES = {"grab": {"s1": 6, "s9": 2, "s10": 2}, "arctic": {"s01": 6, "s05": 2, "s10": 2}}
_NOT_TRAINED_ON = {"s9", "s05", "s10"}
_SMALL_OBJECTS = 2
_HANDS: tuple[HandType, ...] = ("right", "left", "both")


class StudyEntry(NamedTuple):
    """One clip of the plan."""

    subject: str
    object_index: int  # in STUDY_OBJECTS
    verb: str
    hand: HandType
    region: int  # index in ``choices``
    number: int  # counts the repetitions of verb and object by this subject from 1


def shares(dataset: str, size: StudySize) -> dict[str, int]:
    """Return the number of clips of each subject."""
    return (_SHARES if size == "study" else _SMALL_SHARES)[dataset]


def verbs_of(item: StudyObject, hand: HandType) -> list[str]:
    verbs = _VERBS_OF[item.spec.name].split()
    has_handover = hand == "both" and item.spec.lid is None and item.spec.name not in _TOO_SHORT
    return [*verbs, HANDOVER] if has_handover else verbs


def choices(item: StudyObject, verb: str, hand: HandType) -> list[tuple[Region, ...]]:
    """Return the choices of regions: one region, or for "hand over" the regions of the right and of the left hand."""
    if verb != HANDOVER:
        return [(region,) for region in item.regions(verb, 2 if hand == "both" else 1)]
    return [(a, b) for a in item.one for b in item.one if a != b and item.stands_alike(a, b)]


def study_plan(dataset: str, size: StudySize) -> list[StudyEntry]:
    """Plan all clips. A round has each verb with each object and hand once, in random order, with the next region.

    Subjects alternate.
    """
    amounts = shares(dataset, size)
    training_subjects = [name for name in amounts if name not in _NOT_TRAINED_ON]
    entries: list[StudyEntry] = []
    for part, names in enumerate((training_subjects, *([name] for name in amounts if name in _NOT_TRAINED_ON))):
        order = _alternating_subjects({name: amounts[name] for name in names})
        entries += _numbered(zip(order, _rounds(dataset, size, part), strict=False))
    return entries


def _rounds(dataset: str, size: StudySize, part: int) -> Iterator[tuple[int, str, HandType, int]]:
    """Yield (object index, verb, hand, region) without end."""
    objects = STUDY_OBJECTS[dataset][: _SMALL_OBJECTS if size == "study-small" else None]
    actions = [
        (number, verb, hand) for number, item in enumerate(objects) for hand in _HANDS for verb in verbs_of(item, hand)
    ]
    rng = np.random.default_rng([part, DATASET_IDS[dataset]])
    first = rng.integers(1000, size=len(actions))
    done = 0
    while True:
        for index in rng.permutation(len(actions)):
            number, verb, hand = actions[index]
            yield number, verb, hand, int(first[index] + done) % len(choices(objects[number], verb, hand))
        done += 1


def _alternating_subjects(amounts: dict[str, int]) -> list[str]:
    """Repeat each name as often as its amount, evenly distributed."""
    positions = [((repetition + 0.5) / count, name) for name, count in amounts.items() for repetition in range(count)]
    return [name for _, name in sorted(positions)]


def _numbered(pairs) -> Iterator[StudyEntry]:
    done: Counter[tuple] = Counter()
    for subject, (index, verb, hand, region) in pairs:
        done[subject, index, verb] += 1
        yield StudyEntry(subject, index, verb, hand, region=region, number=done[subject, index, verb])
