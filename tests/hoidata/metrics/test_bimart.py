"""BimArt's metrics on shapes and motions with known values; ``paper`` against an independent copy of the release."""

import itertools
from dataclasses import replace

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, ObjectTrack
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.metrics import bimart
from hoidata.metrics.evaluate import evaluate_store
from hoidata.metrics.optional_metrics import BIMART_METRICS, select_metrics
from hoidata.metrics.target_contact import (
    DISTANCES_NAME,
    TargetDistances,
    read_target_distances,
    write_target_distances,
)
from hoidata.objects.distance import is_closed
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from hoidata.surface.contact import HandInObjectFrame
from tests.builders.clips import clip_of, flat_hand
from tests.builders.objects import box_model, model_of, notebook, two_parts

RADIUS_M = 0.05
FACE_UP = Rotation.from_euler("x", 90, degrees=True).as_rotvec()


def under_the_hand(model, depths_m, reach_m, **facts):
    """A still right hand whose lowest vertex is so deep in an object that reaches ``reach_m`` above its origin."""
    n_frames = len(depths_m)
    hand = replace(flat_hand(np.zeros((n_frames, 3))), global_orient=np.tile(np.float32(FACE_UP), (n_frames, 1)))
    away = replace(hand, wrist_m=hand.wrist_m + np.float32([0, 0, 9]))
    vertices = track_vertices(hand, load_embedded_hands().right)[0]
    lowest = vertices[vertices[:, 2].argmin()]
    position_m = lowest - np.array([0, 0, 1]) * (reach_m - np.asarray(depths_m)[:, None])
    track = ObjectTrack(model, np.zeros((n_frames, 3), np.float32), position_m.astype(np.float32), **facts)
    return clip_of("toy/s1/a", track, {"left": away, "right": hand})


def ball():
    return model_of(trimesh.creation.icosphere(4, RADIUS_M), "ball")


# --- known values


