"""Exports of objects with a hinge and with a prismatic joint: each format's own reader finds the posed parts."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.clips import SIDES
from hoidata.clips.clip import Clip, ObjectTrack
from hoidata.errors import BadInput
from hoidata.objects.user_mesh import read_user_object
from hoidata.store.info import generated_info
from hoidata.store.store import Store, open_store, write_store
from pipelines.exports.export import export_store
from tests.builders.clips import build_clip
from tests.builders.urdf import write_drawer, write_laptop
from tests.pipelines.exports import readers

pytestmark = pytest.mark.slow
FRAMES, KINDS = 5, ("drawer", "laptop")


def moved(kind: str, folder: Path, hands: str = "both") -> Clip:
    """The drawer slides out by 12 cm, or the laptop opens by 1.2 rad, while both are carried along."""
    model = read_user_object((write_drawer if kind == "drawer" else write_laptop)(folder / kind)).model
    clip = build_clip(FRAMES, hands, seed=3, clip_id=f"toy/s1/{kind}")
    position = np.linspace(0, 0.12 if kind == "drawer" else 1.2, FRAMES).astype(np.float32)
    return replace(clip, object=ObjectTrack(model, clip.object.rotvec, clip.object.translation_m, position))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    folder = tmp_path_factory.mktemp("articulated")
    write_store(folder / "store", [moved(kind, folder) for kind in KINDS], generated_info("toy"))
    return open_store(folder / "store")


def expected_m(clip: Clip, part: int) -> np.ndarray:
    """(frame, vertex, 3) world vertices of one part by Rodrigues' formula or a translation."""
    model, hinge = clip.object.model, clip.object.model.hinge
    vertices_m = model.vertices_m[model.part == part]
    frames = []
    for frame in range(FRAMES):
        position, local = float(clip.object.hinge_rad[frame]), vertices_m
        if part == 1 and hinge.is_prismatic:
            local = vertices_m + position * hinge.axis
        elif part == 1:
            local = Rotation.from_rotvec(position * hinge.axis).apply(vertices_m - hinge.origin_m) + hinge.origin_m
        frames.append(Rotation.from_rotvec(clip.object.rotvec[frame]).apply(local) + clip.object.translation_m[frame])
    return np.array(frames)


def extremes(points_m: np.ndarray) -> np.ndarray:
    """(frame, 6) bounds, which do not depend on the order of vertices."""
    return np.concatenate((points_m.min(axis=1), points_m.max(axis=1)), axis=1)


def test_the_card_of_lerobot_gives_the_unit_of_a_hinge_and_of_a_slide(store: Store, tmp_path: Path) -> None:
    export_store(store, "lerobot", tmp_path / "lerobot", progress=False)
    card = (tmp_path / "lerobot" / "README.md").read_text()
    (line,) = [line for line in card.splitlines() if "observation.environment_state" in line]
    assert "joint position from the mesh as stored: hinge angle in radian, slide in metre, 0 if rigid" in line


