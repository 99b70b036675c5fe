"""Contact maps, adherence, slip, intersection volume and hand-hand penetration on motions with known values."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.optimize import lsq_linear

from hoidata.clips.clip import FPS, ObjectTrack
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.metrics import touch
from hoidata.metrics.evaluate import evaluate_store
from hoidata.objects.distance import volume_m3
from hoidata.objects.solid import patched_holes
from hoidata.physics.capsules import Capsules
from hoidata.physics.mano_capsules import hand_capsules
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from tests.builders.clips import with_hand, with_object
from tests.builders.objects import box_model, model_of, notebook

HANDS = load_embedded_hands()


def with_true(pair, touched):
    return replace(pair, contact=replace(pair.contact, touched=touched))


# --- maps


def test_precision_divides_by_generated_and_recall_by_reference_contact_and_f1_is_their_harmonic_mean(
    make_clip, pair_of
):
    clip = make_clip(6)
    pair = pair_of(clip, clip)
    touched = touch.touched_points(pair)
    count, half = int(touched.sum()), int(touched.sum()) // 2
    true = touched.copy()
    true[np.flatnonzero(touched)[:half]] = False
    true[np.flatnonzero(~touched)[: 2 * count]] = True
    pair = with_true(pair, true)
    precision, recall = (count - half) / count, (count - half) / (3 * count - half)
    assert touch.contact_precision(pair, 1) == pytest.approx([precision])
    assert touch.contact_recall(pair, 1) == pytest.approx([recall])
    assert touch.contact_f1(pair, 1) == pytest.approx([2 * precision * recall / (precision + recall)])


def test_one_empty_map_scores_zero_and_two_empty_maps_score_one(make_clip, moved, pair_of):
    clip = make_clip(6)
    pair = pair_of(moved(clip, (0.0, 0.0, 1.0)), clip)
    for measure in (touch.contact_f1, touch.contact_precision, touch.contact_recall):
        assert measure(pair, 1) == [0.0]
        assert measure(with_true(pair, np.zeros(256, bool)), 1) == [1.0]
        assert measure(with_true(pair_of(clip, clip), np.zeros(256, bool)), 1) == [0.0]


def test_adherence_compares_with_the_target_map_and_not_with_the_recorded_one(make_clip, pair_of):
    clip = make_clip(6)
    pair = pair_of(clip, clip)
    touched = touch.touched_points(pair)
    target = touched.copy()
    target[np.flatnonzero(touched)[::2]] = False
    n_target = int(target.sum())
    assert touch.adherence(replace(pair, target_contact=touched), 1) == [1.0]
    assert touch.adherence(replace(pair, target_contact=target), 1) == pytest.approx(
        [2 * n_target / (n_target + touched.sum())]
    )
    assert touch.adherence(with_true(replace(pair, target_contact=~touched), touched), 1) == [0.0]
    assert touch.adherence(with_true(replace(pair, target_contact=touched), ~touched), 1) == [1.0]
    assert len(touch.adherence(pair, 1)) == 0


# --- slip


def gliding(make_clip, pair_of, joints_of, track):
    """A pair with the given world joints (frame, 21, 3) of the right hand and the given object motion."""
    clip = replace(make_clip(track.n_frames), object=track)
    joints = np.asarray(joints_of, np.float64)
    pair = pair_of(clip, clip)
    return replace(pair, predicted=replace(pair.predicted, joints_m={"left": joints, "right": joints}))


def everywhere(place_m, n_frames=12):
    """(frame, 21, 3) all joints at one place."""
    return np.tile(np.array(place_m, np.float64), (n_frames, 21, 1))


def test_slip_is_the_speed_of_touching_joints_over_an_object_that_moves(make_clip, pair_of):
    time = np.arange(12) / FPS
    path = np.float32(0.1 * time[:, None] * [1, 0, 0])  # 10 cm/s
    joints = everywhere((0, 0, 0.031))
    joints[:, 5:, 2] += 0.5  # five joints touch
    still = np.zeros((12, 3), np.float32)
    moving = ObjectTrack(box_model(), still, path)
    glides = joints + path[:, None] + (0.03 * time)[:, None, None] * [0, 1, 0]
    values = touch.slip_cm_s(gliding(make_clip, pair_of, glides, moving), 1)
    assert values == pytest.approx(np.full(5 * 11, 3.0), abs=1e-3)
    assert touch.slip_cm_s(gliding(make_clip, pair_of, joints + path[:, None], moving), 1).max() < 1e-3
    lying = ObjectTrack(box_model(), still, still)
    assert len(touch.slip_cm_s(gliding(make_clip, pair_of, glides, lying), 1)) == 0


def test_a_hand_that_turns_with_the_object_or_goes_with_its_lid_does_not_slip(make_clip, pair_of):
    time = np.arange(12) / FPS
    still = np.zeros((12, 3), np.float32)
    turning = ObjectTrack(box_model(), np.float32(2 * time[:, None] * [0, 0, 1]), still)
    on_top = everywhere((0.04, 0.03, 0.031))
    values = touch.slip_cm_s(gliding(make_clip, pair_of, turning.world_from_object @ on_top, turning), 1)
    assert len(values) == 21 * 11
    assert values.max() < 1e-3
    opening = ObjectTrack(notebook(), still, still, np.float32(2 * time))
    on_lid = notebook().hinge.turn(opening.hinge_rad) @ everywhere((0.08, 0, 0.006))
    values = touch.slip_cm_s(gliding(make_clip, pair_of, on_lid, opening), 1)
    assert len(values) == 21 * 11
    assert values.max() < 1e-2
    slips = touch.slip_cm_s(gliding(make_clip, pair_of, everywhere((0.08, 0, 0.006)), opening), 1)
    assert slips[:21] == pytest.approx(np.full(21, 100 * 2 * np.hypot(0.08, 0.006)), rel=0.01)


# --- volume and depth


def in_the_palm(clip, model):
    """The object, still, where the right palm is in the first frame; the clip's hand holds still too."""
    hand = clip.hands["right"].take(np.zeros(clip.n_frames, int))
    capsules_of_hand = hand_capsules(hand, HANDS.right)
    middle = np.float32((capsules_of_hand.start_m[0, 1] + capsules_of_hand.end_m[0, 1]) / 2)
    still = np.zeros((clip.n_frames, 3), np.float32)
    return replace(with_hand(clip, "right", **vars(hand)), object=ObjectTrack(model, still, still + middle))


