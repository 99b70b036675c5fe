"""CAMS's figures on bodies whose forces and arms are known, and ``paper`` beside the released ones written anew."""

from dataclasses import replace

import igl
import numpy as np
import pytest
import trimesh
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, ObjectTrack
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.metrics import cams
from hoidata.metrics.cams import Contacts, Masses
from hoidata.metrics.unmeasured import NO_GRAVITY, Unmeasured
from tests.builders.clips import clip_of, flat_hand
from tests.builders.objects import box_model, model_of, notebook, two_parts

NONE = Contacts(np.zeros((0, 3)), np.zeros((0, 3)))
DOWN = np.array([0.0, 0.0, -1.0])
THREE = np.arange(3)
LYING = Rotation.from_euler("x", 90, degrees=True).as_rotvec()


def on_the_hand(model, path_m, hand_below_m=0.0, **facts):
    """An object that moves along (frame, 3) with a lying right hand, whose upper 8 mm are in its underside."""
    n_frames = len(path_m)
    hand = replace(flat_hand(np.zeros((n_frames, 3))), global_orient=np.tile(np.float32(LYING), (n_frames, 1)))
    vertices = track_vertices(hand, load_embedded_hands().right)[0]
    top = vertices[:, 2].max()
    upper = vertices[vertices[:, 2] > top - 0.008, :2]
    under = [*(upper.min(axis=0) + upper.max(axis=0)) / 2, top - 0.008 + hand_below_m]
    low = model.vertices_m[:, 2].min()
    place = np.asarray(path_m) + under - np.array([0, 0, low])
    right = replace(hand, wrist_m=np.asarray(path_m, np.float32))
    away = replace(hand, wrist_m=right.wrist_m - np.float32([0, 0, 9]))
    track = ObjectTrack(model, np.zeros((n_frames, 3), np.float32), place.astype(np.float32), **facts)
    return clip_of("toy/s1/a", track, {"left": away, "right": right})


def falling(metres_per_s2, n_frames=6):
    path = np.zeros((n_frames, 3))
    path[:, 2] = -0.5 * metres_per_s2 * (np.arange(n_frames) / FPS) ** 2
    return path


# --- penetration


def test_penetration_is_the_share_of_vertices_deep_in_a_known_box_added_up_over_parts(make_clip, moved, pair_of):
    clip = make_clip(5)
    inward = Rotation.from_rotvec(clip.object.rotvec).apply([0, 0, -0.02])
    deep = moved(clip, inward)
    local = deep.object.world_from_object.inverse() @ track_vertices(deep.hands["right"], load_embedded_hands().right)
    share = ((np.array([0.05, 0.04, 0.03]) - np.abs(local)).min(axis=2) > 0.005).mean(axis=1)
    assert share.min() > 0
    pair = pair_of(deep, clip)
    assert cams.pen_paper(pair, 1) == pytest.approx(share)
    assert cams.pen_corrected(pair, 1) == pytest.approx(share)
    box = clip.object.model  # twice the same solid, as two parts that lie in each other
    twice = replace(deep, object=replace(deep.object, model=two_parts(box, box, (1, 0, 0)), hinge_rad=np.zeros(5)))
    assert cams.pen_paper(pair_of(twice, twice), 1) == pytest.approx(2 * share)
    assert cams.pen_corrected(pair_of(twice, twice), 1) == pytest.approx(share)


# --- forces


def test_a_body_needs_its_weight_its_acceleration_and_the_moment_of_both():
    time = np.arange(3)[:, None, None] / FPS
    places = np.array([[0.2, 0, 0], [0.4, 0, 0]]) + 0.5 * np.array([0, 0, 2.0]) * time**2
    wrench = cams.needed_wrenches({0: Masses(places, np.array([0.5, 0.5]))}, THREE, FPS**2, 9.81 * DOWN, np.zeros(3))
    assert wrench[0] == pytest.approx([0, 0, 11.81, 0, -0.3 * 11.81, 0])


def test_six_points_move_as_an_even_solid_does():
    """A bar of 1 kg, 0.3 x 0.1 x 0.1 m, that turns at w: the moment its turning faster takes is I dw/dt."""
    bar = box_model((0.3, 0.1, 0.1))
    time = np.arange(3) * 1e-3
    turn = np.zeros((3, 3))
    turn[:, 2] = 0.5 * 4.0 * time**2
    (body,) = cams.even_masses(ObjectTrack(bar, turn, np.zeros((3, 3)))).values()
    wrench = cams.needed_wrenches({0: body}, THREE, 1e6, np.zeros(3), np.zeros(3))
    assert wrench[0] == pytest.approx([0, 0, 0, 0, 0, (0.3**2 + 0.1**2) / 12 * 4.0], rel=1e-3, abs=1e-9)


