import numpy as np
import pytest

from hoidata.hands import track_joints
from hoidata.objects.sampling import sample_points
from models.text2hoi.generation import GeneratedMotion
from pipelines.pages.generation_page import ARRAYS, write_generation


@pytest.fixture
def motion(page_clip):
    clip = page_clip(right=True, left=False)
    points = sample_points(clip.object.model)
    hand = {"hand": "right", "source": "rule", "confidence": 1.0, "evidence": "the right hand"}
    evidence = {"text": "Lift a box with the right hand.", "seed": 7, "hand": hand, "synthetic": True}
    evidence["trained_on"] = {"grab": 12}
    return GeneratedMotion(clip, page_clip(frames=clip.n_frames), points.points_m[:, 0] > 0.039, points, evidence)


def test_three_files_are_written_and_repeat_byte_for_byte(motion, hands, tmp_path):
    first, again = write_generation(tmp_path / "a", motion, hands), write_generation(tmp_path / "b", motion, hands)
    assert [path.name for path in first] == ["motion.npz", "motion.glb", "index.html"]
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in again]


def test_arrays_open_without_pickle_and_hold_the_motion(motion, hands, tmp_path):
    with np.load(write_generation(tmp_path, motion, hands)[0], allow_pickle=False) as archive:
        arrays = dict(archive)
    assert str(arrays["text"]) == "Lift a box with the right hand."
    assert not arrays["joints_m"][0].any()
    assert not arrays["valid"][0].any()
    assert np.array_equal(arrays["joints_m"][1], track_joints(motion.clip.hands["right"], hands.right))
    assert arrays["contact"].shape == (1024,)
    assert np.allclose(arrays["object_translation_m"], motion.clip.object.translation_m, atol=1e-6)
    assert "vertices_m" not in arrays


def test_page_names_seed_hands_length_and_that_it_is_synthetic(motion, hands, tmp_path):
    page = write_generation(tmp_path, motion, hands)[2].read_text()
    assert "right (decided by rule: the right hand)" in page
    assert "12 SYNTHETIC grab clips" in page
    assert "24 frames, 0.80 s" in page
    assert "<dd>7</dd>" in page
    assert "SYNTHETIC" in page


def test_every_array_is_explained_on_the_page(motion, hands, tmp_path):
    paths = write_generation(tmp_path, motion, hands, vertices=True)
    page = paths[2].read_text()
    with np.load(paths[0], allow_pickle=False) as archive:
        assert set(archive.files) <= set(ARRAYS)
        assert all(f"<dt>{name}</dt>" in page for name in archive.files)
