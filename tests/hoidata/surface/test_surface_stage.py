"""Stage surface: contact, depth and joint distances against a box's own formula, its folder, and what it refuses."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips import SIDES, ObjectTrack
from hoidata.errors import BadInput, MissingResource
from hoidata.files import canonical_json
from hoidata.files.arrays import read_npz
from hoidata.hands import load_embedded_hands, track_joints, track_vertices
from hoidata.objects.model import ObjectModel, articulate
from hoidata.objects.sampling import sample_points
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.store.store import open_store
from hoidata.surface.bimart_maps import bimart_map
from hoidata.surface.contact import deepest_m, placed_hand
from hoidata.surface.measure import ObjectShape, measure_hand
from hoidata.surface.solid_overlap import SolidOverlap
from hoidata.surface.stage import surface_store
from hoidata.surface.store import open_surface
from tests.builders.clips import with_hand, with_object
from tests.builders.stores import write_clips

POINTS = 128
HALF_BOX_M = np.array((0.05, 0.04, 0.03))
TOUCH_M = 0.005
LEFT_OUT = {"test/s2/left": "left out by quality control: so"}
ARGUMENTS: dict = {"points": POINTS, "left_out": LEFT_OUT, "progress": False}


def box_distance(places: np.ndarray) -> np.ndarray:
    """Signed distance to the surface of the box of ``make_clip``, negative inside (Quilez' formula), float64."""
    beyond = np.abs(places) - HALF_BOX_M
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def in_box(places: np.ndarray, track: ObjectTrack) -> np.ndarray:
    """World places (frame, place, 3) in the box's frame, with SciPy's rotations."""
    turn = Rotation.from_rotvec(np.asarray(track.rotvec, np.float64))
    return np.array(
        [turn[f].inv().apply(p - np.asarray(track.translation_m[f], np.float64)) for f, p in enumerate(places)]
    )


@pytest.fixture
def clips(make_clip):
    """A right hand that comes from afar into the box and is not seen in two frames, the left one never; two others."""
    through = make_clip(20, hand_type="right", seed=3, clip_id="test/s1/through")
    hand = through.hands["right"]
    toward = through.object.translation_m - hand.wrist_m
    toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    path = np.concatenate([np.linspace(-0.6, 0.0, 10), np.linspace(0.0, 0.05, 10)])[:, None] * toward
    valid = np.ones(20, bool)
    valid[[4, 15]] = False
    hand = replace(hand, wrist_m=(hand.wrist_m + path).astype(np.float32), valid=valid)
    unseen = replace(through.hands["left"], valid=np.zeros(20, bool))
    through = replace(through, hands={"left": unseen, "right": hand})
    both = make_clip(9, hand_type="both", articulated=True, seed=5, clip_id="test/s1/both")
    left = make_clip(7, hand_type="left", seed=6, clip_id="test/s2/left")
    return [through, both, left]


@pytest.fixture
def written(clips, tmp_path):
    write_clips(tmp_path / "clips", clips)
    return tmp_path, surface_store(tmp_path / "clips", tmp_path / "surface", **ARGUMENTS)


def test_contact_depth_and_joint_distance_are_those_of_the_box(written, clips):
    store, stored = open_surface(written[0] / "surface"), open_store(written[0] / "clips")
    clip, hands = stored.clip("test/s1/through"), load_embedded_hands()
    valid = clip.hands["right"].valid
    exact = box_distance(in_box(track_vertices(clip.hands["right"], hands["right"]), clip.object))
    sure = np.abs(np.abs(exact) - TOUCH_M) > 1e-6
    touched = store.touched("test/s1/through", "right")
    assert touched.shape == (20, 778)
    assert 0 < touched.sum() < touched.size
    np.testing.assert_array_equal(touched[sure], ((np.abs(exact) < TOUCH_M) & valid[:, None])[sure])
    depth = store.depth_m("test/s1/through", "right")
    assert (depth[valid] > 0.01).any()
    assert (depth[valid] == 0).any()
    np.testing.assert_allclose(depth[valid], np.maximum(-exact.min(axis=1), 0)[valid], atol=1e-6)
    assert np.isnan(depth[~valid]).all()
    joints = np.abs(box_distance(in_box(track_joints(clip.hands["right"], hands["right"]), clip.object))).min(axis=1)
    np.testing.assert_allclose(store.joint_m("test/s1/through", "right")[valid], joints[valid], atol=1e-6)
    assert np.isinf(store.joint_m("test/s1/through", "right")[~valid]).all()


def test_map_is_bimarts_rounded_to_steps_and_only_frames_within_reach_are_stored(written):
    store, stored = open_surface(written[0] / "surface"), open_store(written[0] / "clips")
    hands = load_embedded_hands()
    for clip_id in store.ids:
        clip = stored.clip(clip_id)
        points = sample_points(clip.object.model, POINTS)
        for side in SIDES:
            exact = bimart_map(placed_hand(clip, side, hands), points, clip.object.model)
            found = store.bimart_map(clip_id, side)
            assert found.shape == exact.shape
            near = np.isfinite(exact)
            row, seen = store.clips.loc[clip_id], np.flatnonzero(near.any(axis=1))
            kept = [seen[0], seen[-1] + 1] if len(seen) else [0, 0]
            assert [row[f"{side}_map_first"], row[f"{side}_map_stop"]] == kept
            np.testing.assert_array_equal(np.isfinite(found), near)
            assert np.abs(found[near] - exact[near]).max(initial=0) <= 0.0004 + 1e-6
    row = store.clips.loc["test/s1/through"]
    assert 0 < row["right_map_first"] < row["right_map_stop"] == 20
    assert row["left_map_stop"] == 0


def test_hand_type_follows_from_the_kept_distances_at_any_threshold(written):
    store = open_surface(written[0] / "surface")
    for threshold in (0.001, 0.01, 0.02, 0.2, 2.0):
        evidence = store.hand_evidence("test/s1/both", threshold)
        acting = [side for side in SIDES if (store.joint_m("test/s1/both", side) < threshold).any()]
        exact = [store.clips.at["test/s1/both", f"{side}_nearest_joint_m"] for side in SIDES]
        assert [evidence.closest_m(side) for side in SIDES] == exact
        assert evidence.hand_type == {0: None, 1: acting[0] if acting else None, 2: "both"}[len(acting)]
    assert store.hand_evidence("test/s1/both", 0.02).hand_type == "both"
    assert store.hand_evidence("test/s1/through", 9.0).hand_type == "right"


def test_table_sums_up_the_frames_and_lists_what_was_left_out(written):
    folder, report = written
    store = open_surface(folder / "surface")
    assert store.ids == ["test/s1/through", "test/s1/both"]
    row = store.clips.loc["test/s1/through"]
    depth = store.depth_m("test/s1/through", "right")
    assert row["right_touching_frames"] == store.touched("test/s1/through", "right").any(axis=1).sum()
    assert row["right_inside_frames"] == np.nansum(depth > 0)
    assert row["right_deepest_m"] == pytest.approx(np.nanmax(depth))
    assert 0 < row["right_deepest_volume_m3"] < 8 * HALF_BOX_M.prod()
    assert row[["left_inside_frames", "left_deepest_m", "left_deepest_volume_m3", "left_nearest_joint_m"]].isna().all()
    assert store.hand("test/s1/through", "right").deepest_volume_m3 == row["right_deepest_volume_m3"]
    assert row["right_nearest_joint_m"] == pytest.approx(store.joint_m("test/s1/through", "right").min())
    assert report.counts["left_out"] == 1
    assert report.counts["frames"] == 29
    touching = [
        any(store.touched(clip_id, side).any() for side in SIDES) for clip_id in ("test/s1/through", "test/s1/both")
    ]
    assert report.counts["touching"] == sum(touching) == 2
    assert not store.touched("test/s1/through", "left").any()
    assert "per 1,000 frames" in report.cost
    with pytest.raises(KeyError, match="was not measured: left out by quality control: so"):
        store.depth_m("test/s2/left", "left")
    with pytest.raises(KeyError, match="no clip 'test/s9'"):
        store.touched("test/s9", "left")


def test_volume_is_that_of_the_deepest_frame_at_the_angle_of_that_frame(make_clip):
    """A lid turns in the middle of the right hand, and the box under it goes on into the hand."""
    clip, hands = make_clip(8, hand_type="both", articulated=True, seed=5), load_embedded_hands()
    model, angles = clip.object.model, np.linspace(-0.5, 2.0, 8).astype(np.float32)
    lid_m = articulate(model.vertices_m, model.part, model.hinge, angles)[:, model.part == 1].mean(axis=1)
    middle = track_vertices(clip.hands["right"], hands["right"]).mean(axis=1)
    beside = np.linspace(0.0, 0.07, 8)[:, None] * np.array([0.0, 0.0, 1.0])
    place = middle + beside - np.einsum("fij,fj->fi", Rotation.from_rotvec(clip.object.rotvec).as_matrix(), lid_m)
    clip = with_object(clip, translation_m=place.astype(np.float32), hinge_rad=angles)
    clip = with_hand(clip, valid=np.arange(8) > 1)
    right = clip.hands["right"]
    shape = ObjectShape(model, sample_points(model, POINTS))
    found = measure_hand(clip, "right", track_joints(right, hands["right"]), hands, shape)
    hand = placed_hand(clip, "right", hands)
    volume = hand.over_clip(SolidOverlap(shape.index).volume_m3(hand.vertices_m, hand.faces, hand.hinge_rad), np.nan)
    np.testing.assert_array_equal(found.depth_m, deepest_m(hand, shape.index))
    deepest = int(np.nanargmax(found.depth_m))
    assert deepest > 2  # not the first in which the hand is there
    assert volume[deepest] > 1e-7
    assert found.deepest_volume_m3 == pytest.approx(volume[deepest], rel=1e-12)


def test_bits_of_touched_vertices_lie_as_the_layout_says(written):
    """The first of 778 vertices in the highest bit of the first of 98 bytes; clips one after another."""
    store = open_surface(written[0] / "surface")
    packed = read_npz(written[0] / "surface" / "surface-00000.npz")["right_touched"]
    touched = np.concatenate([store.touched(clip_id, "right") for clip_id in store.ids])
    assert packed.shape == (29, 98)
    for vertex in range(778):
        np.testing.assert_array_equal((packed[:, vertex // 8] >> (7 - vertex % 8)) & 1, touched[:, vertex])


def test_bytes_repeat_and_shards_do_not_change_what_is_read(written, monkeypatch):
    folder, _ = written
    surface_store(folder / "clips", folder / "again", **ARGUMENTS)
    names = sorted(path.name for path in (folder / "surface").iterdir())
    assert names == ["clips.parquet", "info.json", "objects.parquet", "surface-00000.npz"]
    assert [(folder / "again" / name).read_bytes() for name in names] == [
        (folder / "surface" / name).read_bytes() for name in names
    ]
    monkeypatch.setattr("hoidata.surface.store.FRAMES_PER_SHARD", 5)
    surface_store(folder / "clips", folder / "small", **ARGUMENTS)
    whole, parts = open_surface(folder / "surface"), open_surface(folder / "small")
    assert parts.clips["shard"].tolist()[:2] == [0, 1]
    for clip_id in whole.ids:
        for side in SIDES:
            for read in ("touched", "depth_m", "joint_m", "bimart_map"):
                np.testing.assert_array_equal(getattr(parts, read)(clip_id, side), getattr(whole, read)(clip_id, side))


def test_results_in_any_order_are_written_in_the_store_s_and_their_costs_added_up(written, monkeypatch):
    folder, asked = written[0], []

    def backwards(measure, clip_ids, jobs):
        asked.append(jobs)
        for clip_id in reversed(clip_ids):
            yield clip_id, (measure(clip_id)[0], {"contact": 0.25, "maps": 1.0})

    monkeypatch.setattr("hoidata.surface.stage.in_workers", backwards)
    report = surface_store(folder / "clips", folder / "backwards", jobs=8, **ARGUMENTS)
    for path in (folder / "surface").iterdir():
        assert (folder / "backwards" / path.name).read_bytes() == path.read_bytes()
    assert report.seconds == {"contact": 0.75, "maps": 3.0}
    assert report.cost == "129.310 s per 1,000 frames of two hands (contact 25.862, maps 103.448)"
    assert asked == [1]  # of 36 frames a second process would cost more than it saves
    monkeypatch.setattr("hoidata.surface.stage.FRAMES_PER_JOB", 18)
    for jobs, expected in ((8, 3), (2, 2)):
        surface_store(folder / "clips", folder / "again", jobs=jobs, **ARGUMENTS)
        assert asked.pop() == expected


@pytest.mark.long
def test_bytes_do_not_depend_on_the_number_of_processes(written, monkeypatch):
    folder, _ = written
    monkeypatch.setattr("hoidata.surface.stage.FRAMES_PER_JOB", 10)
    surface_store(folder / "clips", folder / "jobs", jobs=2, **ARGUMENTS)
    for path in (folder / "surface").iterdir():
        assert (folder / "jobs" / path.name).read_bytes() == path.read_bytes()


def test_object_without_an_inside_has_no_depth_and_says_so(make_clip, tmp_path):
    """A single square plate: it can be touched, nothing can be inside it."""
    clip = make_clip(6)
    corners = np.array([(-0.05, -0.04, 0.03), (0.05, -0.04, 0.03), (0.05, 0.04, 0.03), (-0.05, 0.04, 0.03)])
    plate = ObjectModel("plate", corners, np.array([(0, 1, 2), (0, 2, 3)]), np.zeros(4, np.uint8))
    clip = with_object(clip, model=plate)
    write_clips(tmp_path / "clips", [clip])
    report = surface_store(tmp_path / "clips", tmp_path / "surface", points=POINTS, progress=False)
    store = open_surface(tmp_path / "surface")
    assert report.counts["objects_not_solid"] == 1
    assert not store.is_solid(clip.clip_id)
    assert np.isnan(store.depth_m(clip.clip_id, "right")).all()
    assert store.touched(clip.clip_id, "right").any()
    assert "open" in store.objects.loc[0, "note"]
    for name in ("inside_frames", "deepest_m", "deepest_volume_m3"):
        assert pd.isna(store.clips.loc[clip.clip_id, f"right_{name}"])


def test_object_of_metres_has_depths_but_no_volumes(make_clip, tmp_path):
    clip = make_clip(4)
    model = clip.object.model
    vertices = model.vertices_m * np.array((1.0, 60.0, 40.0))
    large = with_object(clip, model=replace(model, vertices_m=vertices))
    write_clips(tmp_path / "clips", [large])
    surface_store(tmp_path / "clips", tmp_path / "surface", points=POINTS, progress=False)
    row = open_surface(tmp_path / "surface").clips.iloc[0]
    assert row["right_deepest_m"] > 0.01
    assert pd.isna(row["right_deepest_volume_m3"])


def test_one_mesh_without_a_surface_costs_its_own_clips_only(clips, tmp_path, monkeypatch):
    def index_of(model):
        if model.name == "hinged_box":
            raise BadInput("mesh of 'hinged_box'", "at least one triangle", "none")
        return SurfaceIndex(model)

    for module in ("stage", "measure"):
        monkeypatch.setattr(f"hoidata.surface.{module}.SurfaceIndex", index_of)
    write_clips(tmp_path / "clips", clips)
    report = surface_store(tmp_path / "clips", tmp_path / "surface", points=POINTS, progress=False)
    store = open_surface(tmp_path / "surface")
    assert store.ids == ["test/s1/through", "test/s2/left"]
    assert "at least one triangle" in store.clips.at["test/s1/both", "reason"]
    assert report.counts["left_out"] == report.counts["objects_not_solid"] == 1


def test_store_without_clips_gives_a_folder_that_reads(tmp_path):
    surface_store(write_clips(tmp_path / "clips", []), tmp_path / "surface", progress=False)
    assert open_surface(tmp_path / "surface").ids == []


def test_wrong_settings_are_refused(written):
    folder, _ = written
    for touch_m in (0.0, -0.005, np.nan, np.inf):
        with pytest.raises(BadInput, match="touch_m"):
            surface_store(folder / "clips", folder / "new", touch_m=touch_m, progress=False)
    with pytest.raises(BadInput, match=r"surface\.points"):
        surface_store(folder / "clips", folder / "new", points=0, progress=False)
    assert not (folder / "new").exists()


def test_missing_other_or_damaged_folder_is_refused(written):
    folder, _ = written
    surface = folder / "surface"
    with pytest.raises(MissingResource, match="run the stage 'surface'"):
        open_surface(folder / "nothing")
    good = (surface / "info.json").read_text()
    (surface / "info.json").write_text(good.replace('"surface_version":1', '"surface_version":2'))
    with pytest.raises(BadInput, match="surface_version 1"):
        open_surface(surface)
    for text in ("{", canonical_json([1]), canonical_json({"points": 3})):
        (surface / "info.json").write_text(text)
        with pytest.raises(BadInput, match="surface"):
            open_surface(surface)
    (surface / "info.json").write_text(good.replace(f'"points":{POINTS}', '"points":64'))
    with pytest.raises(BadInput, match=r"left_map|right_map"):
        open_surface(surface).touched("test/s1/both", "left")
    (surface / "info.json").write_text(good)
    table = (surface / "clips.parquet").read_bytes()
    (surface / "clips.parquet").write_bytes(table[:100])
    with pytest.raises(BadInput, match="a Parquet table"):
        open_surface(surface)
    pd.read_parquet(surface / "objects.parquet").to_parquet(surface / "clips.parquet")
    with pytest.raises(BadInput, match="none named"):
        open_surface(surface)
    (surface / "clips.parquet").write_bytes(table)
    (surface / "surface-00000.npz").write_bytes(b"PK")
    with pytest.raises(BadInput, match="stored NPZ"):
        open_surface(surface).touched("test/s1/both", "left")
