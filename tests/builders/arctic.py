"""One ARCTIC recording, its object and its description, written by hand: 70 frames of known numbers."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

N_FRAMES = 70
TIME = np.arange(N_FRAMES)
ANGLE = 0.02 * TIME + 3.5  # unwrapped: beyond pi
ORIENT = np.stack([0.3 + 0 * TIME, 0.01 * TIME, -0.6 + 0 * TIME], axis=1)
TRANSLATION_MM = np.stack([100.0 + TIME, -50.0 + 0 * TIME, 900.0 - 2.0 * TIME], axis=1)
BOTTOM_MM = [(0.0, 0.0, 0.0), (200.0, 0.0, 0.0), (200.0, 150.0, 0.0), (0.0, 150.0, -40.0)]
TOP_MM = [(10.0, 5.0, 20.0), (190.0, 5.0, 20.0), (190.0, 140.0, 25.0), (10.0, 140.0, 25.0)]
FACES = "f 1 2 3\nf 1 3 4\nf 5 6 7\nf 5 7 8\n"
SHAPE = {
    "left": np.array([1.5, -0.8, 1.2, 0.3, -0.9, 0.5, -0.4, 0.7, -0.2, 0.6]),
    "right": np.array([-1.1, 0.9, -0.6, 1.4, 0.2, -0.7, 0.8, -0.3, 0.5, -0.5]),
}
HAND_TRANSL = {"left": (0.2, -0.1, 0.8), "right": (-0.1, 0.1, 0.9)}
HAND_ORIENT = {"left": (0.4, -1.0, 0.3), "right": (-0.7, 0.2, 1.9)}
# Relative to the mean pose; the middle finger rotates by more than pi, as in some released files.
STORED = np.array([0.1, -0.2, 0.4, *[0.0] * 6, 4.6, 0.8, 0.3, *[0.0] * 33])
LINES = """1-20 grab, left hand

15-44 lift, both hands
41-70 close right hand
15-44 open, right hand
"""


def hand_params(side: str) -> dict:
    return {
        "rot": np.tile(HAND_ORIENT[side], (N_FRAMES, 1)).astype(np.float32),
        "pose": np.tile(STORED, (N_FRAMES, 1)).astype(np.float32),
        "trans": np.tile(HAND_TRANSL[side], (N_FRAMES, 1)).astype(np.float32),
        "shape": SHAPE[side].astype(np.float32),
        "fitting_err": np.zeros(N_FRAMES, np.float32),
    }


def write_sequence(root: Path, name: str = "box_grab_01", lines: str = LINES) -> None:
    folder = root / "raw_seqs" / "s04"
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / f"{name}.mano.npy", np.array({side: hand_params(side) for side in SHAPE}, dtype=object))
    np.save(folder / f"{name}.object.npy", np.column_stack((ANGLE, ORIENT, TRANSLATION_MM)))
    text = root / "description" / "s04" / name / "description.txt"
    text.parent.mkdir(parents=True, exist_ok=True)
    text.write_text(lines)


def write_template(root: Path, name: str) -> None:
    folder = root / "meta" / "object_vtemplates" / name
    folder.mkdir(parents=True, exist_ok=True)
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in BOTTOM_MM + TOP_MM)
    (folder / "mesh.obj").write_text(f"# a box\n{vertices}vt 0 0\nvn 0 0 1\n{FACES}")
    (folder / "parts.json").write_text(json.dumps([1, 1, 1, 1, 0, 0, 0, 0]))


def write_root(root: Path) -> Path:
    write_sequence(root)
    write_template(root, "box")
    return root


def write_two(root: Path) -> Path:
    """The sequence, and another one with a mixer."""
    write_root(root)
    write_sequence(root, "mixer_use_01")
    write_template(root, "mixer")
    return root


def head() -> dict:
    """The head camera, camera from world; it rotates and moves."""
    rotation = Rotation.from_rotvec(np.stack([1.8 + 0 * TIME, 0.01 * TIME, 0.2 + 0 * TIME], axis=1)).as_matrix()
    shift = np.stack([0.1 + 0.002 * TIME, -0.2 + 0 * TIME, 1.5 + 0 * TIME], axis=1)
    return {
        "R_k_cam_np": rotation,
        "T_k_cam_np": shift[:, :, None],
        "intrinsics": np.array([[1500.0, 0.0, 1400.0], [0.0, 1510.0, 1000.0], [0.0, 0.0, 1.0]]),
        "dist8": np.zeros(8),
        "ego_markers.label": np.array(["a", "b"]),
    }


def body() -> dict:
    columns = {
        "transl": 3, "global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3,
        "left_hand_pose": 45, "right_hand_pose": 45,
    }  # fmt: skip
    return {
        name: (number + TIME[:, None] / 100 + np.arange(width) / 10000).astype(np.float32)
        for number, (name, width) in enumerate(columns.items())
    }


def write_extra(root: Path, kind: str, content, name: str = "box_grab_01") -> Path:
    path = root / "raw_seqs" / "s04" / f"{name}.{kind}.npy"
    np.save(path, np.array(content, dtype=object))
    return path
