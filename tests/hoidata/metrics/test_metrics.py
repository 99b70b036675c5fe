"""Every metric on motions with known values."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.actions.action import action_numbers, learn_actions
from hoidata.clips.clip import FPS, HandTrack, ObjectTrack
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.metrics import motion, touch
from hoidata.metrics.evaluate import evaluate_store
from hoidata.metrics.registry import METRICS
from hoidata.metrics.unmeasured import NO_GRAVITY, NO_INSIDE, Unmeasured
from hoidata.objects.model import ObjectModel
from hoidata.physics.mano_capsules import hand_capsules
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from tests.builders.clips import with_object
from tests.builders.stores import BY_SUBJECT, write_annotated, write_clips

HALF_M = np.array([0.05, 0.04, 0.03])  # of the box of tests/conftest.py


def to_box_m(points):
    """Signed distance of points (..., 3) from the box's surface in closed form, metres, negative inside."""
    beyond = np.abs(points) - HALF_M
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def along_the_face(clip, depth_m):
    """(frame, 3) world shift that pushes a hand of ``make_clip`` into the box's top face."""
    return Rotation.from_rotvec(clip.object.rotvec).apply([0, 0, -depth_m])


# --- joints


def test_joint_error_is_the_length_of_a_shift_and_counts_left_and_right_apart(make_clip, moved, pair_of):
    clip = make_clip(6, "both")
    values = motion.joint_error_mm(pair_of(moved(clip, (0.003, 0.004, 0.0), ["left"]), clip, "both"), 1)
    assert values == pytest.approx(np.repeat([5.0, 0.0], 6), abs=1e-3)


def test_an_inactive_hand_changes_no_metric(make_clip, moved, pair_of):
    clip = make_clip(10)
    garbage = moved(clip, clip.object.translation_m - clip.hands["left"].wrist_m, ["left"])  # inside the box
    one, other = pair_of(clip, clip, table_m=-1.0), pair_of(garbage, clip, table_m=-1.0)
    for metric in METRICS:
        values, again = (metric.measure(pair, metric.frame_step) for pair in (one, other))
        assert values == again if isinstance(values, Unmeasured) else values.tolist() == again.tolist(), metric.name


def test_frames_without_the_hand_in_the_reference_are_not_measured(make_clip, moved, pair_of):
    clip = make_clip(9)
    valid = np.ones(9, bool)
    valid[2:5] = False
    lost = replace(clip, hands=clip.hands | {"right": replace(clip.hands["right"], valid=valid)})
    pair = pair_of(moved(clip, (0, 0, 0.001)), lost)
    assert len(motion.joint_error_mm(pair, 1)) == 6
    assert pair.frames("right", 3).tolist() == [0, 6]


def with_joints(pair, joints):
    """The pair with these right joints (frame, 21, 3) in the prediction, whose hand never turns."""
    hands = pair.predicted.clip.hands
    still = replace(hands["right"], global_orient=np.zeros_like(hands["right"].global_orient))
    clip = replace(pair.predicted.clip, hands=hands | {"right": still})
    return replace(pair, predicted=replace(pair.predicted, clip=clip, joints_m={"left": joints, "right": joints}))


def test_smoothness_is_a_known_acceleration_in_the_wrist_frame(make_clip, pair_of):
    clip = make_clip(8)
    time = np.arange(8) / FPS
    joints = np.zeros((8, 21, 3))
    joints += (2.0 * time**2)[:, None, None]  # the whole hand accelerates: the wrist frame goes along
    joints[:, 1:, 0] += 0.5 * 3.0 * time[:, None] ** 2
    values = motion.smoothness(with_joints(pair_of(clip, clip), joints), 1)
    assert values == pytest.approx([3.0 * 20 / 21])


def test_jitter_is_a_known_jerk_in_the_world(make_clip, pair_of):
    clip = make_clip(8)
    time = np.arange(8) / FPS
    joints = np.zeros((8, 21, 3))
    joints[..., 1] = (7.0 / 6 * time**3 + 5 * time**2)[:, None]
    values = motion.jitter_m_s3(with_joints(pair_of(clip, clip), joints), 1)
    assert values == pytest.approx(np.full(5, 7.0))


