"""Generated hands that slide, sink in and let a box hang in the air come out holding it; recorded ones stay."""

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.errors import BadInput
from hoidata.geometry.intervals import Interval
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.physics.realism import VARIANTS, score
from hoidata.physics.scene import capsules_there, clip_scene
from hoidata.refinement import HoldSettings, carried_share, hold_clip, hold_hands
from hoidata.refinement.hold_solver import spline_shares
from hoidata.refinement.holding import _Load, _passed
from hoidata.refinement.kernels import lower_capsules
from hoidata.refinement.object_field import ObjectField
from hoidata.refinement.regrasping import RegraspSettings
from tests.builders.clips import DOWN, clip_of
from tests.builders.objects import box_model, two_parts

PAIR = load_embedded_hands()
AS_GENERATED = HoldSettings(regrasp=RegraspSettings(tries=0))  # other grasps: test_regrasping.py
FRAMES = 44
BOX = box_model((0.06, 0.30, 0.06))
HELD, LIFT = slice(12, 36), np.interp(np.arange(FRAMES), [0, 14, 30, FRAMES], [0, 0, 0.2, 0.2])


def flat(side: Side) -> HandTrack:
    """A hand at the origin, one frame, mean pose."""
    pose, nothing = PAIR[side].mean_pose.astype(np.float32)[None], np.zeros((1, 3), np.float32)
    return HandTrack(nothing, nothing, pose, np.zeros((1, 10), np.float32), np.ones(1, bool))


def pressed(side: Side, top_m: np.ndarray, inside_m: float, wobble_m: float, turn: np.ndarray) -> HandTrack:
    """A hand whose lowest skin lies inside_m below the top of an object, which sways under it by wobble_m.

    top_m: (frame, 3) middle of the top, world. turn: (frame, 3, 3) of the object. It comes from 10 cm above and goes.
    """
    own, frames = flat(side), np.arange(len(top_m))
    skin = track_vertices(own, PAIR[side])[0].astype(np.float64)
    away = np.interp(frames, [0, 10, 37, FRAMES], [0.1, 0, 0, 0.1])
    sway = wobble_m * np.sin(frames[:, None] / 3.0) * [1.0, 1.0, 0]
    local = np.array([*-skin.mean(axis=0)[:2], -skin[:, 2].min() - inside_m]) + sway
    local[:, 2] += away
    wrist = top_m + (turn @ local[..., None])[..., 0]
    return HandTrack(
        wrist.astype(np.float32),
        rotmat_to_rotvec(turn).astype(np.float32),
        np.repeat(own.hand_pose, len(frames), 0),
        own.betas,
        np.ones(len(frames), bool),
    )


@pytest.fixture(scope="module")
def pushed() -> tuple[Clip, dict[Side, HandTrack]]:
    """Two hands 12 mm inside the top of a box that rises and turns, swaying by 4 mm on it; and what becomes of them."""
    turn = rotvec_to_rotmat(np.interp(np.arange(FRAMES), [0, 9, 38, FRAMES], [0, 0, 0.5, 0.5])[:, None] * [0, 0, 1.0])
    place = np.stack((0 * LIFT, 0 * LIFT, LIFT), 1)
    thing = ObjectTrack(BOX, rotmat_to_rotvec(turn).astype(np.float32), place.astype(np.float32))
    hands = {}
    for side, y in zip(SIDES, (-0.08, 0.08), strict=True):
        top = place + (turn @ np.array([0, y, 0.03]))
        hands[side] = pressed(side, top, 0.012, 0.004, turn)
    clip = clip_of("toy/s1/a", thing, hands)
    return clip, hold_hands(PAIR, clip, AS_GENERATED)


def in_object(clip: Clip, side: Side, track: HandTrack) -> np.ndarray:
    return clip.object.world_from_object.inverse() @ track_vertices(track, PAIR[side]).astype(np.float64)


def depth_mm(model: ObjectModel, points_m: np.ndarray) -> np.ndarray:
    return 1000 * surface_index(model).depth_m(points_m, None).max(axis=1)


