"""H2O on the embedded corpus: gravity and hands from joints compared with the ground truth."""

import numpy as np
import pytest

from hoidata.datasets.h2o.adapter import H2OAdapter
from hoidata.hands import track_joints

pytestmark = pytest.mark.slow


def test_gravity_is_straight_down_if_it_is_known_and_has_a_note_on_the_evidence(small_corpus, load_all):
    clips = load_all(H2OAdapter(), small_corpus("h2o").raw)
    with_gravity = [clip for clip in clips if clip.gravity is not None]
    assert len(with_gravity) >= 0.7 * len(clips)
    for clip in with_gravity:
        np.testing.assert_allclose(clip.gravity, (0, 0, -1), atol=1e-3)
        assert clip.gravity_note.startswith("estimated from")
    for clip in clips:
        assert clip.gravity is not None or clip.gravity_note.startswith("unknown: ")


@pytest.mark.long
def test_hands_fitted_to_the_joints_are_those_of_the_parameters(small_corpus, load_all, hands):
    fitted, from_parameters = (
        load_all(H2OAdapter(hands="keypoints"), small_corpus("h2o").raw),
        load_all(H2OAdapter(), small_corpus("h2o").raw),
    )
    assert [clip.clip_id for clip in fitted] == [clip.clip_id for clip in from_parameters]
    for ours, theirs in zip(fitted, from_parameters, strict=True):
        np.testing.assert_array_equal(ours.source_frames, theirs.source_frames)
        assert ours.fit_error_m < 5e-4
        for side, track in ours.hands.items():
            valid = track.valid
            np.testing.assert_array_equal(valid, theirs.hands[side].valid)
            apart = track_joints(track, hands[side]) - track_joints(theirs.hands[side], hands[side])
            assert not valid.any() or np.linalg.norm(apart[valid], axis=-1).mean() < 1e-3
