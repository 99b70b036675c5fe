"""Contact refinement: hands that sink into a box are moved to its surface and keep their motion; carried objects."""

import os
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from threadpoolctl import threadpool_info, threadpool_limits

from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.contact.maps import f1_score
from hoidata.contact.proximity import ProximityIndex
from hoidata.datasets.base import RawTree
from hoidata.datasets.registry import get_adapter
from hoidata.errors import BadInput
from hoidata.geometry.intervals import Interval
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import HandPair, load_embedded_hands, load_mano_hands, track_joints, track_vertices
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import sample_points
from hoidata.objects.surface_index import surface_index
from hoidata.physics.realism import VARIANTS, score
from hoidata.physics.scene import capsules_or_nan, clip_scene
from hoidata.refinement import carried_fraction, refine_grasps
from hoidata.refinement.contact import _passed, field_contacts
from hoidata.refinement.grasp_solver import spline_weights
from hoidata.refinement.kernels import lower_capsules
from hoidata.refinement.object_field import ObjectField
from hoidata.surface.contact import deepest_m, hand_in_object_frame
from tests.builders.clips import DOWN, clip_of
from tests.builders.objects import box_model, two_parts

PAIR = load_embedded_hands()
FRAMES = 44
# Standard deviations of the constant and of the changing error: wrist (3), metres, and finger joints (45), radians.
WRIST_AND_FINGERS = np.repeat([[0.006, 0.08], [0.004, 0.05]], (3, 45), axis=1)
BOX = box_model((0.06, 0.30, 0.06))
HELD, LIFT = slice(12, 36), np.interp(np.arange(FRAMES), [0, 14, 30, FRAMES], [0, 0, 0.2, 0.2])


def flat(side: Side) -> HandTrack:
    """A hand at the origin, one frame, mean pose."""
    pose, zero = PAIR[side].mean_pose.astype(np.float32)[None], np.zeros((1, 3), np.float32)
    return HandTrack(zero, zero, pose, betas=np.zeros((1, 10), np.float32), valid=np.ones(1, bool))


def pressed(side: Side, top_m: np.ndarray, inside_m: float, wobble_m: float, rotation: np.ndarray) -> HandTrack:
    """A hand that comes from 10 cm above, presses on the top of an object, slides on it, and leaves.

    top_m: (frame, 3) centre of the top, world. inside_m: depth of the lowest skin. wobble_m: amplitude of the sliding.
    rotation: (frame, 3, 3) of the object.
    """
    rest_hand, frames = flat(side), np.arange(len(top_m))
    skin = track_vertices(rest_hand, PAIR[side])[0].astype(np.float64)
    height_m = np.interp(frames, [0, 10, 37, FRAMES], [0.1, 0, 0, 0.1])
    sway_m = wobble_m * np.sin(frames[:, None] / 3.0) * [1.0, 1.0, 0]
    local_m = np.array([*-skin.mean(axis=0)[:2], -skin[:, 2].min() - inside_m]) + sway_m
    local_m[:, 2] += height_m
    wrist_m = top_m + (rotation @ local_m[..., None])[..., 0]
    return HandTrack(
        wrist_m=wrist_m.astype(np.float32),
        global_orient=rotmat_to_rotvec(rotation).astype(np.float32),
        hand_pose=np.repeat(rest_hand.hand_pose, len(frames), 0),
        betas=rest_hand.betas,
        valid=np.ones(len(frames), bool),
    )


@pytest.fixture(scope="module")
def pushed() -> tuple[Clip, dict[Side, HandTrack]]:
    """Two hands 12 mm inside the top of a rising, rotating box, sliding by 4 mm on it; and the refined hands."""
    rotation = rotvec_to_rotmat(
        np.interp(np.arange(FRAMES), [0, 9, 38, FRAMES], [0, 0, 0.5, 0.5])[:, None] * [0, 0, 1.0]
    )
    position_m = np.stack((0 * LIFT, 0 * LIFT, LIFT), 1)
    object_track = ObjectTrack(BOX, rotmat_to_rotvec(rotation).astype(np.float32), position_m.astype(np.float32))
    hands = {}
    for side, y in zip(SIDES, (-0.08, 0.08), strict=True):
        top = position_m + (rotation @ np.array([0, y, 0.03]))
        hands[side] = pressed(side, top, 0.012, 0.004, rotation)
    clip = clip_of("toy/s1/a", object_track, hands)
    return clip, refine_grasps(PAIR, clip).hands