def test_object_jitter_is_a_known_jerk_of_its_centre_wherever_the_mesh_origin_is(make_clip, pair_of):
    """Turned about its middle an object has none, though its origin goes round."""
    clip, time = make_clip(20), np.arange(20) / FPS
    swing = np.stack([np.zeros(20), np.zeros(20), np.sin(9 * time)], 1)
    vertices_m = clip.object.model.vertices_m + np.array([0.1, 0, 0])
    middle, model = (vertices_m.min(0) + vertices_m.max(0)) / 2, replace(clip.object.model, vertices_m=vertices_m)
    path = np.stack([7.0 / 6 * time**3, 5 * time**2, time], 1)
    origin = path - Rotation.from_rotvec(swing).apply(middle)
    track = replace(clip.object, model=model, rotvec=swing.astype(np.float32), translation_m=origin.astype(np.float32))
    moving = replace(clip, object=track)
    values = motion.object_jitter_m_s3(pair_of(moving, moving), 1)
    assert values == pytest.approx(np.full(17, 7.0), abs=0.1)
    assert np.linalg.norm(np.diff(origin, n=3, axis=0), axis=1).max() * FPS**3 > 40


# --- contact and penetration


def test_penetration_is_the_depth_of_the_deepest_vertex_in_a_box(make_clip, moved, pair_of):
    clip, hands = make_clip(12), load_embedded_hands()
    deep = moved(clip, along_the_face(clip, 0.012))
    points = deep.object.world_from_object.inverse() @ track_vertices(deep.hands["right"], hands.right)
    expected = np.maximum(-to_box_m(points).min(axis=1), 0) * 1000
    assert expected.min() > 5
    assert touch.penetration_mm(pair_of(deep, clip), 1) == pytest.approx(expected, abs=1e-3)
    assert touch.penetration_mm(pair_of(deep, clip), 3) == pytest.approx(expected[::3], abs=1e-3)
    away = moved(clip, along_the_face(clip, -0.2))
    assert touch.penetration_mm(pair_of(away, clip), 1).tolist() == [0.0] * 12


def test_deep_share_counts_frames_deeper_than_ten_millimetres(make_clip, moved, pair_of):
    clip = make_clip(4)
    shifts = [along_the_face(clip, depth)[frame] for frame, depth in enumerate((0.005, 0.011, 0.02, -0.1))]
    pair = pair_of(moved(clip, np.array(shifts)), clip)
    depths = touch.penetration_mm(pair, 1)
    assert touch.deep_share(pair, 1).tolist() == (depths > 10).astype(float).tolist()
    assert 0 < touch.deep_share(pair, 1).mean() < 1


def test_an_object_without_an_inside_has_no_penetration_no_volume_and_no_realism(make_clip, pair_of):
    clip = make_clip(3)
    open_box = replace(clip.object.model, faces=clip.object.model.faces[:1], name="one triangle")
    clip = replace(clip, object=replace(clip.object, model=open_box))
    assert touch.penetration_mm(pair_of(clip, clip), 1) == NO_INSIDE
    assert touch.penetration_volume_cm3(pair_of(clip, clip), 1) == NO_INSIDE
    assert motion.realism_si(pair_of(clip, clip, table_m=-1.0), 1) == NO_INSIDE


def test_contact_distance_is_of_joints_in_contact_in_the_recording(make_clip, moved, pair_of):
    clip = make_clip(6)
    lifted = moved(clip, along_the_face(clip, -0.05))
    pair = pair_of(lifted, clip)
    motions = (pair.reference, pair.predicted)
    true, generated = (to_box_m(item.joints_in_object("right", np.arange(6))) for item in motions)
    touching = np.abs(true) < 0.02
    assert 0 < touching.sum() < touching.size
    assert touch.contact_distance_mm(pair, 1) == pytest.approx(1000 * np.abs(generated)[touching], abs=1e-3)
    assert len(touch.contact_distance_mm(pair_of(clip, lifted), 1)) == 0  # nothing touches in that truth