@pytest.mark.slow
def test_the_intersection_volume_of_an_enclosed_ball_is_its_own_and_of_an_enclosing_block_the_hand_s(
    make_clip, pair_of
):
    clip = make_clip(7)
    in_hand = in_the_palm(clip, model_of(trimesh.creation.icosphere(4, 0.006)))
    values = touch.penetration_volume_cm3(pair_of(in_hand, in_hand), 3)
    assert values == pytest.approx(np.full(3, 4 / 3 * np.pi * 0.6**3), rel=0.05)
    buried = in_the_palm(clip, box_model((0.6, 0.6, 0.6)))
    closed = patched_holes(track_vertices(buried.hands["right"], HANDS.right)[0].astype(float), HANDS.right.faces)
    assert touch.penetration_volume_cm3(pair_of(buried, buried), 3) == pytest.approx(
        np.full(3, 1e6 * volume_m3(*closed)), rel=0.01
    )
    far = with_object(in_hand, translation_m=in_hand.object.translation_m + np.float32(1))
    assert touch.penetration_volume_cm3(pair_of(far, far), 3).tolist() == [0.0] * 3


def test_penetration_of_a_ball_is_its_radius_less_the_distance_of_the_nearest_vertex(make_clip, pair_of):
    clip = in_the_palm(make_clip(6), model_of(trimesh.creation.icosphere(5, 0.04)))
    vertices = track_vertices(clip.hands["right"], HANDS.right)[0] - clip.object.translation_m[0]
    expected = 1000 * (0.04 - np.linalg.norm(vertices, axis=1).min())
    assert touch.penetration_mm(pair_of(clip, clip), 1) == pytest.approx(np.full(6, expected), abs=0.05)


# --- two hands


def capsules(start, end, radius) -> Capsules:
    """One frame of capsules (capsule, 3)."""
    return Capsules(np.array([start], float), np.array([end], float), np.array(radius, float))


