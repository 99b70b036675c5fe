"""Naive readers as in published code: one file, one frame, one call of the hand model at a time (the baseline).

Each reader returns the world joints of both hands and the object's pose for chosen frames of one sequence. The readers
share only the hand model and restricted unpickling with the adapters.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hoidata.files import load_npy_object, load_npz_objects
from hoidata.hands import HandPair
from hoidata.hands.kinematics import HandKinematics
from hoidata.objects.mesh import load_mesh


class Poses(NamedTuple):
    """Joints of both hands and the object's pose."""

    joints_m: np.ndarray  # (frame, hand, 21, 3) world, left before right
    object_pose: np.ndarray  # (frame, 4, 4) world_from_object


class NaiveHands:
    """The hand model, called for one frame of one hand, with MANO's ``transl``."""

    def __init__(self, hands: HandPair) -> None:
        self.models = (hands.left, hands.right)
        self.layers = [HandKinematics(model, torch.float64) for model in self.models]

    def joints(self, side: int, orient, fingers, transl, betas, template_m=None) -> np.ndarray:
        rotvecs = np.concatenate([orient, fingers]).reshape(16, 3)
        rotmats = np.stack([Rotation.from_rotvec(rotvec).as_matrix() for rotvec in rotvecs])
        wrist = self.models[side].wrist_offset_m(np.asarray(betas)[None], template_m)[0] + transl
        inputs = [torch.as_tensor(np.asarray(value, dtype=np.float64))[None] for value in (wrist, rotmats, betas)]
        template = None if template_m is None else torch.as_tensor(template_m)
        return self.layers[side].joints(*inputs, template)[0].numpy()


def pose_matrix(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def read_h2o(root: Path, sequence: str, frames: np.ndarray, naive: NaiveHands) -> Poses:
    folder, joints, objects = root / sequence / "cam4", [], []
    for frame in frames:
        camera = np.loadtxt(folder / "cam_pose" / f"{frame:06d}.txt").reshape(4, 4)
        numbers = np.loadtxt(folder / "hand_pose_mano" / f"{frame:06d}.txt").reshape(2, 62)
        pose = np.loadtxt(folder / "obj_pose_rt" / f"{frame:06d}.txt")[1:].reshape(4, 4)
        np.loadtxt(folder / "action_label" / f"{frame:06d}.txt")
        both = []
        for side, parameters in enumerate(numbers):
            points = naive.joints(side, parameters[4:7], parameters[7:52], parameters[1:4], parameters[52:62])
            both.append(points @ camera[:3, :3].T + camera[:3, 3])
        joints.append(both)
        objects.append(camera @ pose)
    return Poses(np.array(joints), np.array(objects))


def read_grab(root: Path, sequence: str, frames: np.ndarray, naive: NaiveHands) -> Poses:
    data = load_npz_objects(root / "grab" / f"{sequence}.npz")
    load_mesh(root / data["object"]["object_mesh"])
    members = (data["lhand"], data["rhand"])
    templates = [load_mesh(root / member["vtemp"]).vertices for member in members]
    joints, objects = [], []
    for frame in frames:
        both = []
        for side, member in enumerate(members):
            params = {name: np.asarray(value[frame], dtype=np.float64) for name, value in member["params"].items()}
            values = params["global_orient"], params["fullpose"], params["transl"]
            both.append(naive.joints(side, *values, np.zeros(10), templates[side]))
        joints.append(both)
        params = {name: np.asarray(value[frame], dtype=np.float64) for name, value in data["object"]["params"].items()}
        rotation = Rotation.from_rotvec(params["global_orient"]).as_matrix().T
        objects.append(pose_matrix(rotation, params["transl"]))
    return Poses(np.array(joints), np.array(objects))


def read_arctic(root: Path, sequence: str, frames: np.ndarray, naive: NaiveHands) -> Poses:
    mano = load_npy_object(root / "raw_seqs" / f"{sequence}.mano.npy")
    object_rows = load_npy_object(root / "raw_seqs" / f"{sequence}.object.npy")
    load_mesh(root / "meta" / "object_vtemplates" / sequence.split("/")[1].split("_")[0] / "mesh.obj")
    joints, objects = [], []
    for frame in frames:
        both = []
        for side, name in enumerate(("left", "right")):
            hand = {key: np.asarray(value, dtype=np.float64) for key, value in mano[name].items()}
            fingers = hand["pose"][frame] + naive.models[side].mean_pose
            both.append(naive.joints(side, hand["rot"][frame], fingers, hand["trans"][frame], hand["shape"]))
        joints.append(both)
        object_row = np.asarray(object_rows[frame], dtype=np.float64)
        objects.append(pose_matrix(Rotation.from_rotvec(object_row[1:4]).as_matrix(), object_row[4:7] / 1000))
    return Poses(np.array(joints), np.array(objects))


READERS = {"h2o": read_h2o, "grab": read_grab, "arctic": read_arctic}
