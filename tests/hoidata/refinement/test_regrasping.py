"""A hand laid flat on what it lifts takes it from two sides instead; one that carries keeps its grasp."""

from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.refinement import HoldSettings, carried_share, hold_hands
from hoidata.refinement.hold_solver import SolverSettings
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.regrasping import Held, RegraspSettings, bends_rad, grasps_that_carry
from hoidata.refinement.skin import HandPose, Skin
from tests.builders.clips import clip_of
from tests.builders.objects import box_model
from tests.hoidata.refinement.test_holding import AS_GENERATED, FRAMES, pressed

PAIR = load_embedded_hands()
CUBE = box_model((0.06, 0.06, 0.06))
RISE = np.interp(np.arange(FRAMES), [0, 14, 22, 28, 36], [0, 0, 0.15, 0.15, 0])


def lifted(turn: np.ndarray, rise_m: np.ndarray = RISE) -> Clip:
    """A right hand flat on a side of a cube that is lifted and put down: on its top, turned (3,) about its middle."""
    place = np.stack((0 * rise_m, 0 * rise_m, rise_m + 0.03), 1)
    turned = rotvec_to_rotmat(np.tile(turn, (FRAMES, 1)))
    thing = ObjectTrack(CUBE, np.zeros((FRAMES, 3), np.float32), place.astype(np.float32))
    hand = pressed("right", place + turned @ np.array([0, 0, 0.03]), 0.002, 0.0, turned)
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
    assert share(clip, before) < share(clip, after) == 1
    skin = (clip.object.world_from_object.inverse() @ track_vertices(after, PAIR["right"]).astype(np.float64))[12:35]
    assert np.abs(np.diff(skin, axis=0)).max() < 1e-6
    below_the_top = skin[0][:, 2] < 0.02
    sides = [((skin[0][:, axis] * sign > 0.02) & below_the_top).any() for axis in (0, 1) for sign in (1, -1)]
    assert (sides[0] and sides[1]) or (sides[2] and sides[3])
    assert deepest_mm(clip, after).max() < 8
    assert np.degrees(bends_rad(HandPose.of(after)).max()) < 110  # as a person's


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
    """In the air at both ends of it, and put down in between."""
    rise = np.interp(np.arange(FRAMES), [8, 18, 26, 36], [0.15, 0, 0, 0.15])
    clip = lifted(np.array([1.2, 0, 0]), rise)
    flat, after = (hold_hands(PAIR, clip, own)["right"] for own in (AS_GENERATED, HoldSettings()))
    assert share(clip, after) > share(clip, flat)
    assert track_vertices(after, PAIR["right"])[18:27, :, 2].min() > -0.008


def one_after_the_other(first: Clip, second: Clip) -> Clip:
    """With the last frame of the first for a second in between."""

    def joined(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.concatenate((one, np.repeat(one[-1:], 30, 0), other))

    def hand(side: Side) -> HandTrack:
        names, tracks = ("wrist_m", "global_orient", "hand_pose", "valid"), (first.hands[side], second.hands[side])
        return replace(tracks[0], **{name: joined(*(getattr(own, name) for own in tracks)) for name in names})

    things = first.object, second.object
    thing = replace(
        things[0],
        rotvec=joined(*(own.rotvec for own in things)),
        translation_m=joined(*(own.translation_m for own in things)),
    )
    return clip_of("toy/s1/b", thing, {side: hand(side) for side in SIDES})


@pytest.mark.parametrize("turn", [(0, 0, 0), (0, -1.2, 0)])
def test_each_of_two_holds_gets_a_grasp_and_the_second_does_not_cost_the_first(turn):
    clip = one_after_the_other(lifted(np.array(turn)), lifted(np.array([np.pi / 2, 0, 0])))
    flat, made = (hold_hands(PAIR, clip, own)["right"] for own in (AS_GENERATED, HoldSettings()))
    assert (share(clip, flat), share(clip, made)) == (0, 1)


def held(model: ObjectModel) -> Held:
    """In frame 24 of ``lifted``, on top of a cube or of a thing in its middle."""
    clip = lifted(np.zeros(3))
    track = clip.hands["right"]
    return Held(
        Skin(PAIR["right"], np.zeros(10), None, np.arange(0, 778, 3)),
        ObjectField(replace(clip.object, model=model, translation_m=np.zeros((FRAMES, 3), np.float32))),
        0,
        False,
        HandPose.of(track.take(slice(24, 25))).moved(np.r_[0, 0, -RISE[24] - 0.03, np.zeros(48)][None]),
        24,
        np.zeros(3),
        None,
    )


@pytest.mark.parametrize(("height_m", "most_m"), [(0.06, 0.006), (0.008, 0.002)])
def test_the_nearest_hand_comes_first_and_none_is_deep_or_bent(height_m, most_m):
    """Half of the way into a plate of 8 mm counts as through it."""
    own, settings = held(box_model((0.06, 0.06, height_m))), RegraspSettings(tries=48)
    found = list(grasps_that_carry(own, lambda _: True, SolverSettings(), settings))
    skin_m = [own.skin.vertices_m(own.skin.chain(pose)) for pose in (own.pose, *found)]
    far = [np.linalg.norm(one - skin_m[0], axis=-1).mean() for one in skin_m[1:]]
    assert 0 < len(found) < 48
    assert far == sorted(far)
    for pose, points_m in zip(found, skin_m[1:], strict=True):
        assert own.field.distances(points_m, np.array([24]))[0].min() > -most_m - 5e-4
        assert np.linalg.norm(pose.fingers, axis=-1).max() < 1.9
    assert not list(grasps_that_carry(own, lambda _: False, SolverSettings(), settings))
