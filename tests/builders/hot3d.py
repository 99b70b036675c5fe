"""Writes HOT3D recordings from a ground truth in a world with z up, like the samples of the authors' toolkit.

Independent of the adapter: rotations are SciPy's, UmeTrack's joints are computed bone by bone, GLB is packed here.
"""

import io
import json
import struct
import tarfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, HandTrack
from hoidata.datasets import SequenceKey
from hoidata.hands import load_embedded_hands, track_joints
from tests.builders.formulas import rest_points

HANDS = load_embedded_hands()
N_FRAMES = 36
HALF_BOX_M = np.array([0.035, 0.03, 0.02])
MUG, MOUSE, KEYBOARD = "223371871635142", "265826671143948", "37787722328019"
NAMES = {MUG: "mug_white", MOUSE: "mouse", KEYBOARD: "keyboard"}
ARIA, QUEST, UMETRACK = "P0001_4bf4e21a", "P0002_273c2819", "P0003_c701bd11"
STREAMS = {"Aria": ("214-1", "1201-1", "1201-2"), "Quest3": ("1201-1", "1201-2")}
# World of each headset from the one with z up: Quest 3 has y up.
HEADSET_FROM = {"Aria": Rotation.identity(), "Quest3": Rotation.from_euler("x", -90, degrees=True)}
MANO_FILE, UMETRACK_FILE = "mano_hand_pose_trajectory.jsonl", "umetrack_hand_pose_trajectory.jsonl"
OBJECT_HEAD = "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z"
FACES = ((0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4), (2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5))  # fmt: skip  # noqa: E501
# Of each digit of UmeTrack, from the thumb on: its three joints and its tip among our 21.
DIGITS = ((13, 14, 15, 20), (1, 2, 3, 16), (4, 5, 6, 17), (10, 11, 12, 19), (7, 8, 9, 18))
SIDEWAYS, BENDING = (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)  # axes of a left hand with its fingers along x
ANGLES = (0.1, 0.2, 0.3, 0.2, 0.05, 0.4, 0.5, 0.3, 0.0, 0.5, 0.5, 0.3, -0.05, 0.5, 0.6, 0.3, -0.1, 0.6, 0.5, 0.4, 0.0, 0.0)  # fmt: skip  # noqa: E501


def key_of(name: str) -> SequenceKey:
    return SequenceKey("hot3d", name.partition("_")[0], name)


@dataclass(frozen=True)
class Truth:
    """The ground truth of a recording, z up."""

    times_ns: tuple[tuple[int, ...], ...]  # per frame, the times of its cameras
    rotation: Rotation  # of the object, per frame
    position_m: np.ndarray  # (frame, 3) of the object
    hands: dict[str, tuple[dict, Rotation, np.ndarray]]  # per side: numbers, orientation and wrist_xform's position