@pytest.mark.parametrize(
    ("start", "end", "depth"),
    [
        ((-1, 0.3, 0.5), (1, 0.3, 0.5), 0.2),  # crosses at a distance of 0.3
        ((0, 0.2, 0), (0, 1.2, 0), 0.3),  # begins 0.2 above the middle
        ((0, 0.1, -5), (0, 0.1, 5), 0.4),  # parallel to it
        ((0, 0, 1.4), (0, 0, 3), 0.1),  # goes on where it ends
        ((0, 0.2, 0.5), (0, 0.2, 0.5), 0.3),  # a ball
        ((3, 0, 0), (4, 0, 0), 0.0),
    ],
)
def test_depth_of_two_capsules_is_the_sum_of_their_radii_less_the_distance_of_their_axes(start, end, depth):
    one, other = capsules([(0, 0, -1)], [(0, 0, 1)], [0.2]), capsules([start], [end], [0.3])
    assert touch.depth_m(one, other) == pytest.approx([depth])
    assert touch.depth_m(other, one) == pytest.approx([depth])


def test_axes_of_any_direction_are_as_far_apart_as_a_search_finds():
    draw = np.random.default_rng(3)
    for _ in range(20):
        a, b, c, d = draw.normal(size=(4, 3))
        values = 9 - touch.depth_m(capsules([a], [b], [4]), capsules([c], [d], [5]))
        along = lsq_linear(np.stack([b - a, c - d], axis=1), c - a, bounds=(0, 1)).x
        far = np.linalg.norm(a + along[0] * (b - a) - c - along[1] * (d - c))
        assert values == pytest.approx([far], abs=1e-6)


def test_hand_hand_penetration_is_measured_if_both_hands_act(make_clip, moved, pair_of):
    clip = make_clip(9, "both")
    apart = moved(clip, (0, 0, 0.5), ["left"])
    between = clip.hands["right"].wrist_m - clip.hands["left"].wrist_m
    hands = clip.hands | {"left": replace(clip.hands["left"], wrist_m=clip.hands["left"].wrist_m + between)}
    crossed = replace(clip, hands=hands)
    assert touch.hand_hand_mm(pair_of(apart, clip, "both"), 3).tolist() == [0.0] * 3
    assert touch.hand_hand_mm(pair_of(crossed, clip, "both"), 3).min() > 5
    assert len(touch.hand_hand_mm(pair_of(crossed, clip, "right"), 3)) == 0


# --- controls


def test_negative_controls_lower_the_expected_metrics(write_annotated, moved, tmp_path):
    """Hands 2 cm away, hands pressed in, hands that tremble, against the recorded clips themselves."""
    root, clips = write_annotated()
    draw = np.random.default_rng(0)

    def trembling(clip):
        hands = {
            side: replace(hand, wrist_m=hand.wrist_m + np.float32(draw.normal(0, 0.005, hand.wrist_m.shape)))
            for side, hand in clip.hands.items()
        }
        return replace(clip, hands=hands)

    def off_the_face(metres):
        return lambda clip: moved(clip, clip.object.world_from_object.turn(np.array([[0, 0, metres]]))[:, 0])

    changes = {"truth": lambda clip: clip, "away": off_the_face(0.02), "pressed": off_the_face(-0.01)}
    values = {}
    for name, change in (changes | {"trembling": trembling}).items():
        write_store(tmp_path / name, map(change, clips.values()), generated_info(name))
        values[name] = evaluate_store(tmp_path / name, root)["figures"]
    truth = values["truth"]
    assert values["away"]["contact_f1"] < 0.8 * truth["contact_f1"]
    assert values["away"]["contact_recall"] < 0.8
    assert values["pressed"]["penetration_mm"] > truth["penetration_mm"] + 5
    assert values["pressed"]["penetration_volume_cm3"] > truth["penetration_volume_cm3"] + 0.5
    assert values["trembling"]["jitter_m_s3"] > 3 * truth["jitter_m_s3"]
    assert values["trembling"]["slip_cm_s"] > 3 * truth["slip_cm_s"] + 1
