"""One hand against the exact surface: contact, depth and joint distances against a box's own formula."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips import ObjectTrack
from hoidata.hands import load_embedded_hands, track_joints, track_vertices
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import sample_points
from hoidata.surface.contact import hand_in_object_frame
from hoidata.surface.measure import bimart_map, measure_hand
from tests.builders.clips import with_object

POINTS = 128
HALF_BOX_M = np.array((0.05, 0.04, 0.03))
TOUCH_M = 0.005


def box_distance(places: np.ndarray) -> np.ndarray:
    """Signed distance to the surface of the box of ``make_clip``, negative inside (Quilez' formula), float64."""
    beyond = np.abs(places) - HALF_BOX_M
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def in_box(places: np.ndarray, track: ObjectTrack) -> np.ndarray:
    """World places (frame, place, 3) in the box's frame, with SciPy's rotations."""
    rotation = Rotation.from_rotvec(np.asarray(track.rotvec, np.float64))
    return np.array(
        [rotation[f].inv().apply(p - np.asarray(track.translation_m[f], np.float64)) for f, p in enumerate(places)]
    )


@pytest.fixture
def through(make_clip):
    """A right hand that comes from afar into the box and is not seen in two frames; the left one is never seen."""
    clip = make_clip(20, hand_type="right", seed=3, clip_id="test/s1/through")
    hand = clip.hands["right"]
    toward = clip.object.translation_m - hand.wrist_m
    toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    path = np.concatenate([np.linspace(-0.6, 0.0, 10), np.linspace(0.0, 0.05, 10)])[:, None] * toward
    valid = np.ones(20, bool)
    valid[[4, 15]] = False
    hand = replace(hand, wrist_m=(hand.wrist_m + path).astype(np.float32), valid=valid)
    unseen = replace(clip.hands["left"], valid=np.zeros(20, bool))
    return replace(clip, hands={"left": unseen, "right": hand})


def measured(clip, side):
    return measure_hand(clip, side, load_embedded_hands(), sample_points(clip.object.model, POINTS))


def test_contact_depth_and_joint_distance_are_those_of_the_box(through):
    measures, hands = measured(through, "right"), load_embedded_hands()
    valid = through.hands["right"].valid
    exact = box_distance(in_box(track_vertices(through.hands["right"], hands["right"]), through.object))
    sure = np.abs(np.abs(exact) - TOUCH_M) > 1e-6
    assert measures.touched.shape == (20, 778)
    assert 0 < measures.touched.sum() < measures.touched.size
    np.testing.assert_array_equal(measures.touched[sure], ((np.abs(exact) < TOUCH_M) & valid[:, None])[sure])
    depth = measures.depth_m
    assert (depth[valid] > 0.01).any()
    assert (depth[valid] == 0).any()
    np.testing.assert_allclose(depth[valid], np.maximum(-exact.min(axis=1), 0)[valid], atol=1e-6)
    assert np.isnan(depth[~valid]).all()
    joints = np.abs(box_distance(in_box(track_joints(through.hands["right"], hands["right"]), through.object)))
    np.testing.assert_allclose(measures.joint_m[valid], joints.min(axis=1)[valid], atol=1e-6)
    assert np.isinf(measures.joint_m[~valid]).all()


def test_a_hand_that_is_never_valid_touches_nothing(through):
    measures = measured(through, "left")
    assert not measures.touched.any()
    assert np.isnan(measures.depth_m).all()
    assert np.isinf(measures.joint_m).all()
    assert np.isinf(measures.map_m).all()


def test_map_is_bimarts(through):
    points = sample_points(through.object.model, POINTS)
    expected = bimart_map(hand_in_object_frame(through, "right", load_embedded_hands()), points, through.object.model)
    assert np.isfinite(expected).any()
    np.testing.assert_array_equal(measured(through, "right").map_m, expected)


def test_object_without_an_inside_has_no_depth(make_clip):
    """A single square plate: it can be touched, nothing can be inside it."""
    clip = make_clip(6)
    corners = np.array([(-0.05, -0.04, 0.03), (0.05, -0.04, 0.03), (0.05, 0.04, 0.03), (-0.05, 0.04, 0.03)])
    plate = ObjectModel("plate", corners, np.array([(0, 1, 2), (0, 2, 3)]), np.zeros(4, np.uint8))
    measures = measured(with_object(clip, model=plate), "right")
    assert np.isnan(measures.depth_m).all()
    assert measures.touched.any()
