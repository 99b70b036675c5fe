"""An object stands while a hand sweeps over it, catches up on its own path, and no hand moves on it for that."""

from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands, track_joints, track_vertices
from hoidata.refinement.waiting import WaitSettings, wait_for_hands
from tests.builders.clips import clip_of
from tests.builders.objects import box_model, two_parts

PAIR = load_embedded_hands()
FRAMES = 60


def hand_at(side: Side, away_m: np.ndarray, world_from_object: RigidTransform, place_m: np.ndarray) -> HandTrack:
    """A hand over a place of an object, its lowest skin (frame,) metres above it, turning with it."""
    pose, nothing = PAIR[side].mean_pose.astype(np.float32)[None], np.zeros((1, 3), np.float32)
    own = HandTrack(nothing, nothing, pose, np.zeros((1, 10), np.float32), np.ones(1, bool))
    skin = track_vertices(own, PAIR[side])[0].astype(np.float64)
    local = place_m - [*skin.mean(axis=0)[:2], skin[:, 2].min()] + away_m[:, None] * [0, 0, 1.0]
    wrist = (world_from_object @ local[:, None])[:, 0]
    return HandTrack(
        wrist.astype(np.float32),
        rotmat_to_rotvec(world_from_object.rotation).astype(np.float32),
        np.repeat(pose, FRAMES, 0),
        own.betas.repeat(FRAMES, 0),
        np.ones(FRAMES, bool),
    )


def carried_box(comes_m: np.ndarray, first: int = 10, frames: int = 40) -> Clip:
    """A box that one hand carries along a bow for some frames while it turns; the other hand comes to it."""
    share = np.clip((np.arange(FRAMES) - first) / frames, 0, 1)
    share = share * share * (3 - 2 * share)
    turn = rotvec_to_rotmat(share[:, None] * [0, 0, 0.6])
    place = np.stack((0.4 * share, 0.2 * np.sin(np.pi * share), 0.1 * share), 1)
    thing = ObjectTrack(
        box_model((0.06, 0.40, 0.06)), (share[:, None] * [0, 0, 0.6]).astype(np.float32), place.astype(np.float32)
    )
    pose = RigidTransform(turn, place)
    hands = {
        "left": hand_at("left", np.zeros(FRAMES), pose, np.array([0, -0.12, 0.03])),
        "right": hand_at("right", comes_m, pose, np.array([0, 0.12, 0.03])),
    }
    return clip_of("toy/s1/a", thing, hands)


COMES = np.interp(np.arange(FRAMES), [0, 20, 27, 33, FRAMES], [0.3, 0.3, 0.03, 0.0, 0.0])  # metres above it


def in_object(clip: Clip, side: Side) -> np.ndarray:
    return clip.object.world_from_object.inverse() @ track_joints(clip.hands[side], PAIR[side]).astype(np.float64)


def steps_m(clip: Clip) -> np.ndarray:
    return np.linalg.norm(np.diff(clip.object.translation_m.astype(np.float64), axis=0), axis=1)


@pytest.fixture(scope="module")
def waited() -> tuple[Clip, Clip]:
    clip = carried_box(COMES)
    return clip, wait_for_hands(PAIR, clip)


def test_the_object_stands_while_the_hand_comes_and_moved_before(waited):
    clip, made = waited
    near, falling = COMES < 0.012, -np.diff(COMES) * 30 > 0.1
    swept = near[1:] & near[:-1] & falling
    assert steps_m(clip)[swept].min() > 0.01
    np.testing.assert_array_equal((steps_m(made) < 1e-5)[11:48], swept[11:48])
    before, after = (own.object.translation_m[:31, 0] for own in waited)
    assert (after - before).max() > 0.005


def test_it_keeps_its_path_its_ends_and_its_rest(waited):
    clip, made = waited
    before, after = (own.object.translation_m.astype(np.float64) for own in waited)
    fine = np.stack([np.interp(np.arange(0, FRAMES - 1, 0.01), np.arange(FRAMES), axis) for axis in before.T], 1)
    off = np.linalg.norm(after[:, None] - fine, axis=-1).min(axis=1)
    assert off.max() < 2e-4
    np.testing.assert_allclose(after[[0, -1]], before[[0, -1]], atol=1e-6)
    np.testing.assert_allclose(after[:10], before[:10], atol=2e-4)
    np.testing.assert_allclose(after[52:], before[52:], atol=2e-4)
    assert (np.diff(after[:, 0]) > -1e-6).all()
    assert steps_m(made).max() < 2 * steps_m(clip).max()


@pytest.mark.parametrize("side", SIDES)
def test_no_hand_moves_on_the_object_for_it(waited, side):
    before, after = (in_object(own, side) for own in waited)
    np.testing.assert_allclose(after, before, atol=1e-5)
    world = [track_joints(own.hands[side], PAIR[side]) for own in waited]
    assert abs(world[0] - world[1]).max() > 0.01


@pytest.mark.parametrize(
    "comes_m",
    [
        np.zeros(FRAMES),
        np.full(FRAMES, 0.3),
        np.interp(np.arange(FRAMES), [0, 2, 8, FRAMES], [0.2, 0.2, 0, 0]),
    ],
    ids=["holds all the time", "never comes", "comes while the object lies"],
)
def test_an_object_no_hand_sweeps_over_in_motion_stays_as_it_was(comes_m):
    clip = carried_box(comes_m)
    assert wait_for_hands(PAIR, clip) is clip