def test_a_constant_acceleration_is_given_per_frame_and_per_second(make_clip, moved, pair_of):
    clip, time = make_clip(9), np.arange(9) / FPS
    still = moved(clip, 0)
    hand = replace(still.hands["right"], global_orient=np.tile(still.hands["right"].global_orient[:1], (9, 1)))
    path = np.zeros((9, 3))
    path[:, 0] = 0.5 * 3.0 * time**2
    accelerating = replace(clip, hands=clip.hands | {"right": replace(hand, wrist_m=path.astype(np.float32))})
    pair = pair_of(accelerating, clip)
    assert bimart.accel_paper(pair, 1) == pytest.approx(np.full(7, 100 * 3.0 / 900), abs=1e-4)
    assert bimart.accel_corrected(pair, 1) == pytest.approx(np.full(7, 3.0), abs=1e-3)
    doubled = replace(clip, source_frames=(np.arange(9) // 2).astype(np.int32))
    pair = pair_of(accelerating, doubled)  # 15 fps: frames 0, 2, 4, 6 and 8 were recorded
    assert bimart.accel_paper(pair, 1) == pytest.approx(np.full(3, 100 * 3.0 / 225), abs=1e-4)
    assert bimart.accel_corrected(pair, 1) == pytest.approx(np.full(3, 3.0), abs=1e-3)


def test_mul_is_the_mean_distance_of_all_pairs_of_motions(make_clip, moved, pair_of):
    clip = make_clip(5, "both")
    shifted = [pair_of(moved(clip, (shift, 0, 0)), clip, "both") for shift in (0, 0.03, 0.07)]
    assert np.mean(bimart.mul_cm(shifted, 1)) == pytest.approx((3 + 4 + 7) / 3, abs=1e-4)
    one_hand = [shifted[0], pair_of(moved(clip, (0, 0.03, 0), ["left"]), clip, "both")]
    assert bimart.mul_cm(one_hand, 1) == pytest.approx([1.5], abs=1e-4)
    assert len(bimart.mul_cm(shifted[:1], 1)) == 0


def test_a_sphere_at_known_depths_is_penetrated_and_touched_at_the_thresholds(pair_of):
    depths_mm = np.array([12, 9, 6, 4, -4, -6, -6, 13])
    clip = under_the_hand(ball(), depths_mm / 1000, RADIUS_M)
    pair = pair_of(clip, clip)
    for pen_1cm, pen_5mm in (
        (bimart.pen_1cm_paper, bimart.pen_5mm_paper),
        (bimart.pen_1cm_corrected, bimart.pen_5mm_corrected),
    ):
        assert pen_1cm(pair, 1).tolist() == [100, 0, 0, 0, 0, 0, 0, 100]
        assert pen_5mm(pair, 1).tolist() == [100, 100, 100, 0, 0, 0, 0, 100]
    # The ball does not move from the sixth frame to the seventh, and the last frame has no next.
    assert bimart.moves(clip.object).tolist() == [True] * 5 + [False, True, False]
    assert bimart.con_paper(pair, 1).tolist() == [100, 100, 100, 100, 100, 0]
    assert bimart.con_corrected(pair, 1).tolist() == [0, 100, 100, 100, 100, 0]
    assert bimart.con_everywhere_corrected(pair, 1).tolist() == [0, 100, 100, 100, 100, 0, 0, 0]


def test_art_needs_contact_with_the_moving_part(pair_of):
    angle = np.float32([0, 0.01, 0.02, 0.0205, 0.04, 0.06])
    wide = notebook()
    wide = replace(wide, vertices_m=wide.vertices_m * [1, 5, 1])  # the hand lies over one plate alone

    def art(middle_x_m):
        clip = under_the_hand(wide, np.full(6, 0.003), 0.005, hinge_rad=angle)
        vertices = track_vertices(clip.hands["right"], load_embedded_hands().right)[0]
        lowest = vertices[vertices[:, 2].argmin()]
        position_m = clip.object.translation_m.copy()
        position_m[:, 0] = lowest[0] - middle_x_m
        at_position = replace(clip, object=replace(clip.object, translation_m=position_m))
        pair = pair_of(at_position, at_position)
        return bimart.art_paper(pair, 1).tolist(), bimart.art_corrected(pair, 1).tolist()

    still = np.zeros((6, 3), np.float32)
    assert bimart.turns(ObjectTrack(wide, still, still, angle)).tolist() == [True, True, False, True, True, False]
    assert art(0.05) == ([100] * 4, [100] * 4)
    assert art(-0.95) == ([0] * 4, [0] * 4)


def test_corrected_metrics_treat_an_open_submesh_as_surface_without_inside(pair_of):
    """A plate whose top has corners in both parts: all that lies wholly in the moving part is its far side."""
    mesh = trimesh.creation.box((0.1, 0.5, 0.02))
    model = notebook()
    model = replace(model, vertices_m=np.array(mesh.vertices), faces=np.array(mesh.faces))
    model = replace(model, part=(model.vertices_m[:, 0] > 0).astype(np.uint8))
    released = bimart.shells(bimart.surface_index(model))[1].mesh.faces
    assert len(released) == 2
    assert len(model.faces_of(1)) == 2  # triangles with corners in both parts belong to neither
    clip = under_the_hand(model, np.full(4, 0.003), 0.01, hinge_rad=np.float32([0, 0.002, 0.004, 0.006]))
    pair = pair_of(clip, clip)
    # Centimetres away from those two triangles, outside their box, though before them on a line along x.
    assert bimart.art_paper(pair, 1).tolist() == [0, 0, 0]
    assert len(bimart.art_corrected(pair, 1)) == len(bimart.pen_1cm_corrected(pair, 1)) == 0


def cut_box(half_m):
    """A closed box about the origin, cut at x = 0: each part is open along the cut, and triangles span both."""
    mesh = trimesh.creation.box(2 * np.array(half_m)).subdivide().subdivide()
    mesh.apply_translation((0.001, 0, 0))  # no vertex lies in the plane of the cut
    part = (mesh.vertices[:, 0] > 0).astype(np.uint8)
    hinge = Hinge(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, half_m[2]]))
    model = ObjectModel("cut box", np.array(mesh.vertices), np.array(mesh.faces), part=part, hinge=hinge)
    assert not any(is_closed(model.faces_of(number)) for number in (0, 1))
    return model