def in_object(clip: Clip, side: Side, track: HandTrack) -> np.ndarray:
    return clip.object.world_from_object.inverse() @ track_vertices(track, PAIR[side]).astype(np.float64)


def depth_mm(model: ObjectModel, points_m: np.ndarray) -> np.ndarray:
    return 1000 * surface_index(model).depth_m(points_m, None).max(axis=1)


def test_a_hand_inside_the_object_is_moved_to_its_surface_and_keeps_its_motion_on_it(pushed):
    clip, refined = pushed
    for side in SIDES:
        before, after = in_object(clip, side, clip.hands[side]), in_object(clip, side, refined[side])
        steps_m = [np.diff(skin[HELD], axis=0) for skin in (before, after)]
        assert np.linalg.norm(steps_m[0], axis=-1).max() > 0.001
        np.testing.assert_allclose(steps_m[1], steps_m[0], atol=2e-4)
        assert depth_mm(BOX, before)[HELD].min() > 7
        assert 0.5 < depth_mm(BOX, after)[HELD].max() < 3.5
        assert depth_mm(BOX, after).max() < 5  # also while it comes and leaves
        assert np.linalg.norm(after - before, axis=-1).mean() < 0.02


def bending(track: HandTrack) -> HandTrack:
    """The track with an index finger that bends and opens 1.5 times a second."""
    pose = track.hand_pose.copy()
    pose[:, 2] += 0.3 * np.sin(2 * np.pi * 1.5 * np.arange(FRAMES) / 30)
    return replace(track, hand_pose=pose)


def test_a_finger_that_bends_in_a_grasp_keeps_its_swing(pushed):
    clip, _ = pushed
    bent = replace(clip, hands={side: bending(track) for side, track in clip.hands.items()})
    refined = refine_grasps(PAIR, bent).hands
    for side in SIDES:
        swings = [np.ptp(track.hand_pose[HELD, 2]) for track in (bent.hands[side], refined[side])]
        assert swings[1] > 0.8 * swings[0] > 0.4
        assert depth_mm(BOX, in_object(clip, side, refined[side]))[HELD].mean() < 5


def test_a_hand_is_unchanged_far_from_its_grasp(pushed):
    clip, refined = pushed
    for side in SIDES:
        change_m = np.linalg.norm(refined[side].wrist_m - clip.hands[side].wrist_m, axis=1)
        assert max(change_m[0], change_m[-1]) < 0.005
        acceleration = [np.abs(np.diff(track.wrist_m, 2, axis=0)).max() for track in (clip.hands[side], refined[side])]
        assert acceleration[1] < acceleration[0] + 0.005


def test_hands_without_contact_and_invalid_frames_are_unchanged(pushed):
    clip, _ = pushed
    away = {side: replace(track, wrist_m=track.wrist_m + np.float32(1)) for side, track in clip.hands.items()}
    refined = refine_grasps(PAIR, replace(clip, hands=away)).hands
    for side in SIDES:
        for name in ("wrist_m", "global_orient", "hand_pose"):
            assert np.array_equal(getattr(refined[side], name), getattr(away[side], name))
    valid = np.arange(FRAMES) < 30
    absent_from_30 = replace(clip, hands={side: replace(track, valid=valid) for side, track in clip.hands.items()})
    for side, track in refine_grasps(PAIR, absent_from_30).hands.items():
        assert np.array_equal(track.hand_pose[30:], clip.hands[side].hand_pose[30:])
        assert not np.array_equal(track.hand_pose[12:30], clip.hands[side].hand_pose[12:30])


def opening(middle_m: float) -> tuple[Clip, RigidTransform]:
    """A right hand pressed on an opening lid at ``middle_m`` from the hinge, and the lid's motion."""
    base, lid = (box_model((0.4, 0.4, 0.01), middle_m=(x, 0, 0)) for x in (-0.2, 0.2))
    model = two_parts(base, lid, (0, 1, 0))
    angle = np.interp(np.arange(FRAMES), [0, 14, 34, FRAMES], [0, 0, -0.8, -0.8])
    still = np.zeros((FRAMES, 3), np.float32)
    object_track = ObjectTrack(model, still, still, angle.astype(np.float32))
    world_from_lid = model.object_from_part(1, angle)
    top = (world_from_lid @ np.tile([middle_m, 0, 0.005], (FRAMES, 1, 1)))[:, 0]
    hands: dict[Side, HandTrack] = {
        "left": pressed("left", top + 1.0, 0.0, 0.0, np.tile(np.eye(3), (FRAMES, 1, 1))),
        "right": pressed("right", top, 0.006, 0.003, world_from_lid.rotation),
    }
    return clip_of("toy/s1/b", object_track, hands), world_from_lid