def test_a_hand_that_sweeps_for_long_is_not_out_of_step():
    clip = carried_box(COMES)
    assert wait_for_hands(PAIR, clip, WaitSettings(most=1)) is clip
    slides = replace(clip.hands["right"], wrist_m=clip.hands["right"].wrist_m)
    slides.wrist_m[:] = carried_box(np.zeros(FRAMES)).hands["right"].wrist_m
    slides.wrist_m[15:45, 1] -= np.linspace(0, 0.2, 30, dtype=np.float32)
    sliding = replace(clip, hands={**clip.hands, "right": slides})
    assert wait_for_hands(PAIR, sliding) is sliding


@pytest.mark.parametrize("frames", [24, 40])
def test_what_it_misses_is_made_up_for_near_by(frames: int):
    clip = carried_box(COMES, frames=frames)
    before, after = (own.object.translation_m[:, 0] for own in (clip, wait_for_hands(PAIR, clip)))
    assert np.abs(after - before)[:15].max() < 0.15 * np.abs(after - before).max()


def test_an_object_that_moves_only_under_the_sweep_has_nowhere_to_make_up_for_it():
    clip = carried_box(COMES, first=31, frames=2)
    assert wait_for_hands(PAIR, clip) is clip


def test_a_frame_without_the_hand_stays_as_it_was():
    clip = carried_box(COMES)
    track = clip.hands["left"]
    gone = replace(track, valid=track.valid & (np.arange(FRAMES) < 50))
    made = wait_for_hands(PAIR, replace(clip, hands={**clip.hands, "left": gone}))
    np.testing.assert_array_equal(made.hands["left"].wrist_m[50:], track.wrist_m[50:])
    np.testing.assert_array_equal(made.hands["left"].valid, gone.valid)


def test_a_hand_on_a_lid_goes_where_the_lid_goes():
    """A hinge that opens while a second hand comes: the angle waits, and the hand on the lid with it."""
    base, lid = (box_model((0.4, 0.4, 0.01), middle_m=(x, 0, 0)) for x in (-0.2, 0.2))
    model = two_parts(base, lid, (0, 1, 0))
    angle = -1.2 * np.clip((np.arange(FRAMES) - 10) / 40, 0, 1)
    still = np.zeros((FRAMES, 3), np.float32)
    thing = ObjectTrack(model, still, still.copy(), angle.astype(np.float32))
    world_from_lid = model.object_from_part(1, angle)
    hands = {
        side: hand_at(side, comes_m, world_from_lid, np.array([0.25, y, 0.005]))
        for side, comes_m, y in (("left", np.zeros(FRAMES), -0.1), ("right", COMES, 0.1))
    }
    clip = clip_of("toy/s1/b", thing, hands)
    made = wait_for_hands(PAIR, clip)
    assert made is not clip
    assert np.abs(np.diff(made.object.hinge_rad))[25:40].min() < 1e-4
    for side in SIDES:
        own, moved = (
            model.object_from_part(1, one.object.hinge_rad).inverse()
            @ track_joints(one.hands[side], PAIR[side]).astype(np.float64)
            for one in (clip, made)
        )
        np.testing.assert_allclose(moved, own, atol=1e-5)


def test_an_object_that_lies_stays_however_little_it_shakes(waited):
    """Generated objects never lie quite still."""
    clip, exact = waited
    shake = np.random.default_rng(0).normal(size=(FRAMES, 3)) * 1e-6
    shaken = replace(clip, object=replace(clip.object, translation_m=clip.object.translation_m + shake))
    made = wait_for_hands(PAIR, shaken)
    assert abs(made.object.translation_m - exact.object.translation_m).max() < 5e-4


def test_skin_at_one_part_does_not_sweep_because_the_other_part_turns():
    """A hand rests on the base while the lid opens a little, then goes to the lid and opens it."""
    base, lid = (box_model((0.3, 0.3, 0.02), middle_m=(x, 0, 0)) for x in (-0.2, 0.2))
    model = two_parts(base, lid, (0, 1, 0))
    frames, still = np.arange(FRAMES), np.zeros((FRAMES, 3), np.float32)
    angle = np.interp(frames, [0, 8, 14, 40, 54, FRAMES], [0, 0, -0.2, -0.2, -0.8, -0.8])
    pose = RigidTransform(np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3)))
    first = hand_at("right", np.interp(frames, [0, 22, 27], [0, 0, 0.3]), pose, np.array([-0.2, 0, 0.01]))
    then = hand_at(
        "right",
        np.interp(frames, [28, 33], [0.3, 0]),
        pose @ model.object_from_part(1, angle),
        np.array([0.2, 0, 0.01]),
    )
    late = (frames > 27)[:, None]
    hand = replace(
        first,
        wrist_m=np.where(late, then.wrist_m, first.wrist_m),
        global_orient=np.where(late, then.global_orient, first.global_orient),
    )
    away = hand_at("left", np.full(FRAMES, 0.5), pose, np.array([-0.2, 0, 0.01]))
    clip = clip_of(
        "toy/s1/b", ObjectTrack(model, still, still, angle.astype(np.float32)), {"left": away, "right": hand}
    )
    assert wait_for_hands(PAIR, clip) is clip
