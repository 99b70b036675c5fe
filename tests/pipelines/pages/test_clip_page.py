"""The page of one clip: time series against independent formulas, texts, and equal bytes."""

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from html import unescape

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.annotation.stage import annotate_store
from hoidata.clips.clip import CameraTrack, SourceFile
from hoidata.contact.settings import read_contact_settings
from hoidata.errors import MissingResource
from hoidata.files import write_whole
from hoidata.hands import track_joints, track_vertices
from hoidata.store.annotated import load_annotated
from pipelines.pages.clip_page import page_name, paint_values, write_clip_page
from pipelines.pages.clip_page_facts import clip_facts, measure_clip
from pipelines.pages.clip_page_timeline import Chart, Line, clip_charts, draw_timeline
from pipelines.pages.glb import glb_bytes
from pipelines.pages.player import three_javascript
from tests.builders.stores import write_annotated

THRESHOLD_M = 0.09
SPLIT = {"by": "subject", "train": "rest", "test": ["s2"], "promises": ["subject"]}
SHA256 = "5e88" * 16


@pytest.fixture(scope="module")
def written(page_clip, tmp_path_factory):
    """Three annotated clips: both hands with a hinged box, a right hand that leaves for five frames, hands far away."""
    both = replace(page_clip(left=True, hinged=True), clip_id="test/s1/lid", labelled_hand="right")
    right = page_clip()
    frames = right.n_frames
    hand = replace(right.hands["right"], valid=(np.arange(frames) < 5) | (np.arange(frames) >= 10))
    camera = CameraTrack("cam4", np.zeros((frames, 3)), np.zeros((frames, 3)), np.arange(frames, dtype=np.int32) + 700)
    right = replace(
        right,
        clip_id="test/s2/box",
        subject="s2",
        hands={"left": right.hands["left"], "right": hand},
        sources=(SourceFile("s2/<box>.npz", 12345, SHA256),),
        camera=camera,
    )
    far_hand = replace(right.hands["right"], wrist_m=right.hands["right"].wrist_m + 1.0)
    far = replace(
        right,
        clip_id="test/s2/far",
        hands={"left": right.hands["left"], "right": far_hand},
        gravity=None,
        gravity_note="still",
    )
    root = tmp_path_factory.mktemp("written") / "grab"
    return write_annotated(root, [both, right, far], "grab", SPLIT, THRESHOLD_M, quality=True)


@pytest.fixture
def dataset(written, hands, tmp_path):
    """A copy that a test may change."""
    return load_annotated(shutil.copytree(written, tmp_path / "grab"), hands)


@pytest.fixture(scope="module")
def page(written, hands, tmp_path_factory):
    """Call it with a clip's id: the page of the clip as it was written, made once."""
    folder, annotated = tmp_path_factory.mktemp("pages"), load_annotated(written, hands)
    return cache(lambda clip_id: write_clip_page(folder / page_name(clip_id), annotated, clip_id, hands))


def world_points(annotated, clip):
    """(frame, point, 3) sampled points in the world, from the definition of a hinge and a pose."""
    points = annotated.points(annotated.object_key(clip.clip_id))
    placed = []
    for frame in range(clip.n_frames):
        local = points.points_m.astype(np.float64).copy()
        if clip.object.model.hinge is not None:
            hinge, moves = clip.object.model.hinge, points.part == 1
            rotation = Rotation.from_rotvec(np.asarray(hinge.axis) * clip.object.hinge_rad[frame]).as_matrix()
            local[moves] = (local[moves] - hinge.origin_m) @ rotation.T + hinge.origin_m
        rotation = Rotation.from_rotvec(clip.object.rotvec[frame]).as_matrix()
        placed.append(local @ rotation.T + clip.object.translation_m[frame])
    return np.stack(placed)