def test_a_lid_that_nothing_holds_lacks_its_moment_about_the_hinge():
    """Two plates of half a kilogram; the base stands on the table, the lid's middle is 5 cm from the axis along y."""
    track = ObjectTrack(notebook(), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3))
    bodies = cams.even_masses(track)
    assert [body.mass_kg.sum() for body in bodies.values()] == pytest.approx([0.5, 0.5])
    wanted = cams.needed_wrenches(bodies, THREE, FPS**2, 9.81 * DOWN, np.zeros(3))
    feet = np.array([[x, y, -0.005] for x in (-0.1, 0.1) for y in (-0.05, 0.05)])
    table = [Contacts(feet, np.tile(DOWN, (4, 1))), NONE]
    axis = np.array([[0, y, 0] for y in np.linspace(-0.05, 0.05, 11)])
    assert cams.residual(wanted, [NONE, NONE], table, axis, np.zeros(3)) == pytest.approx(0.5 * 9.81 * 0.05)
    finger = Contacts(np.array([[0.05, 0, -0.005]]), DOWN[None])
    assert cams.residual(wanted, [NONE, finger], table, axis, np.zeros(3)) == pytest.approx(0, abs=1e-6)
    above = Contacts(np.array([[0.05, 0, 0.005]]), -DOWN[None])
    assert cams.residual(wanted, [NONE, above], table, axis, np.zeros(3)) == pytest.approx(0.5 * 9.81 * 0.05)
    nothing = cams.residual(wanted, [NONE, NONE], [NONE, NONE], np.zeros((0, 3)), np.zeros(3))
    assert nothing == pytest.approx(np.linalg.norm(wanted))


def test_a_plate_on_a_hand_is_carried_and_one_in_the_air_only_by_the_papers_table(pair_of):
    plate = box_model((0.2, 0.4, 0.02))
    held, floating = (on_the_hand(plate, falling(0), below) for below in (0.0, 0.5))

    def of(clip, table_m=-9.0):
        pair = pair_of(clip, clip, table_m=table_m)
        return [
            found if isinstance(found, Unmeasured) else found.tolist()
            for found in (cams.con_paper(pair, 1), cams.con_corrected(pair, 1))
        ]

    assert of(held) == [[1] * 4, [1] * 4]
    assert of(floating) == [[1] * 4, [0] * 4]
    lowest = float(floating.object.translation_m[0, 2]) - 0.01
    assert of(floating, lowest)[1] == [1] * 4
    assert of(on_the_hand(plate, falling(9.81), 0.5))[1] == [1] * 4  # what falls freely needs nothing
    assert of(held, None) == [NO_GRAVITY, NO_GRAVITY]


def test_frames_without_a_hand_and_made_ones_are_not_asked_who_carries(pair_of):
    """A plate on a hand that goes down at 6 m/s^2, and the same recorded at 15 fps and doubled.

    Second differences over made frames would be of 12 m/s^2.
    """
    plate = box_model((0.2, 0.4, 0.02))
    clip = on_the_hand(plate, falling(6.0, 9))
    doubled = between_every_two(clip)
    gone = replace(clip.hands["right"], valid=np.arange(9) < 5)
    left = replace(clip, hands=clip.hands | {"right": gone})

    def con(own):
        pair = pair_of(own, own, table_m=-9.0)
        return cams.con_paper(pair, 1).tolist(), cams.con_corrected(pair, 1).tolist()

    assert con(clip) == ([1] * 7, [1] * 7)
    assert con(doubled) == ([1] * 3, [1] * 3)
    assert con(left) == ([1] * 4, [1] * 4)  # frames 1 to 4


def test_a_plate_that_falls_faster_than_freely_is_not_carried_at_any_frame_rate(pair_of):
    clip = on_the_hand(box_model((0.2, 0.4, 0.02)), falling(9.81 + 1.0, 9))
    for own, frames in ((clip, 7), (between_every_two(clip), 3)):
        assert cams.con_corrected(pair_of(own, own, table_m=-9.0), 1).tolist() == [0] * frames