def test_a_hand_that_swayed_inside_what_it_held_is_still_on_its_surface(pushed):
    clip, made = pushed
    for side in SIDES:
        before, after = in_object(clip, side, clip.hands[side]), in_object(clip, side, made[side])
        slid = [np.linalg.norm(np.diff(skin[HELD], axis=0), axis=-1).max() for skin in (before, after)]
        assert slid[0] > 0.001
        assert slid[1] < 1e-6
        assert depth_mm(BOX, before)[HELD].min() > 7
        assert 0.5 < depth_mm(BOX, after)[HELD].max() < 3.5
        assert depth_mm(BOX, after).max() < 5  # nor on its way to the hold, and away from it
        assert np.linalg.norm(after - before, axis=-1).mean() < 0.02


def test_the_share_that_is_carried_is_none_without_hands_at_the_box_and_all_where_it_never_rises(pushed):
    clip, made = pushed
    held = replace(clip, hands=made)
    away = {side: replace(track, wrist_m=track.wrist_m + np.float32(1)) for side, track in made.items()}
    nobody = {side: replace(track, valid=np.zeros(FRAMES, bool)) for side, track in made.items()}
    lying = replace(clip.object, translation_m=np.zeros((FRAMES, 3), np.float32), rotvec=np.zeros((FRAMES, 3), "f4"))
    assert carried_share(PAIR, replace(held, hands=away)) == carried_share(PAIR, replace(held, hands=nobody)) == 0
    assert carried_share(PAIR, replace(held, hands=nobody, object=lying)) == 1
    realism = score(clip_scene(held, PAIR), VARIANTS["SI"])
    assert carried_share(PAIR, held) == pytest.approx(realism.passed.mean(), abs=0.3)


def test_far_from_its_hold_a_hand_is_left_as_it_was(pushed):
    clip, made = pushed
    for side in SIDES:
        moved = np.linalg.norm(made[side].wrist_m - clip.hands[side].wrist_m, axis=1)
        assert max(moved[0], moved[-1]) < 0.005
        acceleration = [np.abs(np.diff(track.wrist_m, 2, axis=0)).max() for track in (clip.hands[side], made[side])]
        assert acceleration[1] < acceleration[0] + 0.005


def test_what_moves_in_no_hand_is_held_for_longer():
    """A box that is pushed aside already while the hand comes and still when it has gone: no skin slides on it."""
    aside = np.interp(np.arange(FRAMES), [0, 5, 40, FRAMES], [0, 0, 0.4, 0.4])
    place = np.stack((aside, 0 * aside, 0 * aside), 1)
    still = np.zeros((FRAMES, 3), np.float32)
    turn = np.tile(np.eye(3), (FRAMES, 1, 1))
    clip = clip_of(
        "toy/s1/d",
        ObjectTrack(BOX, still, place.astype(np.float32)),
        {
            "left": pressed("left", place + 1.0, 0.0, 0.0, turn),
            "right": pressed("right", place + np.array([0, 0, 0.03]), 0.004, 0.002, turn),
        },
    )
    slid = []
    for carry in (0, 8):
        skin = in_object(clip, "right", hold_hands(PAIR, clip, HoldSettings(carry=carry))["right"])
        slid.append(np.linalg.norm(np.diff(skin[5:41], axis=0), axis=-1).max())
    assert slid[0] > 0.003
    assert slid[1] < 1e-6


def test_a_hand_that_comes_to_what_the_other_carries_takes_its_time():
    clip, made = coming_to_a_carried_box()
    apart = np.linalg.norm(made["right"].wrist_m - clip.hands["right"].wrist_m, axis=1)
    assert apart[:4].max() < 0.005


