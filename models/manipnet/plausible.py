"""Whether trajectories of a file can be meant as they are read; and if not, how else they may have been meant.

All is told by where the hands are: a unit, an order of numbers or axes that are not meant put them elsewhere. None of
296 clips (embedded H2O, GRAB and ARCTIC, real ManipNet), turned 13 ways, and neither demo of ManipNet with six objects
is refused.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.errors import BadInput
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.objects.user_mesh import UNITS_M
from models.manipnet.control import UNSEEN_M, Control, Motion
from models.manipnet.trajectory_files import Body, TrajectoryFile

NEAR_M = 0.12  # from the middle of the palm to the object: a hand that never comes nearer handles nothing
PALM_M = 0.08  # from the wrist to the middle of the palm
REACH_M = NEAR_M + PALM_M  # from the wrist, whatever way the palm lies
SWALLOWED_M = 0.03  # so deep in an object no palm is
WRIST_OFF_M = 0.015  # a wrist nearer to the object's hull has no room for a hand; recorded ones stay 1.9 cm off
MOST = 0.5  # of the frames in which a hand is near
FACING = np.array([0.8, 0.0, -0.6])  # canonical: where a hand that holds something looks to
PER_PALM_M, PER_SPREAD_M, PER_TURN_RAD = 10.0, 5.0, 0.5  # what a fit loses, beside two cosines
NO_FIT, CLEARLY = -2.0, 0.3  # of scores, 2 at best
LOOKS_TO = 0.6
MOST_LOOKED_AT = 10_000  # frames, evenly chosen, are enough to tell


class Fault(NamedTuple):
    """What is wrong: the words of a BadInput."""

    expected: str
    got: str
    remedy: str


class Fit(NamedTuple):
    """How well a hand goes with the object. looks: 1 where the palm looks to it, -1 away. lost: by distance, unrest."""

    looks: float
    lost: float

    @property
    def score(self) -> float:
        return max(2 * self.looks - self.lost, NO_FIT)


class Reading(NamedTuple):
    """A file read in some way. nearest_m: how near each palm comes. fault: why it cannot be meant so, None if it can"""

    control: Control
    nearest_m: Mapping[Side, float]
    fits: Mapping[Side, Fit]
    fault: Fault | None

    @property
    def active(self) -> list[Side]:
        return [side for side in SIDES if self.nearest_m.get(side, np.inf) < NEAR_M]

    @property
    def is_good(self) -> bool:
        """Whether nothing is wrong and a hand that is near looks to the object."""
        return self.fault is None and max(self.fits[side].looks for side in self.active) > LOOKS_TO

    def gain_over(self, other: "Reading") -> float:
        """By how much the hands that are near in this one fit better than in the other."""
        return sum(self.fits[side].score - other.fits[side].score for side in self.active)


def plausible_reading(found: TrajectoryFile, model: ObjectModel, hands: Mapping[Side, TrackedHand]) -> Reading:
    """The file as it is told. Raises BadInput where that cannot be meant, naming the one change that would do."""
    read = reading(found, model, hands)
    turned = [(fault, reading(changed, model, hands)) for fault, changed in _turned_otherwise(found)]
    # The best first; of a reading that has no fault another one must be clearly better.
    turned = sorted((one for one in turned if one[1].is_good), key=lambda one: -one[1].gain_over(read))
    if read.fault is None:
        if turned and turned[0][1].gain_over(read) > CLEARLY:
            raise BadInput(found.where, *turned[0][0])
        return read
    scaled = [(unit, reading(changed, model, hands)) for unit, changed in _scaled_otherwise(found)]
    units = [unit for unit, other in scaled if other.is_good]
    if turned and not units:
        raise BadInput(found.where, *turned[0][0])
    meant = f"perhaps the positions have another unit: --trajectory-unit {' or '.join(units)}"
    raise BadInput(found.where, read.fault.expected, read.fault.got, meant if units else read.fault.remedy)


def reading(found: TrajectoryFile, model: ObjectModel, hands: Mapping[Side, TrackedHand]) -> Reading:
    """Trajectories of a file at an object, with what can be said of them."""
    control = _control(found, model, hands)
    places: dict[Side, _Places] = {side: _Places(_thinned(control), side, hands[side]) for side in found.wrists}
    nearest: dict[Side, float] = {side: float(at.palm_distance_m.min()) for side, at in places.items()}
    fits: dict[Side, Fit] = {side: at.fit() for side, at in places.items()}
    return Reading(control, nearest, fits, _far(nearest) or _inside(places))


def _control(found: TrajectoryFile, model: ObjectModel, hands: Mapping[Side, TrackedHand]) -> Control:
    """A hand that the file has not is put where it senses nothing."""
    thing = found.thing
    if found.at_box:
        middle = (model.vertices_m.min(axis=0) + model.vertices_m.max(axis=0)) / 2
        thing = Body(thing.position_m - thing.rotmats @ middle, thing.rotmats)
    wrists: dict[Side, Motion] = {
        side: Motion(found.time_s, own.rotmats @ _model_from_file(found, hands[side]), own.position_m)
        for side, own in found.wrists.items()
    }
    away = Motion(found.time_s[:1], np.eye(3)[None], thing.position_m[:1] + np.array([UNSEEN_M, 0, 0]))
    both: dict[Side, Motion] = {side: wrists.get(side, away) for side in SIDES}
    return Control(both, Motion(found.time_s, thing.rotmats, thing.position_m), model, found.hinge_rad)


def _model_from_file(found: TrajectoryFile, hand: TrackedHand) -> np.ndarray:
    """(3, 3) from the axes of the hand's own wrist joint to those the file has."""
    if found.axes == "model":
        return np.eye(3)
    file_from_canonical = np.diag([-1.0 if hand.side == "left" else 1.0, 1.0, 1.0])
    return file_from_canonical @ hand.wrist_from_canonical.T


