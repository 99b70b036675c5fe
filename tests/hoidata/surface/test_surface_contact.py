"""Hands of clips against the exact surface: known contacts, invariance under world motion and mirroring."""

from collections.abc import Callable

import igl
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips import SIDES, Clip
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.surface.contact import HandInObjectFrame, deepest_m, hand_in_object_frame, touched_vertices
from hoidata.surface.solid_overlap import SolidOverlap
from tests.builders.clips import in_another_world, mirror_image, with_hand, with_object

HANDS = load_embedded_hands()


def signed_distances_m(hand: HandInObjectFrame, index: SurfaceIndex, most_m: float) -> np.ndarray:
    """(frame, 778) distance of each vertex, negative inside at any depth, infinite beyond ``most_m`` outside."""
    depth = index.depth_m(hand.vertices_m, hand.hinge_rad)
    distance = index.distance_m(hand.vertices_m, hand.hinge_rad, most_m)
    return hand.expand_to_clip(np.where(depth > 0, -depth, distance), np.nan)


def shared_m3(hand: HandInObjectFrame, overlap: SolidOverlap) -> np.ndarray:
    """(frame,) volume that hand and object both fill, NaN without the hand."""
    return hand.expand_to_clip(overlap.volume_m3(hand.vertices_m, hand.faces, hand.hinge_rad), np.nan)


def shifted(clip: Clip, way_m: float) -> Clip:
    """The object moved towards the right hand, so that it enters."""
    wrist = clip.hands["right"].wrist_m
    away = wrist - clip.object.translation_m
    towards = way_m * away / np.linalg.norm(away, axis=1, keepdims=True)
    return with_object(clip, translation_m=(clip.object.translation_m + towards).astype(np.float32))


@pytest.mark.parametrize("articulated", [False, True], ids=["rigid", "articulated"])
def test_distances_equal_libigl_s_to_the_posed_mesh_in_the_world(
    make_clip: Callable[..., Clip], articulated: bool
) -> None:
    clip = shifted(make_clip(n_frames=5, articulated=articulated), 0.02)
    model, track = clip.object.model, clip.object
    index, hand = SurfaceIndex(model), hand_in_object_frame(clip, "right", HANDS)
    posed = track.points_in_world(model.vertices_m, model.part)
    vertices = track_vertices(clip.hands["right"], HANDS.right).astype(np.float64)
    distances_m, touched = signed_distances_m(hand, index, 0.05), touched_vertices(hand, index)
    for frame in range(5):
        kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        parts = [np.ascontiguousarray(model.faces[model.face_part == part], dtype=np.int64) for part in index.solids]
        signed = np.stack([igl.signed_distance(vertices[frame], posed[frame], faces, kind)[0] for faces in parts])
        expected = np.where((signed < 0).any(axis=0), signed.min(axis=0), np.abs(signed).min(axis=0))
        near = np.abs(expected) < 0.0499
        np.testing.assert_allclose(distances_m[frame][near], expected[near], atol=1e-7)
        clear = np.abs(np.abs(signed).min(axis=0) - 0.005) > 1e-7
        np.testing.assert_array_equal(touched[frame][clear], (np.abs(signed).min(axis=0) < 0.005)[clear])
    assert touched.any(axis=1).all()
    assert np.nanmin(distances_m) < 0


def test_a_vertex_inside_has_its_depth_however_deep_and_one_outside_only_within_the_reach(make_clip) -> None:
    clip = shifted(make_clip(n_frames=2), 0.04)
    index, hand = SurfaceIndex(clip.object.model), hand_in_object_frame(clip, "right", HANDS)
    whole, near = signed_distances_m(hand, index, 1.0), signed_distances_m(hand, index, 0.001)
    assert whole.min() < -0.005
    assert (whole > 0.001).any()
    np.testing.assert_array_equal(near, np.where(whole > 0.001, np.inf, whole))


def test_frames_without_the_hand_are_not_looked_at(make_clip: Callable[..., Clip]) -> None:
    clip = shifted(make_clip(n_frames=6), 0.02)
    valid = np.array([False, True, True, False, True, True])
    clip = with_hand(clip, valid=valid)
    index, hand = SurfaceIndex(clip.object.model), hand_in_object_frame(clip, "right", HANDS)
    touched, overlap = touched_vertices(hand, index), SolidOverlap(index, 0.002)
    np.testing.assert_array_equal(touched.any(axis=1), valid)
    np.testing.assert_array_equal(np.isfinite(deepest_m(hand, index)), valid)
    np.testing.assert_array_equal(np.isfinite(shared_m3(hand, overlap)), valid)
    gone = with_hand(clip, valid=np.zeros(6, bool))
    assert np.isnan(deepest_m(hand_in_object_frame(gone, "right", HANDS), index)).all()


