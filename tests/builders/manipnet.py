"""ManipNet recordings written by hand from the format notes: left-handed decimetres, 120 Hz, 17-joint hands."""

import gzip
import json
import shutil
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.clips.recording import HandRecording
from hoidata.datasets import RawTree, SequenceKey
from hoidata.datasets.manipnet.adapter import HAND_JOINTS
from hoidata.geometry.motion import Motion
from models.manipnet.control import Control

# A right hand in the files' axes: fingers to -x, thumb side +y, palm to -z. "~" is "-" on the right, "" on the left.
HAND = """HIERARCHY
ROOT WRIST
{
  OFFSET 0.0 0.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
  JOINT THUMB_CMC_FE { OFFSET ~0.20 0.12 -0.05 CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT THUMB_CMC_AA { OFFSET ~0.18 0.16 -0.10 CHANNELS 3 Yrotation Xrotation Zrotation
      JOINT THUMB_MCP_FE { OFFSET ~0.28 0.20 -0.06 CHANNELS 3 Yrotation Xrotation Zrotation
        JOINT THUMB_IP_FE { OFFSET ~0.30 0.22 -0.04 CHANNELS 3 Yrotation Xrotation Zrotation
          End Site { OFFSET 0.0 0.0 0.0 } } } } }
  JOINT INDEX_MCP { OFFSET ~1.05 0.25 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT INDEX_PIP_FE { OFFSET ~0.41 0.02 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
      JOINT INDEX_DIP_FE { OFFSET ~0.26 0.01 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
        End Site { OFFSET 0.0 0.0 0.0 } } } }
  JOINT MIDDLE_MCP { OFFSET ~1.04 0.02 0.03 CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT MIDDLE_PIP_FE { OFFSET ~0.46 0.00 0.02 CHANNELS 3 Yrotation Xrotation Zrotation
      JOINT MIDDLE_DIP_FE { OFFSET ~0.30 0.00 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
        End Site { OFFSET 0.0 0.0 0.0 } } } }
  JOINT RING_MCP { OFFSET ~0.97 -0.19 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT RING_PIP_FE { OFFSET ~0.42 -0.01 0.02 CHANNELS 3 Yrotation Xrotation Zrotation
      JOINT RING_DIP_FE { OFFSET ~0.28 -0.02 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
        End Site { OFFSET 0.0 0.0 0.0 } } } }
  JOINT PINKY_MCP { OFFSET ~0.86 -0.38 -0.07 CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT PINKY_PIP_FE { OFFSET ~0.33 -0.02 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
      JOINT PINKY_DIP_FE { OFFSET ~0.22 -0.03 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
        End Site { OFFSET 0.0 0.0 0.0 } } } }
}
MOTION
Frames: %d
Frame Time: 0.008333334
"""
THING = """HIERARCHY
ROOT tetra_large
{
  OFFSET 0.0 0.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
  End Site { OFFSET 0.0 0.0 0.0 }
}
MOTION
Frames: %d
Frame Time: 0.008333334
"""
# No mirror symmetry: four corners at different distances.
TETRA = (
    "v 0.5 0.0 0.0\nv 0.0 0.4 0.0\nv 0.0 0.0 0.3\nv -0.2 -0.3 -0.1\nf 1/1/1 2/2/2 3/3/3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n"
)
TIPS = {
    "THUMB_IP_FE": [-0.21, 0.17, -0.02],
    "INDEX_DIP_FE": [-0.25, 0.02, 0.01],
    "MIDDLE_DIP_FE": [-0.28, 0.03, -0.02],
    "RING_DIP_FE": [-0.27, 0.0, -0.01],
    "PINKY_DIP_FE": [-0.24, -0.01, -0.01],
}
REFERENCE = {"capsules": [{"joint": joint, "end_local": end} for joint, end in TIPS.items()]}
# Columns of a hand row: position and rotation of the wrist, then (Y, X, Z) degrees of the other 16 joints.
POSE = [
    *(1.5, 2.0, -0.5, 40.0, -30.0, 20.0),
    *(10.0, -5.0, 8.0, 12.0, 20.0, -15.0, 5.0, 6.0, 7.0, -8.0, 9.0, -10.0),
    *(-15.0, 10.0, 5.0, -30.0, 2.0, 3.0, -20.0, 4.0, -5.0),
    *(-18.0, 1.0, 2.0, -35.0, 3.0, 4.0, -22.0, 5.0, 6.0),
    *(-21.0, 7.0, 8.0, -38.0, 9.0, 10.0, -24.0, 11.0, 12.0),
    *(-25.0, 13.0, 14.0, -40.0, 15.0, 16.0, -26.0, 17.0, 18.0),
]
FLAT = [0.0] * 48
MIRROR = np.array([-1.0, 1.0, 1.0])
KEY = SequenceKey("manipnet", "manipnet", "tetra_large7")


