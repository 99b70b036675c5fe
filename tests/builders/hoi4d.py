"""Writes HOI4D recordings from a ground truth in the world: JSON, text and Python 2 pickles.

Independent of the adapter: rotations are SciPy's, pickles are written opcode by opcode.
"""

import json
import struct
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.datasets import SequenceKey
from hoidata.hands import load_embedded_hands

HANDS = load_embedded_hands()
N_FRAMES = 20
SIDES = ("left", "right")
SAFE = "ZY20210800003/H3/C6/N04/S244/s02/T1"
SCISSORS = "ZY20210800001/H1/C9/N12/S350/s02/T2"
MUG = "ZY20210800002/H2/C2/N07/S81/s01/T1"
MISSING, SHORT = 7, 11  # frames of the scissors' right hand
FREE, REVOLUTE = "自由", "铰链（旋转）"
MODELS, ANNOTATIONS = "HOI4D_CAD_Model_for_release", "HOI4D_annotations"


def key_of(name: str) -> SequenceKey:
    return SequenceKey("hoi4d", name.split("/")[1], name)


@dataclass(frozen=True)
class Recording:
    """A ground truth in the world, and options of the file format."""

    name: str
    folder: str
    parts: list[trimesh.Trimesh]  # of the whole object at rest, base first
    labels: tuple[str, ...]
    camera: np.ndarray  # (frame, 4, 4) world from camera
    pose: np.ndarray  # (frame, 4, 4) world from object
    angle: np.ndarray  # (frame,) radians about ``axis`` through ``origin``
    axis: np.ndarray
    origin: np.ndarray
    box_rotations: tuple[Rotation, ...]  # object from box, per part
    # Per side: orientation (frame, 3), 45 finger angles, wrist (frame, 3), 10 betas.
    hands: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
    events: tuple[tuple[str, int, int], ...]  # word, first frame, stop frame
    padded: bool = False
    hand_folder: str = "handpose/refinehandpose_{}"
    clock_s: float = 20.0
    marks: bool = False
    says_length: bool = True
    objects_at: int = -1
    without: dict[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def hinged(self) -> bool:
        return len(self.parts) == 2


def transforms(turns: Rotation, positions_m) -> np.ndarray:
    result = np.tile(np.eye(4), (len(positions_m), 1, 1))
    result[:, :3, :3], result[:, :3, 3] = turns.as_matrix(), positions_m
    return result


def moving_camera(n_frames: int, seed: int) -> np.ndarray:
    """World from a camera that looks ahead and down, and rotates while it moves."""
    random, time = np.random.default_rng(seed), np.linspace(0, 1, n_frames)[:, None]
    ahead = Rotation.from_matrix(np.array([[1, 0, 0], [0, -0.6, -0.8], [0, 0.8, -0.6]]).T)
    rotation = Rotation.from_rotvec(time * random.normal(0, 0.3, 3)) * ahead
    return transforms(rotation, np.array([0.1, -0.2, 0.4]) + time * random.normal(0, 0.2, 3))


def box(size, middle) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(middle)


def hand_of(side: str, pose: np.ndarray, offset, random) -> tuple:
    rotation = Rotation.from_matrix(pose[:, :3, :3]) * Rotation.from_rotvec(random.normal(0, 0.5, 3))
    wrist = pose[:, :3, :3] @ np.array(offset) + pose[:, :3, 3]
    return rotation.as_rotvec(), HANDS[side].mean_pose + random.normal(0, 0.2, 45), wrist, random.normal(0, 0.5, 10)


def recording(name: str, seed: int, n_frames: int = N_FRAMES, **changes) -> Recording:
    """The safe, the scissors or the mug, with a hand on each side."""
    random, time = np.random.default_rng(seed), np.linspace(0, 1, n_frames)[:, None]
    rotation = Rotation.from_rotvec(random.normal(0, 0.5, 3) + time * random.normal(0, 0.6, 3))
    pose = transforms(rotation, np.array([0.2, 0.5, 0.1]) + time * random.normal(0, 0.2, 3))
    hands = {s: hand_of(s, pose, (0.2 if s == "right" else -0.2, 0, 0.1), random) for s in SIDES}
    shared = {
        "name": name, "camera": moving_camera(n_frames, seed), "pose": pose, "hands": hands,
        "angle": 2.5 + 1.5 * np.sin(2 * time[:, 0]),
        "box_rotations": tuple(Rotation.from_rotvec(random.normal(0, 1, (2, 3)))),
    }  # fmt: skip
    if name == SAFE:
        parts = [box((0.3, 0.25, 0.35), (0, 0, 0)), box((0.28, 0.02, 0.3), (0.01, -0.14, 0))]
        facts = {"folder": "Safe", "labels": ("Safebox", "Safedoor"), "axis": [0, 0, 1], "origin": [-0.14, -0.14, 0]}
        facts["events"] = (("Reachout", 0, 3), ("open", 3, 19))
    elif name == SCISSORS:
        parts = [box((0.02, 0.16, 0.01), (0, 0, 0)), box((0.015, 0.12, 0.008), (0.004, 0.01, 0.009))]
        facts = {"folder": "Scissors", "labels": ("blade_b", "blade_a"), "axis": [0, 0, -1], "origin": [0, 0.03, 0]}
        facts |= {"events": (("cut", 2, 20),), "padded": True, "hand_folder": "Hand_pose/handpose_{}_hand"}
        facts |= {"clock_s": 10.0, "marks": True, "says_length": False, "objects_at": 3}
        facts["without"] = {"right": (MISSING,)}
    else:
        parts = [box((0.08, 0.1, 0.12), (0, 0, 0))]
        facts = {"folder": "Mug", "labels": ("Watercup",), "axis": [0, 0, 1], "origin": [0, 0, 0]}
        facts["events"] = (("Pickup", 0, n_frames),)
    facts |= {name: np.array(facts[name], float) for name in ("axis", "origin")}
    return replace(Recording(parts=parts, **shared, **facts), **changes)


def write_recording(root: Path, truth: Recording) -> Path:
    folder = root / ANNOTATIONS / truth.name
    for name in ("objpose", "action", "3Dseg"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    _write_models(root, truth)
    _write_camera(folder / "3Dseg/output.log", truth.camera)
    _write_events(folder / "action/color.json", truth)
    boxes = _boxes(truth)
    for frame in range(len(truth.pose)):
        entries = [_entry(truth, number, boxes[number], frame) for number in range(len(truth.parts))]
        name = "objects" if frame == truth.objects_at else "dataList"
        value = {"frameId": 1, "filePath": f"align_rgb/{frame:05d}.jpg", "isEffective": 1, name: entries[::-1]}
        stem = f"{frame:05d}" if truth.padded else f"{frame}"
        (folder / f"objpose/{stem}.json").write_text(json.dumps(value))
    for side in SIDES:
        _write_hand(root / truth.hand_folder.format(side) / truth.name, truth, side)
    return root


def write_two(root: Path) -> Path:
    for seed, name in enumerate((SAFE, SCISSORS)):
        write_recording(root, recording(name, seed))
    short = root / "Hand_pose/handpose_right_hand" / SCISSORS / f"{SHORT}.pickle"
    short.write_bytes(pickled({"poseCoeff": np.zeros(1), "beta": np.zeros(10), "trans": np.zeros(3)}))
    return root


def _boxes(truth: Recording) -> list[tuple[np.ndarray, np.ndarray]]:
    """Centre in the whole object and extents of each part's box."""
    result = []
    for part, box_rotation in zip(truth.parts, truth.box_rotations, strict=False):
        rotated = box_rotation.inv().apply(part.vertices)
        result.append((box_rotation.apply((rotated.min(axis=0) + rotated.max(axis=0)) / 2), np.ptp(rotated, axis=0)))
    return result


def _entry(truth: Recording, number: int, centre_and_extents, frame: int) -> dict:
    middle, size = centre_and_extents
    rotation = Rotation.from_rotvec(truth.axis * truth.angle[frame] * (number == 1))
    position_m = rotation.apply(middle - truth.origin) + truth.origin
    world = Rotation.from_matrix(truth.pose[frame, :3, :3]) * rotation * truth.box_rotations[number]
    camera = Rotation.from_matrix(truth.camera[frame, :3, :3])
    centre = camera.inv().apply(
        truth.pose[frame, :3, :3] @ position_m + truth.pose[frame, :3, 3] - truth.camera[frame, :3, 3]
    )
    x, y, z = (camera.inv() * world).as_euler("XYZ")
    return {
        "id": number + 1,
        "label": truth.labels[number],
        "center": dict(zip("xyz", centre.tolist(), strict=True)),
        "dimensions": {"height": 1.02 * size[2], "length": 1.02 * size[0], "width": 1.02 * size[1]},
        "rotation": {"x": x, "y": y, "z": z},
        "2dBox": {"camera1": []},
        "properties": {},
    }


def _write_models(root: Path, truth: Recording) -> None:
    number = f"{int(truth.name.split('/')[3][1:]):03d}"
    if not truth.hinged:
        (middle, _), part = _boxes(truth)[0], truth.parts[0]
        write_obj(
            root / MODELS / "rigid" / truth.folder / f"{number}.obj",
            truth.box_rotations[0].inv().apply(part.vertices - middle),
            part,
        )
        return
    folder = root / MODELS / "articulated" / truth.folder / number
    for part_number, (part, box_rotation, (middle, _)) in enumerate(
        zip(truth.parts, truth.box_rotations, _boxes(truth), strict=True)
    ):
        write_obj(folder / f"objs/new-{1 - part_number}.obj", part.vertices, part)
        write_obj(
            folder / f"objs/new-{1 - part_number}-align.obj", box_rotation.inv().apply(part.vertices - middle), part
        )
    leaves = [
        {"id": 5 + part_number, "name": f"part {part_number}", "text": "", "objs": [f"new-{1 - part_number}"]}
        for part_number in (0, 1)
    ]
    tree = [{"id": 1, "name": "whole", "text": "whole", "objs": [], "children": leaves}]
    (folder / "result.json").write_text(json.dumps(tree), encoding="utf-8")
    nodes = [
        {
            "id": 0, "parent": -1, "joint": FREE, "name": "a", "parts": [{"id": 5, "name": "a", "children": []}],
            "jointData": {},
        },
        {
            "id": 1, "parent": 0, "joint": REVOLUTE, "name": "b", "parts": [{"id": 6, "name": "b", "children": []}],
            "jointData": {
                "axis": {"origin": truth.origin.tolist(), "direction": (2 * truth.axis).tolist()},
                "limit": {"a": 0, "b": -104.76, "noLimit": False},
            },
        },
    ]  # fmt: skip
    (folder / "mobility_v2.json").write_text(json.dumps(nodes[::-1], ensure_ascii=False), encoding="utf-8")


def write_obj(path: Path, vertices: np.ndarray, mesh: trimesh.Trimesh) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()] + [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    path.write_text("\n".join(lines) + "\n")


def _write_camera(path: Path, poses: np.ndarray) -> None:
    blocks = [
        f"{n} {n} {n + 1}\n" + "\n".join(" ".join(map(repr, matrix_row)) for matrix_row in pose.tolist())
        for n, pose in enumerate(poses)
    ]
    path.write_text("\n".join(blocks) + "\n")


def _write_events(path: Path, truth: Recording) -> None:
    seconds = truth.clock_s / 300
    length = {("Duration" if truth.marks else "duration"): truth.clock_s} if truth.says_length else {}
    names = ("hdTimeStart", "hdTimeEnd") if truth.marks else ("startTime", "endTime")
    items = [{"event": word, names[0]: start * seconds, names[1]: stop * seconds} for word, start, stop in truth.events]
    value = {"info": length, **({"markResult": {"marks": items}} if truth.marks else {"events": items})}
    path.write_text(json.dumps(value))


def _write_hand(folder: Path, truth: Recording, side: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    orient, fingers, wrist, betas = truth.hands[side]
    rest = HANDS[side].joint_regressor @ (HANDS[side].template_m + HANDS[side].shape_directions @ betas)
    for frame in range(len(orient)):
        if frame in truth.without.get(side, ()):
            continue
        camera = truth.camera[frame]
        rotation = Rotation.from_matrix(camera[:3, :3]).inv() * Rotation.from_rotvec(orient[frame])
        position_m = camera[:3, :3].T @ (wrist[frame] - camera[:3, 3]) - rest[0]
        value = {
            "poseCoeff": np.concatenate([rotation.as_rotvec(), fingers]), "beta": betas, "trans": position_m,
            "kps2D": np.zeros((21, 2)),
        }  # fmt: skip
        (folder / f"{frame}.pickle").write_bytes(pickled(value))


def pickled(values: dict[str, np.ndarray]) -> bytes:
    """As ``cPickle.dumps(values, 2)`` of Python 2 writes a dictionary of float32 arrays: byte strings, no unicode."""
    out = [b"\x80\x02}("]
    for name, array in values.items():
        array = np.asarray(array, "<f4")
        shape = b"(" + b"".join(b"K" + bytes((length,)) for length in array.shape) + b"t"
        raw = array.tobytes()
        out += [
            *(
                _text(name),
                b"cnumpy.core.multiarray\n_reconstruct\n",
                b"(cnumpy\nndarray\n",
                b"(K\x00t",
                _text("b"),
                b"tR",
            ),
            *(b"(K\x01", shape, b"cnumpy\ndtype\n(", _text("f4"), b"K\x00K\x01tR"),
            *(b"(K\x03", _text("<"), b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb", b"\x89"),
            *(b"T" + struct.pack("<i", len(raw)) + raw, b"tb"),
        ]
    return b"".join([*out, b"u."])


def _text(value: str) -> bytes:
    return b"U" + bytes((len(value),)) + value.encode("latin1")