def test_a_hand_across_the_hinge_avoids_the_part_it_does_not_grasp(monkeypatch):
    clip, world_from_lid = opening(0.04)

    def skin_near_base(track: HandTrack) -> float:
        skin = track_vertices(track, PAIR.right)[HELD].astype(np.float64)
        field, frames = ObjectField(clip.object), np.arange(FRAMES)[HELD]
        return float((field.distances(skin, frames, 0)[0] < 0.01).mean())

    avoiding = refine_grasps(PAIR, clip).hands["right"]
    monkeypatch.setattr("hoidata.refinement.contact._passed", lambda object_track, grasps: None)
    unchanged = refine_grasps(PAIR, clip).hands["right"]
    assert skin_near_base(unchanged) > 0.03
    assert skin_near_base(avoiding) < 0.6 * skin_near_base(unchanged)
    on_lid = world_from_lid.inverse() @ track_vertices(avoiding, PAIR.right).astype(np.float64)
    assert -0.003 < on_lid[20, :, 2].min() - 0.005 < 0.001


def test_equal_input_gives_equal_bytes_and_a_clip_without_weight_is_refined(pushed):
    clip, refined = pushed
    corners, sheet = BOX.vertices_m * [1, 1, 0], clip.object
    paper = replace(clip, object=replace(sheet, model=replace(BOX, name="sheet", vertices_m=corners)))
    assert all(np.isfinite(track.wrist_m).all() for track in refine_grasps(PAIR, paper).hands.values())
    again, floating = (
        refine_grasps(PAIR, clip).hands,
        refine_grasps(PAIR, replace(clip, gravity=None)).hands,
    )
    for side in SIDES:
        assert again[side].wrist_m.tobytes() == refined[side].wrist_m.tobytes()
        assert np.isfinite(floating[side].hand_pose).all()
    assert (clip.gravity == DOWN).all()


def test_a_grasp_has_one_control_point_and_weights_sum_to_one():
    grasps = [(12, 36)]
    weights = spline_weights(FRAMES, grasps)  # pyright: ignore[reportArgumentType]
    assert weights.sum(axis=1) == pytest.approx(1)
    assert weights[12:36].max(axis=1) == pytest.approx(1)
    assert len(set(weights[12:36].argmax(axis=1))) == 1
    assert (weights[:6].max(axis=1) < 0.9).all()


def test_a_hand_that_grasps_at_two_positions_is_not_averaged_over_them():
    frames, still = np.arange(FRAMES), np.zeros((FRAMES, 3), np.float32)
    rotation = np.tile(np.eye(3), (FRAMES, 1, 1))
    y_m = np.interp(frames, [0, 16, 22, FRAMES], [-0.1, -0.1, 0.1, 0.1])
    track = pressed("right", np.stack((0 * y_m, y_m, 0.03 + 0 * y_m), 1), 0.001, 0.0, rotation)
    lift_m = np.interp(frames, [0, 15, 19, 23, FRAMES], [0, 0, 0.02, 0, 0])
    track = replace(track, wrist_m=(track.wrist_m + lift_m[:, None] * [0, 0, 1]).astype(np.float32))
    away = replace(track, wrist_m=track.wrist_m + 1)
    clip = clip_of("toy/s1/e", ObjectTrack(BOX, still, still), {"left": away, "right": track})
    refined = refine_grasps(PAIR, clip).hands["right"]
    for start, stop in ((11, 15), (25, 36)):
        assert abs(refined.wrist_m - track.wrist_m)[start:stop, 1].max() < 0.01


