"""An object with a prismatic joint: a drawer in the model, store, networks' inputs, keyframes and exports."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from hoidata.actions.action import action_numbers
from hoidata.batches.requests import ObjectPoints, Request, collate_requests
from hoidata.clips.clip import Clip, ObjectTrack
from hoidata.clips.features import object_features
from hoidata.errors import BadInput
from hoidata.object_paths import keyframed_path, parse_keyframes
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.objects.sampling import sample_points
from hoidata.objects.signed_distance_grid import DistanceFields
from hoidata.objects.surface_index import surface_index
from hoidata.objects.user_mesh import read_user_object
from hoidata.sensors.part_bps import BasisSettings, PartBps, canonical_object
from hoidata.store.info import generated_info
from hoidata.store.store import open_store, write_store
from hoidata.store_check.check import check_store
from models.common.features import place_points
from tests.builders.clips import clip_of
from tests.builders.urdf import write_drawer

SLIDE_M = np.linspace(0, 0.15, 6).astype(np.float32)


@pytest.fixture
def drawer(tmp_path: Path) -> ObjectModel:
    return read_user_object(write_drawer(tmp_path / "drawer")).model


def opened(model: ObjectModel) -> Clip:
    frames = len(SLIDE_M)
    track = ObjectTrack(model, np.full((frames, 3), 0.2, np.float32), np.full((frames, 3), 0.3, np.float32), SLIDE_M)
    return clip_of("toy/s1/drawer_open_1", track)


def expected_vertices_m(model: ObjectModel) -> np.ndarray:
    """(frame, vertex, 3) in the object frame: the tray moves along -y."""
    shift = np.zeros((len(SLIDE_M), len(model.vertices_m), 3))
    shift[:, model.part == 1, 1] = -SLIDE_M[:, None]
    return model.vertices_m + shift


def test_a_store_keeps_the_joint_without_an_origin_and_is_sound(drawer: ObjectModel, tmp_path: Path) -> None:
    write_store(tmp_path / "store", [opened(drawer)], generated_info("toy"))
    store = open_store(tmp_path / "store")
    assert store.objects["hinge_origin_m"].tolist() == [None]
    assert check_store(tmp_path / "store") == []
    model, clip = store.object_model("drawer"), store.clip("toy/s1/drawer_open_1")
    assert model.hinge.is_prismatic
    np.testing.assert_array_equal(clip.object.hinge_rad, SLIDE_M)
    local = articulate(model.vertices_m, model.part, model.hinge, clip.object.hinge_rad)
    np.testing.assert_allclose(local, expected_vertices_m(drawer), atol=1e-7)


def test_a_slide_and_a_hinge_of_one_axis_have_different_digests(drawer: ObjectModel) -> None:
    hinge = drawer.hinge
    turning = ObjectModel(drawer.name, drawer.vertices_m, drawer.faces, drawer.part, Hinge(hinge.axis, hinge.origin_m))
    assert turning.digest != drawer.digest


def test_networks_see_the_points_and_distances_of_the_moved_tray(drawer: ObjectModel) -> None:
    cloud, track = sample_points(drawer), opened(drawer).object
    features = object_features(track, np.eye(3), np.zeros(3))
    np.testing.assert_allclose(features[:, 9], SLIDE_M / drawer.joint_scale, rtol=1e-6)
    request = Request(
        motion_id="a",
        object=drawer,
        points=ObjectPoints(cloud.points_m, cloud.normals, cloud.part),
        text=np.zeros(4, np.float32),
        active_hands=np.ones(2, bool),
        n_frames=len(SLIDE_M),
    )
    placed = place_points(collate_requests([request]), torch.from_numpy(features)[None])[0]
    np.testing.assert_allclose(placed, track.points_in_world(cloud.points_m, cloud.part), atol=1e-5)
    fields, queries_m = DistanceFields([("drawer", drawer)]), np.array([[0.0, -0.3, 0.01], [0.0, -0.2, 0.1]])
    points = torch.from_numpy(np.tile(queries_m, (len(SLIDE_M), 1, 1))[None]).float()
    distance_m, _ = fields.query(fields.rows(["drawer"]), points, torch.from_numpy(features[None, :, 9]))
    exact_m = surface_index(drawer).distance_m(np.tile(queries_m, (len(SLIDE_M), 1, 1)), SLIDE_M)
    np.testing.assert_allclose(distance_m[0], exact_m, atol=0.004)  # the nodes of the grid are 8 mm apart


@pytest.mark.slow
@pytest.mark.parametrize("nearest", ["vertex", "surface"])
def test_bimarts_basis_points_have_the_nearest_points_of_the_moved_tray(nearest, drawer: ObjectModel) -> None:
    ball = trimesh.creation.icosphere(2, 0.1)  # many vertices, none equally near
    part = np.repeat(np.array([0, 1], np.uint8), len(ball.vertices))
    faces = np.concatenate((ball.faces, ball.faces + len(ball.vertices)))
    model = ObjectModel(
        "balls", np.concatenate((ball.vertices, ball.vertices + np.array([0.3, 0, 0]))), faces, part, drawer.hinge
    )
    canonical, object_from_canonical = canonical_object(model)
    np.testing.assert_allclose(object_from_canonical.inverse().turn(drawer.hinge.axis[None])[0], [0, 0, -1], atol=1e-9)
    bps = PartBps(canonical, BasisSettings(16, nearest=nearest))
    result = bps.nearest_points(SLIDE_M)
    posed = articulate(canonical.vertices_m, part, canonical.hinge, SLIDE_M)
    for frame, vertices_m in enumerate(posed):
        tray = trimesh.Trimesh(vertices_m[part == 1], ball.faces, process=False)
        if nearest == "vertex":
            distance_m = np.linalg.norm(tray.vertices[:, None] - bps.points_m, axis=2).min(axis=0)
        else:
            # Every triangle for every point: trimesh's search needs rtree.
            corners = np.repeat(tray.triangles[None], len(bps.points_m), 0).reshape(-1, 3, 3)
            points_m = np.repeat(bps.points_m, len(tray.faces), 0)
            closest_m = trimesh.triangles.closest_point(corners, points_m)
            distance_m = np.linalg.norm(closest_m - points_m, axis=1).reshape(len(bps.points_m), -1).min(axis=1)
        found_m = np.linalg.norm(result.point_m[frame, :16] - bps.points_m, axis=1)
        np.testing.assert_allclose(found_m, distance_m, atol=1e-5)


def test_measures_of_motion_count_a_slide_by_the_tray_radius_as_one_radian(drawer: ObjectModel) -> None:
    measures = action_numbers(opened(drawer).object, None, np.zeros((2, len(SLIDE_M)), bool))
    assert measures["hinge_net_deg"] == pytest.approx(np.degrees(0.15 / drawer.joint_scale), rel=1e-5)
    tray_m = drawer.vertices_m[drawer.part == 1]
    assert drawer.joint_scale == pytest.approx(np.linalg.norm(tray_m - tray_m.mean(axis=0), axis=1).max())


def test_keyframes_slide_a_drawer_in_centimetres_within_its_limits(drawer: ObjectModel) -> None:
    keys = parse_keyframes(b"time_s,slide_cm\n0,0\n2,15\n", "keys.csv")
    path = keyframed_path(drawer, keys, (0.0, 0.2))
    assert path.track.hinge_rad.max() == pytest.approx(0.15)
    with pytest.raises(BadInput, match=r"a slide of 0\.0 to 10\.0 cm, got 15\.0 cm"):
        keyframed_path(drawer, keys, (0.0, 0.1))
    with pytest.raises(BadInput, match=r"m/s of the slide"):
        keyframed_path(drawer, parse_keyframes(b"time_s,slide_m\n0,0\n0.05,0.15\n", "keys.csv"))
    with pytest.raises(BadInput, match="a column slide_cm: 'drawer' slides, got a column hinge_deg"):
        keyframed_path(drawer, parse_keyframes(b"time_s,hinge_deg\n0,0\n2,15\n", "keys.csv"))
    with pytest.raises(BadInput, match="an object has one joint"):
        parse_keyframes(b"time_s,hinge_deg,slide_cm\n0,0,0\n2,15,1\n", "keys.csv")


def test_a_mesh_of_named_pieces_slides_along_a_direction(tmp_path: Path) -> None:
    path, drawer = tmp_path / "drawer.obj", read_user_object(write_drawer(tmp_path / "urdf")).model
    shells = trimesh.Trimesh(drawer.vertices_m, drawer.faces, process=False).split(only_watertight=False)
    lines, start = [], 1
    for name, shell in zip(("left", "right", "top", "back", "tray", "handle"), shells, strict=True):
        lines += [f"g {name}", *(f"v {x} {y} {z}" for x, y, z in shell.vertices)]
        lines += ["f " + " ".join(str(corner + start) for corner in face) for face in shell.faces]
        start += len(shell.vertices)
    path.write_text("\n".join(lines))
    user = read_user_object(path, up="z", hinge="0,-2,0", moving="tray,handle")
    assert user.model.hinge.is_prismatic
    np.testing.assert_allclose(user.model.hinge.axis, [0, -1, 0])
    assert (user.model.part == 1).sum() == (drawer.part == 1).sum()
    assert "'tray, handle' slides, 'left, right, top, back' stays" in user.notes
    with pytest.raises(BadInput, match="groups: left, right, top, back, tray, handle"):
        read_user_object(path, hinge="0,-2,0", moving="lid")
    with pytest.raises(BadInput, match="--hinge too"):
        read_user_object(path, moving="tray")
