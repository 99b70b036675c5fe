import base64
import zlib
from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips.clip import ObjectTrack
from hoidata.objects.model import ObjectModel
from pipelines.pages.player import motion_player, three_javascript, view_of


def test_three_comes_with_its_licence_notice_and_the_loader():
    script = three_javascript()
    assert "SPDX-License-Identifier: MIT" in script[:200]
    assert "THREE.GLTFLoader=" in script
    assert len(script) < 700_000
    assert "</script" not in script


def test_a_page_holds_a_motion_deflated(hands, page_clip):
    player = motion_player(page_clip(), hands, "a box")
    assert zlib.decompress(base64.b64decode(player.glb_packed)) == player.glb
    assert len(player.glb_packed) < len(player.glb)


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