def test_skin_is_not_attracted_through_the_other_hand():
    """The right hand hovers where the left hand is attracted to, and moves too fast for a grasp."""
    position_m, rotation = np.zeros((FRAMES, 3)), np.tile(np.eye(3), (FRAMES, 1, 1))
    left = pressed("left", position_m + np.array([0, 0, 0.03]), -0.004, 0.0, rotation)
    over = 0.02 * np.sin(np.arange(FRAMES))[:, None] * [1.0, 0, 0] + [0, 0, 0.018]
    right = pressed("right", position_m + np.array([0, 0, 0.03]), -0.01, 0.0, rotation)
    right = replace(right, wrist_m=(right.wrist_m + over).astype(np.float32))
    still = np.zeros((FRAMES, 3), np.float32)
    depths_mm = []
    for hands in ({"left": left, "right": right}, {"left": left, "right": replace(right, wrist_m=right.wrist_m + 1)}):
        clip = clip_of("toy/s1/h", ObjectTrack(BOX, still, still), hands)
        refined = refine_grasps(PAIR, clip).hands["left"]
        between = np.full((FRAMES, 778), np.inf)
        skin = track_vertices(refined, PAIR["left"]).astype(np.float64)
        lower_capsules(*capsules_or_nan(right, PAIR["right"]), skin, between, np.zeros((FRAMES, 778, 3)))
        depths_mm.append(-1000 * between[HELD].min(axis=1).mean())
    assert depths_mm[0] < depths_mm[1] - 1


