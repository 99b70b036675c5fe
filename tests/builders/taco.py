"""TACO recordings written as the format notes have them: pickles of torch tensors, OBJ in centimetres."""

import pickle
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, HandTrack
from hoidata.datasets import SequenceKey
from hoidata.hands import load_embedded_hands, track_joints

HANDS = load_embedded_hands()
N_FRAMES = 30
HALF_TOOL_M = np.array([0.035, 0.03, 0.02])
NAMES = (
    "(brush, brush, bowl)/20230927_034",
    "(put in, spoon, bowl)/20230928_001",
    "(put in, spoon, bowl)/20230928_002",
)
KEY = SequenceKey("taco", "20230927", NAMES[0])


def dump(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(value))


def write_box(path: Path, half_m: np.ndarray) -> None:
    mesh = trimesh.creation.box(2 * half_m * 100)
    path.parent.mkdir(parents=True, exist_ok=True)
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in mesh.vertices)
    path.write_text(vertices + "".join(f"f {a} {b} {c}\n" for a, b, c in mesh.faces + 1))


def write_recording(root: Path, name: str, seed: int) -> None:
    """Both hands grasp the tool, which moves and rotates above a resting bowl. Object ids are 012 and 105."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, N_FRAMES)[:, None]
    rotation = Rotation.from_rotvec(rng.normal(0, 0.6, 3) + time * rng.normal(0, 1.2, 3))
    position_m = np.array([0.3, -0.2, 1.0]) + time * rng.normal(0, 0.2, 3)
    tool, target = np.tile(np.eye(4), (2, N_FRAMES, 1, 1))
    tool[:, :3, :3], tool[:, :3, 3], target[:, :3, 3] = rotation.as_matrix(), position_m, (0.3, -0.2, 0.8)
    folder = root / "Object_Poses" / name
    folder.mkdir(parents=True)
    np.save(folder / "tool_012.npy", tool.astype(np.float32))
    np.save(folder / "target_105.npy", target.astype(np.float32))
    for side in SIDES:
        poses, betas = hand(side, rotation, position_m, rng)
        dump(root / "Hand_Poses" / name / f"{side}_hand.pkl", poses)
        dump(root / "Hand_Poses" / name / f"{side}_hand_shape.pkl", {"hand_shape": torch.tensor(betas).float()})


def hand(side: str, rotation: Rotation, position_m: np.ndarray, rng: np.random.Generator) -> tuple[dict, np.ndarray]:
    """A hand whose mean of index, middle and ring tip is on one side of the tool. Frame keys count from 00001."""
    betas, fingers = rng.normal(0, 0.3, 10), HANDS[side].mean_pose + rng.normal(0, 0.05, 45)
    at_origin = HandTrack(
        wrist_m=np.zeros((1, 3)),
        global_orient=np.zeros((1, 3)),
        hand_pose=fingers[None],
        betas=betas[None],
        valid=np.ones(1, dtype=bool),
    )
    tips = track_joints(at_origin, HANDS[side])[0, [16, 17, 19]].mean(axis=0)
    wrist = position_m + rotation.apply(HALF_TOOL_M * ((1, 0, 0) if side == "right" else (-1, 0, 0)) - tips)
    poses = {
        f"{frame + 1:05d}": {
            "hand_pose": torch.tensor(np.concatenate((rotation.as_rotvec()[frame], fingers))).float(),
            "hand_trans": torch.tensor(wrist[frame]).float(),
        }
        for frame in range(N_FRAMES)
    }
    return poses, betas


def write_taco(root: Path) -> Path:
    for seed, name in enumerate(NAMES):
        write_recording(root, name, seed)
    write_box(root / "Object_Models" / "012_cm.obj", HALF_TOOL_M)
    write_box(root / "Object_Models" / "105_cm.obj", np.array([0.08, 0.08, 0.03]))
    return root


def write_two(root: Path) -> Path:
    """Two recordings with the same target and different tools."""
    for seed, name in enumerate(NAMES[:2]):
        write_recording(root, name, seed)
    other = root / "Object_Poses" / NAMES[1]
    (other / "tool_012.npy").rename(other / "tool_013.npy")
    for number in ("012", "013"):
        write_box(root / f"Object_Models/{number}_cm.obj", HALF_TOOL_M)
    write_box(root / "Object_Models/105_cm.obj", np.array([0.08, 0.08, 0.03]))
    return root