def coming_to_a_carried_box() -> tuple[Clip, dict[Side, HandTrack]]:
    """The left hand holds a box that moves in all frames; the right one comes in the tenth."""
    place = np.stack((np.linspace(0, 0.5, FRAMES), 0 * LIFT, 0 * LIFT), 1)
    turn, still = np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3), np.float32)
    hands = {
        side: pressed(side, place + np.array([0, y, 0.03]), 0.004, 0.0, turn)
        for side, y in (("left", -0.08), ("right", 0.08))
    }
    held = hands["left"]
    held = replace(held, wrist_m=(place + held.wrist_m[20] - place[20]).astype(np.float32))
    clip = clip_of("toy/s1/e", ObjectTrack(BOX, still, place.astype(np.float32)), {**hands, "left": held})
    return clip, hold_hands(PAIR, clip)


def test_hands_that_touch_nothing_and_frames_without_a_hand_keep_their_numbers(pushed):
    clip, _ = pushed
    away = {side: replace(track, wrist_m=track.wrist_m + np.float32(1)) for side, track in clip.hands.items()}
    left_alone = hold_hands(PAIR, replace(clip, hands=away))
    for side in SIDES:
        for name in ("wrist_m", "global_orient", "hand_pose"):
            assert np.array_equal(getattr(left_alone[side], name), getattr(away[side], name))
    valid = np.arange(FRAMES) < 30
    gone = replace(clip, hands={side: replace(track, valid=valid) for side, track in clip.hands.items()})
    for side, track in hold_hands(PAIR, gone).items():
        assert np.array_equal(track.hand_pose[30:], clip.hands[side].hand_pose[30:])
        assert not np.array_equal(track.hand_pose[12:30], clip.hands[side].hand_pose[12:30])


def opening(middle_m: float) -> tuple[Clip, RigidTransform]:
    """A right hand pressed on a lid so far from the hinge while it opens, and the lid's motion."""
    base, lid = (box_model((0.4, 0.4, 0.01), middle_m=(x, 0, 0)) for x in (-0.2, 0.2))
    model = two_parts(base, lid, (0, 1, 0))
    angle = np.interp(np.arange(FRAMES), [0, 14, 34, FRAMES], [0, 0, -0.8, -0.8])
    still = np.zeros((FRAMES, 3), np.float32)
    thing = ObjectTrack(model, still, still, angle.astype(np.float32))
    world_from_lid = model.object_from_part(1, angle)
    top = (world_from_lid @ np.tile([middle_m, 0, 0.005], (FRAMES, 1, 1)))[:, 0]
    hands: dict[Side, HandTrack] = {
        "left": pressed("left", top + 1.0, 0.0, 0.0, np.tile(np.eye(3), (FRAMES, 1, 1))),
        "right": pressed("right", top, 0.006, 0.003, world_from_lid.rotation),
    }
    return clip_of("toy/s1/b", thing, hands), world_from_lid


def test_a_hand_on_a_lid_stays_still_on_the_lid_while_it_opens():
    clip, world_from_lid = opening(0.2)
    made = hold_hands(PAIR, clip)["right"]
    on_lid = world_from_lid.inverse() @ track_vertices(made, PAIR.right).astype(np.float64)
    assert np.linalg.norm(np.diff(on_lid[14:33], axis=0), axis=-1).max() < 1e-6
    on_base = track_vertices(made, PAIR.right)[HELD]
    assert np.linalg.norm(np.diff(on_base, axis=0), axis=-1).max() > 0.001


def test_a_hand_across_the_hinge_gives_way_to_the_part_it_does_not_hold(monkeypatch):
    clip, world_from_lid = opening(0.04)

    def skin_near_base(track: HandTrack) -> float:
        skin = track_vertices(track, PAIR.right)[HELD].astype(np.float64)
        field, frames = ObjectField(clip.object), np.arange(FRAMES)[HELD]
        return float((field.distances_to(0, skin, frames)[0] < 0.01).mean())

    gives_way = hold_hands(PAIR, clip)["right"]
    monkeypatch.setattr("hoidata.refinement.holding._passed", lambda thing, holds: None)
    stays = hold_hands(PAIR, clip)["right"]
    assert skin_near_base(stays) > 0.03
    assert skin_near_base(gives_way) < 0.3 * skin_near_base(stays)
    on_lid = world_from_lid.inverse() @ track_vertices(gives_way, PAIR.right).astype(np.float64)
    assert np.linalg.norm(np.diff(on_lid[14:33], axis=0), axis=-1).max() < 1e-6
    assert -0.002 < on_lid[20, :, 2].min() - 0.005 < 0.001


