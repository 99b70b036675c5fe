"""The GLB of a motion against independent formulas, and the player that shows it."""

import base64
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import ObjectTrack
from hoidata.files import write_whole
from hoidata.hands import HandKinematics, track_joints, track_rotmats
from hoidata.hands.model import HandModel
from hoidata.objects.model import ObjectModel
from pipelines.pages import player
from pipelines.pages.glb import contact_colours, continuous_quaternions, glb_bytes, upright_rotation
from pipelines.pages.player import motion_player, three_javascript, view_of
from pipelines.pages.surface import ContactPaint, crease_normals, display_surface, paint_values


def without_pose_correctives(model: HandModel) -> HandModel:
    values = {name: getattr(model, name) for name in model.__dataclass_fields__}
    return HandModel(**{**values, "pose_directions": np.zeros_like(model.pose_directions)})


@pytest.mark.parametrize("side", ["left", "right"])
def test_skinned_hand_equals_the_kinematics_without_pose_correctives(side, hands, page_clip, read_glb, tmp_path):
    clip = page_clip(right=True, left=True)
    glb = read_glb(write_whole(tmp_path / "motion.glb", glb_bytes(clip, hands)))
    track = clip.hands[side]
    layer = HandKinematics(without_pose_correctives(hands[side]), torch.float64)
    vertices, _ = layer(
        torch.tensor(track.wrist_m), torch.tensor(track_rotmats(track)), torch.tensor(track.betas, dtype=torch.float64)
    )
    for frame in (0, 11, clip.n_frames - 1):
        assert np.abs(glb.skinned(f"{side} hand", frame) - vertices[frame].numpy()).max() < 1e-4


def test_skeleton_nodes_lie_on_the_joints_of_the_track(hands, page_clip, read_glb, tmp_path):
    clip = page_clip()
    glb = read_glb(write_whole(tmp_path / "motion.glb", glb_bytes(clip, hands)))
    joints = track_joints(clip.hands["right"], hands.right)[7]
    for joint, name in ((0, "wrist"), (3, "index3"), (15, "thumb3")):
        position = glb.world_matrix(glb.node(f"right {name}"), 7, world=False)[:3, 3]
        assert np.abs(position - joints[joint]).max() < 1e-4


def test_hand_that_is_never_valid_is_not_in_the_file(hands, page_clip, read_glb, tmp_path):
    glb = glb_bytes(page_clip(right=True, left=False), hands)
    names = read_glb(write_whole(tmp_path / "motion.glb", glb)).node_names()
    assert "right hand" in names
    assert not [name for name in names if name.startswith("left")]


def test_hand_vanishes_in_frames_where_it_means_nothing(hands, page_clip, read_glb, tmp_path):
    clip = page_clip()
    clip.hands["right"].valid[:5] = False
    glb = read_glb(write_whole(tmp_path / "motion.glb", glb_bytes(clip, hands)))
    assert np.ptp(glb.skinned("right hand", 2), axis=0).max() < 1e-6
    assert np.ptp(glb.skinned("right hand", 5), axis=0).max() > 0.1


def test_moving_part_turns_about_the_hinge_line(hands, page_clip, read_glb, tmp_path):
    clip = page_clip(hinged=True)
    glb = read_glb(write_whole(tmp_path / "motion.glb", glb_bytes(clip, hands)))
    model, track, frame = clip.object.model, clip.object, 20
    angle = Rotation.from_rotvec(model.hinge.axis * track.hinge_rad[frame]).as_matrix()
    lid = model.vertices_m[model.part == 1]
    expected = (lid - model.hinge.origin_m) @ angle.T + model.hinge.origin_m
    expected = expected @ Rotation.from_rotvec(track.rotvec[frame]).as_matrix().T + track.translation_m[frame]
    part_vertices = glb.placed("lidded box part mesh", frame)
    assert np.abs(np.sort(part_vertices.min(axis=0)) - np.sort(expected.min(axis=0))).max() < 1e-5
    assert np.abs(part_vertices.max(axis=0) - expected.max(axis=0)).max() < 1e-5


def test_gravity_points_down_in_the_viewer(page_clip):
    for gravity in (np.array((0.0, 0.0, -1.0)), np.array((0.0, 1.0, 0.0)), np.array((0.6, 0.0, 0.8))):
        assert np.allclose(upright_rotation(gravity).apply(gravity), (0, -1, 0), atol=1e-9)
    assert upright_rotation(None).magnitude() == 0


def test_trimesh_opens_the_file_and_finds_the_same_triangles(hands, page_clip, tmp_path):
    scene = trimesh.load_scene(write_whole(tmp_path / "motion.glb", glb_bytes(page_clip(), hands)))
    counts = sorted(len(geometry.faces) for geometry in scene.geometry.values())
    assert counts == [12, 1538]


