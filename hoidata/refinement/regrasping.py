"""Another grasp for a hand that cannot carry: the nearest of many, each near its own and closed on the object.

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

_OPPOSED = [JOINT_NAMES.index(name) for name in ("index3", "middle3", "thumb3")]
_MOST_OPEN = 1.1  # of its own fingers' bends a hand that closes again begins with up to so many


@dataclass(frozen=True)
class RegraspSettings:
    """tries: hands at most; 0 keeps the grasps that were generated. at_once: how many of these are looked at together.
    answers: how many that carry are taken up at most, until one still does with the hand's way to it. turn_rad,
    shift_m: standard deviations, of a hand's turn about its middle and of where it goes. closing: how it is drawn to
    the object in the search, in so many steps; holding: how with its way. deep_m: no skin may lie deeper. blend: frames
    in which a hand comes to another grasp, and leaves it.
    """

    tries: int = 192
    at_once: int = 16
    answers: int = 8
    turn_rad: float = 0.45
    shift_m: float = 0.02
    closing: Draw = field(default_factory=lambda: Draw(0.06, 0.04))
    steps: int = 8
    holding: Draw = field(default_factory=lambda: Draw(0.012, 0.006))
    deep_m: float = 0.006
    blend: int = 16


@dataclass(frozen=True)
class Held:
    """One hand that holds a part, in one frame, in the part's frame. skin: some of it does. pose: one frame.

    frame: of the object. centre_m: (3,) the object's centre of mass. other: capsules of the other hand, that frame.
    """

    skin: Skin
    field: ObjectField
    pose: HandPose
    frame: int
    centre_m: np.ndarray
    other: Capsules | None


def grasps_that_carry(
    held: Held, carries: Callable[[HandPose], bool], solver: SolverSettings, settings: RegraspSettings
) -> Iterator[HandPose]:
    """Hands (1 frame), lot by lot, those of a lot that are nearest to the hand's own first.

    carries: whether a hand of one frame does. The same hands are tried whenever it is asked.
    """
    own_m = held.skin.vertices_m(held.skin.chain(held.pose))
    for hands in _lots(held, settings):
        frames = np.full(len(hands.wrist_m), held.frame)
        other = None if held.other is None else held.other.taken(np.zeros_like(frames))
        there = np.ones(len(frames), bool)
        wishes = Wishes(held.skin, held.field, hands, frames, there, other, solver, settings.closing)
        closed = settled(wishes, settings.steps)
        points_m = held.skin.vertices_m(held.skin.chain(closed))
        outside = held.field.distances(points_m, frames)[0].min(axis=1) > -settings.deep_m
        moved = np.linalg.norm(points_m - own_m, axis=-1).mean(axis=1)
        for number in np.argsort(np.where(outside, moved, np.inf), kind="stable")[: outside.sum()]:
            if carries(hand := closed.taken(np.array([number]))):
                yield hand


def _lots(held: Held, settings: RegraspSettings) -> Iterator[HandPose]:
    """Hands to be closed, so many at once; the same ones every time."""
    rng = np.random.default_rng(0)
    middle = held.skin.vertices_m(held.skin.chain(held.pose))[0].mean(axis=0)
    for first in range(0, settings.tries, settings.at_once):
        count = min(settings.at_once, settings.tries - first)
        own = held.pose.taken(np.zeros(count, int))
        turn = rotvec_to_rotmat(rng.normal(0, settings.turn_rad, (count, 3)))
        fingers = own.fingers * rng.uniform(0, _MOST_OPEN, (count, 1, 1))
        wrist = middle + (turn @ (own.wrist_m - middle)[..., None])[..., 0]
        hands = HandPose(wrist, turn @ own.orient, fingers)
        joints_m = held.skin.chain(hands).position_m[:, _OPPOSED]
        # Where thumb and fingers meet what lies between them.
        grip_m = (joints_m[:, :2].mean(axis=1) + joints_m[:, 2]) / 2
        shift = rng.uniform(0, 1, (count, 1)) * (held.centre_m - grip_m) + rng.normal(0, settings.shift_m, (count, 3))
        yield HandPose(wrist + shift, hands.orient, fingers)
