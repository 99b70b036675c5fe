"""A hand laid flat on what it lifts takes it from two sides instead; one that carries keeps its grasp."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hoidata.clips.clip import Clip, HandTrack, ObjectTrack
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.objects.surface_index import surface_index
from hoidata.refinement import HoldSettings, carried_share, hold_hands
from hoidata.refinement.hold_solver import SolverSettings
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.regrasping import Held, RegraspSettings, grasps_that_carry
from hoidata.refinement.skin import HandPose, Skin
from tests.builders.clips import clip_of
from tests.builders.objects import box_model
from tests.hoidata.refinement.test_holding import FRAMES, pressed

PAIR = load_embedded_hands()
CUBE = box_model((0.06, 0.06, 0.06))
AS_GENERATED = HoldSettings(regrasp=RegraspSettings(tries=0))
RISE = np.interp(np.arange(FRAMES), [0, 14, 22, 28, 36], [0, 0, 0.15, 0.15, 0])
SIDEWAYS = np.array([np.pi / 2, 0, 0])


def lifted(turn: np.ndarray, inside_m: float = 0.002) -> Clip:
    """A right hand flat on a side of a cube that is lifted and put down: on its top, turned (3,) about its middle."""
    place = np.stack((0 * RISE, 0 * RISE, RISE + 0.03), 1)
    turned = rotvec_to_rotmat(np.tile(turn, (FRAMES, 1)))
    thing = ObjectTrack(CUBE, np.zeros((FRAMES, 3), np.float32), place.astype(np.float32))
    hand = pressed("right", place + turned @ np.array([0, 0, 0.03]), inside_m, 0.0, turned)
    return clip_of("toy/s1/a", thing, {"left": replace(hand, valid=np.zeros(FRAMES, bool)), "right": hand})


def deepest_mm(clip: Clip, track: HandTrack) -> np.ndarray:
    """(frame,)"""
    skin = clip.object.world_from_object.inverse() @ track_vertices(track, PAIR["right"]).astype(np.float64)
    return 1000 * surface_index(CUBE).depth_m(skin, None).max(axis=1)


def share(clip: Clip, track: HandTrack) -> float:
    return carried_share(PAIR, replace(clip, hands={**clip.hands, "right": track}))


@pytest.fixture(scope="module")
def laid_on_top() -> tuple[Clip, HandTrack, HandTrack]:
    """The clip, the hand as it is held, and as it takes the cube otherwise."""
    clip = lifted(np.zeros(3))
    return clip, hold_hands(PAIR, clip, AS_GENERATED)["right"], hold_hands(PAIR, clip)["right"]


def test_a_flat_hand_that_carries_nothing_takes_hold_from_two_sides_and_stays_there(laid_on_top):
    clip, before, after = laid_on_top
    assert (share(clip, before), share(clip, after)) == (0, 1)
    skin = (clip.object.world_from_object.inverse() @ track_vertices(after, PAIR["right"]).astype(np.float64))[12:35]
    assert np.abs(np.diff(skin, axis=0)).max() < 1e-6
    below_the_top = skin[0][:, 2] < 0.02
    sides = [((skin[0][:, axis] * sign > 0.02) & below_the_top).any() for axis in (0, 1) for sign in (1, -1)]
    assert (sides[0] and sides[1]) or (sides[2] and sides[3])
    assert deepest_mm(clip, after).max() < 7


def test_the_other_grasp_is_a_near_one(laid_on_top):
    _, before, after = laid_on_top
    both = (track_vertices(track, PAIR["right"])[24] for track in (before, after))
    assert 0.01 < np.linalg.norm(np.subtract(*both), axis=1).mean() < 0.08


def test_told_twice_the_grasp_is_the_same_to_the_bit(laid_on_top):
    clip, _, after = laid_on_top
    again = hold_hands(PAIR, clip)["right"]
    assert again.wrist_m.tobytes() == after.wrist_m.tobytes()
    assert again.hand_pose.tobytes() == after.hand_pose.tobytes()


def test_a_hand_that_carries_keeps_its_grasp(laid_on_top):
    clip, _, after = laid_on_top
    carrying = replace(clip, hands={**clip.hands, "right": after})
    kept, plain = (hold_hands(PAIR, carrying, own)["right"] for own in (HoldSettings(), AS_GENERATED))
    assert kept.wrist_m.tobytes() == plain.wrist_m.tobytes()
    assert kept.hand_pose.tobytes() == plain.hand_pose.tobytes()


def test_no_hand_reaches_through_the_table():
    """Flat on a side of the cube, fingers along the table."""
    clip = lifted(SIDEWAYS)
    after = hold_hands(PAIR, clip)["right"]
    assert share(clip, after) == 1
    lowest = [track_vertices(track, PAIR["right"])[14, :, 2].min() for track in (clip.hands["right"], after)]
    assert lowest[1] > min(0, lowest[0]) - 0.01


def test_each_of_two_holds_gets_a_grasp_of_its_own():
    """There and back again, with the hand away for a second in between."""
    once, frames = lifted(np.zeros(3)), np.arange(FRAMES)
    order = np.concatenate((frames, np.full(30, FRAMES - 1), frames[::-1]))

    def and_back(track: HandTrack) -> HandTrack:
        names = ("wrist_m", "global_orient", "hand_pose", "valid")
        return replace(track, **{name: getattr(track, name)[order] for name in names})

    thing = replace(once.object, rotvec=once.object.rotvec[order], translation_m=once.object.translation_m[order])
    twice = clip_of("toy/s1/b", thing, {side: and_back(track) for side, track in once.hands.items()})
    flat, made = (hold_hands(PAIR, twice, own)["right"] for own in (AS_GENERATED, HoldSettings()))
    assert (share(twice, flat), share(twice, made)) == (0, 1)


def held_cube() -> Held:
    clip = lifted(np.zeros(3))
    track = clip.hands["right"]
    return Held(
        Skin(PAIR["right"], np.zeros(10), None, np.arange(0, 778, 3)),
        ObjectField(replace(clip.object, translation_m=np.zeros((FRAMES, 3), np.float32))),
        HandPose.of(track.take(slice(24, 25))).moved(np.r_[0, 0, -RISE[24] - 0.03, np.zeros(48)][None]),
        24,
        np.zeros(3),
        None,
    )


def test_hands_come_lot_by_lot_the_nearest_first_and_none_is_deep():
    held, settings = held_cube(), RegraspSettings(tries=24, at_once=12)
    found = list(grasps_that_carry(held, lambda _: True, SolverSettings(), settings))
    own = held.skin.vertices_m(held.skin.chain(held.pose))
    far = [np.linalg.norm(held.skin.vertices_m(held.skin.chain(pose)) - own, axis=-1).mean() for pose in found]
    assert 6 < len(found) < 24
    assert sum(a > b for a, b in pairwise(far)) == 1  # where the second lot begins
    for pose in found:
        assert held.field.distances(held.skin.vertices_m(held.skin.chain(pose)), np.array([24]))[0].min() > -0.006
    assert not list(grasps_that_carry(held, lambda _: False, SolverSettings(), settings))