# --- forces


BOTTOM_M = 0.05


def on_a_hand(make_clip, fall_m_s2=0.0, hand_below_m=0.0):
    """A plate of 40 x 40 x 10 cm, its middle over a flat hand whose highest capsule reaches 6 mm into it."""
    mesh, n_frames = trimesh.creation.box((0.4, 0.4, 2 * BOTTOM_M)), 12
    model = ObjectModel("plate", mesh.vertices, mesh.faces, np.zeros(8, np.uint8))
    time = np.arange(n_frames) / FPS
    path = np.zeros((n_frames, 3), np.float32)
    path[:, 2] = -0.5 * fall_m_s2 * time**2
    zeros = np.zeros((n_frames, 3), np.float32)
    orient = np.tile(np.float32([np.pi / 2, 0, 0]), (n_frames, 1))
    hand = HandTrack(
        wrist_m=zeros,
        global_orient=orient,
        hand_pose=np.zeros((n_frames, 45), np.float32),
        betas=np.zeros((1, 10), np.float32),
        valid=zeros[:, 0] == 0,
    )
    capsules = hand_capsules(hand, load_embedded_hands().right)
    top = (np.maximum(capsules.start_m, capsules.end_m)[0, :, 2] + capsules.radius_m).max()
    middle = (capsules.start_m[0, :4] + capsules.end_m[0, :4]).mean(axis=0) / 2
    wrist = np.array([-middle[0], -middle[1], 0.006 - BOTTOM_M - top - hand_below_m]) + path
    clip = make_clip(n_frames)
    right = replace(hand, wrist_m=wrist.astype(np.float32))
    left = replace(hand, wrist_m=(wrist - np.array([0, 0, 9])).astype(np.float32))
    return replace(clip, hands={"left": left, "right": right}, object=ObjectTrack(model, zeros, path))


def test_a_plate_at_rest_on_a_hand_is_realistic_and_one_in_the_air_is_not(make_clip, pair_of):
    carried, floating = on_a_hand(make_clip), on_a_hand(make_clip, hand_below_m=0.5)
    for measure in (motion.realism_si, motion.realism_as_released):
        assert measure(pair_of(carried, floating, table_m=-1.0), 1).tolist() == [1.0] * 12
        assert measure(pair_of(floating, carried, table_m=-1.0), 1).tolist() == [0.0] * 12
    for floor in (motion.floor_si, motion.floor_as_released):
        assert floor(pair_of(carried, carried, table_m=-1.0), 1).tolist() == [0.0] * 12


def test_realism_without_hands_is_one_only_in_free_fall(make_clip, pair_of):
    """As released, gravity is ten times too small: an object that falls that slowly needs no hand."""
    free, slow = on_a_hand(make_clip, 9.81, 0.5), on_a_hand(make_clip, 0.98, 0.5)
    assert motion.floor_si(pair_of(free, free, table_m=-1.0), 1).all()
    assert not motion.floor_as_released(pair_of(free, free, table_m=-1.0), 1).any()
    assert not motion.floor_si(pair_of(slow, slow, table_m=-1.0), 1).any()
    # Its forward differences have nothing after the last two frames.
    assert motion.floor_as_released(pair_of(slow, slow, table_m=-1.0), 1)[:-2].all()


@pytest.mark.parametrize("lost", ["interpolated", "untracked"])
def test_frames_in_which_a_hand_is_not_measured_are_not_unrealistic(make_clip, pair_of, lost):
    clip = on_a_hand(make_clip)
    measured = np.arange(clip.n_frames) % 3 != 2
    if lost == "interpolated":
        frames = np.where(measured, clip.source_frames, clip.source_frames - 1).astype(np.int32)
        reference = replace(clip, source_frames=frames)
    else:
        reference = replace(clip, hands={side: replace(one, valid=measured) for side, one in clip.hands.items()})
    for measure in (motion.realism_si, motion.realism_every_frame):
        complete, partly = (measure(pair_of(clip, other, table_m=-1.0), 1) for other in (clip, reference))
        assert complete.all()
        assert partly.all()
        assert len(partly) == measured.sum() < len(complete) == clip.n_frames