def times(headset: str, count: int = N_FRAMES) -> tuple[tuple[int, ...], ...]:
    """Aria's cameras look a tenth of a millisecond apart; times in the files tremble by some microseconds."""
    if headset == "Quest3":
        return tuple((43124400000000 + 100000000 * frame // 3,) for frame in range(count))
    return tuple((56752108188860 + 33331000 * frame, 56752108279673 + 33331000 * frame) for frame in range(count))


def truth(headset: str, kind: str, seed: int) -> Truth:
    """Both hands grasp a box, which moves and rotates."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, N_FRAMES)[:, None]
    rotation = Rotation.from_rotvec(rng.normal(0, 0.6, 3) + time * rng.normal(0, 0.9, 3))
    position_m = np.array([0.2, -0.3, 0.9]) + time * rng.normal(0, 0.15, 3)
    betas, hands = rng.normal(0, 0.5, 10), {}
    for side in SIDES:
        numbers = {"pose": rng.normal(0, 0.3, 15).tolist(), "betas": betas.tolist()}
        numbers = numbers if kind == "mano" else {"joint_angles": list(ANGLES), "hand_confidence": 1.0}
        tips, origin = mano_tips(side, numbers) if kind == "mano" else umetrack_tips(side)
        reach = position_m + rotation.apply(HALF_BOX_M * ((1, 0, 0) if side == "right" else (-1, 0, 0)) - tips)
        hands[side] = numbers, rotation, reach - origin
    return Truth(times(headset), rotation, position_m, hands)


def mano_tips(side: str, numbers: dict) -> tuple[np.ndarray, np.ndarray]:
    """Mean of index, middle and ring tip relative to the wrist of an unrotated hand; and its rest wrist J0."""
    fingers = HANDS[side].mean_pose + np.array(numbers["pose"]) @ HANDS[side].components[:15]
    betas = np.array(numbers["betas"])
    at_origin = HandTrack(
        wrist_m=np.zeros((1, 3)),
        global_orient=np.zeros((1, 3)),
        hand_pose=fingers[None],
        betas=betas[None],
        valid=np.ones(1, dtype=bool),
    )
    return track_joints(at_origin, HANDS[side])[0, [16, 17, 19]].mean(axis=0), rest_points(HANDS[side], betas)[0]


def umetrack_tips(side: str) -> tuple[np.ndarray, np.ndarray]:
    return umetrack_joints(side, ANGLES)[[16, 17, 19]].mean(axis=0), np.zeros(3)


def umetrack_rest_m() -> np.ndarray:
    """(21, 3) rest joints of the left hand in hoidata's order, relative to the wrist."""
    rest = rest_points(HANDS.left)
    return rest - rest[0]


def umetrack_joints(side: str, angles) -> np.ndarray:
    """(21, 3) joints of a bent hand in hoidata's order, relative to the wrist; NaN for the base of the thumb."""
    rest, result = umetrack_rest_m(), np.zeros((21, 3))
    for number, (first, second, third, tip) in enumerate(DIGITS):
        sideways, *bends = angles[4 * number : 4 * number + 4]
        rotation = Rotation.from_rotvec(np.array(SIDEWAYS) * sideways)
        result[first] = rest[first]
        for bend, start, end in zip(bends, (first, second, third), (second, third, tip), strict=True):
            rotation = rotation * Rotation.from_rotvec(np.array(BENDING) * bend)
            result[end] = result[start] + rotation.apply(rest[end] - rest[start])
    result[13] = np.nan
    return result * ((-1, 1, 1) if side == "right" else 1)


def profile() -> dict:
    """A profile in millimetres, with integers as floats as in the released files."""
    rest = (umetrack_rest_m() * 1000).tolist()
    positions_m = [rest[joint] for first, second, third, _ in DIGITS for joint in (first, first, second, third)]
    landmarks = [(digit[3], 4 + 3 * number) for number, digit in enumerate(DIGITS)]
    landmarks += [(0, 1), (14, 2), (15, 3)]
    for number, (first, second, third, _) in enumerate(DIGITS[1:], 1):
        landmarks += [(first, 1), (second, 2 + 3 * number), (third, 3 + 3 * number)]
    return {
        "hand_model": {
            "hand_scale": 1.0,
            "joint_rest_positions": [*positions_m, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
            "joint_rotation_axes": [*([SIDEWAYS, BENDING, BENDING, BENDING] * 5), [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            "landmark_rest_bone_indices": [*([bone] * 3 for _, bone in landmarks), [1, 8, 5]],
            "landmark_rest_bone_weights": [*([1.0, 0.0, 0.0] for _ in landmarks), [0.75, 0.125, 0.125]],
            "landmark_rest_positions": [*(rest[joint] for joint, _ in landmarks), [50.0, -10.0, 4.0]],
            "mesh_triangles": [[0.0, 1.0, 2.0]],
        }
    }


def wxyz(rotation: Rotation) -> list[float]:
    return np.roll(rotation.as_quat(), 1).tolist()


def hand_lines(whole: Truth, headset: str) -> str:
    """One line per time. All times of a frame have the same hands."""
    world, lines = HEADSET_FROM[headset], []
    for frame, frame_times in enumerate(whole.times_ns):
        poses = {}
        for side, (numbers, rotation, position_m) in whole.hands.items():
            # MANO rotates about its rest wrist, so a change of frame rotates position + rest wrist.
            rest = rest_points(HANDS[side], numbers["betas"])[0] if "betas" in numbers else np.zeros(3)
            moved = (world.apply(position_m[frame] + rest) - rest).tolist()
            wrist = {"t_xyz": moved, "q_wxyz": wxyz(world * rotation[frame])}
            poses[str(SIDES.index(side))] = {**numbers, "wrist_xform": wrist}
        lines += [json.dumps({"timestamp_ns": time, "hand_poses": poses}) for time in frame_times]
    return "".join(f"{line}\n" for line in lines)


def object_rows(uid: str, whole: Truth, headset: str) -> list[tuple[int, str]]:
    world = HEADSET_FROM[headset]
    return [
        (time, ",".join([uid, str(time), *map(repr, map(float, (*world.apply(position_m), *wxyz(world * rotation))))]))
        for frame_times, rotation, position_m in zip(whole.times_ns, whole.rotation, whole.position_m, strict=True)
        for time in frame_times
    ]


def object_table(rows: list[tuple[int, str]]) -> str:
    return (
        "\n".join([OBJECT_HEAD, *(text for _, text in sorted(rows, key=lambda time_and_text: time_and_text[0]))]) + "\n"
    )


def mask_table(whole: Truth, headset: str, failed: dict[int, str]) -> str:
    """failed: camera stream that failed, by frame."""
    lines = ["timestamp[ns],stream_id,mask"]
    for frame, frame_times in enumerate(whole.times_ns):
        for number, stream in enumerate(STREAMS[headset]):
            lines.append(f"{frame_times[min(number, len(frame_times) - 1)]},{stream},{failed.get(frame) != stream}")
    return "\n".join(lines) + "\n"


def metadata(name: str, headset: str) -> str:
    status = {"mano_hand_pose_gt": True, "umetrack_hand_pose_gt": True, "object_pose_gt": True}
    facts = {"gt_available_status": status, "headset": headset, "participant_id": name[:5], "recording_name": name}
    return json.dumps(facts, indent=4) + "\n"


def instances() -> str:
    kind = {"instance_type": "object", "motion_type": "dynamic", "rigidity": "rigid"}
    about = {uid: {"instance_id": uid, "instance_name": name, **kind} for uid, name in NAMES.items()}
    return json.dumps(about, indent=4) + "\n"


def glb(vertices, faces=FACES, node: dict | None = None) -> bytes:
    """A binary glTF 2.0 file of one mesh. vertices: metres. node: transform in the scene."""
    body = np.asarray(vertices, "<f4").tobytes()
    corners = np.asarray(faces, "<u2").tobytes()
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": len(body)}]
    views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(corners)})
    low, high = np.asarray(vertices, "<f4").min(axis=0).tolist(), np.asarray(vertices, "<f4").max(axis=0).tolist()
    position_accessor = {
        "bufferView": 0,
        "componentType": 5126,
        "type": "VEC3",
        "count": len(vertices),
        "min": low,
        "max": high,
    }
    corner = {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 3 * len(faces)}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [position_accessor, corner],
        "bufferViews": views,
        "buffers": [{"byteLength": len(body) + len(corners)}],
    }
    return packed(json.dumps(tree).encode(), body + corners)


def packed(text: bytes, body: bytes) -> bytes:
    text, body = text + b" " * (-len(text) % 4), body + b"\0" * (-len(body) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def box(half_m) -> np.ndarray:
    """(8, 3) corners, x fastest."""
    return np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]) * half_m


def write_assets(root: Path) -> None:
    (root / "assets").mkdir(parents=True)
    (root / "assets/instance.json").write_text(instances())
    for uid, half in ((MUG, HALF_BOX_M), (MOUSE, HALF_BOX_M), (KEYBOARD, (0.2, 0.07, 0.01))):
        (root / f"assets/{uid}.glb").write_bytes(glb(box(half)))


def write_recording(root: Path, name: str, headset: str, kind: str, seed: int, uid: str) -> Truth:
    """The box and a keyboard that lies still a metre away."""
    whole = truth(headset, kind, seed)
    folder = root / name
    (folder / "masks").mkdir(parents=True)
    (folder / "metadata.json").write_text(metadata(name, headset))
    (folder / (MANO_FILE if kind == "mano" else UMETRACK_FILE)).write_text(hand_lines(whole, headset))
    (folder / "umetrack_hand_user_profile.json").write_text(json.dumps(profile(), indent=4))
    still = Truth(whole.times_ns, Rotation.identity(N_FRAMES), np.tile((1.2, 0.0, 0.8), (N_FRAMES, 1)), {})
    rows = object_rows(uid, whole, headset) + object_rows(KEYBOARD, still, headset)
    (folder / "dynamic_objects.csv").write_text(object_table(rows))
    (folder / "masks/mask_qa_pass.csv").write_text(mask_table(whole, headset, {}))
    return whole


def write_clip(root: Path, headset: str, number: int, recording: str, whole: Truth, without: str = "") -> Path:
    """The first frames as one of HOT3D-Clips: a tar with JSON files of each frame, and an image that is none.

    without: a format of hands the clip does not have.
    """
    world, path = HEADSET_FROM[headset], root / f"train_{headset.lower()}/clip-{number:06d}.tar"
    path.parent.mkdir(parents=True, exist_ok=True)
    betas = whole.hands["left"][0]["betas"]
    members = {"__hand_shapes.json__": json.dumps({"mano": betas, "umetrack": profile()["hand_model"]})}
    for frame in range(N_FRAMES):
        hands: dict = {"left": None} if frame == 5 else {}
        for side in SIDES if frame != 5 else ("right",):
            numbers, rotation, position_m = whole.hands[side]
            rest = rest_points(HANDS[side], betas)[0]
            wrist = [*(world * rotation[frame]).as_rotvec(), *(world.apply(position_m[frame] + rest) - rest)]
            angles = {
                "joint_angles": list(ANGLES[:20]),
                "T_world_from_wrist": rigid(world * rotation[frame], wrist[3:]),
            }
            hands[side] = {"mano_pose": {"thetas": numbers["pose"], "wrist_xform": wrist}, "umetrack_pose": angles}
            hands[side].pop(f"{without}_pose", None)
        pose = rigid(world * whole.rotation[frame], world.apply(whole.position_m[frame]))
        tracked_object = {
            "object_bop_id": "9",
            "object_uid": MUG,
            "object_name": "mug_white",
            "T_world_from_object": pose,
        }
        members[f"{frame:06d}.hands.json"] = json.dumps(hands)
        members[f"{frame:06d}.objects.json"] = json.dumps({"9": [tracked_object]})
        members[f"{frame:06d}.image_1201-1.jpg"] = "no image"
    with tarfile.open(path, "w") as archive:
        for name, text in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(text.encode())
            archive.addfile(info, io.BytesIO(text.encode()))
    table = {str(number): {"sequence_id": recording, "device": headset, "timestamps_ns": [1, 2]}}
    (root / "clip_definitions.json").write_text(json.dumps(table))
    (root / "object_models_eval").mkdir(exist_ok=True)
    (root / "object_models_eval/obj_000009.glb").write_bytes(glb(box(HALF_BOX_M)))
    return path


def rigid(rotation: Rotation, position_m) -> dict:
    return {"translation_xyz": [float(number) for number in position_m], "quaternion_wxyz": wxyz(rotation)}


def write_two(root: Path) -> Path:
    """One recording per headset, both with MANO parameters and with different objects."""
    write_assets(root)
    write_recording(root, ARIA, "Aria", "mano", 0, MUG)
    write_recording(root, QUEST, "Quest3", "mano", 1, MOUSE)
    return root
