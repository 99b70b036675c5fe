"""Each adapter recovers, for every clip, the ground truth from which the embedded corpus was written."""

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.contact.maps import find_active_hands
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import load_embedded_hands
from hoidata.objects.sampling import sample_points
from hoidata.store.store import open_store

TOLERANCE = 1e-4  # metres, radians


@pytest.fixture(scope="module", params=["h2o", "grab", "arctic"])
def corpus(request, small_corpus):
    """(truths by sequence and first source frame, store) of one dataset's small corpus."""
    small = small_corpus(request.param)
    truths = {(truth.source_key, int(truth.source_frames[0])): truth for truth in small.truths}
    return truths, open_store(small.clips)


@pytest.fixture
def pairs(corpus):
    truths, store = corpus
    clips = [store.clip(clip_id) for clip_id in store.ids]
    assert {(clip.sequence, int(clip.source_frames[0])) for clip in clips} == set(truths)
    clip_truths = [truths[clip.sequence, int(clip.source_frames[0])] for clip in clips]
    return [(clip, truth.take(truth.clip_frames)) for clip, truth in zip(clips, clip_truths, strict=True)]


@pytest.mark.slow
def test_frames_words_and_hand_are_those_of_the_truth(corpus, pairs):
    truths, store = corpus
    assert len(pairs) == len(truths) >= 8
    for clip, truth in pairs:
        whole = truths[clip.sequence, int(clip.source_frames[0])]
        assert clip.source_frames.tolist() == whole.source_frames.tolist()
        assert (clip.verb, clip.object_words, clip.subject) == (truth.verb, truth.object_words, truth.subject)
        index = ProximityIndex(sample_points(clip.object.model))
        joints = {side: store.joints(clip.clip_id, side) for side in ("left", "right")}
        assert find_active_hands(clip, joints, index).hand_type == truth.hand_type
        assert clip.labelled_hand in (None, truth.hand_type)


@pytest.mark.slow
def test_joints_are_those_of_the_truth(corpus, pairs):
    _, store = corpus
    for clip, truth in pairs:
        expected = truth.joints(load_embedded_hands())
        for side in ("left", "right"):
            np.testing.assert_array_equal(clip.hands[side].valid, truth.hands[side].valid)
            valid = clip.hands[side].valid
            np.testing.assert_allclose(
                store.joints(clip.clip_id, side)[valid], expected[side][valid], atol=TOLERANCE, rtol=0
            )


@pytest.mark.slow
def test_object_pose_and_hinge_are_those_of_the_truth(pairs):
    for clip, truth in pairs:
        close = partial(np.testing.assert_allclose, atol=TOLERANCE, rtol=0)
        close(clip.object.translation_m, truth.object.translation_m)
        between = Rotation.from_rotvec(clip.object.rotvec) * Rotation.from_rotvec(truth.object.rotvec).inv()
        assert between.magnitude().max() < TOLERANCE
        assert clip.object.is_articulated == truth.object.is_articulated
        if truth.object.hinge_rad is not None:
            close(clip.object.hinge_rad, truth.object.hinge_rad)


@pytest.mark.slow
def test_meshes_parts_and_hinges_are_those_of_the_truth(pairs):
    for clip, truth in pairs:
        model, expected = clip.object.model, truth.object.model
        assert model.name == truth.object_name
        np.testing.assert_allclose(model.vertices_m, expected.vertices_m, atol=1e-6, rtol=0)
        np.testing.assert_array_equal(model.faces, expected.faces)
        np.testing.assert_array_equal(model.part, expected.part)
        if expected.hinge is not None:
            assert model.hinge is not None
            np.testing.assert_allclose(model.hinge.axis, expected.hinge.axis, atol=1e-9)
            np.testing.assert_allclose(model.hinge.origin_m, expected.hinge.origin_m, atol=1e-9)