def placed(points_m, hinge_rad):
    faces = np.zeros((0, 3), int)
    return HandInObjectFrame(points_m[None], np.zeros(1, int), np.array([hinge_rad]), faces=faces, n_frames=1)


def test_depth_as_released_takes_its_sign_from_the_whole_posed_mesh_though_each_part_is_open():
    model, random = cut_box((0.06, 0.05, 0.04)), np.random.default_rng(2)
    points = random.uniform(-0.08, 0.08, (400, 3))
    depth_m = bimart.whole_depth_m(placed(points, 0.0), model)[0]
    outside_by = np.abs(points - [0.001, 0, 0]) - [0.06, 0.05, 0.04]
    inside = (outside_by < 0).all(axis=1)
    assert 20 < inside.sum() < 380
    assert depth_m[inside] == pytest.approx(-outside_by[inside].max(axis=1))  # to the nearest face of the box
    assert depth_m[inside].max() > 0.02  # beyond all thresholds, and finite
    assert (depth_m[~inside] < 0).all()
    for angle in (-0.3, 0.4):
        depth_m = bimart.whole_depth_m(placed(points, angle), model)[0]
        posed = articulate(model.vertices_m, model.part, model.hinge, np.array([angle]))[0]
        expected = depth(points, posed, model.faces)
        near = expected > -0.02
        assert depth_m[near] == pytest.approx(expected[near], abs=1e-9)
        assert (depth_m[~near] <= -0.02).all()


def test_the_overlap_of_two_parts_is_outside_as_released():
    """Cubes of 4 cm, the second shifted by 3 cm along x: they share the slab from x = 1 cm to 2 cm."""
    cube, shifted = box_model((0.04, 0.04, 0.04)), box_model((0.04, 0.04, 0.04), middle_m=(0.03, 0, 0))
    model = two_parts(cube, shifted, (0, 0, 1))
    places = np.array([[0, 0.003, 0.001], [0.015, 0.003, 0.001], [0.044, 0.003, 0.001], [0.057, 0.003, 0.001]])
    depth_m = bimart.whole_depth_m(placed(places, 0.0), model)
    # 1 cm from the face at x = 1 cm; between the faces at 1 cm and 2 cm; 6 mm within, and 7 mm beyond x = 5 cm.
    assert depth_m[0] == pytest.approx([0.010, -0.005, 0.006, -0.007], abs=1e-9)


def test_an_object_without_hinge_has_no_art_and_one_at_rest_no_con(pair_of):
    clip = under_the_hand(ball(), np.zeros(4), RADIUS_M)
    pair = pair_of(clip, clip)
    for measure in (bimart.art_paper, bimart.art_corrected, bimart.con_paper, bimart.con_corrected):
        assert len(measure(pair, 1)) == 0


def test_shifted_hands_lose_contact_and_pressed_hands_keep_only_that_of_the_paper(make_clip, moved, pair_of):
    clip = make_clip(12, "both", articulated=True)
    normal = Rotation.from_rotvec(clip.object.rotvec).apply([0, 0, 1.0])

    def con(shift_m):
        pair = pair_of(moved(clip, shift_m * normal), clip, "both")
        return [measure(pair, 1).mean() for measure in (bimart.con_paper, bimart.con_corrected)]

    assert con(0.0) == [100, 100]
    assert con(0.03) == [0, 0]
    assert con(-0.03) == [100, 0]


def shaken(model, steps_m, hinge_rad=None):
    """An object whose place along x changes by (frame - 1,) steps."""
    position_m = np.zeros((len(steps_m) + 1, 3), np.float32)
    position_m[1:, 0] = np.cumsum(steps_m)
    return ObjectTrack(model, np.zeros_like(position_m), position_m, hinge_rad)


