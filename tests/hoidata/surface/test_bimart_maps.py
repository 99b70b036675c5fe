"""BimArt's maps against brute force in the world, world motion, mirroring, hinges, and the cost of storing them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips import SIDES, Clip, ObjectTrack
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.objects.sampling import sample_points
from hoidata.surface.contact import HandInObjectFrame, hand_in_object_frame
from hoidata.surface.measure import BEYOND, REACH_M, STEP_M, bimart_map, packed_map
from tests.builders.clips import MIRROR, in_another_world, mirror_image, with_object

POINTS = 200


@pytest.fixture(params=[False, True], ids=["rigid", "articulated"])
def scene(request, make_clip):
    """A clip in which both hands hold the box (the lid turns by more than half a circle), its vertices and points."""
    clip = make_clip(8, hand_type="both", articulated=request.param, seed=4)
    if request.param:
        angles = np.linspace(-1.4, 2.2, clip.n_frames)
        clip = with_object(clip, hinge_rad=angles)
    hands = load_embedded_hands()
    vertices = {side: track_vertices(clip.hands[side], hands[side]).astype(np.float64) for side in SIDES}
    return clip, vertices, sample_points(clip.object.model, POINTS)


def placed(track: ObjectTrack, vertices: np.ndarray, valid: np.ndarray | None = None) -> HandInObjectFrame:
    """World vertices as the object sees them."""
    frames = np.arange(len(vertices)) if valid is None else np.flatnonzero(valid)
    hinge = None if track.hinge_rad is None else track.hinge_rad[frames]
    return HandInObjectFrame(
        vertices_m=(track.world_from_object.inverse() @ vertices.astype(np.float64))[frames],
        frames=frames,
        hinge_rad=hinge,
        faces=np.zeros((0, 3), int),
        n_frames=len(vertices),
    )


def map_of(track: ObjectTrack, vertices: np.ndarray, points, valid: np.ndarray | None = None) -> np.ndarray:
    return bimart_map(placed(track, vertices, valid), points, track.model)


def world_points(track: ObjectTrack, points) -> np.ndarray:
    """(frame, point, 3) float64, from the definitions of a hinge and a pose."""
    placed = []
    for frame in range(track.n_frames):
        local = points.points_m.astype(np.float64).copy()
        if track.model.hinge is not None:
            moves, hinge = points.part == 1, track.model.hinge
            rotation = Rotation.from_rotvec(np.asarray(hinge.axis) * track.hinge_rad[frame])
            local[moves] = rotation.apply(local[moves] - hinge.origin_m) + hinge.origin_m
        pose = Rotation.from_rotvec(np.asarray(track.rotvec[frame], np.float64))
        placed.append(pose.apply(local) + track.translation_m[frame])
    return np.array(placed)


def brute_force(track: ObjectTrack, vertices: np.ndarray, points) -> np.ndarray:
    """(frame, point) distance to the nearest vertex, float64, in the world; infinite beyond the reach."""
    placed = world_points(track, points)
    rows = zip(placed, vertices, strict=True)
    nearest = np.array([np.linalg.norm(p[:, None] - v[None], axis=2).min(axis=1) for p, v in rows])
    return np.where(nearest <= REACH_M, nearest, np.inf)


def moved(clip: Clip) -> Clip:
    return in_another_world(clip, Rotation.from_rotvec((0.4, -1.1, 0.7)), np.array((1.0, -2.0, 0.5)))


def turns(clip: Clip) -> np.ndarray:
    """(frame, 3, 3) that take row vectors of the object's frame to the world."""
    return Rotation.from_rotvec(clip.object.rotvec).as_matrix().transpose(0, 2, 1)


def in_object(clip: Clip, places_m: np.ndarray) -> np.ndarray:
    return (places_m - clip.object.translation_m[:, None]) @ turns(clip).transpose(0, 2, 1)


def test_map_is_the_distance_to_the_nearest_hand_vertex(scene):
    clip, vertices, points = scene
    for side in SIDES:
        truth = brute_force(clip.object, vertices[side], points)
        assert np.isfinite(truth).sum() > POINTS
        np.testing.assert_allclose(map_of(clip.object, vertices[side], points), truth, atol=1e-6)
        hand = hand_in_object_frame(clip, side, load_embedded_hands())
        np.testing.assert_allclose(bimart_map(hand, points, clip.object.model), truth, atol=1e-6)


@pytest.mark.parametrize("changed", [moved, mirror_image], ids=["another world", "mirror"])
def test_map_is_unchanged_in_another_world_and_in_a_mirror(scene, changed):
    """The mirrored right hand is a left one, before a mirrored object that turns and folds the other way round."""
    clip, vertices, points = scene
    other, flip = changed(clip), MIRROR if changed is mirror_image else np.ones(3)
    other_points = replace(points, points_m=(points.points_m * flip).astype(np.float32))
    for side in SIDES:
        mirrored_m = other.object.translation_m[:, None] + (in_object(clip, vertices[side]) * flip) @ turns(other)
        before, after = map_of(clip.object, vertices[side], points), map_of(other.object, mirrored_m, other_points)
        np.testing.assert_array_equal(np.isfinite(before), np.isfinite(after))
        np.testing.assert_allclose(before, after, atol=1e-6)


def test_frames_without_the_hand_are_beyond_and_do_not_count(scene):
    clip, vertices, points = scene
    valid = np.arange(clip.n_frames) % 3 != 0
    whole = map_of(clip.object, vertices["right"], points)
    part = map_of(clip.object, vertices["right"], points, valid)
    np.testing.assert_array_equal(part[valid], whole[valid])
    assert np.isinf(part[~valid]).all()
    assert np.isinf(map_of(clip.object, vertices["right"], points, np.zeros(clip.n_frames, bool))).all()


def test_a_hand_beyond_the_reach_gives_infinity(make_clip):
    clip: Clip = make_clip(2)
    points = sample_points(clip.object.model, POINTS)
    centre = clip.object.translation_m[:, None].astype(np.float64)
    offset = np.array((0.0, 0.0, 1.0))
    radius = np.linalg.norm(points.points_m, axis=1)
    for away, reached in ((0.19, True), (0.45, False)):
        hand = centre + away * offset
        distances = map_of(clip.object, np.broadcast_to(hand, (2, 778, 3)), points)
        assert np.isfinite(distances).any() == reached
    assert radius.max() < 0.1


def test_packing_errs_by_at_most_half_a_step_and_repeats():
    distances = np.append(np.linspace(0, REACH_M, 40_001), [REACH_M * 1.0001, 0.3, np.inf]).astype(np.float32)
    packed = packed_map(distances)
    assert packed.dtype == np.uint8
    assert packed[-4:].tolist() == [250, BEYOND, BEYOND, BEYOND]
    unpacked = np.where(packed == BEYOND, np.inf, packed * STEP_M)
    assert np.abs(unpacked[:-3] - distances[:-3]).max() <= 0.0004 + 1e-7
    np.testing.assert_array_equal(packed_map(unpacked), packed)