def test_each_valid_frame_uses_its_hinge_angle(
    make_clip: Callable[..., Clip],
) -> None:
    clip = shifted(make_clip(n_frames=6, articulated=True), 0.02)
    clip = with_object(clip, hinge_rad=np.linspace(-0.5, 2.0, 6).astype(np.float32))
    valid = np.array([False, True, False, True, True, False])
    with_gaps = with_hand(clip, valid=valid)
    index = SurfaceIndex(clip.object.model)
    overlap = SolidOverlap(index, 0.002)
    whole, part = (hand_in_object_frame(each, "right", HANDS) for each in (clip, with_gaps))
    np.testing.assert_array_equal(
        signed_distances_m(part, index, 1.0)[valid], signed_distances_m(whole, index, 1.0)[valid]
    )
    volumes = [shared_m3(hand, overlap) for hand in (part, whole)]
    np.testing.assert_array_equal(volumes[0][valid], volumes[1][valid])


def test_deeper_hands_share_more_volume_and_a_far_hand_none(make_clip: Callable[..., Clip]) -> None:
    clip = make_clip(n_frames=3)
    index = SurfaceIndex(clip.object.model)
    overlap, volumes, depths = SolidOverlap(index), [], []
    for way_m in (0.0, 0.01, 0.02, 0.04):
        hand = hand_in_object_frame(shifted(clip, way_m), "right", HANDS)
        volumes.append(shared_m3(hand, overlap).mean())
        depths.append(deepest_m(hand, index).mean())
    assert (np.diff(volumes[1:]) > 0).all()
    assert (np.diff(depths[1:]) > 0).all()
    assert not shared_m3(hand_in_object_frame(clip, "left", HANDS), overlap).any()
    assert not deepest_m(hand_in_object_frame(clip, "left", HANDS), index).any()


@pytest.mark.parametrize("articulated", [False, True], ids=["rigid", "articulated"])
def test_results_do_not_depend_on_the_world_frame(make_clip: Callable[..., Clip], articulated: bool) -> None:
    clip = shifted(make_clip(n_frames=6, articulated=articulated), 0.02)
    moved = in_another_world(clip, Rotation.from_rotvec([0.4, -2.0, 1.0]), np.array([0.3, -0.2, 0.5]))
    index = SurfaceIndex(clip.object.model)
    overlap = SolidOverlap(index)
    for side in SIDES:
        one, two = hand_in_object_frame(clip, side, HANDS), hand_in_object_frame(moved, side, HANDS)
        np.testing.assert_allclose(two.vertices_m, one.vertices_m, atol=2e-6)
        first, second = signed_distances_m(one, index, 0.05), signed_distances_m(two, index, 0.05)
        clear = np.abs(np.abs(first) - 0.005) > 3e-6
        np.testing.assert_array_equal(touched_vertices(one, index)[clear], touched_vertices(two, index)[clear])
        both = np.isfinite(first) & np.isfinite(second)
        np.testing.assert_allclose(second[both], first[both], atol=3e-6)
        volumes = [shared_m3(hand, overlap) for hand in (one, two)]
        np.testing.assert_allclose(volumes[1], volumes[0], atol=2e-8)


def test_the_mirrored_clip_has_the_other_hand_s_contacts(make_clip: Callable[..., Clip]) -> None:
    clip = shifted(make_clip(n_frames=6, articulated=True), 0.02)
    mirrored = mirror_image(clip)
    index, other = SurfaceIndex(clip.object.model), SurfaceIndex(mirrored.object.model)
    overlaps = SolidOverlap(index, 0.0005), SolidOverlap(other, 0.0005)
    for side, opposite in zip(SIDES, reversed(SIDES), strict=True):
        one, two = hand_in_object_frame(clip, side, HANDS), hand_in_object_frame(mirrored, opposite, HANDS)
        first, second = signed_distances_m(one, index, 0.05), signed_distances_m(two, other, 0.05)
        both = np.isfinite(first) & np.isfinite(second)
        np.testing.assert_allclose(second[both], first[both], atol=3e-6)
        clear = np.abs(np.abs(first) - 0.005) > 3e-6
        np.testing.assert_array_equal(touched_vertices(one, index)[clear], touched_vertices(two, other)[clear])
        volumes = [shared_m3(hand, overlap) for hand, overlap in zip((one, two), overlaps, strict=True)]
        np.testing.assert_allclose(volumes[1], volumes[0], atol=2e-8)


def test_an_open_object_has_touched_vertices_but_no_penetration(make_clip: Callable[..., Clip]) -> None:
    clip = make_clip(n_frames=2)
    model = clip.object.model
    sheet = ObjectModel("sheet", model.vertices_m, model.faces[: len(model.faces) // 2], model.part)
    index, hand = SurfaceIndex(sheet), hand_in_object_frame(clip, "right", HANDS)
    assert isinstance(hand, HandInObjectFrame)
    assert touched_vertices(hand, index, 1.0).all()
    with pytest.raises(BadInput, match="it is open"):
        deepest_m(hand, index)
    assert index.repair_note == "sheet has no inside: it is open"
