"""HOI4D recordings written as the format notes have them, from a truth in the world: JSON, text and Python 2 pickles.

Nothing of the adapter is used: rotations are SciPy's, pickles are written opcode by opcode.
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
    """A truth in the world, and how it is written.

    parts: meshes of the whole object at rest, base first. camera, pose: (frame, 4, 4) world from camera and object.
    angle: (frame,) radians about ``axis`` through ``origin``. own: by part the turn of its own mesh. hands: per side
    (orient (frame, 3), 45 finger angles, wrist (frame, 3), 10 betas). events: (word, first, stop) in frames.
    """

    name: str
    folder: str
    parts: list[trimesh.Trimesh]
    labels: tuple[str, ...]
    camera: np.ndarray
    pose: np.ndarray
    angle: np.ndarray
    axis: np.ndarray
    origin: np.ndarray
    own: tuple[Rotation, ...]
    hands: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
    events: tuple[tuple[str, int, int], ...]
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


def transforms(turns: Rotation, places) -> np.ndarray:
    found = np.tile(np.eye(4), (len(places), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = turns.as_matrix(), places
    return found


def moving_camera(n_frames: int, seed: int) -> np.ndarray:
    """A head that looks ahead and down, and turns while it goes."""
    random, time = np.random.default_rng(seed), np.linspace(0, 1, n_frames)[:, None]
    ahead = Rotation.from_matrix(np.array([[1, 0, 0], [0, -0.6, -0.8], [0, 0.8, -0.6]]).T)
    turn = Rotation.from_rotvec(time * random.normal(0, 0.3, 3)) * ahead
    return transforms(turn, np.array([0.1, -0.2, 0.4]) + time * random.normal(0, 0.2, 3))


def box(size, middle) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(middle)


def hand_of(side: str, pose: np.ndarray, offset, random) -> tuple:
    turn = Rotation.from_matrix(pose[:, :3, :3]) * Rotation.from_rotvec(random.normal(0, 0.5, 3))
    wrist = pose[:, :3, :3] @ np.array(offset) + pose[:, :3, 3]
    return turn.as_rotvec(), HANDS[side].mean_pose + random.normal(0, 0.2, 45), wrist, random.normal(0, 0.5, 10)


def recording(name: str, seed: int, n_frames: int = N_FRAMES, **changes) -> Recording:
    """The safe, the scissors or the mug, both hands beside it."""
    random, time = np.random.default_rng(seed), np.linspace(0, 1, n_frames)[:, None]
    turn = Rotation.from_rotvec(random.normal(0, 0.5, 3) + time * random.normal(0, 0.6, 3))
    pose = transforms(turn, np.array([0.2, 0.5, 0.1]) + time * random.normal(0, 0.2, 3))
    hands = {s: hand_of(s, pose, (0.2 if s == "right" else -0.2, 0, 0.1), random) for s in SIDES}
    shared = {
        "name": name, "camera": moving_camera(n_frames, seed), "pose": pose, "hands": hands,
        "angle": 2.5 + 1.5 * np.sin(2 * time[:, 0]), "own": tuple(Rotation.from_rotvec(random.normal(0, 1, (2, 3)))),
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


def write_recording(root: Path, made: Recording) -> Path:
    folder = root / ANNOTATIONS / made.name
    for name in ("objpose", "action", "3Dseg"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    _write_models(root, made)
    _write_camera(folder / "3Dseg/output.log", made.camera)
    _write_events(folder / "action/color.json", made)
    boxes = _boxes(made)
    for frame in range(len(made.pose)):
        entries = [_entry(made, number, boxes[number], frame) for number in range(len(made.parts))]
        name = "objects" if frame == made.objects_at else "dataList"
        value = {"frameId": 1, "filePath": f"align_rgb/{frame:05d}.jpg", "isEffective": 1, name: entries[::-1]}
        stem = f"{frame:05d}" if made.padded else f"{frame}"
        (folder / f"objpose/{stem}.json").write_text(json.dumps(value))
    for side in SIDES:
        _write_hand(root / made.hand_folder.format(side) / made.name, made, side)
    return root


def write_two(root: Path) -> Path:
    for seed, name in enumerate((SAFE, SCISSORS)):
        write_recording(root, recording(name, seed))
    short = root / "Hand_pose/handpose_right_hand" / SCISSORS / f"{SHORT}.pickle"
    short.write_bytes(pickled({"poseCoeff": np.zeros(1), "beta": np.zeros(10), "trans": np.zeros(3)}))
    return root


def _boxes(made: Recording) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each part: the middle of its own box in the whole object, and its extents, along its own axes."""
    found = []
    for part, own in zip(made.parts, made.own, strict=False):
        turned = own.inv().apply(part.vertices)
        found.append((own.apply((turned.min(axis=0) + turned.max(axis=0)) / 2), np.ptp(turned, axis=0)))
    return found