def box_distance_m(clip, places):
    """(frame, place) distances of world places (frame, place, 3) to a rigid box of 8 x 12 x 6 cm, by formula."""
    turns, half = Rotation.from_rotvec(clip.object.rotvec).as_matrix(), np.array((0.04, 0.06, 0.03))
    away = places.astype(np.float64) - clip.object.translation_m[:, None]
    beyond = np.abs(np.einsum("fvi,fij->fvj", away, turns)) - half
    return np.abs(np.linalg.norm(np.maximum(beyond, 0), axis=2) + np.minimum(beyond.max(axis=2), 0))


@pytest.mark.parametrize("clip_id", ["test/s1/lid", "test/s2/box"])
def test_touched_points_and_nearest_distances_are_those_of_brute_force(dataset, hands, clip_id):
    clip = dataset.clip(clip_id)
    series = measure_clip(dataset, clip, hands)
    points = world_points(dataset, clip)
    for side, track in clip.hands.items():
        joints = track_joints(track, hands[side]).astype(np.float64)
        distance = np.linalg.norm(joints[:, :, None] - points[:, None], axis=3)
        distance[~track.valid] = np.inf
        clear = np.abs(distance - THRESHOLD_M).min(axis=1) > 1e-6
        assert (series.touched[side] == (distance.min(axis=1) < THRESHOLD_M))[clear].all()
        np.testing.assert_allclose(series.evidence.distance_m[side], distance.min(axis=(1, 2)), atol=1e-6)
    assert series.touched["right"].any()


def test_lift_and_speed_are_those_of_the_objects_middle(dataset, hands):
    clip = dataset.clip("test/s1/lid")
    series = measure_clip(dataset, clip, hands)
    middle = world_points(dataset, clip).mean(axis=1)
    assert series.lift_m is not None
    np.testing.assert_allclose(series.lift_m, middle[:, 2] - middle[0, 2], atol=1e-6)
    inner = np.linalg.norm(middle[2:] - middle[:-2], axis=1) / 2 * 30
    np.testing.assert_allclose(series.speed_m_s[1:-1], inner, atol=1e-5)
    assert series.lift_m[-1] > 0.19
    assert measure_clip(dataset, dataset.clip("test/s2/far"), hands).lift_m is None


def test_depth_is_the_distance_of_a_vertex_inside_the_box(dataset, hands):
    """Rigid box of 8 x 12 x 6 cm: the depth of an inner point is its distance to the nearest of six planes."""
    clip = dataset.clip("test/s2/box")
    track = clip.hands["right"]
    deep = replace(track, wrist_m=clip.object.translation_m + np.array((0.05, 0.0, 0.0), np.float32))
    moved = replace(clip, hands={"left": clip.hands["left"], "right": deep})
    series = measure_clip(dataset, moved, hands)
    vertices = track_vertices(deep, hands["right"]).astype(np.float64) - clip.object.translation_m[:, None]
    rotation = Rotation.from_rotvec(clip.object.rotvec).as_matrix()
    local = np.einsum("fvi,fij->fvj", vertices, rotation)
    depth = np.maximum((np.array((0.04, 0.06, 0.03)) - np.abs(local)).min(axis=2).max(axis=1), 0)
    assert depth.max() > 0.01
    assert series.depth_m is not None
    np.testing.assert_allclose(series.depth_m["right"][track.valid], depth[track.valid], atol=1e-6)
    assert np.isnan(series.depth_m["right"][~track.valid]).all()
    assert np.isnan(series.depth_m["left"]).all()


def test_hand_against_the_surface_is_that_of_the_box(dataset, hands):
    """Distance of joints to a box of 8 x 12 x 6 cm by formula, and vertices closer than 5 mm."""
    clip = dataset.clip("test/s2/box")
    series = measure_clip(dataset, clip, hands)
    track = clip.hands["right"]
    joints = box_distance_m(clip, track_joints(track, hands["right"])).min(axis=1)
    np.testing.assert_allclose(series.surface["right"].joint_m[track.valid], joints[track.valid], atol=1e-6)
    vertices = box_distance_m(clip, track_vertices(track, hands["right"]))
    clear = np.abs(vertices - 0.005) > 1e-6
    expected = (vertices < 0.005) & track.valid[:, None]
    np.testing.assert_array_equal(series.surface["right"].touched[clear], expected[clear])
    assert not series.surface["left"].touched.any()


