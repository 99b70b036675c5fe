"""Writes ground truth in H2O's format: per-frame text files in the frame of a moving head camera.

MANO translations are added to the wrist of the rest mesh: wrist = J0(betas) + translation. The hand rotates about J0,
so in the camera frame ``t' = A (J0 + t) + b - J0``.
"""

from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, HandTrack
from hoidata.hands import HandPair, track_joints
from hoidata.hands.model import OPENPOSE
from hoidata.synthetic.actions import H2O_ACTION_IDS, H2O_OBJECT_IDS, H2O_VERB_IDS
from hoidata.synthetic.catalogue import ObjectSpec, model_of
from hoidata.synthetic.generate import GAP_FRAMES
from hoidata.synthetic.object_files import obj_text, write_text
from hoidata.synthetic.truth import TruthSequence

_EDGES = [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)]
_INTRINSICS = (636.6593, 636.2520, 635.2839, 366.8740, 1280.0, 720.0)
_ABSENT_MANO, _ABSENT_POINTS = np.zeros(62), np.zeros(64)
_SPLITS = {"subject1": "train", "subject2": "val", "subject3": "test"}


def write_h2o_objects_and_lists(root: Path, sequences: list[TruthSequence], specs: tuple[ObjectSpec, ...]) -> None:
    """Write object/<name>/<name>.obj, metres, and label_split/action_*.txt: the labelled intervals of each split.

    The test list has no labels, as in the original.
    """
    for spec in specs:
        model = model_of(spec)
        write_text(root / "object" / spec.name / f"{spec.name}.obj", obj_text(model.vertices_m, model.faces))
    last = {truth.source_key: 0 for truth in sequences}
    for truth in sequences:
        last[truth.source_key] = max(last[truth.source_key], truth.raw_start + truth.n_frames + GAP_FRAMES - 1)
    for split in ("train", "val", "test"):
        members = [truth for truth in sequences if _SPLITS[truth.subject] == split]
        header = "id path action_label start_act end_act start_frame end_frame"
        lines = [header if split != "test" else header.replace(" action_label", "")]
        for number, truth in enumerate(members, 1):
            label = "" if split == "test" else f" {H2O_ACTION_IDS[truth.verb, truth.object_name]}"
            start, stop = truth.raw_start + truth.clip[0], truth.raw_start + truth.clip[1] - 1
            lines.append(f"{number} {truth.source_key}{label} {start} {stop} 0 {last[truth.source_key]}")
        write_text(root / "label_split" / f"action_{split}.txt", "\n".join(lines) + "\n")


def write_h2o_sequence(root: Path, members: list[TruthSequence], pair: HandPair) -> None:
    """Write the per-frame files of one raw sequence, camera 4: its actions in order, with empty frames between."""
    key = members[0].source_key
    folder = root / key / "cam4"
    write_text(folder / "cam_intrinsics.txt", _line(np.array(_INTRINSICS)))
    n_frames = members[-1].raw_start + members[-1].n_frames + GAP_FRAMES
    cameras = _head_camera(key, n_frames)
    lines_of = _empty_lines(n_frames, cameras)
    for truth in members:
        _fill_lines(lines_of, truth, cameras, pair)
    for name, frame_lines in lines_of.items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        for frame, line in enumerate(frame_lines):
            with open(f"{folder}/{name}/{frame:06d}.txt", "w", encoding="ascii") as stream:
                stream.write(line)


def _line(numbers: np.ndarray) -> str:
    return " ".join(map(repr, numbers.tolist())) + "\n"


def _head_camera(key: str, n_frames: int) -> np.ndarray:
    """Return (frame, 4, 4) world_from_camera of a swaying head that looks at the table; OpenCV axes (z forward)."""
    phase = np.linspace(0, 1, n_frames)[:, None] * 2 * np.pi
    offset = np.frombuffer(key.encode().ljust(16)[:16], dtype=np.uint8).astype(float)[:3] % 7
    eye = np.array([0.0, -0.45, 0.55]) + 0.03 * np.sin(phase * [1, 2, 3] + offset)
    looking = np.array([0.0, 0.05, 0.05]) + 0.04 * np.cos(phase * [2, 1, 2] + offset) - eye
    ahead = looking / np.linalg.norm(looking, axis=1, keepdims=True)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    pose = np.tile(np.eye(4), (n_frames, 1, 1))
    pose[:, :3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=2)
    pose[:, :3, 3] = eye
    return pose