def _thinned(control: Control) -> Control:
    rows = slice(None, None, 1 + (len(control.thing.time_s) - 1) // MOST_LOOKED_AT)

    def some(motion: Motion) -> Motion:
        return Motion(motion.time_s[rows], motion.rotmats[rows], motion.position_m[rows])

    wrists: dict[Side, Motion] = {side: some(motion) for side, motion in control.wrists.items()}
    hinge = None if control.hinge_rad is None else control.hinge_rad[rows]
    return Control(wrists, some(control.thing), control.model, hinge)


class _Places:
    """A hand in the object's frame. wrist_m, palm_m: (frame, 3), with their signed distances from the surface."""

    def __init__(self, control: Control, side: Side, hand: TrackedHand) -> None:
        wrist, thing = control.wrists[side], control.thing
        self.control, self.hand = control, hand
        self.turn = np.swapaxes(thing.rotmats, 1, 2) @ wrist.rotmats  # object from wrist
        self.wrist_m = ((wrist.position_m - thing.position_m)[:, None] @ thing.rotmats)[:, 0]
        self.palm_m = self.wrist_m + self.turn @ (hand.wrist_from_canonical @ [PALM_M, 0.0, 0.0])
        found = surface_index(control.model).nearest(self.palm_m[:, None], control.hinge_rad)
        self.palm_distance_m, self.touched_m = found.distance_m[:, 0], found.closest_m[:, 0]
        self.is_near = self.palm_distance_m < NEAR_M

    def distance_m(self, model: ObjectModel) -> np.ndarray:
        """(frame,) signed distances of the wrist from a model that is hinged as the object."""
        return surface_index(model).nearest(self.wrist_m[:, None], self.control.hinge_rad).distance_m[:, 0]

    def share_of_near(self, frames: np.ndarray) -> float:
        return float((frames & self.is_near).sum() / max(self.is_near.sum(), 1))

    def fit(self) -> Fit:
        """Where the hand can reach it: does the palm look to its middle and nearest place, is it near, does it rest?"""
        at = self.distance_m(self.control.model) < REACH_M
        if not at.any():
            return Fit(NO_FIT / 2, 0.0)
        looks = self.turn[at] @ (self.hand.wrist_from_canonical @ FACING)
        wrist_m, turn = self.wrist_m[at], Rotation.from_matrix(self.turn[at])
        middle_m = self.control.model.vertices_m.mean(axis=0)
        facing = [_mean_cosine(looks, goal - wrist_m) for goal in (middle_m, self.touched_m[at])]
        spread_m = float(np.linalg.norm(wrist_m.std(axis=0)))
        turned_rad = float(np.sqrt(((turn.mean().inv() * turn).magnitude() ** 2).mean()))
        away_m = max(float(np.median(self.palm_distance_m[at])), 0.0)
        return Fit(sum(facing) / 2, PER_PALM_M * away_m + PER_SPREAD_M * spread_m + PER_TURN_RAD * turned_rad)


def _mean_cosine(looks: np.ndarray, way: np.ndarray) -> float:
    """Between unit vectors (frame, 3) and ways of any length."""
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    return float(((looks * way).sum(axis=1) / length).mean())


def _far(nearest_m: Mapping[Side, float]) -> Fault | None:
    if min(nearest_m.values()) < NEAR_M:
        return None
    got = ", ".join(f"the {side} one {metres:.3g} m" for side, metres in nearest_m.items())
    return Fault(f"a palm that comes within {NEAR_M} m of the object", got, "check the positions and their unit")


def _inside(places: Mapping[Side, _Places]) -> Fault | None:
    """A palm deep in the object, or a wrist in its hull, most of the time."""
    for side, at in places.items():
        if (share := at.share_of_near(at.palm_distance_m < -SWALLOWED_M)) > MOST:
            got = f"a {side} palm inside it in {100 * share:.0f} % of the frames in which it is near"
            remedy = "perhaps the mesh has another unit (--unit cm), or another origin than the trajectories mean"
            return Fault(f"{at.control.model.name} beside the hands", got, remedy)
        buried = at.distance_m(_hull(at.control.model)) < WRIST_OFF_M
        if (share := at.share_of_near(buried)) > MOST:
            got = f"a {side} wrist in it or closer in {100 * share:.0f} % of the frames in which the palm is near"
            remedy = "check the unit of the positions (--trajectory-unit) and of the mesh (--unit)"
            return Fault(f"a wrist at least {100 * WRIST_OFF_M} cm off {at.control.model.name}", got, remedy)
    return None


def _hull(model: ObjectModel) -> ObjectModel:
    """Each part's convex hull: what is hollow is full. A part without one (a flat sheet) stays as it is."""
    faces = [_hull_faces(model, part) for part in model.parts]
    return replace(model, faces=np.concatenate(faces))


def _hull_faces(model: ObjectModel, part: int) -> np.ndarray:
    """(face, 3) rows of the model's vertices, turned outward."""
    own = model.faces_of(part)
    rows = np.unique(own)
    try:
        hull = ConvexHull(model.vertices_m[rows])
    except QhullError:
        return own
    corner = model.vertices_m[rows][hull.simplices]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inward = (normal * hull.equations[:, :3]).sum(axis=1) < 0
    simplices = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    return rows[simplices].astype(own.dtype)


def _turned_otherwise(found: TrajectoryFile) -> Iterator[tuple[Fault, TrajectoryFile]]:
    """The file with the other axes of wrists, where they were told, and with w last; and what to say if that is it."""
    if found.unit:
        other = "model" if found.axes == "canonical" else "canonical"
        got = f"hands that go with the object only in those of --wrist-axes {other}"
        fault = Fault(f"wrists in the axes of --wrist-axes {found.axes}", got, f"--wrist-axes {other}")
        yield fault, replace(found, axes=other)
    wrists: dict[Side, Body] = {side: _reordered(own) for side, own in found.wrists.items()}
    got = "hands that go with the object only if they are x, y, z, w"
    fault = Fault("quaternions in the order w, x, y, z", got, "put w first")
    yield fault, replace(found, wrists=wrists, thing=_reordered(found.thing))


def _reordered(body: Body) -> Body:
    """The body if what was read as w, x, y, z is x, y, z, w."""
    as_read = Rotation.from_matrix(body.rotmats).as_quat()[:, [3, 0, 1, 2]]
    return Body(body.position_m, Rotation.from_quat(as_read).as_matrix())


def _scaled_otherwise(found: TrajectoryFile) -> Iterator[tuple[str, TrajectoryFile]]:
    """The file in the other units, those next to the one that was told first."""
    if not found.unit:
        return
    factors = {unit: metres / UNITS_M[found.unit] for unit, metres in UNITS_M.items() if unit != found.unit}
    for unit, factor in sorted(factors.items(), key=lambda one: abs(np.log(one[1]))):
        wrists: dict[Side, Body] = {side: _scaled(own, factor) for side, own in found.wrists.items()}
        yield unit, replace(found, wrists=wrists, thing=_scaled(found.thing, factor))


def _scaled(body: Body, factor: float) -> Body:
    return Body(body.position_m * factor, body.rotmats)