def test_packed_distances_of_every_frame_are_bimarts_in_steps(dataset, hands):
    clip = dataset.clip("test/s1/lid")
    points, series = dataset.points("lidded box"), measure_clip(dataset, clip, hands)
    maps = {side: measured.map_m for side, measured in series.surface.items()}
    values = json.loads(json.dumps(paint_values(clip, points, series.touched, maps)))
    placed = world_points(dataset, clip)
    for side in ("left", "right"):
        steps = np.frombuffer(base64.b64decode(values["distances"][side]), np.uint8).reshape(clip.n_frames, -1)
        vertices = track_vertices(clip.hands[side], hands[side])
        for frame in (0, 12, 23):
            nearest = np.linalg.norm(placed[frame][:, None] - vertices[frame][None], axis=2).min(axis=1)
            near = nearest < 0.1999
            assert near.any()
            np.testing.assert_allclose(steps[frame][near] * 0.0008, nearest[near], atol=0.000401)
            assert (steps[frame][nearest > 0.2001] == 255).all()
    assert values["farthest"] * 0.0008 == pytest.approx(0.2)


def test_packed_contact_of_every_frame_unpacks_to_the_touched_points(dataset, hands):
    clip = dataset.clip("test/s1/lid")
    points = dataset.points("lidded box")
    touched = measure_clip(dataset, clip, hands).touched
    values = json.loads(json.dumps(paint_values(clip, points, touched, {})))
    for side in ("left", "right"):
        data = base64.b64decode(values[side])
        for frame in (0, 11, 23):
            packed = data[frame * values["stride"] : (frame + 1) * values["stride"]]
            unpacked = [point for point in range(len(points)) if packed[point // 8] >> (7 - point % 8) & 1]
            assert unpacked == np.flatnonzero(touched[side][frame]).tolist()


def test_every_painted_mesh_of_the_glb_finds_its_points_where_its_vertices_are(dataset, hands, read_glb, tmp_path):
    clip = dataset.clip("test/s1/lid")
    points = dataset.points("lidded box")
    glb = read_glb(write_whole(tmp_path / "clip.glb", glb_bytes(clip, hands)))
    values = paint_values(clip, points, measure_clip(dataset, clip, hands).touched, {})
    assert sorted(number for part in values["parts"] for number in part["numbers"]) == list(range(len(points)))
    assert len(values["parts"]) == 2
    for part in values["parts"]:
        node = glb.document.nodes[glb.node(part["mesh"])]
        vertices = glb.array(glb.document.meshes[node.mesh].primitives[0].attributes.POSITION)
        position_m = np.array(part["tenth_mm"]).reshape(-1, 3) * 1e-4
        np.testing.assert_allclose(position_m.min(axis=0), vertices.min(axis=0), atol=0.012)
        np.testing.assert_allclose(position_m.max(axis=0), vertices.max(axis=0), atol=0.012)


def test_page_shows_sentences_evidence_quality_split_and_sources(dataset, page):
    text = page("test/s2/box").read_text()
    for sentence in dataset.sentences("test/s2/box"):
        assert sentence in text
    assert f'<td>s2/&lt;box&gt;.npz</td><td class="number">12,345</td><td>{SHA256}</td>' in text
    assert "<h2>Hand type: right</h2>" in text
    assert '<td>right</td><td class="number">19 of 24</td><td>yes</td>' in text
    assert '<td>left</td><td class="number">0 of 24</td><td>no</td><td class="number">never visible</td>' in text
    assert "exact surface in place of sampled points the hand type is the same." in text
    assert "The source has no label of the hand." in text
    assert "cam4, images 700 to 723" in text
    assert "(chosen)</td><td>test</td>" in text
    assert "(0, 0, -1), stated by the source" in text
    assert "SYNTHETIC" in text


def test_page_gives_the_nearest_distances_in_centimetres(dataset, page, hands):
    """Distances of the right hand in its valid frames: joint to sampled point, and joint to the box by formula."""
    clip = dataset.clip("test/s2/box")
    track = clip.hands["right"]
    joints, points = track_joints(track, hands["right"]).astype(np.float64), world_points(dataset, clip)
    to_points = np.linalg.norm(joints[:, :, None] - points[:, None], axis=3)[track.valid].min()
    to_surface = box_distance_m(clip, joints)[track.valid].min()
    [cells] = re.findall(r"<td>right</td>.*?</tr>", page("test/s2/box").read_text(), re.S)
    shown = [float(number) for number in re.findall(r"([\d.]+) cm<", cells)]
    assert shown == pytest.approx([100 * to_points, 100 * to_surface], abs=0.0051)


def test_fit_to_keypoints_is_shown_with_its_error_in_millimetres(dataset, hands):
    fitted = replace(dataset.clip("test/s2/box"), hands_from="keypoints", fit_error_m=0.0042)
    said = dict(clip_facts(dataset, fitted, hands))["hands from"]
    assert said == "a hand model fitted to the source's keypoints, mean error 4.2 mm"


def test_frames_that_were_interpolated_are_counted(dataset, hands):
    clip = dataset.clip("test/s2/box")
    numbers = np.arange(clip.n_frames, dtype=np.int32)
    numbers[[4, 5, 9]] = 3, 3, 8
    said = [dict(clip_facts(dataset, replace(clip, source_frames=source_frames), hands))["source frames"]
            for source_frames in (np.arange(clip.n_frames, dtype=np.int32), numbers)]  # fmt: skip
    assert "interpolated" not in said[0]
    assert said[1].endswith(f"; 3 of {clip.n_frames} frames are interpolated")


def test_page_says_where_annotator_and_distances_disagree(page):
    text = page("test/s1/lid").read_text()
    assert "Label of the source: right, which DISAGREES" in text
    assert "with a hinge" in text
    assert text.count('<div class="readout"') == 7


@pytest.mark.slow
def test_page_names_the_source_of_the_hand_type_if_labels_are_used(dataset, hands, tmp_path):
    contact = read_contact_settings(dataset.root / "contact")
    annotate_store(
        dataset.root / "clips",
        dataset.root / "annotation",
        encoder="hash",
        contact=contact,
        hand="annotated-else-proximity",
    )
    annotated = load_annotated(dataset.root, hands)
    for clip_id, words in (("test/s1/lid", "as for this clip."), ("test/s2/box", "but not for this clip.")):
        text = write_clip_page(tmp_path / "page.html", annotated, clip_id, hands).read_text()
        assert f"If the source has a label of the hand, the label is used instead, {words}" in unescape(text)
        assert "<h2>Hand type: right</h2>" in text


@pytest.mark.slow
def test_verb_derived_from_the_motion_is_marked_as_derived(page_clip, hands, tmp_path):
    """A box lifted by 20 cm under the hand, without a label in the source."""
    clips, rule = [replace(page_clip(), verb=None)], {**SPLIT, "test": []}
    root = write_annotated(tmp_path / "grab", clips, "grab", rule, THRESHOLD_M, quality=True)
    text = write_clip_page(tmp_path / "page.html", load_annotated(root, hands), "test/box_lift", hands).read_text()
    assert re.search(r"<dd>lift, derived from the motion \(.+\): the source has no label</dd>", text)


def test_clip_without_sentences_has_a_page_with_the_reason(page):
    text = page("test/s2/far").read_text()
    assert "No sentences: no joint within 9 cm of the object" in text
    assert "<h2>Hand type: none</h2>" in text
    assert '<td>right</td><td class="number">19 of 24</td><td>no</td>' in text
    assert "The direction of gravity is unknown" in text
    assert "No hand comes within 9 cm of the object." in text


def test_page_repeats_byte_for_byte_and_fetches_nothing(dataset, page, hands, tmp_path):
    first, second = page("test/s1/lid"), write_clip_page(tmp_path / "again.html", dataset, "test/s1/lid", hands)
    assert first.read_bytes() == second.read_bytes()
    own_part = first.read_text().replace(three_javascript(), "")
    assert not re.search(r"https?://|@import|url\((?!#)", own_part)
    assert "default-src 'none'" in own_part


def test_missing_quality_control_is_named(dataset, hands, tmp_path):
    shutil.rmtree(dataset.root / "quality")
    with pytest.raises(MissingResource, match="run the stage 'quality'"):
        write_clip_page(tmp_path / "page.html", dataset, "test/s1/lid", hands)


def test_cursor_of_the_first_and_the_last_frame_lie_at_the_ends_of_the_lines(dataset, hands):
    """Checked against the drawing itself: the x coordinates of the plotted line, in the svg's own units."""
    timeline = draw_timeline([Chart("height", "cm", [Line("object", "#123456", np.array([0.0, 5.0, 2.0]))], 1)], "salt")
    [width] = re.findall(r'viewBox="0 0 ([0-9.]+) ', timeline.svg)
    [path] = re.findall(r'<path d="M ([^"]*)"[^>]*stroke: #123456', timeline.svg)
    numbers = [float(word) for word in re.findall(r"-?[0-9.]+", path)]
    ends = np.array([min(numbers[0::2]), max(numbers[0::2])]) / float(width) * 100
    np.testing.assert_allclose([timeline.left, timeline.right], ends, atol=0.05)


def test_values_under_the_cursor_are_empty_where_a_hand_is_not_valid(dataset, hands):
    series = measure_clip(dataset, dataset.clip("test/s2/box"), hands)
    charts = clip_charts(series, ["right"], 1024)
    assert charts[1].title == "distance of the closest joint to the object"
    values = draw_timeline(charts, "salt").charts[1][1][0]["values"]
    assert values[5:10] == [None] * 5
    assert values[4] == pytest.approx(series.evidence.distance_m["right"][4] * 100, abs=0.05)


def test_page_names_are_safe_file_names():
    assert page_name("arctic/s01/box_grab_01/0012-0100") == "arctic_s01_box_grab_01_0012-0100.html"
    assert "/" not in page_name("../../etc/passwd")


@pytest.mark.long
def test_curves_and_contact_follow_the_player_in_chromium(chromium, dataset, page, hands, tmp_path):
    page = page("test/s1/lid")
    profile = f"--user-data-dir={tmp_path / 'profile'}"
    chromium += [profile, "--virtual-time-budget=6000", "--dump-dom"]
    series = measure_clip(dataset, dataset.clip("test/s1/lid"), hands)
    for part, frame in ((0.0, 0), (1.0, 23)):
        command = [*chromium, f"{page.as_uri()}#t={part}"]
        dom = subprocess.run(command, check=True, capture_output=True, text=True, timeout=180).stdout
        shown = re.findall(r'<div class="readout".*?</div>', dom, re.S)[0]
        counts = [int(number) for number in re.findall(r"<b>(\d+)</b>", shown)]
        assert counts == [int(series.touched[side][frame].sum()) for side in ("left", "right")]
        assert f"frame {frame} of 23" in dom
    painted = tmp_path / "painted.html"
    text = page.read_text().replace('value="frame" checked', 'value="frame"')
    painted.write_text(text.replace('value="left">', 'value="left" checked>'))
    command = [*chromium, f"{painted.as_uri()}#t=0.5"]
    dom = subprocess.run(command, check=True, capture_output=True, text=True, timeout=180).stdout
    # The legends change places after the object has been painted.
    assert '<span class="legend" data-for="distance">' in dom
    assert '<span class="legend" data-for="contact" hidden="">' in dom
