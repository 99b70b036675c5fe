"""One GRAB recording and its meshes, written by hand: a sequence of 61 frames of known numbers."""

import shutil
from pathlib import Path

import numpy as np
import trimesh

from hoidata.hands import load_embedded_hands

N_FRAMES = 61  # at 120 Hz: frames 0, 4, ..., 60 are kept
TOUCHED = (9, 47)  # the object is touched in frames 9 to 47: strided frames 12 to 44
TIME = np.arange(N_FRAMES)
LEFT = {
    "global_orient": np.stack([0.1 + 0.01 * TIME, -0.4 + 0 * TIME, 0.9 - 0.005 * TIME], axis=1),
    "transl": np.stack([0.3 + 0.002 * TIME, 0.1 + 0 * TIME, 0.8 + 0.001 * TIME], axis=1),
}
RIGHT = {
    "global_orient": np.stack([1.2 - 0.01 * TIME, 0.3 + 0 * TIME, -0.2 + 0 * TIME], axis=1),
    "transl": np.stack([0.1 + 0 * TIME, -0.2 + 0.003 * TIME, 0.9 + 0 * TIME], axis=1),
}
OBJECT = {
    "global_orient": np.stack([0.4 + 0 * TIME, 0.02 * TIME, -0.7 + 0 * TIME], axis=1),
    "transl": np.stack([0.2 + 0 * TIME, 0.001 * TIME, 0.75 + 0 * TIME], axis=1),
}
MIDDLE_BEND = (0.1, -0.05, 0.6)
N_VERTICES = 8


def personal_mesh(side: str) -> np.ndarray:
    """A hand 8 % larger than the model's, and shifted: J0 must come from this mesh."""
    return load_embedded_hands()[side].template_m * 1.08 + np.array([0.004, -0.003, 0.002])


def sequence() -> dict:
    fullpose = np.zeros((N_FRAMES, 45))
    fullpose[:, 9:12] = MIDDLE_BEND
    contact = np.zeros((N_FRAMES, N_VERTICES), dtype=np.int8)
    contact[TOUCHED[0] : TOUCHED[1] + 1, 3] = 22
    numbers = {name: {key: value.astype(np.float32) for key, value in block.items()} for name, block in BLOCKS.items()}
    numbers["lhand"]["fullpose"] = np.zeros((N_FRAMES, 45), np.float32)
    numbers["rhand"]["fullpose"] = fullpose.astype(np.float32)
    return {
        "gender": "male",
        "sbj_id": "s3",
        "obj_name": "cubelarge",
        "motion_intent": "offhand",
        "framerate": 120.0,
        "n_frames": N_FRAMES,
        "n_comps": 24,
        "lhand": {"params": numbers["lhand"], "vtemp": "tools/subject_meshes/male/s3_lhand.ply"},
        "rhand": {"params": numbers["rhand"], "vtemp": "tools/subject_meshes/male/s3_rhand.ply"},
        "object": {"params": numbers["object"], "object_mesh": "tools/object_meshes/contact_meshes/cubelarge.ply"},
        "contact": {"object": contact, "body": np.zeros((N_FRAMES, 5), np.int8)},
    }


BLOCKS = {"lhand": LEFT, "rhand": RIGHT, "object": OBJECT}


def write_sequence(root: Path, data: dict) -> Path:
    path = root / "grab" / "s3" / "cubelarge_offhand_1.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path, **{key: np.array(value, dtype=object if isinstance(value, dict) else None) for key, value in data.items()}
    )
    return path


def write_root(root: Path) -> Path:
    """The sequence with the meshes of its object and of the subject's hands."""
    write_sequence(root, sequence())
    meshes = root / "tools" / "object_meshes" / "contact_meshes"
    meshes.mkdir(parents=True)
    trimesh.creation.box((0.1, 0.12, 0.14)).export(meshes / "cubelarge.ply")
    people = root / "tools" / "subject_meshes" / "male"
    people.mkdir(parents=True)
    for side, letter in (("left", "l"), ("right", "r")):
        mesh = trimesh.Trimesh(personal_mesh(side), load_embedded_hands()[side].faces, process=False)
        mesh.export(people / f"s3_{letter}hand.ply")
    return root


def write_two(root: Path) -> Path:
    """The sequence, and one of another cube."""
    write_root(root)
    first = root / "grab/s3/cubelarge_offhand_1.npz"
    first_bytes = first.read_bytes()
    data = sequence() | {"obj_name": "cubesmall"}
    data["object"]["object_mesh"] = data["object"]["object_mesh"].replace("large", "small")
    write_sequence(root, data).rename(root / "grab/s3/cubesmall_offhand_1.npz")
    first.write_bytes(first_bytes)
    meshes = root / "tools/object_meshes/contact_meshes"
    shutil.copy(meshes / "cubelarge.ply", meshes / "cubesmall.ply")
    return root


def with_table(mesh: str = "tools/object_meshes/contact_meshes/table.ply") -> dict:
    pose = {"global_orient": np.tile((0.1, 0.0, 0.3), (N_FRAMES, 1)), "transl": np.tile((0.2, 0.1, 0.7), (N_FRAMES, 1))}
    return sequence() | {"table": {"params": pose, "table_mesh": mesh}}


def write_table(root: Path) -> None:
    trimesh.creation.box((1.0, 0.8, 0.02)).export(root / "tools/object_meshes/contact_meshes/table.ply")


BODY = {
    "transl": 3, "global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3,
    "left_hand_pose": 24, "right_hand_pose": 24, "fullpose": 165, "expression": 10,
}  # fmt: skip


def with_body() -> dict:
    params = {
        name: (number + TIME[:, None] / 100 + np.arange(columns) / 10000).astype(np.float32)
        for number, (name, columns) in enumerate(BODY.items())
    }
    return sequence() | {"body": {"params": params, "vtemp": "tools/subject_meshes/male/s3.ply"}}
