"""Alternative grasp search for a hand that cannot carry the object: the closest of many sampled grasps that can.

A network that has not seen an object often generates hands flat on one side of it. No attraction of fingers gives such
a grasp opposing contacts. The search samples hands nearby, rotated and opened, and closes them on the object.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands.model import JOINT_NAMES
from hoidata.physics.capsules import Capsules
from hoidata.refinement.grasp_solver import Attraction, GraspObjective, SolverSettings, solve_each_frame
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.skin import HandPose, SkinnedHand
from hoidata.settings import require_at_least

_OPPOSED = [JOINT_NAMES.index(name) for name in ("index3", "middle3", "thumb3")]
_MOST_OPEN = 1.1  # of its own fingers' bends a hand that closes again begins with up to so many
_AT_ONCE = 32  # hands; bounds memory, changes nothing


@dataclass(frozen=True)
class GraspSearchSettings:
    """Alternative grasp search: how grasps are sampled, closed and accepted."""

    tries: int = 192  # sampled hands; 0 disables the search
    answers: int = 8  # carrying grasps that are tried in the whole motion
    turn_rad: float = 0.45  # standard deviation of the rotation about the hand's centre
    shift_m: float = 0.02  # standard deviation of the translation
    most_m: float = 0.1  # largest translation towards the object's centre
    closing: Attraction = field(default_factory=lambda: Attraction(0.06, 0.04))  # of a sampled hand
    steps: int = 8  # solver steps of a sampled hand
    holding: Attraction = field(default_factory=lambda: Attraction(0.012, 0.006))  # of the whole motion
    bent_rad: float = 1.9  # largest rotation of a finger joint, unless the original is larger
    deep_m: float = 0.006  # largest depth of skin in a grasp
    way_deep_m: float = 0.008  # largest depth of skin in the whole motion, unless the original is larger
    step_m: float = 0.04  # largest wrist motion per frame, unless the original is larger
    blend: int = 16  # frames in which a hand comes to another grasp, and leaves it

    def __post_init__(self) -> None:
        require_at_least("hold.regrasp", self, "tries", 0)


@dataclass(frozen=True)
class Held:
    """One hand that holds a part, in one frame, in the part's frame. skin: some vertices of it are enough.

    part: its number. passed: whether the other one moves past the hand meanwhile. pose: one frame. frame: its number.
    centre_m: (3,) the object's centre of mass. other: capsules of the other hand in that frame.
    """

    skin: SkinnedHand
    field: ObjectField
    part: int
    passed: bool
    pose: HandPose
    frame: int
    centre_m: np.ndarray
    other: Capsules | None


def search_grasps(
    held: Held, carries: Callable[[HandPose], bool], solver: SolverSettings, settings: GraspSearchSettings
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


def _closed(held: Held, hands: HandPose, solver: SolverSettings, settings: GraspSearchSettings) -> HandPose:
    """The hands, each drawn to the object by itself."""
    frames = np.full(len(hands.wrist_m), held.frame)
    other = None if held.other is None else held.other.taken(np.zeros_like(frames))
    there = np.ones(len(frames), bool)
    passed = there if held.passed else None
    wishes = GraspObjective(
        held.skin, held.field, hands, frames, there, other, solver, settings.closing, held.part, passed
    )
    return solve_each_frame(wishes, settings.steps)


def _hands_near(held: Held, settings: GraspSearchSettings) -> HandPose:
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