def test_every_registered_metric_measures_what_its_name_says(make_clip, pair_of):
    """Motions on which the metrics of forces, meshes and derivatives all have different values."""

    def figures(pair):
        by_metric = {metric.name: metric.measure(pair, metric.frame_step) for metric in METRICS}
        # Without the last two frames, in which forward differences are undefined.
        inner = {name: values[:-2] if len(values) > 2 else values for name, values in by_metric.items()}
        return {name: float(values.mean()) for name, values in inner.items() if len(values)}

    on_hand, slow = on_a_hand(make_clip), on_a_hand(make_clip, 0.98, 0.5)
    carried = figures(pair_of(on_hand, on_hand, table_m=-1.0))
    alone = {name: value for name, value in figures(pair_of(slow, on_hand, table_m=-1.0)).items() if "realism" in name}
    assert (carried["realism_si"], carried["realism_released"], carried["realism_every_frame"]) == (1, 1, 1)
    floors = ("realism_si_floor", "realism_released_floor", "realism_every_frame_floor")
    assert [carried[name] for name in floors] == [0, 0, 0]
    assert alone == {
        "realism_every_frame": 0,
        "realism_every_frame_floor": 0,
        "realism_si": 0,
        "realism_si_floor": 0,
        "realism_released": 1,
        "realism_released_floor": 1,
    }
    assert 6 < carried["penetration_mm"] < 15
    assert carried["deep_share"] in (0, 1)
    assert carried["capsule_depth_mm"] < 6
    time = np.arange(12) / FPS
    joints = np.zeros((12, 21, 3))
    joints[:, 1:, 0] += 7.0 / 6 * time[:, None] ** 3
    moving = figures(with_joints(pair_of(on_hand, on_hand), joints))
    assert moving["jitter_m_s3"] == pytest.approx(7.0 * 20 / 21)
    assert moving["smoothness_m_s2"] == pytest.approx(7.0 * 20 / 21 * time[1:-1].mean())


def test_realism_is_scored_only_above_the_table_of_the_recording(make_clip, pair_of):
    carried = on_a_hand(make_clip)
    assert len(motion.realism_si(pair_of(carried, carried, table_m=-BOTTOM_M), 1)) == 0
    assert len(motion.realism_si(pair_of(carried, carried, table_m=-BOTTOM_M - 0.02), 1)) == 12
    assert len(motion.realism_si(pair_of(carried, carried, table_m=-BOTTOM_M - 0.02), 3)) == 4
    assert motion.realism_si(pair_of(carried, carried, table_m=None), 1) == NO_GRAVITY


def test_the_table_of_a_clip_that_is_cut_while_held_is_that_of_its_recording(make_clip, moved, tmp_path):
    carried = on_a_hand(make_clip)
    other_frame = np.diag([2.0, 2.0, 2.0, 1.0])

    def clip(name, recording, height_m, source_from_world=carried.source_from_world, plate="plate"):
        subject, low = name.split("/")[0], np.float32([0, 0, height_m])
        model = replace(carried.object.model, name=plate)
        track = replace(carried.object, model=model, translation_m=carried.object.translation_m + low)
        names = {"clip_id": f"toy/{name}", "subject": subject, "sequence": recording}
        return replace(moved(carried, low), object=track, source_from_world=source_from_world, **names)

    clips = [clip("s1/0", "other", -0.5), clip("s2/0", "another", -0.6)]
    clips += [clip("s3/0", "cut", 0), clip("s3/1", "cut", 0.1)]  # only the second is above the table
    clips += [clip("s3/2", "cut", 0.7, other_frame), clip("s3/3", "cut", -0.8, plate="another")]
    clips += [clip("s3/4", "same name", -0.9), clip("s4/0", "same name", 0.2)]
    root = write_annotated(tmp_path / "data", clips, rule=BY_SUBJECT | {"test": ["s3", "s4"]}, points=256)
    evaluation = evaluate_store(write_clips(tmp_path / "same", clips[2:]), root)
    assert evaluation["counts"]["realism_si"]["clips"] == 1
    assert evaluation["figures"]["realism_si"] == 1


