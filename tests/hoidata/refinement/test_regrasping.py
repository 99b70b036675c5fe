"""Alternative grasp search: a hand flat on an object grasps it from two sides; one that carries is unchanged."""

from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.refinement import GraspSettings, carried_fraction, refined_tracks
from hoidata.refinement.grasp_solver import SolverSettings
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.regrasping import GraspSearchSettings, Held, bends_rad, search_grasps
from hoidata.refinement.skin import HandPose, SkinnedHand
from tests.builders.clips import clip_of
from tests.builders.objects import box_model
from tests.hoidata.refinement.test_holding import AS_GENERATED, FRAMES, pressed

PAIR = load_embedded_hands()
CUBE = box_model((0.06, 0.06, 0.06))
RISE = np.interp(np.arange(FRAMES), [0, 14, 22, 28, 36], [0, 0, 0.15, 0.15, 0])


def lifted(rotvec: np.ndarray, rise_m: np.ndarray = RISE) -> Clip:
    """A cube is lifted and put down with a right hand flat on its top; ``rotvec (3,)`` rotates hand and side."""
    position_m = np.stack((0 * rise_m, 0 * rise_m, rise_m + 0.03), 1)
    rotation = rotvec_to_rotmat(np.tile(rotvec, (FRAMES, 1)))
    object_track = ObjectTrack(CUBE, np.zeros((FRAMES, 3), np.float32), position_m.astype(np.float32))
    hand = pressed("right", position_m + rotation @ np.array([0, 0, 0.03]), 0.002, 0.0, rotation)
    return clip_of("toy/s1/a", object_track, {"left": replace(hand, valid=np.zeros(FRAMES, bool)), "right": hand})


def deepest_mm(clip: Clip, track: HandTrack) -> np.ndarray:
    """(frame,) largest depth of the hand's skin in the cube."""
    skin = clip.object.world_from_object.inverse() @ track_vertices(track, PAIR["right"]).astype(np.float64)
    return 1000 * surface_index(CUBE).depth_m(skin, None).max(axis=1)


def carried(clip: Clip, track: HandTrack) -> float:
    return carried_fraction(PAIR, replace(clip, hands={**clip.hands, "right": track}))


@pytest.fixture(scope="module")
def laid_on_top() -> tuple[Clip, HandTrack, HandTrack]:
    """The clip, the hand refined without the grasp search, and with it."""
    clip = lifted(np.zeros(3))
    return clip, refined_tracks(PAIR, clip, AS_GENERATED)["right"], refined_tracks(PAIR, clip)["right"]


def test_a_flat_hand_that_carries_nothing_grasps_from_two_sides_and_does_not_slide(laid_on_top):
    clip, before, after = laid_on_top
    assert carried(clip, before) < carried(clip, after) == 1
    skin = (clip.object.world_from_object.inverse() @ track_vertices(after, PAIR["right"]).astype(np.float64))[12:35]
    assert np.abs(np.diff(skin, axis=0)).max() < 1e-6
    below_the_top = skin[0][:, 2] < 0.02
    sides = [((skin[0][:, axis] * sign > 0.02) & below_the_top).any() for axis in (0, 1) for sign in (1, -1)]
    assert (sides[0] and sides[1]) or (sides[2] and sides[3])
    assert deepest_mm(clip, after).max() < 8
    assert np.degrees(bends_rad(HandPose.of(after)).max()) < 110  # as human fingers


def test_the_alternative_grasp_is_close_to_the_original(laid_on_top):
    _, before, after = laid_on_top
    vertices_m = (track_vertices(track, PAIR["right"])[24] for track in (before, after))
    assert 0.01 < np.linalg.norm(np.subtract(*vertices_m), axis=1).mean() < 0.08


def test_equal_input_gives_equal_bytes(laid_on_top):
    clip, _, after = laid_on_top
    again = refined_tracks(PAIR, clip)["right"]
    assert again.wrist_m.tobytes() == after.wrist_m.tobytes()
    assert again.hand_pose.tobytes() == after.hand_pose.tobytes()


