"""SPIDER's input (facebookresearch/spider, docs "Add New Dataset", process_datasets/gigahand.py): keypoints per clip.

processed/<dataset>/mano/<hands>/<clip>/0/trajectory_keypoints.npz has, per side, wrist, five fingertips (thumb,
index, middle, ring, pinky) and object as position and quaternion wxyz. task_info.json names the object's mesh. The
world is rotated so that z is up, as in MuJoCo. The object belongs to the right hand, or to the left one if only that
is tracked.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import orjson
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, SIDES, Clip, Side
from hoidata.files.arrays import write_npz
from hoidata.objects.model import ObjectModel
from pipelines.exports.motion import ExportedClip, file_name_of
from pipelines.pages.glb import upright_rotation

WORLD = "rotated so that gravity is -z, z is up"
TIPS = (20, 16, 17, 19, 18)  # of the 21 joints: thumb, index, middle, ring, pinky
_INDEX, _MIDDLE, _RING = 1, 4, 10  # the first joint of each finger
_IDENTITY_POSE = np.array([0.0, 0, 0, 1, 0, 0, 0])


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write processed/<dataset>/ below ``folder``."""
    for item in clips:
        root = folder / "processed" / file_name_of(item.clip.dataset)
        mesh = root / "assets" / "objects" / file_name_of(item.clip.object.model.name)
        if not mesh.exists():
            mesh.mkdir(parents=True)
            (mesh / "visual.obj").write_text(_obj(item.clip.object.model))
        embodiment = _embodiment(item.clip)
        task = root / "mano" / embodiment / item.file_name
        (task / "0").mkdir(parents=True)
        write_npz(task / "0" / "trajectory_keypoints.npz", _keypoints(item, embodiment))
        owner = "left" if embodiment == "left" else "right"
        meshes = {f"{side}_object_mesh_dir": str(mesh.relative_to(folder)) if side == owner else None for side in SIDES}
        info = {"task": item.file_name, "dataset_name": item.clip.dataset, "robot_type": "mano", "data_id": 0}
        info |= {"embodiment_type": embodiment, "hand_type": embodiment, "ref_dt": 1 / FPS, **meshes}
        (task / "task_info.json").write_bytes(orjson.dumps(info, option=orjson.OPT_INDENT_2) + b"\n")


def unsupported(clip: Clip) -> str:
    """The reason why SPIDER cannot represent a clip; empty if it can."""
    if clip.object.is_articulated:
        return "SPIDER moves rigid objects only, this one has a hinge"
    if clip.gravity is None:
        return "SPIDER moves objects under gravity, and this clip's is not known"
    if not all(clip.hands[side].valid.all() or not clip.hands[side].valid.any() for side in SIDES):
        return "SPIDER requires all hands in all frames; export the frames in which the hand is tracked"
    return "" if any(clip.hands[side].valid.any() for side in SIDES) else "no hand is tracked"


def _embodiment(clip: Clip) -> str:
    tracked = [side for side in SIDES if clip.hands[side].valid.any()]
    return "bimanual" if len(tracked) == 2 else tracked[0]


def _keypoints(item: ExportedClip, embodiment: str) -> dict[str, np.ndarray]:
    n_frames = item.clip.n_frames
    z_up = Rotation.from_rotvec((np.pi / 2, 0, 0)) * upright_rotation(item.clip.gravity)
    identity = np.broadcast_to(_IDENTITY_POSE, (n_frames, 7))
    arrays: dict[str, np.ndarray] = {}
    for side in ("right", "left"):
        tracked = embodiment in ("bimanual", side)
        wrist, tips = _hand(item.joints[side], side, z_up) if tracked else (identity, np.stack([identity] * 5, axis=1))
        has_object = side == ("left" if embodiment == "left" else "right")
        arrays |= {f"qpos_wrist_{side}": wrist, f"qpos_finger_{side}": tips}
        arrays[f"qpos_obj_{side}"] = _object(item.clip, z_up) if has_object else identity
    return {name: np.array(values, np.float64) for name, values in arrays.items()}


def _hand(joints_m: np.ndarray, side: Side, z_up: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Poses of wrist (frame, 7) and tips (frame, 5, 7); the wrist's z points to the middle finger, y to the index."""
    joints = z_up.apply(joints_m.reshape(-1, 3).astype(np.float64)).reshape(joints_m.shape)
    z = _unit(joints[:, _MIDDLE] - joints[:, 0])
    x = _unit(np.cross(joints[:, _INDEX] - joints[:, _RING], z))
    sign = -1.0 if side == "left" else 1.0
    frame = Rotation.from_matrix(np.stack([sign * x, sign * np.cross(z, x), z], axis=-1))
    tips = np.concatenate([joints[:, list(TIPS)], np.broadcast_to(_IDENTITY_POSE[3:], (len(joints), 5, 4))], axis=-1)
    return _pose(joints[:, 0], frame), tips


def _object(clip: Clip, z_up: Rotation) -> np.ndarray:
    rotation = z_up * Rotation.from_rotvec(clip.object.rotvec.astype(np.float64))
    return _pose(z_up.apply(clip.object.translation_m.astype(np.float64)), rotation)


def _pose(position_m: np.ndarray, rotation: Rotation) -> np.ndarray:
    return np.concatenate([position_m, rotation.as_quat()[:, [3, 0, 1, 2]]], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _obj(model: ObjectModel) -> str:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in model.vertices_m]
    lines += [f"f {a} {b} {c}" for a, b, c in model.faces + 1]
    return "\n".join(lines) + "\n"
