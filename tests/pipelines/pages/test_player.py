import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips.clip import ObjectTrack
from hoidata.objects.model import ObjectModel
from pipelines.pages.player import motion_player, three_javascript, write_motion_page
from pipelines.pages.view import view_of

FETCHES = re.compile(r"""(?:src|href|data)\s*=\s*["']?\s*(?:https?:)?//|url\(\s*["']?(?:https?:)?//|@import""", re.I)


@pytest.fixture
def page(hands, page_clip, tmp_path):
    player = motion_player(page_clip(), hands, "Lift a box with the right hand.")
    facts = [("hand type", "right <named in the sentence>")]
    return write_motion_page(tmp_path / "index.html", player, "Lift a box & hold it.", facts, synthetic=True)


def test_page_fetches_nothing(page):
    text = page.read_text()
    own_part = text.replace(three_javascript(), "")
    assert not FETCHES.search(own_part)
    assert not re.search(r"https?://", own_part)
    assert "default-src 'none'" in own_part


def test_page_says_synthetic_and_escapes_words(page):
    text = page.read_text()
    assert "SYNTHETIC" in text
    assert "right &lt;named in the sentence&gt;" in text
    assert "Lift a box &amp; hold it." in text


def test_same_motion_gives_the_same_page(hands, page_clip, tmp_path, page):
    player = motion_player(page_clip(), hands, "Lift a box with the right hand.")
    facts = [("hand type", "right <named in the sentence>")]
    again = write_motion_page(tmp_path / "again.html", player, "Lift a box & hold it.", facts, synthetic=True)
    assert again.read_bytes() == page.read_bytes()


def test_three_comes_with_its_licence_notice_and_the_loader():
    script = three_javascript()
    assert "SPDX-License-Identifier: MIT" in script[:200]
    assert "THREE.GLTFLoader=" in script
    assert len(script) < 700_000
    assert "</script" not in script


def test_camera_sees_every_joint_and_stands_on_the_lowest_point(hands, page_clip):
    clip = page_clip(left=True)
    view = view_of(clip, hands)
    upright_object = clip.object.translation_m[:, [0, 2, 1]] * (1, 1, -1)
    assert (np.linalg.norm(upright_object - view.centre, axis=1) < view.radius_m).all()
    assert view.ground_m is not None
    assert view.ground_m <= 1e-4
    assert view_of(page_clip(), hands).frames == clip.n_frames


def test_idle_hand_far_away_does_not_widen_the_view(hands, page_clip):
    clip = page_clip(left=True)
    far = replace(clip.hands["left"], wrist_m=clip.hands["left"].wrist_m - (3.0, 0.0, 0.0))
    idle = replace(clip, hands={"left": far, "right": clip.hands["right"]})
    assert view_of(idle, hands).radius_m == view_of(page_clip(), hands).radius_m


def test_the_ground_lies_under_a_table_which_does_not_widen_the_view(hands, page_clip):
    clip = page_clip()
    slab = np.array([[-0.5, -0.4, 0.0], [0.5, -0.4, 0.0], [0.5, 0.4, 0.0], [-0.5, 0.4, -0.3]])
    model = ObjectModel("table", slab, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(4, np.uint8))
    still = np.zeros((clip.n_frames, 3), np.float32)
    with_table = view_of(replace(clip, other_objects=(ObjectTrack(model, still, still),)), hands)
    assert with_table.ground_m == pytest.approx(-0.3)
    assert replace(with_table, ground_m=None) == replace(view_of(clip, hands), ground_m=None)


@pytest.mark.slow
def test_the_picture_in_chromium_changes_with_time(page, tmp_path):
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium on PATH: the page was not opened")
    pictures = [take_picture(chromium, page, tmp_path / f"{part}.png", part) for part in (0.0, 1.0)]
    again = take_picture(chromium, page, tmp_path / "again.png", 1.0)
    assert len({picture.size for picture in pictures}) == 1
    assert np.abs(pictures[0] - pictures[1]).mean() > 0.3
    assert np.abs(pictures[1] - again).mean() < 0.1


def take_picture(chromium, page, out, part):
    switches = [
        "--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--use-angle=swiftshader",
        "--disable-background-networking", "--disable-component-update", "--no-first-run", "--hide-scrollbars",
        "--window-size=900,700", "--virtual-time-budget=5000",
    ]  # fmt: skip
    command = [chromium, *switches, f"--user-data-dir={out.with_suffix('.profile')}", f"--screenshot={out}"]
    subprocess.run([*command, f"{page.as_uri()}#t={part}"], check=True, capture_output=True, timeout=120)
    from PIL import Image

    with Image.open(out) as image:
        return np.asarray(image.convert("RGB"), dtype=np.float64)