def test_a_hand_keeps_to_the_part_it_holds_at_first(monkeypatch):
    """A try may push it off that part and nearer to the other one."""
    clip, asked = opening(0.07)[0], []
    touched = ObjectField.part_touched

    def part_touched(self, places_m, touching, part=None):
        asked.append(part)
        return touched(self, places_m, touching, part)

    monkeypatch.setattr(ObjectField, "part_touched", part_touched)
    monkeypatch.setattr("hoidata.refinement.holding._Load.carried_share", lambda self, pair, hands: 0.0)
    hold_hands(PAIR, clip, AS_GENERATED)
    rights = [part for part in asked if part is not None]
    assert set(rights) == {1}
    assert len(rights) == len(HoldSettings().reach_m) - 1


def test_where_the_object_would_fall_hands_are_drawn_to_it_from_farther_away():
    """Two palms 4 mm off both sides of a box in the air."""
    place, shares = np.stack((0 * LIFT, 0 * LIFT, LIFT), 1), []
    still = np.zeros((FRAMES, 3), np.float32)
    thing, hands = ObjectTrack(box_model((0.1, 0.1, 0.1)), still, place.astype(np.float32)), {}
    for side, sign in zip(SIDES, (-1, 1), strict=True):
        turn = np.tile(rotvec_to_rotmat(np.array([-sign * np.pi / 2, 0, 0])), (FRAMES, 1, 1))
        hands[side] = pressed(side, place + np.array([0, sign * 0.05, 0]), -0.004, 0.0, turn)
    clip = clip_of("toy/s1/c", thing, hands)
    for reach in ((0.0005,), (0.0005, 0.03)):
        made = hold_hands(PAIR, clip, replace(AS_GENERATED, reach_m=reach, keypoint_m=(0.006, 0.02)[: len(reach)]))
        shares.append(score(clip_scene(replace(clip, hands=made), PAIR, -0.05), VARIANTS["SI"]).share)
        # Not by fingers that nobody can bend so.
        assert max(np.linalg.norm(track.hand_pose.reshape(-1, 15, 3), axis=-1).max() for track in made.values()) < 1.2
    assert shares[0] < 0.2
    assert shares[1] > 0.6


def test_told_twice_the_answer_is_the_same_and_what_has_no_weight_needs_no_carrying(pushed):
    clip, made = pushed
    corners, sheet = BOX.vertices_m * [1, 1, 0], clip.object
    paper = replace(clip, object=replace(sheet, model=replace(BOX, name="sheet", vertices_m=corners)))
    assert all(np.isfinite(track.wrist_m).all() for track in hold_hands(PAIR, paper).values())
    again, floating = hold_hands(PAIR, clip, AS_GENERATED), hold_hands(PAIR, replace(clip, gravity=None))
    for side in SIDES:
        assert again[side].wrist_m.tobytes() == made[side].wrist_m.tobytes()
        assert np.isfinite(floating[side].hand_pose).all()
    assert (clip.gravity == DOWN).all()


def test_a_hold_has_one_control_point_and_shares_add_up_to_one():
    holds = [(12, 36)]
    shares = spline_shares(FRAMES, holds, 5)  # pyright: ignore[reportArgumentType]
    assert shares.sum(axis=1) == pytest.approx(1)
    assert shares[12:36].max(axis=1) == pytest.approx(1)
    assert len(set(shares[12:36].argmax(axis=1))) == 1
    assert (shares[:6].max(axis=1) < 0.9).all()