def between_every_two(clip):
    """The clip as a doubled recording: every second frame is the mean of its neighbours."""
    frames = np.arange(clip.n_frames)
    before, after = frames // 2 * 2, (frames + 1) // 2 * 2

    def mean(rows):
        return (rows[before] + rows[after]) / np.float32(2)

    hands = {side: replace(hand, wrist_m=mean(hand.wrist_m)) for side, hand in clip.hands.items()}
    thing = replace(clip.object, translation_m=mean(clip.object.translation_m))
    return replace(clip, hands=hands, object=thing, source_frames=(frames // 2).astype(np.int32), source_fps=15.0)


# --- arms about the hinge


def test_the_arm_of_a_contact_is_that_of_the_edges_of_its_cone():
    contact = Contacts(np.array([[0.1, 0, 0.0]]), np.array([[0, 0, 1.0]]))
    arm = 0.1 / np.sqrt(1 + 0.35**2)
    assert cams.arm_range(contact, np.array([0, 1.0, 0]), np.zeros(3)) == pytest.approx((arm, arm))
    sideways = cams.arm_range(contact, np.array([0, 0, 1.0]), np.zeros(3))
    assert sideways == pytest.approx((-0.35 * arm, 0.35 * arm))
    assert cams.arm_range(NONE, np.array([0, 0, 1.0]), np.zeros(3)) == (0, 0)


def test_both_parts_must_be_touched_to_turn_them_against_each_other(make_clip, pair_of):
    """A hand under both plates of a book pushes them up, one each way about the hinge; under one plate it does not."""
    plates = [trimesh.creation.box((0.1, 0.1, 0.01)).apply_translation((x, 0, 0)) for x in (-0.05, 0.05)]
    for _ in range(3):
        plates = [plate.subdivide() for plate in plates]
    book = two_parts(*map(model_of, plates), (0, 1, 0))
    angle = np.float32([0, 1e-4, 2e-4, 0.01, 0.02])

    def art(shift_m):
        clip = on_the_hand(book, np.zeros((5, 3)), hinge_rad=angle)
        place = clip.object.translation_m + np.float32([shift_m, 0, 0])
        own = replace(clip, object=replace(clip.object, translation_m=place))
        pair = pair_of(own, own)
        return cams.art_paper(pair, 1).tolist(), cams.art_corrected(pair, 1).tolist()

    assert art(0.0) == ([1] * 4, [1] * 2)
    trembles = on_the_hand(book, np.zeros((3, 3)), hinge_rad=np.float32([0, 0.0015, 0]))  # as a recorded hinge at rest
    pair = pair_of(trembles, trembles)
    assert (len(cams.art_paper(pair, 1)), len(cams.art_corrected(pair, 1))) == (2, 0)
    assert art(0.12) == ([0] * 4, [0] * 2)
    clip = on_the_hand(book, np.zeros((5, 3)), hinge_rad=angle)
    for own in (
        replace(clip, source_frames=np.int32([0, 0, 1, 1, 2])),  # frames 1 and 3 are made
        replace(clip, hands=clip.hands | {"right": replace(clip.hands["right"], valid=np.arange(5) % 2 == 0)}),
    ):
        pair = pair_of(own, own)
        assert (cams.art_paper(pair, 1).tolist(), cams.art_corrected(pair, 1).tolist()) == ([1] * 2, [1])


# --- the released definitions, written anew


def test_paper_is_what_the_release_gives_on_random_motions(pair_of, make_clip):
    random, hands = np.random.default_rng(3), load_embedded_hands()
    parts = [model_of(trimesh.creation.icosphere(2, 0.04)), box_model((0.05, 0.06, 0.07), middle_m=(0, -0.07, 0))]
    model = two_parts(*parts, (1, 0, 0), (0, -0.035, -0.03))
    seen = []
    for seed in range(2):
        clip = make_clip(8, "both", articulated=True, seed=seed)
        shift = random.normal(0, 0.008, (8, 3)).astype(np.float32)
        moved = {s: replace(hand, wrist_m=hand.wrist_m + shift) for s, hand in clip.hands.items()}
        own = replace(clip, hands=moved, object=replace(clip.object, model=model))
        pair = pair_of(own, own, "both", table_m=0.0)
        scene = [_placed(own, hands, frame) for frame in range(8)]
        assert cams.pen_paper(pair, 1).mean() == pytest.approx(
            np.mean([(depth > 0.005).sum() for _, _, depths, _ in scene for depth in depths]) * 2 / (2 * 778)
        )
        carried = [_carried(scene[frame - 1 : frame + 2], pair, frame) for frame in range(1, 7)]
        turned = [_turned(scene[frame], own, frame) for frame in range(7)]
        assert cams.con_paper(pair, 1).tolist() == carried
        assert cams.art_paper(pair, 1).tolist() == turned
        seen += [np.mean(carried), np.mean(turned), cams.pen_paper(pair, 1).mean()]
    assert len(set(seen)) > 2


def _placed(clip, hands, frame):
    """World vertices and normals by part, depths of all hand vertices in each part, and the hand vertices."""
    track, model = clip.object, clip.object.model
    hand = np.concatenate([track_vertices(clip.hands[s], hands[s])[frame] for s in ("left", "right")]).astype(float)
    vertices, normals, depths = [], [], []
    for part in (0, 1):
        faces = model.faces[(model.part[model.faces] == part).all(axis=1)]
        mesh = trimesh.Trimesh(model.vertices_m, faces, process=False)
        turn = Rotation.from_rotvec(model.hinge.axis * float(track.hinge_rad[frame]) * part)
        pose = Rotation.from_rotvec(track.rotvec[frame])
        mesh.vertices = pose.apply(turn.apply(mesh.vertices - model.hinge.origin_m) + model.hinge.origin_m)
        mesh.vertices = mesh.vertices + track.translation_m[frame]
        own = model.part == part
        vertices.append(np.array(mesh.vertices[own]))
        normals.append(_normals(np.array(mesh.vertices), faces)[own])
        apart = np.sqrt(igl.point_mesh_squared_distance(hand, np.array(mesh.vertices), faces)[0])
        depths.append(np.where(igl.fast_winding_number(np.array(mesh.vertices), faces, hand) > 0.5, apart, -apart))
    return vertices, normals, depths, hand


def _normals(vertices, faces):
    found = np.zeros_like(vertices)
    for face in faces:
        corners = vertices[face]
        found[face] += np.cross(corners[1] - corners[0], corners[2] - corners[0])
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)


def _touched(scene, part):
    vertices, normals, depths, hand = scene
    near = [np.linalg.norm(vertices[part] - point, axis=1).argmin() for point in hand[depths[part] > -0.002]]
    return [(vertices[part][v], normals[part][v]) for v in sorted(set(near))]


def _edges(normal):
    """The release draws the two tangents; ours are these."""
    first = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.7 else [0, 1.0, 0])
    first = first / np.linalg.norm(first)
    return [0.35 * sign * way - normal for way in (first, np.cross(normal, first)) for sign in (1, -1)]