def test_touched_corner_is_painted_and_the_far_side_is_not(hands, page_clip, read_glb, tmp_path):
    clip = page_clip()
    model = clip.object.model
    mesh = trimesh.Trimesh(model.vertices_m, model.faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, 1024, seed=3)
    corner = model.vertices_m.max(axis=0)
    paint = ContactPaint(points, np.zeros(1024), (np.linalg.norm(points - corner, axis=1) < 0.03).astype(float))
    glb = read_glb(write_whole(tmp_path / "motion.glb", glb_bytes(clip, hands, paint)))
    attributes = glb.document.meshes[glb.document.nodes[glb.node("box base mesh")].mesh].primitives[0].attributes
    position, colour = glb.array(attributes.POSITION), glb.array(attributes.COLOR_0)
    red = contact_colours(np.array([1.0]))[0]
    assert (colour[np.linalg.norm(position - corner, axis=1) < 0.015] == red).all()
    assert (colour[np.linalg.norm(position + corner, axis=1) < 0.02] == contact_colours(np.array([0.0]))[0]).all()


def test_full_contact_is_painted_full_everywhere_and_no_points_paint_nothing():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
    everywhere = ContactPaint(points, np.zeros(3), np.ones(3))
    assert np.allclose(paint_values(np.array([[-50.0, 0, 0], [1.0, 0, 0]]), everywhere), 1)
    assert (paint_values(points, ContactPaint(np.zeros((0, 3)), np.zeros(0), np.zeros(0))) == 0).all()


def test_the_same_mesh_is_shown_plain_and_with_each_of_its_contact_maps():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    vertices, faces = np.asarray(box.vertices), np.asarray(box.faces)
    paints = [ContactPaint(vertices, np.zeros(8), np.full(8, value)) for value in (0.25, 0.75)]
    first, second = (display_surface(vertices, faces, paint) for paint in paints)
    plain, larger = display_surface(vertices, faces), display_surface(2 * vertices, faces)
    assert np.allclose(first.value, 0.25)
    assert np.allclose(second.value, 0.75)
    assert plain.value is None
    assert len(plain.vertices_m) == 24 < len(first.vertices_m)
    assert np.allclose(larger.vertices_m, 2 * plain.vertices_m)


def test_edges_of_a_box_stay_crisp_and_a_ball_is_smooth():
    box = trimesh.creation.box((1, 1, 1))
    normals = crease_normals(np.asarray(box.vertices), np.asarray(box.faces))
    assert np.allclose(normals, box.face_normals[:, None], atol=1e-9)
    ball = trimesh.creation.icosphere(3)
    normals = crease_normals(np.asarray(ball.vertices), np.asarray(ball.faces))
    assert np.abs(normals - ball.vertices[ball.faces]).max() < 0.02


def test_quaternions_do_not_flip_between_frames():
    """Nearly two turns about z, in axis-angle of at most half a turn: the axis turns about twice on the way."""
    angle = np.linspace(0, 12, 60)
    wrapped = np.arctan2(np.sin(angle), np.cos(angle))
    assert (np.abs(np.diff(wrapped)) > np.pi).sum() == 2
    quaternions = continuous_quaternions(np.outer(wrapped, (0, 0, 1)))
    assert (np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1]) > 0.9).all()
    ahead = Rotation.from_quat(quaternions).apply((1, 0, 0))
    np.testing.assert_allclose(ahead, np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), atol=1e-12)


def test_three_comes_with_its_licence_notice_and_the_loader():
    script = three_javascript()
    assert "SPDX-License-Identifier: MIT" in script[:200]
    assert "THREE.GLTFLoader=" in script
    assert len(script) < 700_000
    assert "</script" not in script


FETCHES = re.compile(
    r"""(?:src|href|data)\s*=\s*["']?\s*(?:https?:)?//|url\(\s*["']?(?:https?:)?//|@import|https?://""", re.I
)


def test_no_page_fetches_anything():
    folder = Path(player.__file__).parent
    for path in (path for path in folder.iterdir() if path.suffix in (".html", ".css", ".js")):
        assert not FETCHES.search(path.read_text()), path
        if path.suffix == ".html" and path.stem not in ("base", "macros", "metrics", "quality"):
            assert '{% extends "base.html" %}' in path.read_text(), path
    assert "default-src 'none'" in (folder / "base.html").read_text()


def test_a_page_holds_a_motion_deflated(hands, page_clip):
    shown = motion_player(page_clip(), hands, "a box")
    assert zlib.decompress(base64.b64decode(shown.glb_packed)) == shown.glb
    assert len(shown.glb_packed) < len(shown.glb)


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


def test_other_objects_are_in_the_legend_once(hands, page_clip):
    clip = page_clip()
    model = replace(clip.object.model, name="low_table")
    table = replace(clip.object, model=model)
    legend = dict(motion_player(replace(clip, other_objects=(table, table)), hands, "title").legend)
    assert list(legend)[-1] == "low table"
    assert len(set(legend.values())) == len(legend)
    assert "low table" not in dict(motion_player(clip, hands, "title").legend)


def test_the_ground_lies_under_a_table_which_does_not_widen_the_view(hands, page_clip):
    clip = page_clip()
    slab = np.array([[-0.5, -0.4, 0.0], [0.5, -0.4, 0.0], [0.5, 0.4, 0.0], [-0.5, 0.4, -0.3]])
    model = ObjectModel("table", slab, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(4, np.uint8))
    still = np.zeros((clip.n_frames, 3), np.float32)
    with_table = view_of(replace(clip, other_objects=(ObjectTrack(model, still, still),)), hands)
    assert with_table.ground_m == pytest.approx(-0.3)
    assert replace(with_table, ground_m=None) == replace(view_of(clip, hands), ground_m=None)