class ZeroGradientField:
    """Depth with zero gradient, as half-way between two faces."""

    def distances(self, points_m: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full(points_m.shape[:2], -0.003), np.zeros(points_m.shape)


def test_contact_normals_are_unit_vectors_and_the_centre_of_a_slab_has_no_contact():
    """The axis of a capsule is in the centre of a slab, where the interpolated gradient is short or zero."""
    for thick_m in (0.006, 0.012, 0.03):
        slab = box_model((0.12, 0.12, thick_m))
        position_m = np.stack((0 * LIFT, 0 * LIFT, LIFT), 1).astype(np.float32)
        rotation = np.tile(np.eye(3), (FRAMES, 1, 1))
        hand = pressed("right", position_m + np.array([0, 0, thick_m / 2]), thick_m / 2 + 0.008, 0.0, rotation)
        object_track = ObjectTrack(slab, np.zeros_like(position_m), position_m)
        clip = clip_of("toy/s1/i", object_track, {"left": replace(hand, wrist_m=hand.wrist_m + 1), "right": hand})
        assert np.isfinite(carried_fraction(PAIR, clip))
        frames = np.array([18, 24, 30, 40])
        capsules = capsules_or_nan(hand.take(frames), PAIR["right"])
        contacts = field_contacts(ObjectField(object_track), capsules, frames)
        assert len(contacts.frame)
        np.testing.assert_allclose(np.linalg.norm(contacts.normal, axis=1), 1, atol=1e-9)
        without_gradient = field_contacts(ZeroGradientField(), capsules, frames)  # pyright: ignore[reportArgumentType]
        assert not len(without_gradient.frame)


def test_a_hand_with_a_shape_per_frame_is_refined():
    clip = clip_of_box_at_rest()
    tracks = {side: replace(track, betas=np.repeat(track.betas, FRAMES, 0)) for side, track in clip.hands.items()}
    assert carried_fraction(PAIR, replace(clip, hands=tracks)) == 1
    refined = refine_grasps(PAIR, replace(clip, hands=tracks)).hands
    expected = refine_grasps(PAIR, clip).hands
    np.testing.assert_allclose(refined["right"].wrist_m, expected["right"].wrist_m, atol=1e-6)


def clip_of_box_at_rest() -> Clip:
    """A hand on a box that is never lifted."""
    still, rotation = np.zeros((FRAMES, 3), np.float32), np.tile(np.eye(3), (FRAMES, 1, 1))
    hand = pressed("right", still + np.array([0, 0, 0.03]), 0.004, 0.002, rotation)
    away = replace(pressed("left", still + np.array([0, 0, 0.03]), 0.0, 0.0, rotation), wrist_m=hand.wrist_m + 1)
    return clip_of("toy/s1/j", ObjectTrack(BOX, still, still), {"left": away, "right": hand})


def test_refinement_uses_one_blas_thread(pushed, monkeypatch):
    """Several threads give other bits, and take many times as long."""
    threads = []

    def grasps(*arguments):
        threads.append(max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"))
        return []

    monkeypatch.setattr("hoidata.refinement.contact._grasps", grasps)
    with threadpool_limits(2, user_api="blas"):
        refine_grasps(PAIR, pushed[0])
    assert set(threads) == {1}


def test_invalid_frames_of_the_other_hand_have_no_effect(pushed):
    clip = pushed[0]
    right, is_absent = clip.hands["right"], np.arange(FRAMES) < 22
    refined = []
    for seed in (0, 1):
        noise = np.random.default_rng(seed).normal(size=(FRAMES, 3)).astype(np.float32)
        wrist_m = np.where(is_absent[:, None], clip.hands["left"].wrist_m + 0.02 * noise, right.wrist_m)
        hands = {**clip.hands, "right": replace(right, wrist_m=wrist_m, valid=~is_absent)}
        refined.append(refine_grasps(PAIR, replace(clip, hands=hands)).hands["left"])
        assert carried_fraction(PAIR, replace(clip, hands=hands)) <= 1
    assert refined[0].wrist_m.tobytes() == refined[1].wrist_m.tobytes()
    assert refined[0].hand_pose.tobytes() == refined[1].hand_pose.tobytes()


def test_an_invalid_hand_carries_nothing():
    """A slab in the air at the world's origin, where an invalid hand may be stored."""
    position_m = np.stack((0 * LIFT, 0 * LIFT, LIFT - 0.2), 1).astype(np.float32)
    object_track = ObjectTrack(box_model((0.1, 0.1, 0.02)), np.zeros_like(position_m), position_m)
    hand = pressed("right", position_m, 0.0, 0.0, np.tile(np.eye(3), (FRAMES, 1, 1)))
    for wrist_m in (hand.wrist_m, np.full_like(hand.wrist_m, np.nan)):
        absent = replace(hand, wrist_m=wrist_m, valid=np.arange(FRAMES) < 3)
        clip = clip_of("toy/s1/g", object_track, {"left": replace(hand, valid=np.zeros(FRAMES, bool)), "right": absent})
        assert carried_fraction(PAIR, clip) == 0


def test_a_flat_lid_has_no_weight_and_does_not_fail():
    base = box_model((0.1, 0.1, 0.04))
    sheet = box_model((0.1, 0.1, 0.04))
    sheet = replace(sheet, vertices_m=sheet.vertices_m * [1, 1, 0] + [0, 0, 0.02])
    model = two_parts(base, sheet, (0, 1, 0))
    position_m = np.stack((0 * LIFT, 0 * LIFT, LIFT), 1).astype(np.float32)
    object_track = ObjectTrack(model, np.zeros_like(position_m), position_m, np.zeros(FRAMES, np.float32))
    hand = pressed("right", position_m + np.array([0, 0, 0.02]), 0.001, 0.0, np.tile(np.eye(3), (FRAMES, 1, 1)))
    clip = clip_of("toy/s1/f", object_track, {"left": replace(hand, wrist_m=hand.wrist_m + 1), "right": hand})
    scene = clip_scene(clip, PAIR)
    alone = clip_scene(replace(clip, object=ObjectTrack(base, object_track.rotvec, position_m)), PAIR)
    np.testing.assert_allclose(scene.wrench, alone.wrench, atol=1e-9)
    assert 0 <= carried_fraction(PAIR, clip) <= 1


def test_the_other_part_passes_only_in_grasps_in_which_the_hinge_moves():
    still = np.zeros((FRAMES, 3), np.float32)
    angle = np.interp(np.arange(FRAMES), [0, 24, 40, FRAMES], [0, 0, -0.8, -0.8]).astype(np.float32)
    object_track = ObjectTrack(two_parts(BOX, BOX, (0, 1, 0)), still, still, angle)
    holds = [Interval(4, 14), Interval(20, 40)]
    passed = _passed(object_track, holds)
    assert passed is not None
    assert np.flatnonzero(passed).tolist() == list(range(20, 40))
    assert _passed(object_track, holds[:1]) is None
    assert _passed(ObjectTrack(BOX, still, still), holds) is None


@pytest.mark.parametrize(("shift_m", "fraction"), [(0.0, 1.0), (1.0, 0.0)])
def test_the_carried_fraction_is_1_in_a_firm_grasp_0_without_hands_and_1_for_an_object_at_rest(shift_m, fraction):
    """Two palms press on opposite sides of a box in the air."""
    position_m = np.stack((0 * LIFT, 0 * LIFT, LIFT), 1)
    still, hands = np.zeros((FRAMES, 3), np.float32), {}
    for side, sign in zip(SIDES, (-1, 1), strict=True):
        rotation = np.tile(rotvec_to_rotmat(np.array([-sign * np.pi / 2, 0, 0])), (FRAMES, 1, 1))
        top = position_m + np.array([shift_m, sign * 0.05, 0])
        hand = pressed(side, top, 0.01, 0.0, rotation)
        hands[side] = replace(hand, wrist_m=(top + hand.wrist_m[20] - top[20]).astype(np.float32))
    clip = clip_of("toy/s1/c", ObjectTrack(box_model((0.1, 0.1, 0.1)), still, position_m.astype(np.float32)), hands)
    assert carried_fraction(PAIR, clip) == fraction
    realism = score(clip_scene(clip, PAIR), VARIANTS["SI"])
    assert carried_fraction(PAIR, clip) == pytest.approx(realism.passed.mean(), abs=0.3)
    resting = replace(clip, object=replace(clip.object, translation_m=still))
    assert carried_fraction(PAIR, resting) == 1


def recordings(name: str, count: int) -> tuple[list[Clip], HandPair]:
    """Some recorded clips of at most 150 frames."""
    root = Path(os.environ[f"HOIDATA_{name.upper()}"])
    hands = load_mano_hands(root / "hand") if name == "arctic" else PAIR
    adapter, clips = get_adapter(name, **({"clips": "segments"} if name == "arctic" else {})), list[Clip]()
    keys = list(adapter.sequences(root))
    for key in keys[:: max(1, len(keys) // (8 * count))]:
        with suppress(BadInput):  # many recordings of ManipNet have no hands
            loaded = [clip for clip in adapter.load(RawTree(root), key, hands) if isinstance(clip, Clip)]
            clips += [clip.take(np.arange(min(clip.n_frames, 150))) for clip in loaded[len(loaded) // 2 :][:1]]
    return clips[:count], hands


def perturbed(clip: Clip, random: np.random.Generator) -> Clip:
    """Hands with a constant and a slowly changing error (``WRIST_AND_FINGERS``)."""
    hands = {}
    for side, track in clip.hands.items():
        noise = gaussian_filter1d(random.normal(size=(clip.n_frames, 48)), 8, axis=0, mode="nearest")
        error = random.normal(size=48) * WRIST_AND_FINGERS[0] + noise / noise.std() * WRIST_AND_FINGERS[1]
        wrist_m, hand_pose = track.wrist_m + error[:, :3], track.hand_pose + error[:, 3:]
        hands[side] = replace(track, wrist_m=wrist_m.astype(np.float32), hand_pose=hand_pose.astype(np.float32))
    return replace(clip, hands=hands)


def touched_points(clip: Clip, hands: HandPair) -> np.ndarray:
    """(1024,) bool."""
    points = sample_points(clip.object.model, 1024)
    index, touched = ProximityIndex(points), np.zeros(1024, bool)
    for side in SIDES:
        track = clip.hands[side]
        if track.valid.any():
            near = index.entries(track_joints(track, hands[side]), track.valid, clip.object, 0.02)
            touched[near["point"]] = True
    return touched


@pytest.mark.long
@pytest.mark.parametrize("name", ["manipnet", "arctic"])
def test_perturbed_recordings_keep_contact_and_finger_motion_and_lose_penetration(name):
    if f"HOIDATA_{name.upper()}" not in os.environ:
        pytest.skip(f"HOIDATA_{name.upper()} is not set: the recordings are not in this repository")
    clips, hands = recordings(name, 6)
    random, f1, swings, deep = np.random.default_rng(0), [], [], []
    for clip in clips:
        true, coarse = touched_points(clip, hands), perturbed(clip, random)
        both = coarse, refine_grasps(hands, coarse)
        f1.append([f1_score(touched_points(one, hands), true) for one in both])
        swings.append([np.mean([np.std(one.hands[side].hand_pose, axis=0).mean() for side in SIDES]) for one in both])
        index = surface_index(clip.object.model)
        depths_m = [[deepest_m(hand_in_object_frame(one, side, hands), index) for side in SIDES] for one in both]
        deep.append([float((np.nan_to_num(np.array(depth)) > 0.01).mean()) for depth in depths_m])
    f1, swings, deep = (np.mean(rows, axis=0) for rows in (f1, swings, deep))
    assert f1[1] > f1[0] - 0.02
    assert swings[1] > 0.8 * swings[0]
    assert deep[1] < 0.5 * deep[0]
