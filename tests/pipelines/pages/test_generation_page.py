"""The files of a generated motion: arrays, an animated model, and a self-contained page."""

import contextlib
import json
import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips.clip import HandTrack
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import track_joints
from hoidata.metrics.verdict import Check
from hoidata.objects.sampling import sample_points
from models.text2hoi.generation import GeneratedMotion
from pipelines.pages.examples import touched_points
from pipelines.pages.generation_page import ARRAYS, write_generation
from pipelines.pages.player import three_javascript

TEXT = "Lift a box & hold it with the right hand."


@pytest.fixture
def motion(page_clip):
    clip = page_clip(right=True, left=False)
    points = sample_points(clip.object.model)
    hand = {"hand": "right", "source": "rule", "confidence": 1.0, "evidence": "the right <hand>"}
    evidence = {
        "text": TEXT,
        "seed": 7,
        "number": 0,
        "hand": hand,
        "verb": "lift",
        "attempts": 3,
        "moved_as": "pour",
        "unusual": ["highest rise 15.8 cm (usual: <19.1> to 23.7)"],
        "synthetic": True,
        "unseen": ["the object 'vase' was never in training"],
        "contact_threshold_m": 0.02,
        "checkpoints": {"contact": "ab" * 32},
        "refine": "contact",
        "trained_on": {"grab": 12},
    }
    coarse, contact = page_clip(frames=clip.n_frames), points.points_m[:, 0] > 0.039
    checks = (Check("touches", False, "3 cm <away>"), Check("carries", None, "still"))
    return GeneratedMotion(clip, coarse, contact, points, evidence=evidence, verdict=checks)


@pytest.fixture
def write(hands, tmp_path):
    def written(*motions, to="out"):
        return write_generation(tmp_path / to, motions, hands, "checkpoints/embedded/grab", ["z is <taken> for up"])

    return written


def test_the_written_page_fetches_nothing(motion, write):
    own_text = write(motion)[-1].read_text().replace(three_javascript(), "")
    assert not re.search(r"""https?://|@import|(?:src|href|data)\s*=\s*["']?//|url\(\s*["']?//""", own_text, re.I)
    assert "default-src 'none'" in own_text


def test_three_files_are_written_and_repeat_byte_for_byte(motion, write):
    first, again = write(motion, to="a"), write(motion, to="b")
    assert [path.name for path in first] == ["motion.npz", "motion.glb", "index.html"]
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in again]


def test_every_sample_has_its_files_and_stands_on_the_one_page(motion, write):
    second = replace(motion, evidence=motion.evidence | {"number": 1})
    paths = write(motion, second)
    assert [path.name for path in paths[2:]] == ["motion-1.npz", "motion-1.glb", "index.html"]
    page = paths[-1].read_text()
    assert "sample 1" in page
    assert "sample 2" in page


def test_arrays_open_without_pickle_and_hold_the_motion(motion, hands, write):
    with np.load(write(motion)[0], allow_pickle=False) as archive:
        arrays = dict(archive)
    assert str(arrays["text"]) == TEXT
    assert not arrays["joints_m"][0].any()
    assert not arrays["valid"][0].any()
    assert np.array_equal(arrays["joints_m"][1], track_joints(motion.clip.hands["right"], hands.right))
    assert arrays["contact"].shape == (1024,)
    assert np.allclose(arrays["object_translation_m"], motion.clip.object.translation_m, atol=1e-6)


def test_a_person_s_rest_meshes_are_among_the_arrays(motion, hands, write):
    templates = {side: (hands[side].template_m * 1.1).astype(np.float32) for side in motion.clip.hands}
    tracks = {side: replace(track, template_m=templates[side]) for side, track in motion.clip.hands.items()}
    with np.load(write(replace(motion, clip=replace(motion.clip, hands=tracks)))[0]) as archive:
        arrays = dict(archive)
    names = ("wrist_m", "global_orient", "hand_pose", "betas", "valid")
    right_track = HandTrack(*(arrays[name][1] for name in names), arrays["template_m"][1])
    assert np.allclose(track_joints(right_track, hands.right), arrays["joints_m"][1], atol=1e-6)
    with np.load(write(motion, to="without")[0]) as archive:
        assert archive["template_m"].size == 0


def test_page_names_seed_hands_length_models_and_untrained_inputs(motion, write):
    page = write(motion)[-1].read_text()
    for words in (
        "right (decided by rule: the right &lt;hand&gt;)",
        "12 SYNTHETIC grab clips",
        "24 frames, 0.80 s",
        "<dd>7</dd>",
        "checkpoints/embedded/grab (sha256: contact abababababab)",
        "the object &#39;vase&#39; was never in training",
        "z is &lt;taken&gt; for up",
        "Lift a box &amp; hold it",
        "1 of 1 checks fail: touches",
        "3 cm &lt;away&gt;",
        "sample 1: the best of 3 motions<",
        "sample 1: motion classified as &#39;pour&#39;, highest rise 15.8 cm (usual: &lt;19.1&gt; to 23.7)",
    ):
        assert words in page, words


def test_generated_contact_is_that_of_joints_near_points(motion, hands, write):
    reached = touched_points(motion.clip, hands, motion.points, 0.02)
    track = motion.clip.hands["right"]
    entries = ProximityIndex(motion.points).entries(
        track_joints(track, hands.right), track.valid, motion.clip.object, 0.02
    )
    assert set(np.flatnonzero(reached)) == set(entries["point"].tolist())
    assert f"{reached.sum()} touched points" in write(motion)[-1].read_text()


def test_target_and_generated_contact_are_seen_from_one_side(motion, write):
    far = replace(motion, contact=motion.points.points_m[:, 0] < -0.039)  # the touched side is the opposite one
    page = write(far)[-1].read_text()
    views = [json.loads(text.split("</script>")[0]) for text in page.split('class="view">')[1:]]
    target, generated = (view["azimuth_rad"] for view in views if view["frames"] == 1)
    assert target == generated


def test_every_array_is_explained_on_the_page(motion, write):
    paths = write(motion)
    page = paths[-1].read_text()
    with np.load(paths[0], allow_pickle=False) as archive:
        assert set(archive.files) <= set(ARRAYS)
        assert all(f"<dt>{name}</dt>" in page for name in archive.files)


@pytest.mark.long
def test_the_picture_in_chromium_changes_with_time(chromium, motion, write, tmp_path):
    page = write(motion)[-1]
    pictures = [take_picture(chromium, page, tmp_path / f"{part}.png", part) for part in (0.0, 1.0)]
    again = take_picture(chromium, page, tmp_path / "again.png", 1.0)
    assert len({picture.size for picture in pictures}) == 1
    assert np.abs(pictures[0] - pictures[1]).mean() > 0.3
    assert np.abs(pictures[1] - again).mean() < 0.1


def take_picture(chromium, page, out, part):
    quiet = ("--disable-background-networking", "--disable-component-update", "--hide-scrollbars")
    switches = [*chromium, *quiet, "--window-size=900,700", "--virtual-time-budget=5000"]
    for attempt in range(3):  # on a machine with much to do a browser sometimes never begins
        profile = out.with_suffix(f".profile{attempt}")
        command = [*switches, f"--user-data-dir={profile}", f"--screenshot={out}"]
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run([*command, f"{page.as_uri()}#t={part}"], check=True, capture_output=True, timeout=120)
            break
    from PIL import Image

    with Image.open(out) as image:
        return np.asarray(image.convert("RGB"), dtype=np.float64)
