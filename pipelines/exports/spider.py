"""SPIDER's input (facebookresearch/spider, docs "Add New Dataset", process_datasets/gigahand.py): keypoints per clip.

processed/<dataset>/mano/<hands>/<clip>/0/trajectory_keypoints.npz has, per side, wrist, five fingertips (thumb,
index, middle, ring, pinky) and object as position and quaternion wxyz. task_info.json names the object's mesh. The
world is rotated so that z is up, as in MuJoCo. The object belongs to the right hand, or to the left one if only that
is tracked. SPIDER moves one rigid object per hand, so the parts of a hinged object are two objects: the moving part
belongs to the hand closer to it, the base to the other hand.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, SIDES, Clip, Side
from hoidata.files.arrays import write_npz
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from pipelines.exports.motion import ExportedClip, file_name_of, write_json
from pipelines.pages.glb import upright_rotation

WORLD = "rotated so that gravity is -z, z is up"
TIPS = (20, 16, 17, 19, 18)  # of the 21 joints: thumb, index, middle, ring, pinky
_INDEX, _MIDDLE, _RING = 1, 4, 10  # the first joint of each finger
_IDENTITY_POSE = np.array([0.0, 0, 0, 1, 0, 0, 0])


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write processed/<dataset>/ below ``folder``."""
    for item in clips:
        root = folder / "processed" / file_name_of(item.clip.dataset)
        objects, model, embodiment = root / "assets" / "objects", item.clip.object.model, _embodiment(item.clip)
        part_of = _part_of_hand(item, embodiment)
        meshes = {side: str(_write_mesh(objects, model, part).relative_to(folder)) for side, part in part_of.items()}
        task = root / "mano" / embodiment / item.file_name
        (task / "0").mkdir(parents=True)
        write_npz(task / "0" / "trajectory_keypoints.npz", _keypoints(item, embodiment, part_of))
        info = {"task": item.file_name, "dataset_name": item.clip.dataset, "robot_type": "mano", "data_id": 0}
        info |= {"embodiment_type": embodiment, "hand_type": embodiment, "ref_dt": 1 / FPS}
        write_json(task / "task_info.json", info | {f"{side}_object_mesh_dir": meshes.get(side) for side in SIDES})


def unsupported(clip: Clip) -> str:
    """The reason why SPIDER cannot represent a clip; empty if it can."""
    if clip.gravity is None:
        return "SPIDER moves objects under gravity, and this clip's is not known"
    if not all(clip.hands[side].valid.all() or not clip.hands[side].valid.any() for side in SIDES):
        return "SPIDER requires all hands in all frames; export the frames in which the hand is tracked"
    if not any(clip.hands[side].valid.any() for side in SIDES):
        return "no hand is tracked"
    if clip.object.is_articulated and _embodiment(clip) != "bimanual":
        return "SPIDER moves one rigid object per hand: the parts of a hinged object need both hands"
    return ""


def _embodiment(clip: Clip) -> str:
    tracked = [side for side in SIDES if clip.hands[side].valid.any()]
    return "bimanual" if len(tracked) == 2 else tracked[0]


def _part_of_hand(item: ExportedClip, embodiment: str) -> dict[Side, int | None]:
    """The part of the object that belongs to each hand with an object; None is the whole rigid object."""
    track = item.clip.object
    if not track.is_articulated:
        return {"left" if embodiment == "left" else "right": None}
    surfaces = surface_index(track.model).filled

    def excess_m(side: Side) -> float:
        """By how much a hand is farther from the moving part than from the base, mean over the frames."""
        tips_m = item.joints[side][:, list(TIPS)].astype(np.float64)
        nearest_m = []
        for part in (0, 1):
            world_from_part = track.world_from_object @ track.model.object_from_part(part, track.hinge_rad)
            positions_m = np.ascontiguousarray((world_from_part.inverse() @ tips_m).reshape(-1, 3))
            nearest_m.append(surfaces[part].distance_m(positions_m).reshape(-1, len(TIPS)).min(axis=1))
        return float((nearest_m[1] - nearest_m[0]).mean())

    moving_side = min(SIDES, key=excess_m)
    return {side: int(side == moving_side) for side in SIDES}


def _write_mesh(folder: Path, model: ObjectModel, part: int | None) -> Path:
    """Write the mesh of an object, or of one part in the frame of the object, once; returns its folder."""
    name = model.name if part is None else f"{model.name}/{('base', 'moving_part')[part]}"
    mesh = folder / file_name_of(name)
    if not mesh.exists():
        mesh.mkdir(parents=True)
        (mesh / "visual.obj").write_text(_obj(model, part))
    return mesh


def _keypoints(item: ExportedClip, embodiment: str, part_of: Mapping[Side, int | None]) -> dict[str, np.ndarray]:
    n_frames = item.clip.n_frames
    z_up = Rotation.from_rotvec((np.pi / 2, 0, 0)) * upright_rotation(item.clip.gravity)
    identity = np.broadcast_to(_IDENTITY_POSE, (n_frames, 7))
    arrays: dict[str, np.ndarray] = {}
    sides: tuple[Side, Side] = ("right", "left")
    for side in sides:
        tracked = embodiment in ("bimanual", side)
        wrist, tips = _hand(item.joints[side], side, z_up) if tracked else (identity, np.stack([identity] * 5, axis=1))
        arrays |= {f"qpos_wrist_{side}": wrist, f"qpos_finger_{side}": tips}
        arrays[f"qpos_obj_{side}"] = _object(item.clip, z_up, part_of[side]) if side in part_of else identity
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


def _object(clip: Clip, z_up: Rotation, part: int | None) -> np.ndarray:
    track = clip.object
    world_from_part = track.world_from_object @ track.model.object_from_part(part or 0, track.hinge_rad)
    return _pose(z_up.apply(world_from_part.translation), z_up * Rotation.from_matrix(world_from_part.rotation))


def _pose(position_m: np.ndarray, rotation: Rotation) -> np.ndarray:
    return np.concatenate([position_m, rotation.as_quat()[:, [3, 0, 1, 2]]], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _obj(model: ObjectModel, part: int | None) -> str:
    vertices_m, faces = (model.vertices_m, model.faces) if part is None else model.part_mesh(part)
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices_m]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    return "\n".join(lines) + "\n"
