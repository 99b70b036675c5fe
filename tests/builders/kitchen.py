"""The walk-through's dataset and adapter: the code as printed in ``hoidata/datasets/README.md``, files written here."""

import importlib.util
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

import hoidata.datasets
from hoidata.clips.clip import HandTrack
from hoidata.datasets.registry import ENTRY_POINT_GROUP
from hoidata.hands import HandPair, track_joints

WALK_THROUGH = Path(hoidata.datasets.__file__).with_name("README.md")
PACKAGE = "kitchen_hoi"
FILES = {"toml": "facts.toml", "json": "splits/drawn.json", "python": "adapter.py"}
FRAMES_AT_60_HZ = 48
HALF_BOX_M = np.array([0.05, 0.02, 0.05])


def write_dataset(folder: Path) -> Path:
    """The walk-through's folder ``kitchen``: the first block of TOML, JSON and Python it prints."""
    text = WALK_THROUGH.read_text()
    blocks = {kind: re.findall(rf"^```{kind}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)[0] for kind in FILES}
    for kind, name in FILES.items():
        path = folder / "kitchen" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(blocks[kind])
    return folder / "kitchen"


def write_package(folder: Path) -> Path:
    """The same as an installed package of somebody else, with the entry point in its metadata; the adapter's file."""
    (folder / PACKAGE).mkdir(parents=True)
    (folder / PACKAGE / "__init__.py").touch()
    metadata = folder / f"{PACKAGE}-2.5.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: kitchen-hoi\nVersion: 2.5\n")
    point = f"[{ENTRY_POINT_GROUP}]\nkitchen = {PACKAGE}.kitchen.adapter:KitchenAdapter\n"
    (metadata / "entry_points.txt").write_text(point)
    return write_dataset(folder / PACKAGE) / "adapter.py"


def import_example(folder: Path) -> ModuleType:
    """The example as a module of this process."""
    name = "kitchen_adapter"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, write_dataset(folder) / "adapter.py")
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


def write_kitchen(root: Path, hands: HandPair) -> Path:
    """Three recordings of two people. Both hands grip a box of 10 x 4 x 10 cm that is moved and turned."""
    (root / "meshes").mkdir(parents=True)
    box_cm = trimesh.creation.box(2 * HALF_BOX_M * 100)
    (root / "meshes" / "cup.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in box_cm.vertices)
        + "".join(f"f {a} {b} {c}\n" for a, b, c in box_cm.faces + 1)
    )
    for number, name in enumerate(("p01/lift_cup_1", "p01/pour_cup_2", "p02/lift_cup_1")):
        path = root / "recordings" / f"{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(_recording(np.random.default_rng(number), hands)))
    return root


def _recording(rng: np.random.Generator, hands: HandPair) -> dict:
    time = np.linspace(0, 1, FRAMES_AT_60_HZ)[:, None]
    rotation = Rotation.from_rotvec(rng.normal(0, 0.6, 3) + time * rng.normal(0, 1.2, 3))
    position_m = np.array([0.3, -0.2, 1.0]) + time * rng.normal(0, 0.2, 3)
    pose = np.tile(np.eye(4), (FRAMES_AT_60_HZ, 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = rotation.as_matrix(), position_m
    recording = {"fps": 60, "object": pose.reshape(-1, 16).round(9).tolist()}
    return recording | {side: _hand(side, rotation, position_m, rng, hands) for side in ("left", "right")}


def _hand(side: str, rotation: Rotation, position_m: np.ndarray, rng: np.random.Generator, hands: HandPair) -> dict:
    """Bent about as the mean pose; the middle of index, middle and ring tip lies on the face below the palm."""
    model = hands[side]
    betas, fingers = rng.normal(0, 0.3, 10), np.tile(rng.normal(0, 0.05, 45), (len(position_m), 1))
    flat = HandTrack(
        wrist_m=np.zeros((1, 3)),
        global_orient=np.zeros((1, 3)),
        hand_pose=fingers[:1] + model.mean_pose,
        betas=betas[None],
        valid=np.ones(1, bool),
    )
    tips = track_joints(flat, model)[0, [16, 17, 19]].mean(axis=0)
    grip = np.array([0.02 if side == "right" else -0.02, HALF_BOX_M[1], 0.0])
    wrist = position_m + rotation.apply(grip - tips)
    rest = model.joint_regressor[0] @ (model.template_m + model.shape_directions @ betas)
    return {
        "trans": (wrist - rest).round(9).tolist(),
        "rot": rotation.as_rotvec().round(9).tolist(),
        "fingers": fingers.round(9).tolist(),
        "betas": betas.round(9).tolist(),
    }
