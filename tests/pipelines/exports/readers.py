"""Readers of the export formats that do not use hoidata's writers: the target's library, else code after its docs.

A reader takes the exported folder and returns, by clip id, the left joints (frame, 21, 3), the right joints
(frame, 21, 3) and world_from_object (frame, 4, 4), in metres in the clip's world.
"""

import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pygltflib
from scipy.spatial.transform import Rotation

from hoidata.store.store import Store
from pipelines.exports.export import FORMATS, export_store

Read = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]


def export_all(store: Store, root: Path) -> dict[str, Path]:
    """Export a store in all formats, and return the folders by format."""
    for name in FORMATS:
        export_store(store, name, root / name, progress=False)
    return {name: root / name for name in FORMATS}


def read(name: str, folder: Path, cache: Path) -> Read:
    """Read an export with the reader of its format."""
    reader = globals()[name]
    return reader(folder, cache) if name == "huggingface" else reader(folder)


def transforms(positions: Any, quaternions_xyzw: Any) -> np.ndarray:
    matrices = np.tile(np.eye(4), (len(positions), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = Rotation.from_quat(quaternions_xyzw).as_matrix(), positions
    return matrices


def lerobot(folder: Path) -> Read:
    """As in "LeRobotDataset v3.0" of huggingface/lerobot: info.json has the files, meta/episodes the rows in them."""
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    clips = {}
    for episode in pd.read_parquet(folder / "meta" / "episodes").to_dict("records"):
        file_indices = {"chunk_index": episode["data/chunk_index"], "file_index": episode["data/file_index"]}
        frames = pd.read_parquet(folder / info["data_path"].format(**file_indices))
        frames = frames[frames["episode_index"] == episode["episode_index"]]
        assert frames["index"].tolist() == list(range(episode["dataset_from_index"], episode["dataset_to_index"]))
        state, pose = (np.stack(list(frames[f"observation.{name}"])) for name in ("state", "environment_state"))
        for name, values in (("observation.state", state), ("observation.environment_state", pose)):
            assert info["features"][name]["shape"] == [values.shape[1]] == [len(info["features"][name]["names"])]
        joints = state.reshape(-1, 2, 21, 3)
        clips[episode["clip_id"]] = (joints[:, 0], joints[:, 1], transforms(pose[:, :3], pose[:, 3:7]))
    return clips


def huggingface(folder: Path, cache: Path) -> Read:
    import datasets

    loaded = datasets.load_dataset(str(folder), cache_dir=str(cache))
    records = [record for split in loaded.values() for record in split.with_format("numpy")]
    return {str(record["clip_id"]): _of_columns(record) for record in records}


def webdataset(folder: Path) -> Read:
    from webdataset import autodecode, tariterators

    clips = {}
    for shard in folder.glob("*.tar"):
        with open(shard, "rb") as stream:  # WebDataset(shard) itself leaves the file open
            files = tariterators.tar_file_expander([{"url": str(shard), "stream": stream}])
            for sample in map(autodecode.Decoder([]), tariterators.group_by_keys(files)):
                clips[sample["json"]["clip_id"]] = _of_columns(sample["npz"])
    return clips


def _of_columns(record: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pose = transforms(np.asarray(record["object_translation_m"]), np.asarray(record["object_quaternion_xyzw"]))
    return np.asarray(record["left_joints_m"]), np.asarray(record["right_joints_m"]), pose


def glb(folder: Path) -> Read:
    return {_id(path): _of_glb(path) for path in folder.glob("*.glb")}


def _of_glb(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    document = pygltflib.GLTF2().load_binary(str(path))
    data, tracks = document.binary_blob(), {}
    for channel in document.animations[0].channels:
        accessor = document.accessors[document.animations[0].samplers[channel.sampler].output]
        view = document.bufferViews[accessor.bufferView]
        values = np.frombuffer(data, np.float32, view.byteLength // 4, view.byteOffset).reshape(accessor.count, -1)
        tracks[document.nodes[channel.target.node].name, channel.target.path] = values
    names = [node.name for node in document.nodes]
    sides = [
        np.stack([tracks[name, "translation"] for name in names if name.startswith(f"{side} joint ")], axis=1)
        for side in ("left", "right")
    ]
    return sides[0], sides[1], transforms(tracks["object", "translation"], tracks["object", "rotation"])


def usd(folder: Path) -> Read:
    return {_id(path): _of_usd(path) for path in folder.glob("*.usdc")}


def _of_usd(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    from pxr import Usd, UsdGeom

    stage: Any = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    times = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 1)
    left, right = (
        np.array([UsdGeom.Points.Get(stage, f"/world/{side}_joints").GetPointsAttr().Get(time) for time in times])
        for side in ("left", "right")
    )
    poses = []
    for time in times:
        cache = UsdGeom.XformCache(time)
        world, placed = (cache.GetLocalToWorldTransform(stage.GetPrimAtPath(p)) for p in ("/world", "/world/object"))
        poses.append(np.array(placed * world.GetInverse()).T)  # USD multiplies rows
    return left, right, np.array(poses)


def bvh(folder: Path) -> Read:
    clips = {}
    for clip in (path for path in folder.iterdir() if path.is_dir()):
        facts = json.loads((clip / "clip.json").read_text())
        angle_deg = {(0, -1, 0): 0, (0, 0, -1): 90}[
            tuple(facts["gravity"])
        ]  # degrees about x, from y up to the clip's up axis
        world_from_file = transforms(np.zeros((1, 3)), Rotation.from_euler("x", [angle_deg], degrees=True).as_quat())
        left, right, object_poses = (
            world_from_file[0] @ _of_bvh(clip / f"{name}.bvh") for name in ("left", "right", "object")
        )
        clips[facts["clip_id"]] = (left[:, :, :3, 3], right[:, :, :3, 3], object_poses[:, 0])
    return clips


def _of_bvh(path: Path) -> np.ndarray:
    """World transforms (frame, joint, 4, 4) in the file's order, from the channels of each joint."""
    header, motion = path.read_text().split("MOTION")
    names, parents, channels, open_joints = [], [], [], []
    for words in map(str.split, header.splitlines()):
        if words[0] in ("ROOT", "JOINT"):
            parents.append(next((j for j in reversed(open_joints) if j is not None), -1))
            names.append(words[1])
            pending = len(names) - 1
        elif words[0] == "End":
            pending = None
        elif words[0] == "{":
            open_joints.append(pending)
        elif words[0] == "}":
            open_joints.pop()
        elif words[0] == "CHANNELS":
            channels.append(words[2:])
    channel_values = np.loadtxt(motion.strip().splitlines()[2:], ndmin=2).reshape(-1, len(names), 6)
    world_transforms: list[np.ndarray] = []
    for joint, parent in enumerate(parents):
        order = "".join(name[0] for name in channels[joint][3:])
        rotation = Rotation.from_euler(order, channel_values[:, joint, 3:], degrees=True)
        local = transforms(channel_values[:, joint, :3], rotation.as_quat())
        world_transforms.append(local if parent < 0 else world_transforms[parent] @ local)
    by_name = dict(zip(names, world_transforms, strict=True))
    from hoidata.hands import JOINT_NAMES

    return np.stack([by_name[name] for name in (JOINT_NAMES if "wrist" in names else names)], axis=1)


def _id(path: Path) -> str:
    return unquote(path.stem.replace("__", "/"))