def _empty_lines(n_frames: int, cameras: np.ndarray) -> dict[str, list[str]]:
    no_object = np.concatenate([[0.0], np.eye(4).ravel()])
    return {
        "cam_pose": [_line(pose.ravel()) for pose in cameras],
        "hand_pose": [_line(np.tile(_ABSENT_POINTS, 2))] * n_frames,
        "hand_pose_mano": [_line(np.tile(_ABSENT_MANO, 2))] * n_frames,
        "obj_pose": [_line(np.zeros(64))] * n_frames,
        "obj_pose_rt": [_line(no_object)] * n_frames,
        "verb_label": ["0\n"] * n_frames,
        "action_label": ["0\n"] * n_frames,
    }


def _fill_lines(lines_of: dict[str, list[str]], truth: TruthSequence, cameras: np.ndarray, pair: HandPair) -> None:
    frames = slice(truth.raw_start, truth.raw_start + truth.n_frames)
    camera = cameras[frames]
    world_to_camera = camera[:, :3, :3].transpose(0, 2, 1)
    eye = camera[:, :3, 3]
    blocks = [_hand_blocks(truth.hands[side], pair, side, world_to_camera, eye) for side in SIDES]
    mano, points = (np.concatenate(kind, axis=1) for kind in zip(*blocks, strict=True))
    pose, corners = _object_blocks(truth, world_to_camera, eye)
    table = {"hand_pose": points, "hand_pose_mano": mano, "obj_pose": corners, "obj_pose_rt": pose}
    for name, numbers in table.items():
        lines_of[name][frames] = [_line(values) for values in numbers]
    labelled = range(truth.raw_start + truth.clip[0], truth.raw_start + truth.clip[1])
    for frame in labelled:
        lines_of["action_label"][frame] = f"{H2O_ACTION_IDS[truth.verb, truth.object_name]}\n"
        lines_of["verb_label"][frame] = f"{H2O_VERB_IDS[truth.verb]}\n"


def _hand_blocks(
    track: HandTrack, pair: HandPair, side, camera_from_world: np.ndarray, eye: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (frame, 62) flag, translation, 48 pose, 10 betas, and (frame, 64) flag, 21 points; camera frame."""
    n_frames = track.n_frames
    if not track.valid.any():
        return np.tile(_ABSENT_MANO, (n_frames, 1)), np.tile(_ABSENT_POINTS, (n_frames, 1))
    rest_wrist = pair[side].rest_joints_m(track.betas)[0, 0]
    translation = np.einsum("fij,fj->fi", camera_from_world, track.wrist_m - eye) - rest_wrist
    orient = (Rotation.from_matrix(camera_from_world) * Rotation.from_rotvec(track.global_orient)).as_rotvec()
    flag = np.ones((n_frames, 1))
    mano = np.concatenate([flag, translation, orient, track.hand_pose, np.repeat(track.betas, n_frames, 0)], axis=1)
    joints = track_joints(track, pair[side])[:, OPENPOSE].astype(np.float64)
    joints_camera_m = (joints - eye[:, None]) @ camera_from_world.transpose(0, 2, 1)
    return mano, np.concatenate([flag, joints_camera_m.reshape(n_frames, 63)], axis=1)


def _object_blocks(
    truth: TruthSequence, camera_from_world: np.ndarray, eye: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (frame, 17) class id, camera_from_object; and (frame, 64) class id, centre, corners, edge midpoints."""
    track, n_frames = truth.object, truth.n_frames
    pose = np.tile(np.eye(4), (n_frames, 1, 1))
    pose[:, :3, :3] = camera_from_world @ Rotation.from_rotvec(track.rotvec).as_matrix()
    pose[:, :3, 3] = np.einsum("fij,fj->fi", camera_from_world, track.translation_m - eye)
    low, high = track.model.vertices_m.min(0), track.model.vertices_m.max(0)
    corners = np.array(list(product(*zip(low, high, strict=True))))
    edges = np.array([(corners[a] + corners[b]) / 2 for a, b in _EDGES])
    points = np.concatenate([[(low + high) / 2], corners, edges])
    points_camera_m = points @ pose[:, :3, :3].transpose(0, 2, 1) + pose[:, None, :3, 3]
    kind = np.full((n_frames, 1), float(H2O_OBJECT_IDS[truth.object_name]))
    numbers = pose.reshape(n_frames, 16), points_camera_m.reshape(n_frames, 63)
    return np.concatenate([kind, numbers[0]], 1), np.concatenate([kind, numbers[1]], 1)