def test_a_still_object_with_the_noise_of_recordings_does_not_move_as_corrected_and_does_as_released():
    noise = 1e-3 * np.array([0.19, -0.31, 0.4, -0.4])
    assert not bimart.moves(shaken(ball(), noise)).any()
    assert (bimart.steps_m(shaken(ball(), noise))[:-1] > bimart.MOVED_AS_RELEASED_M).all()
    assert bimart.moves(shaken(ball(), [6e-4, -6e-4])).tolist() == [True, True, False]


def test_the_released_contact_counts_frames_in_which_a_vertex_moves_by_more_than_a_hundredth_of_a_millimetre(pair_of):
    clip = under_the_hand(ball(), np.full(4, 0.003), RADIUS_M)
    position_m = clip.object.translation_m.copy()
    position_m[:, 0] = np.float32(position_m[0, 0]) + np.float32([0, 1.5e-5, 2.2e-5, 4e-5])
    moved = replace(clip, object=replace(clip.object, translation_m=position_m))
    assert bimart.con_paper(pair_of(moved, moved), 1).tolist() == [100, 100]  # the second step is 7 um


def test_a_hinge_that_trembles_as_in_recordings_does_not_turn_and_one_that_turns_moves_the_object():
    tremble = np.float32([0, 0.0015, 0, 0.0019, 0.005])
    track = shaken(notebook(), np.zeros(4), tremble)
    assert bimart.turns(track).tolist() == [False, False, False, True, False]
    assert bimart.moves(track)[3]
    small = replace(notebook(), vertices_m=notebook().vertices_m / 10)  # 1 cm wide: its vertices move by 0.03 mm
    assert bimart.moves(shaken(small, np.zeros(4), tremble)).tolist() == [False, False, False, True, False]


# --- an independent implementation of the released definitions: other distances, other rays, loops


def released(vertices_m, track):
    """Pen 1 cm, Pen 5 mm, Con, Art in percent, Accel in cm per frame^2, of (frame, vertex, 3) hand vertices."""
    model, n_frames = track.model, len(vertices_m)
    whole, top, places = np.empty(n_frames), np.empty(n_frames), []
    wholly = model.faces[(model.part[model.faces] == 1).all(axis=1)]
    for frame in range(n_frames):
        local = model.vertices_m.copy()
        moving = model.part == 1
        rotation = Rotation.from_rotvec(model.hinge.axis * float(track.hinge_rad[frame]))
        local[moving] = rotation.apply(local[moving] - model.hinge.origin_m) + model.hinge.origin_m
        world = Rotation.from_rotvec(track.rotvec[frame]).apply(local) + track.translation_m[frame]
        places.append(world)
        whole[frame] = depth(vertices_m[frame], world, model.faces).max()
        top[frame] = depth(vertices_m[frame], world, wholly).max()
    moves = [np.linalg.norm(b - a, axis=1).max() > 1e-5 for a, b in itertools.pairwise(places)]
    turns = [abs(float(b) - float(a)) > 0.001 for a, b in itertools.pairwise(track.hinge_rad)]
    accel = [
        np.mean([np.linalg.norm(vertices_m[f + 1, v] - 2 * vertices_m[f, v] + vertices_m[f - 1, v]) for v in (0, 9)])
        for f in range(1, n_frames - 1)
    ]
    return {
        "bimart_pen_1cm_paper": 100 * np.mean(whole > 0.01),
        "bimart_pen_5mm_paper": 100 * np.mean(whole > 0.005),
        "bimart_con_paper": 100 * np.mean([whole[f] > -0.005 for f in range(n_frames - 1) if moves[f]]),
        "bimart_art_paper": 100 * np.mean([top[f] > -0.005 for f in range(n_frames - 1) if turns[f]]),
        "accel of two": 100 * np.mean(accel),
    }