def test_a_hand_that_goes_elsewhere_holds_there_not_between_both_places():
    frames, still = np.arange(FRAMES), np.zeros((FRAMES, 3), np.float32)
    turn = np.tile(np.eye(3), (FRAMES, 1, 1))
    place = np.interp(frames, [0, 16, 22, FRAMES], [-0.1, -0.1, 0.1, 0.1])
    track = pressed("right", np.stack((0 * place, place, 0.03 + 0 * place), 1), 0.001, 0.0, turn)
    lifted = np.interp(frames, [0, 15, 19, 23, FRAMES], [0, 0, 0.02, 0, 0])
    track = replace(track, wrist_m=(track.wrist_m + lifted[:, None] * [0, 0, 1]).astype(np.float32))
    away = replace(track, wrist_m=track.wrist_m + 1)
    clip = clip_of("toy/s1/e", ObjectTrack(BOX, still, still), {"left": away, "right": track})
    made = hold_hands(PAIR, clip)["right"]
    for start, stop in ((11, 15), (25, 36)):
        assert abs(made.wrist_m - track.wrist_m)[start:stop, 1].max() < 0.01


def test_between_two_holds_on_a_moving_object_the_hand_takes_the_frames_it_has():
    """It lifts off, and comes down 20 cm farther on: drawn out up to one another, both holds would be one jump."""
    frames = np.arange(FRAMES)
    turn, still = np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3), np.float32)
    place = np.stack((0.012 * frames, 0.0 * frames, 0.0 * frames), 1)
    along = np.interp(frames, [0, 16, 24, FRAMES], [-0.1, -0.1, 0.1, 0.1])
    lift = np.interp(frames, [0, 16, 18, 22, 24, FRAMES], [0, 0, 0.02, 0.02, 0, 0])
    top = place + np.stack((0 * along, along, 0.03 + lift), 1)
    track = pressed("right", top, 0.001, 0.0, turn)
    away = replace(track, wrist_m=track.wrist_m + 1)
    clip = clip_of("toy/s1/e", ObjectTrack(BOX, still, place.astype(np.float32)), {"left": away, "right": track})
    made = hold_hands(PAIR, clip, AS_GENERATED)["right"].wrist_m - place
    own = track.wrist_m - place
    step, own_step = (np.linalg.norm(np.diff(one[12:36], axis=0), axis=1).max() for one in (made, own))
    assert own_step < 0.03
    assert step < 2.5 * own_step


def test_a_hand_that_is_only_near_is_not_pushed_through():
    """The right one hovers over the place the left one is drawn to, and moves too fast to hold."""
    place, turn = np.zeros((FRAMES, 3)), np.tile(np.eye(3), (FRAMES, 1, 1))
    left = pressed("left", place + np.array([0, 0, 0.03]), -0.004, 0.0, turn)
    over = 0.02 * np.sin(np.arange(FRAMES))[:, None] * [1.0, 0, 0] + [0, 0, 0.018]
    right = pressed("right", place + np.array([0, 0, 0.03]), -0.01, 0.0, turn)
    right = replace(right, wrist_m=(right.wrist_m + over).astype(np.float32))
    still = np.zeros((FRAMES, 3), np.float32)
    depths_mm = []
    for hands in ({"left": left, "right": right}, {"left": left, "right": replace(right, wrist_m=right.wrist_m + 1)}):
        clip = clip_of("toy/s1/h", ObjectTrack(BOX, still, still), hands)
        made = hold_hands(PAIR, clip, AS_GENERATED)["left"]
        between = np.full((FRAMES, 778), np.inf)
        skin = track_vertices(made, PAIR["left"]).astype(np.float64)
        lower_capsules(*capsules_there(right, PAIR["right"]), skin, between, np.zeros((FRAMES, 778, 3)))
        depths_mm.append(-1000 * between[HELD].min(axis=1).mean())
    assert depths_mm[0] < depths_mm[1] - 1