def test_a_hand_that_carries_is_unchanged(laid_on_top):
    clip, _, after = laid_on_top
    carrying = replace(clip, hands={**clip.hands, "right": after})
    with_search, without_search = (
        refined_tracks(PAIR, carrying, settings)["right"] for settings in (GraspSettings(), AS_GENERATED)
    )
    assert with_search.wrist_m.tobytes() == without_search.wrist_m.tobytes()
    assert with_search.hand_pose.tobytes() == without_search.hand_pose.tobytes()


def test_an_alternative_grasp_is_above_the_table():
    """The cube is in the air at both ends of the clip and on the table in between."""
    rise_m = np.interp(np.arange(FRAMES), [8, 18, 26, 36], [0.15, 0, 0, 0.15])
    clip = lifted(np.array([1.2, 0, 0]), rise_m)
    flat, after = (refined_tracks(PAIR, clip, settings)["right"] for settings in (AS_GENERATED, GraspSettings()))
    assert carried(clip, after) > carried(clip, flat)
    assert track_vertices(after, PAIR["right"])[18:27, :, 2].min() > -0.008


def one_after_the_other(first: Clip, second: Clip) -> Clip:
    """Both clips, with the last frame of the first one repeated for a second in between."""

    def joined(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.concatenate((one, np.repeat(one[-1:], 30, 0), other))

    def hand(side: Side) -> HandTrack:
        names, tracks = ("wrist_m", "global_orient", "hand_pose", "valid"), (first.hands[side], second.hands[side])
        return replace(tracks[0], **{name: joined(*(getattr(track, name) for track in tracks)) for name in names})

    object_tracks = first.object, second.object
    object_track = replace(
        object_tracks[0],
        rotvec=joined(*(track.rotvec for track in object_tracks)),
        translation_m=joined(*(track.translation_m for track in object_tracks)),
    )
    return clip_of("toy/s1/b", object_track, {side: hand(side) for side in SIDES})


@pytest.mark.parametrize("rotvec", [(0, 0, 0), (0, -1.2, 0)])
def test_each_of_two_grasps_gets_an_alternative_that_carries(rotvec):
    clip = one_after_the_other(lifted(np.array(rotvec)), lifted(np.array([np.pi / 2, 0, 0])))
    flat, regrasped = (refined_tracks(PAIR, clip, settings)["right"] for settings in (AS_GENERATED, GraspSettings()))
    assert (carried(clip, flat), carried(clip, regrasped)) == (0, 1)


def held(model: ObjectModel) -> Held:
    """The hand in frame 24 of ``lifted``, on an object of another size at the centre of the cube."""
    clip = lifted(np.zeros(3))
    track = clip.hands["right"]
    return Held(
        skin=SkinnedHand(PAIR["right"], np.zeros(10), None, np.arange(0, 778, 3)),
        field=ObjectField(replace(clip.object, model=model, translation_m=np.zeros((FRAMES, 3), np.float32))),
        part=0,
        passed=False,
        pose=HandPose.of(track.take(slice(24, 25))).moved(np.r_[0, 0, -RISE[24] - 0.03, np.zeros(48)][None]),
        frame=24,
        centre_m=np.zeros(3),
        other=None,
    )


@pytest.mark.parametrize(("height_m", "most_m"), [(0.06, 0.006), (0.008, 0.002)])
def test_grasps_are_ordered_by_distance_and_none_is_deep_or_bent(height_m, most_m):
    """In a plate of 8 mm half of the usual depth is allowed."""
    start, settings = held(box_model((0.06, 0.06, height_m))), GraspSearchSettings(tries=48)
    grasps = list(search_grasps(start, lambda _: True, SolverSettings(), settings))
    skin_m = [start.skin.vertices_m(start.skin.chain(pose)) for pose in (start.pose, *grasps)]
    change_m = [np.linalg.norm(points_of_grasp_m - skin_m[0], axis=-1).mean() for points_of_grasp_m in skin_m[1:]]
    assert 0 < len(grasps) < 48
    assert change_m == sorted(change_m)
    for pose, points_m in zip(grasps, skin_m[1:], strict=True):
        assert start.field.distances(points_m, np.array([24]))[0].min() > -most_m - 5e-4
        assert np.linalg.norm(pose.fingers, axis=-1).max() < 1.9
    assert not list(search_grasps(start, lambda _: False, SolverSettings(), settings))
