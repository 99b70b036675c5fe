"""Writes OakInk2 recordings from a ground truth in the world: pickles of tensors and of arrays with NumPy 1's names,
programs by pairs of ranges. Independent of the adapter: rotations are SciPy's."""

import contextlib
import json
import pickle
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, HandTrack, Side
from hoidata.datasets import SequenceKey
from hoidata.hands import load_embedded_hands, track_joints
from tests.builders.hoi4d import box, transforms, write_obj

HANDS = load_embedded_hands()
N_FRAMES = 81  # at 120 Hz: 21 of a clip
FIRST = 6  # number of the first mocap frame
PREFIX = {"left": "lh__", "right": "rh__"}
LAPTOP = "scene_01__A001/seq__0a1b2c3d4e5f60718293__2023-04-27-20-38-16"
BOTTLE = "scene_02__A004/seq__1b2c3d4e5f60718293a4__2023-04-26-20-27-29"
CUP = "scene_02__O003/seq__2c3d4e5f60718293a4b5__2023-04-12-10-22-38"
LID, BASE, CAP, BODY, MUG = "O02@0061@00001", "O02@0061@00002", "O02@0015@00001", "O02@0015@00002", "S10021"
NAMES = {LID: "laptop_lid", BASE: "laptop base", "O02@0061": "Laptop", CAP: "bottle cap", BODY: "bottle", MUG: "mug"}
TREE = {"O02@0061": [LID, BASE], "O02@0015": [CAP, BODY], MUG: [f"{MUG}_handle"]}
AXIS, ORIGIN = np.array([0.0, 0.6, 0.8]), np.array([0.02, 0.1, 0.01])