class NoWayOut:
    """Depth without a slope, as half-way between two faces."""

    def distances(self, places_m: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full(places_m.shape[:2], -0.003), np.zeros(places_m.shape)


def test_normals_of_contacts_are_unit_ones_and_the_middle_of_a_thin_thing_has_none():
    """A capsule's axis along the middle of a slab, where what is interpolated has no slope, or a short one."""
    for thick_m in (0.006, 0.012, 0.03):
        slab = box_model((0.12, 0.12, thick_m))
        place = np.stack((0 * LIFT, 0 * LIFT, LIFT), 1).astype(np.float32)
        turn = np.tile(np.eye(3), (FRAMES, 1, 1))
        hand = pressed("right", place + np.array([0, 0, thick_m / 2]), thick_m / 2 + 0.008, 0.0, turn)
        thing = ObjectTrack(slab, np.zeros_like(place), place)
        clip = clip_of("toy/s1/i", thing, {"left": replace(hand, wrist_m=hand.wrist_m + 1), "right": hand})
        load = _Load.of(clip, 4)
        found = load._contacts(capsules_there(hand.take(load.frames), PAIR["right"]))
        assert len(found.frame)
        np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1, atol=1e-9)
        assert np.isfinite(load.carried([capsules_there(hand.take(load.frames), PAIR["right"])]))
        nowhere = replace(load, field=NoWayOut())
        assert not len(nowhere._contacts(capsules_there(hand.take(load.frames), PAIR["right"])).frame)


def test_a_hand_whose_shape_is_told_in_every_frame():
    clip = clip_of_box_at_rest()
    tracks = {side: replace(track, betas=np.repeat(track.betas, FRAMES, 0)) for side, track in clip.hands.items()}
    assert carried_share(PAIR, replace(clip, hands=tracks)) == 1
    made = hold_hands(PAIR, replace(clip, hands=tracks), AS_GENERATED)
    same = hold_hands(PAIR, clip, AS_GENERATED)
    np.testing.assert_allclose(made["right"].wrist_m, same["right"].wrist_m, atol=1e-6)


def clip_of_box_at_rest() -> Clip:
    """A hand on it, nothing in the air."""
    still, turn = np.zeros((FRAMES, 3), np.float32), np.tile(np.eye(3), (FRAMES, 1, 1))
    hand = pressed("right", still + np.array([0, 0, 0.03]), 0.004, 0.002, turn)
    away = replace(pressed("left", still + np.array([0, 0, 0.03]), 0.0, 0.0, turn), wrist_m=hand.wrist_m + 1)
    return clip_of("toy/s1/j", ObjectTrack(BOX, still, still), {"left": away, "right": hand})


