import numpy as np
import pytest

from hoidata.hands import track_joints
from hoidata.objects.sampling import sample_points
from pipelines.pages.generation_page import GeneratedMotion, write_generation


@pytest.fixture
def motion(hands, page_clip):
    clip = page_clip(right=True, left=False)
    points = sample_points(clip.object.model)
    contact = np.stack([np.zeros(1024), points.points_m[:, 0] > 0.039]).astype(np.float32)
    return GeneratedMotion(
        clip, hands, "Lift a box with the right hand.", "right", "named in the sentence", 7, points, contact, True
    )


def test_three_files_are_written_and_repeat_byte_for_byte(motion, tmp_path):
    first, again = write_generation(tmp_path / "a", motion), write_generation(tmp_path / "b", motion)
    assert [path.name for path in first] == ["motion.npz", "motion.glb", "index.html"]
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in again]


def test_arrays_open_without_pickle_and_hold_the_motion(motion, hands, tmp_path):
    with np.load(write_generation(tmp_path, motion)[0], allow_pickle=False) as archive:
        arrays = dict(archive)
    assert str(arrays["text"]) == motion.text
    assert not arrays["joints_m"][0].any()
    assert not arrays["valid"][0].any()
    assert np.array_equal(arrays["joints_m"][1], track_joints(motion.clip.hands["right"], hands.right))
    assert arrays["contact"].shape == (2, 1024)
    assert np.allclose(arrays["object_translation_m"], motion.clip.object.translation_m, atol=1e-6)
    assert "vertices_m" not in arrays


def test_hand_meshes_are_stored_when_asked_for(motion, tmp_path):
    with np.load(write_generation(tmp_path, motion, vertices=True)[0], allow_pickle=False) as archive:
        assert archive["vertices_m"].shape == (2, motion.clip.n_frames, 778, 3)


def test_page_names_seed_hands_length_and_that_it_is_synthetic(motion, tmp_path):
    page = write_generation(tmp_path, motion)[2].read_text()
    assert "right: named in the sentence" in page
    assert "24 frames, 0.80 s" in page
    assert "<dd>7</dd>" in page
    assert "SYNTHETIC" in page