def write_gz(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(text.encode(), mtime=0))


def motion_text(head: str, rows: list[list[float]]) -> str:
    return (
        head % len(rows)
        + "\n".join(" ".join(f"{value:.6f}" for value in frame_numbers) + " " for frame_numbers in rows)
        + "\n"
    )


def write_tree(root: Path, left: list, right: list, object_rows: list, name: str = "tetra_large7") -> RawTree:
    folder = root / "sequences" / name
    write_gz(folder / "leftHand.bvh.gz", motion_text(HAND.replace("~", ""), left))
    write_gz(folder / "rightHand.bvh.gz", motion_text(HAND.replace("~", "-"), right))
    write_gz(folder / "tetra_large.bvh.gz", motion_text(THING, object_rows))
    write_gz(root / "objects" / "Primitive" / "tetra_large.obj.gz", TETRA)
    (root / "hand").mkdir(exist_ok=True)
    (root / "hand" / "hand_reference.json").write_text(json.dumps(REFERENCE))
    return RawTree(root)


def lift_rows(n_frames: int = 600) -> tuple[list, list, list]:
    """A flat right hand whose palm carries the object 30 cm up after half a second; the left hand waits nearby."""
    left, right, object_rows = [], [], []
    for frame in range(n_frames):
        sway = 0.002 * np.sin(frame / 9)
        height = 1.0 + 3.0 * np.clip((frame - 60) / 240, 0, 1)
        right.append([sway, height, 0.0, *[0.0] * 3, *FLAT])
        left.append([-6.0 + sway, 1.5, 0.0, *[0.0] * 3, *FLAT])
        object_rows.append([-0.9 + sway, height, -0.4, 0.0, 0.0, 0.0])
    return left, right, object_rows


def write_two(root: Path) -> Path:
    """A lift, and the same with a cube."""
    write_tree(root, *lift_rows())
    shutil.copytree(root / "sequences/tetra_large7", root / "sequences/cube_large8")
    object_file = root / "sequences/cube_large8/tetra_large.bvh.gz"
    text = gzip.decompress(object_file.read_bytes()).replace(b"tetra_large", b"cube_large")
    object_file.with_name("cube_large.bvh.gz").write_bytes(gzip.compress(text, mtime=0))
    object_file.unlink()
    shutil.copy(root / "objects/Primitive/tetra_large.obj.gz", root / "objects/Primitive/cube_large.obj.gz")
    return root


def write_skin(root: Path, seed: int = 0) -> dict[str, np.ndarray]:
    """Write a right hand: random skin points on random bones, and all capsules. Returns the skin."""
    random = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (17, 1, 1))
    poses[1:, :3, :3] = Rotation.from_rotvec(random.normal(0, 0.3, (16, 3))).as_matrix()
    poses[1:, :3, 3] = random.normal(0, 0.5, (16, 3))
    poses[:2] = np.eye(4)  # both are the wrist
    normals = random.normal(size=(788, 3))
    weights = random.dirichlet(np.ones(4), 788)
    weights[:, 3] = 0
    skin = {
        "vertices": random.normal(0, 0.5, (788, 3)),
        "normals": normals / np.linalg.norm(normals, axis=1, keepdims=True),
        "bone_weights": weights / weights.sum(axis=1, keepdims=True),
        "bind_poses": poses,
    }
    arrays = {name: array.astype(np.float32) for name, array in skin.items()}
    arrays["bone_indices"] = random.permuted(np.tile(np.arange(17), (788, 1)), axis=1)[:, :4].astype(np.int32)
    np.savez(root / "hand" / "right_hand_skin.npz", **arrays)
    capsules = [
        {
            "joint": joint,
            "start_local": random.normal(0, 0.1, 3).tolist(),
            "end_local": TIPS.get(joint, random.normal(0, 0.1, 3).tolist()),
            "radius": float(random.uniform(0.07, 0.2)),
        }
        for joint in ["WRIST"] * 4 + [name for name in HAND_JOINTS if name not in ("WRIST", "THUMB_CMC_FE")]
    ]
    sensors = sorted(random.choice(788, 104, replace=False).tolist())
    (root / "hand" / "hand_reference.json").write_text(
        json.dumps({"capsules": capsules, "proximity_vertices": sensors})
    )
    return arrays


def recording_control(recording: HandRecording) -> Control:
    """Inputs of the network from a recording with 17-joint hands, at its rate, with time 0 in its first frame."""
    object_track, time_s = recording.object, recording.time_s
    wrists: dict[Side, Motion] = {}
    for side in SIDES:
        pose = recording.world_from_wrist(side)
        wrists[side] = Motion(time_s, pose.rotation, pose.translation)
    body = object_track.world_from_object
    hinge = None if object_track.hinge_rad is None else object_track.hinge_rad.astype(np.float64)
    return Control(wrists, Motion(time_s, body.rotation, body.translation), object_track.model, hinge)
