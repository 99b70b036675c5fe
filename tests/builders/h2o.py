"""One H2O sequence written by hand: text files of a moving head camera and a hand that takes chips."""

import shutil
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

N_FRAMES = 27
LABELS = [0, 0, 0] + [26] * 22 + [0, 0]  # take out chips in frames 3 to 24
LEFT = {"t": (0.05, -0.02, 0.4), "orient": (0.3, -0.8, 0.5), "betas": (0.6, -0.4, 0, 0, 0.2, 0, 0, 0, 0, 0.1)}
RIGHT = {"t": (-0.04, 0.03, 0.5), "orient": (-0.2, 1.1, 0.1), "betas": (-0.5, 0.3, 0.1, 0, 0, 0, 0, 0, 0, 0)}
INDEX_BEND = (0.0, 0.1, 0.7)


def camera(frame: int) -> np.ndarray:
    """World from camera: a head that rotates and moves."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("zyx", [20 + 3 * frame, 10, -110], degrees=True).as_matrix()
    matrix[:3, 3] = (0.1 + 0.01 * frame, -0.2, 1.5 - 0.005 * frame)
    return matrix


def object_in_camera(frame: int) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec((0.2, 0.9, 0.02 * frame)).as_matrix()
    matrix[:3, 3] = (0.02, 0.05 + 0.002 * frame, 0.45)
    return matrix


def hand_block(flag: int, hand: dict, fingers=(0.0,) * 45) -> list[float]:
    return [flag, *hand["t"], *hand["orient"], *fingers, *hand["betas"]]


def write_text(path: Path, numbers) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(" ".join(repr(float(number)) for number in np.ravel(numbers)))


def write_root(root: Path) -> Path:
    """One sequence; the right index bends at its first joint; the left hand is not annotated in frame 5."""
    fingers = np.zeros(45)
    fingers[:3] = INDEX_BEND
    folder = root / "subject2" / "k1" / "3" / "cam4"
    for frame in range(N_FRAMES):
        name = f"{frame:06d}.txt"
        left = [0.0] * 62 if frame == 5 else hand_block(1, LEFT)
        write_text(folder / "cam_pose" / name, camera(frame))
        write_text(folder / "hand_pose_mano" / name, left + hand_block(1, RIGHT, fingers))
        write_text(folder / "obj_pose_rt" / name, [7, *object_in_camera(frame).ravel()])
        write_text(folder / "action_label" / name, [LABELS[frame]])
    mesh = root / "object" / "chips" / "chips.obj"
    mesh.parent.mkdir(parents=True)
    trimesh.creation.cylinder(0.04, 0.2, sections=8).export(mesh)
    return root


def write_two(root: Path) -> Path:
    """The sequence, and another one of subject 1 with milk instead of chips."""
    write_root(root)
    shutil.copytree(root / "subject2", root / "subject1")
    shutil.copytree(root / "object/chips", root / "object/milk")
    (root / "object/milk/chips.obj").rename(root / "object/milk/milk.obj")
    for name in ("action_label", "obj_pose_rt"):
        for path in (root / "subject1/k1/3/cam4" / name).iterdir():
            words = path.read_text().split()
            words[0] = {"26.0": "5.0", "7.0": "5.0"}.get(words[0], words[0])
            path.write_text(" ".join(words))
    return root