@pytest.mark.parametrize("kind", KINDS)
def test_usd_moves_the_part(kind: str, store: Store, tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom

    export_store(store, "usd", tmp_path / "usd", progress=False)
    stage: Any = Usd.Stage.Open(str(tmp_path / "usd" / f"toy__s1__{kind}.usdc"))
    for part, path in enumerate(("/world/object/base", "/world/object/moving_part/mesh")):
        prim, frames = stage.GetPrimAtPath(path), []
        for time in range(FRAMES):
            cache = UsdGeom.XformCache(time)
            world = cache.GetLocalToWorldTransform(stage.GetPrimAtPath("/world"))
            matrix = np.array(cache.GetLocalToWorldTransform(prim) * world.GetInverse())  # multiplies rows
            points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(time))
            frames.append(points @ matrix[:3, :3] + matrix[3, :3])
        expected = expected_m(store.clip(f"toy/s1/{kind}"), part)
        np.testing.assert_allclose(extremes(np.array(frames)), extremes(expected), atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_glb_animates_the_node_of_the_moving_part(kind: str, store: Store, tmp_path: Path) -> None:
    export_store(store, "glb", tmp_path / "glb", progress=False)
    document = pygltflib.GLTF2().load_binary(str(tmp_path / "glb" / f"toy__s1__{kind}.glb"))
    targets = {
        channel.target.path: document.accessors[document.animations[0].samplers[channel.sampler].output]
        for channel in document.animations[0].channels
        if document.nodes[channel.target.node].name == "object moving part"
    }
    (path,) = targets
    view = document.bufferViews[targets[path].bufferView]
    values = np.frombuffer(document.binary_blob(), np.float32, view.byteLength // 4, view.byteOffset)
    clip = store.clip(f"toy/s1/{kind}")
    if kind == "drawer":
        assert path == "translation"
        expected = np.outer(clip.object.hinge_rad, clip.object.model.hinge.axis)
        np.testing.assert_allclose(values.reshape(-1, 3), expected, atol=1e-6)
    else:
        assert path == "rotation"
        turned = Rotation.from_quat(values.reshape(-1, 4)).magnitude()
        np.testing.assert_allclose(turned, clip.object.hinge_rad, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_bvh_has_the_pose_of_the_moving_part(kind: str, store: Store, tmp_path: Path) -> None:
    export_store(store, "bvh", tmp_path / "bvh", progress=False)
    world_from_file = Rotation.from_euler("x", 90, degrees=True)  # gravity is -z in these clips
    poses, clip = readers._of_bvh(tmp_path / "bvh" / f"toy__s1__{kind}" / "object.bvh"), store.clip(f"toy/s1/{kind}")
    hinge = clip.object.model.hinge
    vertices_m = clip.object.model.vertices_m[clip.object.model.part == 1] - hinge.origin_m
    posed = np.einsum("fij,vj->fvi", poses[:, 1, :3, :3], vertices_m) + poses[:, 1, None, :3, 3]
    posed = world_from_file.apply(posed.reshape(-1, 3)).reshape(posed.shape)
    np.testing.assert_allclose(posed, expected_m(clip, 1), atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_spider_gets_both_parts_as_the_objects_of_both_hands(kind: str, store: Store, tmp_path: Path) -> None:
    export_store(store, "spider", tmp_path / "spider", progress=False)
    task = tmp_path / "spider" / "processed" / "toy" / "mano" / "bimanual" / f"toy__s1__{kind}"
    info = json.loads((task / "task_info.json").read_text())
    clip, parts = store.clip(f"toy/s1/{kind}"), []
    with np.load(task / "0" / "trajectory_keypoints.npz") as arrays:
        for side in SIDES:
            folder = info[f"{side}_object_mesh_dir"]
            parts.append(int(folder.endswith("moving_part")))
            mesh, pose = (
                trimesh.load(tmp_path / "spider" / folder / "visual.obj", process=False),
                arrays[f"qpos_obj_{side}"],
            )
            frames = [Rotation.from_quat(q[[4, 5, 6, 3]]).apply(mesh.vertices) + q[:3] for q in pose]
            np.testing.assert_allclose(extremes(np.array(frames)), extremes(expected_m(clip, parts[-1])), atol=1e-5)
    assert sorted(parts) == [0, 1]


def test_spider_cannot_represent_a_hinged_object_in_one_hand(tmp_path: Path) -> None:
    clip = moved("laptop", tmp_path)
    left = replace(clip.hands["left"], valid=np.zeros(FRAMES, bool))
    write_store(tmp_path / "store", [replace(clip, hands={**clip.hands, "left": left})], generated_info("toy"))
    with pytest.raises(BadInput, match="one rigid object per hand"):
        export_store(open_store(tmp_path / "store"), "spider", tmp_path / "spider", progress=False)