def depth(points, vertices, faces):
    """Positive inside: parity of a slanted ray by Moeller and Trumbore, distance by libigl."""
    apart = np.sqrt(igl.point_mesh_squared_distance(points, vertices, np.asarray(faces, np.int64))[0])
    ray = np.array([0.31, -0.52, 0.79])
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    ab, ac = b - a, c - a
    side = np.cross(ray, ac)
    area = (ab * side).sum(axis=1)
    from_a = points[:, None] - a
    u = (from_a * side).sum(axis=2) / area
    across = np.cross(from_a, ab)
    v = across @ ray / area
    ahead = (across * ac).sum(axis=2) / area > 0
    hits = ((u >= 0) & (v >= 0) & (u + v <= 1) & ahead).sum(axis=1)
    return np.where(hits % 2 == 1, apart, -apart)


def test_paper_equals_an_independent_implementation_on_random_motions(pair_of, make_clip):
    random, hands = np.random.default_rng(5), load_embedded_hands()
    names = {metric.name: metric.measure for metric in BIMART_METRICS}
    measured = []
    for seed in range(3):
        clip = make_clip(14, "both", articulated=True, seed=seed)
        overlapping = replace(clip.object.model, vertices_m=clip.object.model.vertices_m * [1, 1.1, 1])
        hinge = np.cumsum(np.where(random.random(14) < 0.4, 0.0, random.normal(0, 0.05, 14))).astype(np.float32)
        still = random.random(14) < 0.3
        still[0] = False
        frames = np.maximum.accumulate(np.where(still, 0, np.arange(14)))  # some frames repeat the one before
        track = replace(clip.object.take(frames), model=overlapping, hinge_rad=hinge)
        shift = random.normal(0, 0.02, (14, 3)).astype(np.float32)
        moved = {s: replace(hand, wrist_m=hand.wrist_m[frames] + shift) for s, hand in clip.hands.items()}
        moving = replace(clip, object=track, hands=moved)
        pair = pair_of(moving, moving, "both")
        vertices = np.concatenate([track_vertices(moving.hands[s], hands[s]) for s in ("left", "right")], axis=1)
        expected = released(vertices.astype(np.float64), track)
        two = np.stack([vertices[:, 0], vertices[:, 9]], axis=1)
        second_differences = np.linalg.norm(np.diff(vertices.astype(np.float64), n=2, axis=0), axis=2)
        assert 100 * np.linalg.norm(np.diff(two, n=2, axis=0), axis=2).mean() == pytest.approx(
            expected.pop("accel of two")
        )
        assert names["bimart_accel_paper"](pair, 1).mean() == pytest.approx(100 * second_differences.mean())
        assert {name: names[name](pair, 1).mean() for name in expected} == pytest.approx(expected)
        measured.append(list(expected.values()))
    assert (np.ptp(measured, axis=0) > 0).any()
    assert 0 < np.mean(measured) < 100


# --- contact maps


def target_of(clip, off_m=0.0, hand_vertices=None):
    """The map that the clip's hands make at ten vertices of its box, off by so much."""
    used = np.arange(778) if hand_vertices is None else hand_vertices
    hands, model = load_embedded_hands(), clip.object.model
    vertex = np.arange(10) % len(model.vertices_m)
    points = clip.object.points_in_world(model.vertices_m, model.part)[:, vertex]
    turned = clip.object.world_from_object.rotation
    places = np.einsum("fji,fpj->fpi", turned, points - clip.object.translation_m[:, None])
    distance = np.stack(
        [
            np.linalg.norm(points[:, :, None] - track_vertices(clip.hands[s], hands[s])[:, None, used], axis=3).min(
                axis=2
            )
            for s in ("left", "right")
        ],
        axis=1,
    )
    return TargetDistances(places, distance + off_m, used.astype(np.int32))