def test_the_table_of_a_window_is_that_of_the_whole_recording(make_clip, tmp_path):
    carried = on_a_hand(make_clip)
    rises = replace(carried, object=replace(carried.object, translation_m=carried.object.translation_m.copy()))
    rises.object.translation_m[:2, 2] -= 0.1
    clip = replace(rises, clip_id="toy/s3", subject="s3")
    root = write_annotated(tmp_path / "data", [clip], points=256)
    window = replace(clip.take(slice(2, 10)), clip_id="toy/s3@2")
    windows = {"start": 2, "stride": 8, "frames": 8, "trimmed_end": 1}
    write_store(tmp_path / "window", [window], generated_info("predicted") | {"windows": windows})
    assert evaluate_store(tmp_path / "window", root)["figures"]["realism_si"] == 1


def test_every_frame_is_scored_and_the_table_carries_what_rests_on_it(make_clip, pair_of):
    alone, carried = on_a_hand(make_clip, hand_below_m=0.5), on_a_hand(make_clip)
    for table_m, passes in ((-BOTTOM_M, 1.0), (-BOTTOM_M - 0.02, 0.0)):
        pair = pair_of(alone, carried, table_m=table_m)
        assert motion.realism_every_frame(pair, 3).tolist() == [passes] * 4
        assert motion.floor_every_frame(pair_of(carried, carried, table_m=table_m), 3).tolist() == [passes] * 4
    assert motion.realism_every_frame(pair_of(carried, alone, table_m=-BOTTOM_M - 0.02), 1).all()
    assert motion.realism_every_frame(pair_of(carried, carried, table_m=None), 1) == NO_GRAVITY


def test_capsule_depth_is_how_far_capsules_reach_over_a_plane(make_clip, pair_of):
    carried = on_a_hand(make_clip)
    capsules = hand_capsules(carried.hands["right"], load_embedded_hands().right)
    depth = np.maximum(capsules.start_m, capsules.end_m)[0, :, 2] + capsules.radius_m + BOTTOM_M
    expected = 1000 * depth[depth > 0].mean()
    assert (depth > 0).sum() > 3
    assert motion.capsule_depth_mm(pair_of(carried, carried, table_m=-1.0), 1) == pytest.approx([expected], abs=1e-3)
    floating = on_a_hand(make_clip, hand_below_m=0.5)
    assert len(motion.capsule_depth_mm(pair_of(floating, carried, table_m=-1.0), 1)) == 0


def test_a_motion_is_evaluated_with_the_verb_of_its_reference(make_clip, pair_of):
    clip = make_clip(30)
    lifted = with_object(clip, translation_m=clip.object.translation_m + np.linspace(0, 0.5, 30)[:, None] * [0, 0, 1])
    untouched = np.zeros((2, 30), bool)
    lift, rest = (action_numbers(moved.object, np.array([0.0, 0.0, -1.0]), untouched) for moved in (lifted, clip))
    learnt = learn_actions({"lift": [lift] * 3, "pour": [rest] * 3})
    actions = replace(learnt, limits={"lift": {"end_rise_m": (0.35, 0.9)}})
    for predicted, verb, followed in ((lifted, "lift", [1.0]), (clip, "lift", [0.0]), (lifted, "juggle", [])):
        pair = replace(pair_of(predicted, clip), verb=verb, actions=actions)
        assert list_of(motion.action_followed(pair, 1)) == followed
    named = [
        motion.action_named(replace(pair_of(lifted, clip), verb=verb, actions=actions), 1)
        for verb in ("lift", "pour", "juggle", None)
    ]
    assert list(map(list_of, named)) == [[1.0], [0.0], [], []]
    assert named[2:] == [Unmeasured("no training clip has the verb"), Unmeasured("the clip has no verb")]


def list_of(values):
    return [] if isinstance(values, Unmeasured) else values.tolist()