def test_one_blas_thread_whatever_the_process_has(pushed, monkeypatch):
    """Several give other bits, and take many times as long."""
    threads = []

    def starts(*given):
        threads.append(max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"))
        return {}

    monkeypatch.setattr("hoidata.refinement.holding._starts", starts)
    with threadpool_limits(2, user_api="blas"):
        hold_clip(PAIR, pushed[0])
    assert set(threads) == {1}


def test_a_hold_is_drawn_out_once_not_at_every_try(pushed, monkeypatch):
    clip, tries = pushed[0], []

    def solved(pair, clip, starts, wishes, draw):
        tries.append({side: start.holds for side, start in starts.items()})
        return dict(clip.hands)

    monkeypatch.setattr("hoidata.refinement.holding._solved", solved)
    monkeypatch.setattr("hoidata.refinement.holding._Load.carried", lambda self, hands: 0.0)
    hold_hands(PAIR, clip, AS_GENERATED)
    assert len(tries) == len(HoldSettings().reach_m)
    wider = [sum(stop - start for start, stop in held["left"]) for held in tries[1:]]
    assert len(set(wider)) == 1


def test_frames_without_the_other_hand_do_not_push_this_one(pushed):
    clip = pushed[0]
    right, gone = clip.hands["right"], np.arange(FRAMES) < 22
    made = []
    for draw in (0, 1):
        nonsense = np.random.default_rng(draw).normal(size=(FRAMES, 3)).astype(np.float32)
        wrist = np.where(gone[:, None], clip.hands["left"].wrist_m + 0.02 * nonsense, right.wrist_m)
        hands = {**clip.hands, "right": replace(right, wrist_m=wrist, valid=~gone)}
        made.append(hold_hands(PAIR, replace(clip, hands=hands), AS_GENERATED)["left"])
        assert carried_share(PAIR, replace(clip, hands=hands)) <= 1
    assert made[0].wrist_m.tobytes() == made[1].wrist_m.tobytes()
    assert made[0].hand_pose.tobytes() == made[1].hand_pose.tobytes()


def test_a_hand_that_is_not_there_carries_nothing():
    """A slab in the air about the world's origin, where the numbers of an absent hand may lie."""
    place = np.stack((0 * LIFT, 0 * LIFT, LIFT - 0.2), 1).astype(np.float32)
    thing = ObjectTrack(box_model((0.1, 0.1, 0.02)), np.zeros_like(place), place)
    hand = pressed("right", place, 0.0, 0.0, np.tile(np.eye(3), (FRAMES, 1, 1)))
    for wrist in (hand.wrist_m, np.full_like(hand.wrist_m, np.nan)):
        absent = replace(hand, wrist_m=wrist, valid=np.arange(FRAMES) < 3)
        clip = clip_of("toy/s1/g", thing, {"left": replace(hand, valid=np.zeros(FRAMES, bool)), "right": absent})
        assert carried_share(PAIR, clip) == 0


def test_a_flat_lid_has_no_weight_and_stops_nothing():
    base = box_model((0.1, 0.1, 0.04))
    sheet = box_model((0.1, 0.1, 0.04))
    sheet = replace(sheet, vertices_m=sheet.vertices_m * [1, 1, 0] + [0, 0, 0.02])
    model = two_parts(base, sheet, (0, 1, 0))
    place = np.stack((0 * LIFT, 0 * LIFT, LIFT), 1).astype(np.float32)
    thing = ObjectTrack(model, np.zeros_like(place), place, np.zeros(FRAMES, np.float32))
    hand = pressed("right", place + np.array([0, 0, 0.02]), 0.001, 0.0, np.tile(np.eye(3), (FRAMES, 1, 1)))
    clip = clip_of("toy/s1/f", thing, {"left": replace(hand, wrist_m=hand.wrist_m + 1), "right": hand})
    scene = clip_scene(clip, PAIR)
    alone = clip_scene(replace(clip, object=ObjectTrack(base, thing.rotvec, place)), PAIR)
    np.testing.assert_allclose(scene.wrench, alone.wrench, atol=1e-9)
    assert 0 <= carried_share(PAIR, clip) <= 1


@pytest.mark.parametrize("wrong", [{"reach_m": (0.003, 0.012)}, {"reach_m": (), "keypoint_m": ()}])
def test_each_try_needs_a_reach_and_a_deviation(wrong):
    with pytest.raises(BadInput, match="as many of each"):
        HoldSettings(**wrong)


def test_only_holds_in_which_the_hinge_moves_are_passed():
    still = np.zeros((FRAMES, 3), np.float32)
    angle = np.interp(np.arange(FRAMES), [0, 24, 40, FRAMES], [0, 0, -0.8, -0.8]).astype(np.float32)
    thing = ObjectTrack(two_parts(BOX, BOX, (0, 1, 0)), still, still, angle)
    holds = [Interval(4, 14), Interval(20, 40)]
    passed = _passed(thing, holds)
    assert passed is not None
    assert np.flatnonzero(passed).tolist() == list(range(20, 40))
    assert _passed(thing, holds[:1]) is None
    assert _passed(ObjectTrack(BOX, still, still), holds) is None


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_a_correction_that_is_no_number_is_never_taken(pushed, monkeypatch):
    """A solver that diverges at once leaves numbers that are finite."""
    monkeypatch.setattr(
        "hoidata.refinement.hold_solver.solve_damped", lambda blocks, vector, damping: np.full_like(vector, np.nan)
    )
    for track in hold_hands(PAIR, pushed[0], AS_GENERATED).values():
        assert all(np.isfinite(array).all() for array in (track.wrist_m, track.global_orient, track.hand_pose))