def test_cm_is_the_distance_between_the_generated_and_the_target_map(make_clip, pair_of):
    clip = make_clip(6, "both", articulated=True)
    pair = replace(pair_of(clip, clip, "both"), target_distances=target_of(clip, 0.01))
    assert bimart.contact_map_error_paper(pair, 1) == pytest.approx(np.ones(12), abs=1e-4)
    few = target_of(clip, hand_vertices=np.arange(0, 778, 10))
    pair = replace(pair, target_distances=few)
    assert bimart.contact_map_error_corrected(pair, 1) == pytest.approx(np.zeros(12), abs=1e-4)
    assert (bimart.contact_map_error_paper(pair, 1) > 0.01).all()  # a map of few vertices is farther than one of all
    nothing = few._replace(distance_m=np.full_like(few.distance_m, np.nan))
    assert len(bimart.contact_map_error_paper(replace(pair, target_distances=nothing), 1)) == 0
    assert len(bimart.contact_map_error_paper(pair_of(clip, clip, "both"), 1)) == 0
    far = few._replace(distance_m=np.full_like(few.distance_m, 5.0))
    assert bimart.contact_map_error_corrected(replace(pair, target_distances=far), 1).max() < 20


def test_target_distances_survive_the_file_to_a_tenth_of_a_millimetre(make_clip, tmp_path):
    targets = {"a~0": target_of(make_clip(4)), "b~0": target_of(make_clip(7)), "a~1": target_of(make_clip(4), 0.01)}
    assert read_target_distances(tmp_path / "clips") == {}
    write_target_distances(tmp_path, targets)
    back = read_target_distances(tmp_path / "clips")
    assert list(back) == list(targets)
    for name, target in targets.items():
        assert np.abs(back[name].place_m - target.place_m).max() < 1.5e-4
        near = target.distance_m < 0.2
        assert np.abs(back[name].distance_m - target.distance_m)[near].max() < 1e-4
    wrong = np.load(tmp_path / DISTANCES_NAME)
    arrays = {name: wrong[name] for name in wrong.files}
    assert len(arrays["place_m"]) == 11  # motions for one path share them
    for spoilt in ({"first": arrays["first"][::-1]}, {"place_first": arrays["place_first"] + 8}):
        np.savez(tmp_path / DISTANCES_NAME, **(arrays | spoilt))
        with pytest.raises(BadInput, match="motion_id"):
            read_target_distances(tmp_path / "clips")


# --- computed on request


def test_optional_metrics_are_computed_only_on_request(write_annotated, moved, tmp_path):
    root, clips = write_annotated()
    predicted = [
        replace(moved(c, (0, 0.01 * k, 0)), clip_id=f"{c.clip_id}~{k}") for c in clips.values() for k in (0, 1)
    ]
    write_store(tmp_path / "two" / "clips", predicted, generated_info("predicted"))
    write_target_distances(tmp_path / "two", {clip.clip_id: target_of(clip) for clip in predicted})
    bimart_names = {metric.name for metric in BIMART_METRICS}
    plain = evaluate_store(tmp_path / "two" / "clips", root)
    assert not bimart_names & set(plain["figures"])
    evaluation = evaluate_store(tmp_path / "two" / "clips", root, metrics=select_metrics(["bimart"]))
    values, counts = evaluation["figures"], evaluation["counts"]
    assert {name: value for name, value in values.items() if name not in bimart_names} == plain["figures"]
    assert values["bimart_mul_cm"] == pytest.approx(1, abs=1e-4)
    assert counts["bimart_mul_cm"] == {"clips": 2, "motions": 2, "values": 2}
    assert counts["bimart_con_paper"] == {"clips": 2, "motions": 2, "values": 22}
    assert values["bimart_cm_paper"] == pytest.approx(0, abs=0.01)
    needs_hinge = {name for name in bimart_names if "_art_" in name}
    assert bimart_names - set(values) == needs_hinge
    with pytest.raises(BadInput, match="bimart"):
        select_metrics(["bimart", "omomo"])
    short = TargetDistances(*(array[:5] for array in target_of(predicted[1])))
    write_target_distances(tmp_path / "two", {predicted[1].clip_id: short})
    reasons = {item["clip_id"]: item["reason"] for item in evaluate_store(tmp_path / "two" / "clips", root)["left_out"]}
    assert "5 frames, not 12" in reasons[predicted[1].clip_id]
