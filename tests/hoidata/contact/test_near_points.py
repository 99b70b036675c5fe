"""The compiled searches against SciPy's trees and brute force: the same rows, the same bits, in the same order."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from hoidata.clips import ObjectTrack
from hoidata.contact.proximity import ENTRY, ProximityIndex, near_entries, point_boxes
from hoidata.errors import BadInput
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.objects.sampling import SampledPoints
from tests.builders.objects import sampled

FRAMES, JOINTS = 9, 21
Scene = tuple[SampledPoints, ObjectTrack, np.ndarray]


def scene(seed: int, n_points: int, articulated: bool, spread_m: float) -> Scene:
    """A moving, maybe folding cloud of points, and joints scattered about it."""
    random = np.random.default_rng(seed)
    points = random.uniform(-0.09, 0.09, (n_points, 3)) * random.uniform(0, 1, 3)
    part = (points[:, 0] > 0).astype(np.uint8) if articulated else np.zeros(n_points, np.uint8)
    hinge = Hinge(np.array([0.0, 0.6, 0.8]), np.array([0.01, -0.02, 0.03])) if articulated else None
    model = ObjectModel(name="cloud", vertices_m=points, faces=np.zeros((1, 3), np.int64), part=part, hinge=hinge)
    angle = random.uniform(-2, 2, FRAMES) if articulated else None
    track = ObjectTrack(model, random.normal(size=(FRAMES, 3)), random.normal(size=(FRAMES, 3)), angle)
    joints = track.translation_m[:, None] + random.normal(0, spread_m, (FRAMES, JOINTS, 3))
    return sampled(points, part), track, joints.astype(np.float32)


def by_part(
    points: SampledPoints, track: ObjectTrack, joints: np.ndarray
) -> list[tuple[np.ndarray, KDTree, np.ndarray]]:
    """Per part its rows, a tree of its points, and the joints in its frame."""
    in_object = track.world_from_object.inverse() @ joints.astype(np.float64)
    parts = []
    for part in np.unique(points.part):
        rows = np.flatnonzero(points.part == part)
        local = track.model.object_from_part(int(part), track.hinge_rad).inverse() @ in_object
        parts.append((rows, KDTree(points.points_m[rows].astype(np.float64)), local))
    return parts


def entries_from_trees(scene_data: Scene, valid: np.ndarray, threshold_m: float) -> np.ndarray:
    """One tree per part and one of the joints, sorted afterwards."""
    pieces = [np.zeros(0, ENTRY)]
    for rows, tree, local in by_part(*scene_data):
        near = KDTree(local.reshape(-1, 3)).sparse_distance_matrix(tree, threshold_m, output_type="ndarray")
        near = near[near["v"] < threshold_m]
        entries = np.zeros(len(near), ENTRY)
        entries["frame"], entries["joint"] = np.divmod(near["i"], JOINTS)
        entries["point"], entries["distance_m"] = rows[near["j"]], near["v"]
        pieces.append(entries[valid[entries["frame"]]])
    entries = np.concatenate(pieces)
    return entries[np.lexsort((entries["joint"], entries["point"], entries["frame"]))]


@given(
    st.integers(0, 2**32), st.integers(1, 600), st.booleans(), st.sampled_from([0.001, 0.02, 0.3]),
    st.sampled_from([0.0, 0.03, 0.3]),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_entries_are_those_of_trees_bit_for_bit_and_in_order(
    seed, n_points, articulated, threshold_m, spread_m
) -> None:
    scene_data = scene(seed, n_points, articulated, spread_m)
    points, track, joints = scene_data
    valid = np.random.default_rng(seed).random(FRAMES) < 0.8
    entries = ProximityIndex(points).entries(joints, valid, track, threshold_m)
    assert entries.tobytes() == entries_from_trees(scene_data, valid, threshold_m).tobytes()


@given(st.integers(0, 2**32), st.integers(1, 600), st.booleans(), st.sampled_from([0.0, 0.03, 0.3, 5.0]))
@settings(max_examples=60, deadline=None)
def test_the_nearest_point_is_that_of_trees_bit_for_bit(seed, n_points, articulated, spread_m) -> None:
    points, track, joints = scene(seed, n_points, articulated, spread_m)
    index = ProximityIndex(points)
    expected = np.min([tree.query(local)[0] for _, tree, local in by_part(points, track, joints)], axis=0)
    np.testing.assert_array_equal(index.closest_m(joints, track), expected.min(axis=1))


def points_near(places: np.ndarray, points: np.ndarray, reach_m: float) -> np.ndarray:
    """(entry, 2) frame and point: one joint per frame at ``places``, before an object of one part at rest."""
    boxes = point_boxes(points, [np.arange(len(points))])
    every_frame = np.ones(len(places), bool)
    entries = near_entries(places[:, None, None].astype(np.float64), every_frame, boxes, len(points), reach_m)
    return np.column_stack((entries["frame"], entries["point"]))


def test_boxes_lose_no_point_within_reach_of_any_place() -> None:
    random = np.random.default_rng(3)
    points, reach = random.uniform(-0.05, 0.05, (200, 3)).astype(np.float32), 0.02
    places = random.uniform(-0.069, 0.069, (500, 3))
    near = np.linalg.norm(places[:, None] - points, axis=2) < reach
    np.testing.assert_array_equal(points_near(places, points, reach), np.argwhere(near))


def test_places_exactly_on_points_and_corners_of_boxes_lose_no_point() -> None:
    points = np.stack(np.meshgrid(*[np.arange(5) * 0.01] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    near = np.linalg.norm(points[:, None].astype(np.float64) - points, axis=2) < 0.0101
    np.testing.assert_array_equal(points_near(points, points, 0.0101), np.argwhere(near))


def test_more_entries_than_room_was_made_for_are_all_there() -> None:
    points, track, _ = scene(1, 1000, False, 0.0)
    still = ObjectTrack(track.model, np.zeros((FRAMES, 3)), np.zeros((FRAMES, 3)))
    entries = ProximityIndex(points).entries(np.zeros((FRAMES, JOINTS, 3)), np.ones(FRAMES, bool), still, 1.0)
    assert len(entries) == FRAMES * JOINTS * 1000
    np.testing.assert_array_equal(entries["joint"], np.tile(np.arange(JOINTS), FRAMES * 1000))


def test_without_points_nothing_is_near_and_all_is_infinitely_far() -> None:
    _, track, joints = scene(1, 5, False, 0.0)
    index = ProximityIndex(sampled(np.zeros((0, 3)), np.zeros(0, np.uint8)))
    assert len(index.entries(joints, np.ones(FRAMES, bool), track)) == 0
    assert index.closest_m(joints, track).tolist() == [np.inf] * FRAMES


@pytest.mark.parametrize(
    ("shape", "n_points", "message"),
    [
        ((32768, 1), 3, "at most 32767 frames"),
        ((1, 128), 3, "at most 127 joints"),
        ((1, 1), 32768, "at most 32767 points"),
    ],
    ids=["frames", "joints", "points"],
)
def test_numbers_beyond_the_range_of_an_entry_are_refused(shape: tuple[int, int], n_points: int, message: str) -> None:
    index = ProximityIndex(sampled(np.zeros((n_points, 3)), np.zeros(n_points, np.uint8)))
    model = ObjectModel("dot", np.zeros((1, 3)), np.zeros((1, 3), np.int64), np.zeros(1, np.uint8))
    track = ObjectTrack(model, np.zeros((shape[0], 3)), np.zeros((shape[0], 3)))
    with pytest.raises(BadInput, match=message):
        index.entries(np.zeros((*shape, 3)), np.ones(shape[0], bool), track)