def _carried(scenes, pair, frame):
    track, (before, now, after) = pair.predicted.clip.object, (scene[0] for scene in scenes)
    about, columns, wanted = track.translation_m[frame].astype(float), [], []
    for part in (0, 1):
        force = after[part] - 2 * now[part] + before[part] - DOWN
        wanted += [*force.sum(axis=0), *np.cross(now[part] - about, force).sum(axis=0)]
        pushes = [(place, edge) for place, normal in _touched(scenes[1], part) for edge in _edges(normal)]
        pushes += [
            (p, e)
            for c in cams._table(pair, frame, DOWN, None)[part : part + 1]
            for p in c.point_m
            for e in _edges(DOWN)
        ]
        for place, edge in pushes:
            column = np.zeros(12)
            column[6 * part : 6 * part + 6] = [*edge, *np.cross(place - about, edge)]
            columns.append(column)
    for point in cams._hinge_points(track, frame):
        for way in (*np.eye(3), *-np.eye(3)):
            wrench = [*way, *np.cross(point - about, way)]
            columns.append(np.array([*(-np.array(wrench)), *wrench]))
    found = lsq_linear(np.array(columns).T, np.array(wanted), (0, np.inf), method="bvls", max_iter=5000)
    return float(np.linalg.norm(found.fun) < 0.01)


def _turned(scene, clip, frame):
    model, track = clip.object.model, clip.object
    pose = Rotation.from_rotvec(track.rotvec[frame])
    axis, origin = pose.apply(model.hinge.axis), pose.apply(model.hinge.origin_m) + track.translation_m[frame]
    reach = []
    for part in (0, 1):
        arms = np.linalg.norm(np.cross(scene[0][part] - origin, axis), axis=1)
        moments = [
            np.dot(np.cross(place - origin, edge / np.linalg.norm(edge)), axis)
            for place, normal in _touched(scene, part)
            for edge in _edges(normal)
        ]
        reach.append([(min(moments, default=0)) / arms.mean(), max(moments, default=0) / arms.mean()])
    (base_low, base_high), (lid_low, lid_high) = reach
    return float((base_high > 0.3 and lid_low < -0.3) or (base_low < -0.3 and lid_high > 0.3))