def _entry(made: Recording, number: int, middle_and_size, frame: int) -> dict:
    middle, size = middle_and_size
    turn = Rotation.from_rotvec(made.axis * made.angle[frame] * (number == 1))
    place = turn.apply(middle - made.origin) + made.origin
    world = Rotation.from_matrix(made.pose[frame, :3, :3]) * turn * made.own[number]
    camera = Rotation.from_matrix(made.camera[frame, :3, :3])
    centre = camera.inv().apply(made.pose[frame, :3, :3] @ place + made.pose[frame, :3, 3] - made.camera[frame, :3, 3])
    x, y, z = (camera.inv() * world).as_euler("XYZ")
    return {
        "id": number + 1,
        "label": made.labels[number],
        "center": dict(zip("xyz", centre.tolist(), strict=True)),
        "dimensions": {"height": 1.02 * size[2], "length": 1.02 * size[0], "width": 1.02 * size[1]},
        "rotation": {"x": x, "y": y, "z": z},
        "2dBox": {"camera1": []},
        "properties": {},
    }


def _write_models(root: Path, made: Recording) -> None:
    number = f"{int(made.name.split('/')[3][1:]):03d}"
    if not made.hinged:
        (middle, _), part = _boxes(made)[0], made.parts[0]
        write_obj(
            root / MODELS / "rigid" / made.folder / f"{number}.obj",
            made.own[0].inv().apply(part.vertices - middle),
            part,
        )
        return
    folder = root / MODELS / "articulated" / made.folder / number
    for place, (part, own, (middle, _)) in enumerate(zip(made.parts, made.own, _boxes(made), strict=True)):
        write_obj(folder / f"objs/new-{1 - place}.obj", part.vertices, part)
        write_obj(folder / f"objs/new-{1 - place}-align.obj", own.inv().apply(part.vertices - middle), part)
    leaves = [{"id": 5 + place, "name": f"part {place}", "text": "", "objs": [f"new-{1 - place}"]} for place in (0, 1)]
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
                "axis": {"origin": made.origin.tolist(), "direction": (2 * made.axis).tolist()},
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
        f"{n} {n} {n + 1}\n" + "\n".join(" ".join(map(repr, row)) for row in pose.tolist())
        for n, pose in enumerate(poses)
    ]
    path.write_text("\n".join(blocks) + "\n")


def _write_events(path: Path, made: Recording) -> None:
    seconds = made.clock_s / 300
    length = {("Duration" if made.marks else "duration"): made.clock_s} if made.says_length else {}
    names = ("hdTimeStart", "hdTimeEnd") if made.marks else ("startTime", "endTime")
    items = [{"event": word, names[0]: start * seconds, names[1]: stop * seconds} for word, start, stop in made.events]
    value = {"info": length, **({"markResult": {"marks": items}} if made.marks else {"events": items})}
    path.write_text(json.dumps(value))


def _write_hand(folder: Path, made: Recording, side: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    orient, fingers, wrist, betas = made.hands[side]
    rest = HANDS[side].joint_regressor @ (HANDS[side].template_m + HANDS[side].shape_directions @ betas)
    for frame in range(len(orient)):
        if frame in made.without.get(side, ()):
            continue
        camera = made.camera[frame]
        turn = Rotation.from_matrix(camera[:3, :3]).inv() * Rotation.from_rotvec(orient[frame])
        place = camera[:3, :3].T @ (wrist[frame] - camera[:3, 3]) - rest[0]
        value = {
            "poseCoeff": np.concatenate([turn.as_rotvec(), fingers]), "beta": betas, "trans": place,
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