@dataclass(frozen=True)
class Recording:
    """parts: mesh and (frame, 4, 4) world from part, by id. hands: per side orient (frame, 3), 45 angles, wrist, betas.

    program: (left range, right range, primitive, mode, left parts, right parts), ranges in mocap frame numbers.
    """

    name: str
    parts: dict[str, tuple[trimesh.Trimesh, np.ndarray]]
    hands: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
    program: tuple[tuple, ...]
    untracked: dict[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def token(self) -> str:
        return self.name.replace("/", "++")

    @property
    def frames(self) -> list[int]:
        return list(range(FIRST, FIRST + len(next(iter(self.parts.values()))[1])))


def key_of(name: str) -> SequenceKey:
    return SequenceKey("oakink2", name.split("/")[0].split("__")[1], name)


def holding(side: Side, pose: np.ndarray, half, random) -> tuple:
    """A hand whose mean of index, middle and ring tip is on one side of the object."""
    rotation, betas = Rotation.from_matrix(pose[:, :3, :3]), random.normal(0, 0.3, 10)
    fingers = HANDS[side].mean_pose + random.normal(0, 0.05, 45)
    at_origin = HandTrack(
        wrist_m=np.zeros((1, 3)),
        global_orient=np.zeros((1, 3)),
        hand_pose=fingers[None],
        betas=betas[None],
        valid=np.ones(1, dtype=bool),
    )
    tips = track_joints(at_origin, HANDS[side])[0, [16, 17, 19]].mean(axis=0)
    position_m = np.array(half) * ((1, 0, 0) if side == "right" else (-1, 0, 0))
    return rotation.as_rotvec(), fingers, pose[:, :3, 3] + rotation.apply(position_m - tips), betas


def recording(name: str, seed: int, n_frames: int = N_FRAMES, **changes) -> Recording:
    """A laptop that is opened next to a mug, a bottle whose cap is removed, or the mug alone."""
    random, time = np.random.default_rng(seed), np.linspace(0, 1, n_frames)[:, None]
    rotation = Rotation.from_rotvec(random.normal(0, 0.5, 3) + time * random.normal(0, 0.6, 3))
    pose = transforms(rotation, np.array([0.2, 0.9, 0.1]) + time * random.normal(0, 0.2, 3))
    stop, grips = FIRST + n_frames, {side: pose for side in SIDES}
    if name == LAPTOP:
        swing = Rotation.from_rotvec(np.outer(0.2 + 1.5 * time[:, 0] ** 2, AXIS))
        relative = transforms(swing, ORIGIN - swing.apply(ORIGIN))
        lid, base = box((0.3, 0.2, 0.01), (0.0, 0.0, 0.02)), box((0.3, 0.22, 0.02), (0, 0, 0))
        still = np.tile(transforms(Rotation.from_rotvec([[0.1, 0.4, 0]]), [[0.6, 0.9, 0]]), (n_frames, 1, 1))
        parts, half = {LID: (lid, pose @ relative), BASE: (base, pose), MUG: (_mug(), still)}, (0.15, 0.0, 0.0)
        program = (
            ((FIRST + 20, stop), (FIRST, FIRST + 60), "open_laptop_lid", "rh_main", [BASE], [LID]),
            (None, (FIRST, FIRST + 79), "rearrange", "rh_main", None, [MUG, LID]),
        )
    elif name == BOTTLE:
        off = transforms(Rotation.from_rotvec(np.outer(6 * time[:, 0], [0, 0, 1])), np.outer(time, [0.05, 0.02, 0.2]))
        cap, body = box((0.03, 0.03, 0.02), (0, 0, 0.11)), box((0.06, 0.06, 0.2), (0, 0, 0))
        parts, half = {CAP: (cap, pose @ off), BODY: (body, pose), MUG: (_mug(), pose)}, (0.03, 0.0, 0.0)
        grips["left"] = pose @ off @ transforms(Rotation.identity(1), [[0.012, 0, 0.11]])
        program = (
            ((FIRST, stop), (FIRST + 4, stop), "unscrew", "lh_main", [CAP], [BODY]),
            ((FIRST + 40, FIRST + 60), None, "hold", "lh_main", [BODY], None),
            (None, (FIRST, stop), "?(unk)", "rh_main", None, [BODY]),
            (None, (FIRST + 2, stop), "hold", "rh_main", None, ["O02@0099@00001"]),
        )
    else:
        parts, half = {MUG: (_mug(), pose)}, (0.04, 0.0, 0.0)
        program = ((None, (FIRST, stop), "pour", "rh_main", None, [MUG]),)
    hands = {side: holding(side, grips[side], half, random) for side in SIDES}
    return replace(Recording(name, parts, hands, program), **changes)


def _mug() -> trimesh.Trimesh:
    return box((0.08, 0.1, 0.12), (0.01, 0, 0.02))


@contextlib.contextmanager
def numpy_1() -> Iterator[None]:
    """Pickle arrays with the module name before NumPy 2, as in the release."""
    rebuild = np._core.multiarray._reconstruct  # type: ignore[attr-defined]
    before = rebuild.__module__
    rebuild.__module__ = "numpy.core.multiarray"
    try:
        yield
    finally:
        rebuild.__module__ = before


def dump(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with numpy_1():
        path.write_bytes(pickle.dumps(value, 4))


def tensor(values) -> torch.Tensor:
    """(1, ...) float32 with separate storage."""
    return torch.tensor(np.asarray(values)[None], dtype=torch.float32)


def quaternions(orient, fingers) -> np.ndarray:
    """(16, 4) w x y z of an axis-angle and 45 more."""
    return Rotation.from_rotvec(np.concatenate([orient, fingers]).reshape(16, 3)).as_quat()[:, [3, 0, 1, 2]]


def annotation(truth: Recording) -> dict:
    frames = truth.frames
    camera = {"allocentric_top": {frame: np.eye(4) for frame in frames[::4]}}
    # Two of the body's ten tensors, because adapters ignore the body.
    body = {"world_tsl": tensor(np.zeros(3)), "body_shape": tensor(np.zeros(300))}
    mano = {frame: {} for frame in frames}
    for side, (orient, fingers, wrist, betas) in truth.hands.items():
        for at, frame in enumerate(frames):
            values = {"pose_coeffs": quaternions(orient[at], fingers), "tsl": wrist[at], "betas": betas}
            mano[frame] |= {f"{PREFIX[side]}{name}": tensor(value) for name, value in values.items()}
    return {
        "cam_def": {"104422070969": "allocentric_top"}, "cam_selection": ["allocentric_top"],
        "frame_id_list": frames[::4], "cam_intr": {"allocentric_top": {frame: np.eye(3) for frame in frames[::4]}},
        "cam_extr": camera, "mocap_frame_id_list": frames, "obj_list": list(truth.parts),
        "obj_transf": {
            name: {f: pose for f, pose in zip(frames, poses, strict=True) if f not in truth.untracked.get(name, ())}
            for name, (_, poses) in truth.parts.items()
        },
        "raw_smplx": dict.fromkeys(frames, body), "raw_mano": mano,
    }  # fmt: skip


def program(truth: Recording) -> dict:
    return {
        str((left, right)): {
            "primitive": primitive, "obj_list": [*(on_left or []), *(on_right or [])], "interaction_mode": mode,
            "primitive_lh": left and primitive, "primitive_rh": right and primitive, "obj_list_lh": on_left,
            "obj_list_rh": on_right,
        }
        for left, right, primitive, mode, on_left, on_right in truth.program
    }  # fmt: skip


def write_json(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=4))


def write_recording(root: Path, truth: Recording) -> Path:
    dump(root / f"anno_preview/{truth.token}.pkl", annotation(truth))
    write_json(root / f"program/program_info/{truth.token}.json", program(truth))
    for name, (mesh, _) in truth.parts.items():
        write_obj(root / f"object_repair/align_ds/{name}/model.obj", mesh.vertices, mesh)
    write_json(root / "object_repair/obj_desc.json", {k: {"obj_id": k, "obj_name": v} for k, v in NAMES.items()})
    write_json(root / "object_affordance/object_part_tree.json", TREE)
    return root


def write_two(root: Path) -> Path:
    for seed, name in enumerate((LAPTOP, BOTTLE)):
        write_recording(root, recording(name, seed))
    return root


def write_three(root: Path) -> Path:
    return write_recording(write_two(root), recording(CUP, 2))
