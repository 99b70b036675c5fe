"""Another grasp for a hand that cannot carry: of many near its own, closed on the object, the nearest that can.

Where a network does not know an object, hands lie flat on one side of it: all of their skin touches, and nothing
opposes it, however far fingers are drawn. Some of many hands nearby, turned, opened and closed again, take it from two
sides.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands.model import JOINT_NAMES
from hoidata.physics.capsules import Capsules
from hoidata.refinement.hold_solver import Draw, SolverSettings, Wishes, settled
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.skin import HandPose, Skin
from hoidata.settings import at_least

_OPPOSED = [JOINT_NAMES.index(name) for name in ("index3", "middle3", "thumb3")]
_MOST_OPEN = 1.1  # of its own fingers' bends a hand that closes again begins with up to so many
_AT_ONCE = 32  # hands; bounds memory, changes nothing


@dataclass(frozen=True)
class RegraspSettings:
    """tries: hands; 0 keeps the grasps that were generated. answers: how many that carry are taken up at most, until
    one still does with the hand's way to it. turn_rad, shift_m: standard deviations, of a hand's turn about its middle
    and of where it goes; most_m: by which it is moved towards the object's centre at most. closing: how it is drawn to
    the object in the search, in so many steps; holding: how with its way. bent_rad: no finger joint may be turned by
    more, if it was not before. deep_m, way_deep_m: no skin may lie deeper, in the hold and on the way. step_m: no wrist
    may go farther from one frame to the next, if it did not before. blend: frames in which a hand comes to another
    grasp, and leaves it.
    """

    tries: int = 192
    answers: int = 8
    turn_rad: float = 0.45
    shift_m: float = 0.02
    most_m: float = 0.1
    closing: Draw = field(default_factory=lambda: Draw(0.06, 0.04))
    steps: int = 8
    holding: Draw = field(default_factory=lambda: Draw(0.012, 0.006))
    bent_rad: float = 1.9
    deep_m: float = 0.006
    way_deep_m: float = 0.008
    step_m: float = 0.04
    blend: int = 16

    def __post_init__(self) -> None:
        at_least("hold.regrasp", self, "tries", 0)


@dataclass(frozen=True)
class Held:
    """One hand that holds a part, in one frame, in the part's frame. skin: some vertices of it are enough.

    part: its number. passed: whether the other one moves past the hand meanwhile. pose: one frame. frame: its number.
    centre_m: (3,) the object's centre of mass. other: capsules of the other hand in that frame.
    """

    skin: Skin
    field: ObjectField
    part: int
    passed: bool
    pose: HandPose
    frame: int
    centre_m: np.ndarray
    other: Capsules | None


def grasps_that_carry(
    held: Held, carries: Callable[[HandPose], bool], solver: SolverSettings, settings: RegraspSettings
) -> Iterator[HandPose]:
    """Hands (1 frame), those whose skin has moved least first.

    carries: whether a hand of one frame does. The same hands are tried whenever it is asked.
    """
    hands = _hands_near(held, settings)
    own_m = held.skin.vertices_m(held.skin.chain(held.pose))
    # Half of the way into a thin thing is through it.
    deepest_m = min(settings.deep_m, held.field.most_depth_m(held.part) / 2)
    found: list[tuple[float, HandPose]] = []
    for first in range(0, settings.tries, _AT_ONCE):
        closed = _closed(held, hands.taken(np.arange(first, min(first + _AT_ONCE, settings.tries))), solver, settings)
        points_m = held.skin.vertices_m(held.skin.chain(closed))
        frames = np.full(len(points_m), held.frame)
        good = held.field.distances(points_m, frames)[0].min(axis=1) > -deepest_m
        good &= bends_rad(closed) < max(settings.bent_rad, bends_rad(held.pose).item())
        moved = np.linalg.norm(points_m - own_m, axis=-1).mean(axis=1)
        found += [(moved[number], closed.taken(np.array([number]))) for number in np.flatnonzero(good)]
    return (hand for _, hand in sorted(found, key=lambda own: own[0]) if carries(hand))


def bends_rad(pose: HandPose) -> np.ndarray:
    """(frame,) the angle by which the finger joint that is turned most is turned."""
    return np.linalg.norm(pose.fingers, axis=-1).max(axis=1)


def _closed(held: Held, hands: HandPose, solver: SolverSettings, settings: RegraspSettings) -> HandPose:
    """The hands, each drawn to the object by itself."""
    frames = np.full(len(hands.wrist_m), held.frame)
    other = None if held.other is None else held.other.taken(np.zeros_like(frames))
    there = np.ones(len(frames), bool)
    passed = there if held.passed else None
    wishes = Wishes(held.skin, held.field, hands, frames, there, other, solver, settings.closing, held.part, passed)
    return settled(wishes, settings.steps)


def _hands_near(held: Held, settings: RegraspSettings) -> HandPose:
    """Hands to be closed, the same ones every time."""
    rng, count = np.random.default_rng(0), settings.tries
    own = held.pose.taken(np.zeros(count, int))
    middle = held.skin.vertices_m(held.skin.chain(held.pose))[0].mean(axis=0)
    turn = rotvec_to_rotmat(rng.normal(0, settings.turn_rad, (count, 3)))
    fingers = own.fingers * rng.uniform(0, _MOST_OPEN, (count, 1, 1))
    wrist = middle + (turn @ (own.wrist_m - middle)[..., None])[..., 0]
    hands = HandPose(wrist, turn @ own.orient, fingers)
    joints_m = held.skin.chain(hands).position_m[:, _OPPOSED]
    # Where thumb and fingers meet what lies between them.
    way = held.centre_m - (joints_m[:, :2].mean(axis=1) + joints_m[:, 2]) / 2
    way *= np.minimum(1, settings.most_m / np.linalg.norm(way, axis=1, keepdims=True).clip(1e-9))
    shift = rng.uniform(0, 1, (count, 1)) * way + rng.normal(0, settings.shift_m, (count, 3))
    return HandPose(wrist + shift, hands.orient, fingers)
