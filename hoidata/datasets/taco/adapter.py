"""TACO (Liu et al. 2024): two hands, a tool and a target; pickled torch tensors, meshes in centimetres, 30 fps.

The folder of a recording is named ``(action, tool, object)``, which gives verb and words. The tool is the clip's
object. The target is its other object.
"""

import re
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.clips.clip import SIDES, Clip, ObjectTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import HandConvention, SourceHand, to_track
from hoidata.dataset_folders import facts_of_adapter
from hoidata.datasets import checks
from hoidata.datasets.base import AdapterBase, DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.errors import BadInput
from hoidata.files import load_npy, load_torch_pickle
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import HandPair, track_joints
from hoidata.objects.distance import closest_points
from hoidata.objects.mesh import load_mesh
from hoidata.objects.model import ObjectModel

CENTIMETRES = 1e-2
TOUCH_M = 0.02
HANDS, OBJECTS, MODELS = "Hand_Poses", "Object_Poses", "Object_Models"
TRIPLET = re.compile(r"\(([^,()]+),([^,()]+),([^,()]+)\)")
FRAME_KEY = re.compile(r"\D*(\d{1,9})")  # 00012, with an optional prefix
FRAME = WorldFrame(None, "unknown", "the capture rig's world of the recording day, right-handed, metres")
SHAPE_NOTE = "no {side}_hand_shape.pkl: its betas are zero, as in TACO's own loader"
GRAVITY_NOTE = "TACO's world frame differs from day to day and its axes are not documented"
HAND_NOTE = "MANO: absolute axis-angles, own betas for each side, the translation is the wrist (manopth, center_idx 0)"
CONVENTION = HandConvention(
    translation="wrist", fingers="absolute", shape="betas per sequence", left_shape="as released", note=HAND_NOTE
)
PARTS = (
    DatasetPart("hand motion and shapes", (f"{HANDS}/*/*/*.pkl",), "Hand_Poses.zip"),
    DatasetPart("object motion", (f"{OBJECTS}/*/*/*.npy",), "Object_Poses.zip"),
    DatasetPart("object meshes", (f"{MODELS}/*_cm.obj",), "Object_Models.zip"),
)

Poses = Mapping[Hashable, Any]  # by frame key: {"hand_pose": (48,), "hand_trans": (3,)}


@dataclass(frozen=True)
class TacoAdapter(AdapterBase):
    """Raw root: ``Hand_Poses/``, ``Object_Poses/`` (``<triplet>/<recording>/``) and ``Object_Models/<id>_cm.obj``.

    The source names no persons. The subject is the recording's day: its name up to the first underscore.
    """

    facts = facts_of_adapter(__file__)
    margin_frames: int = 0  # frames kept before the first and after the last frame with a hand within 2 cm of the tool
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION
    parts: tuple[DatasetPart, ...] = PARTS

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per recording with hand or object poses in a folder named like a triplet."""
        folders = {path for kind in (HANDS, OBJECTS) for path in Path(root).glob(f"{kind}/(*)/*") if path.is_dir()}
        days = {f"{path.parent.name}/{path.name}": path.name.partition("_")[0] for path in folders}
        return sorted(SequenceKey(self.name, day, name) for name, day in days.items())

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """One clip from the first to the last frame with a hand at the tool, and a reason per missing hand shape."""
        verb, tool_word, _ = triplet(key.name)
        tool, target = (_object(raw, key, kind) for kind in ("tool", "target"))
        if target.n_frames != tool.n_frames:
            raise BadInput(f"{OBJECTS}/{key.name}/target", f"{tool.n_frames} frames as the tool", f"{target.n_frames}")
        whole = self.new_clip(
            key,
            hands={side: to_track(hand, CONVENTION, hands[side]) for side, hand in _hands(raw, key, tool).items()},
            object=tool,
            other_objects=(target,),
            source_frames=np.arange(tool.n_frames, dtype=np.int32),
            gravity=None,
            gravity_note=GRAVITY_NOTE,
            verb=verb,
            object_words=tool_word,
        )
        start, stop = _contact_range(whole, hands)
        clip = whole.take(slice(max(0, start - self.margin_frames), stop + self.margin_frames))
        without_shape: list[Side] = [side for side in SIDES if not _has_shape(raw, key, side)]
        notes = [clip.gravity_note, *(SHAPE_NOTE.format(side=side) for side in without_shape)]
        remedy = "nothing to do: the clip has zero betas, as TACO's own loader gives them"
        absent = {"expected": "the shape of the hand", "got": "no file", "remedy": remedy}
        reasons = [Quarantined(f"{key}/{side}-shape", _shape_path(key, side), **absent) for side in without_shape]
        return [replace(clip, sources=raw.sources, gravity_note="; ".join(notes)), *reasons]


def triplet(name: str) -> tuple[str, str, str]:
    """Action, tool and object from ``(put in, spoon, bowl)/20230927_034``. Raises BadInput for another form."""
    folder = name.partition("/")[0]
    match = TRIPLET.fullmatch(folder)
    if match is None:
        raise BadInput(f"Hand_Poses/{folder}", "a folder named (action, tool, object)", folder, "restore its name")
    action, tool, target = (" ".join(word.replace("_", " ").split()) for word in match.groups())
    return action.lower(), tool, target


def frames_by_side(folder: str, keys: Mapping[Side, list[Hashable]], n_frames: int) -> dict[Side, dict[Hashable, int]]:
    """Map each side's keys to frames. Keys are numbers, and a side may lack some.

    If a side has one key per frame, its sorted keys are the frames in order. If neither side is complete, the numbers
    must be 0 to n - 1 or 1 to n, as the first and last number show; else BadInput is raised.
    """
    numbers = dict[Side, dict[Hashable, int]]()
    for side in SIDES:
        numbers[side] = _numbers(f"{folder}/{side}_hand.pkl", keys[side], n_frames)
    complete = next((sorted(of_side.values()) for of_side in numbers.values() if len(of_side) == n_frames), None)
    if complete is None:
        first = _first_number(folder, {number for of_side in numbers.values() for number in of_side.values()}, n_frames)
        complete = list(range(first, first + n_frames))
    frame = {number: index for index, number in enumerate(complete)}
    frames_by_key: dict[Side, dict[Hashable, int]] = {}
    for side, side_numbers in numbers.items():
        unknown = sorted(set(side_numbers.values()) - set(frame))
        if unknown and len(side_numbers) < n_frames:
            expected = f"frame numbers {complete[0]} to {complete[-1]}"
            raise BadInput(f"{folder}/{side}_hand.pkl", expected, f"{unknown[0]}")
        in_turn = sorted(side_numbers, key=side_numbers.__getitem__)
        is_complete = len(side_numbers) == n_frames
        frames_by_key[side] = {key: at if is_complete else frame[side_numbers[key]] for at, key in enumerate(in_turn)}
    return frames_by_key


def _numbers(path: str, keys: list[Hashable], n_frames: int) -> dict[Hashable, int]:
    matches = {key: FRAME_KEY.fullmatch(str(key)) for key in keys}
    numbers = {key: int(match[1]) for key, match in matches.items() if match is not None}
    if len(numbers) < len(keys):
        wrong = next(key for key in keys if key not in numbers)
        raise BadInput(path, "frame numbers as keys", repr(wrong)[:40])
    if len(set(numbers.values())) < len(keys):
        raise BadInput(path, "one entry per frame", "a frame number twice")
    if len(keys) > n_frames:
        raise BadInput(path, f"at most {n_frames} frames as the tool", f"{len(keys)}")
    return numbers


def _first_number(folder: str, numbers: set[int], n_frames: int) -> int:
    if numbers and 0 in numbers and max(numbers) < n_frames:
        return 0
    if numbers and min(numbers) > 0 and max(numbers) == n_frames:
        return 1
    got = f"{len(numbers)} numbers, {min(numbers)} to {max(numbers)}" if numbers else "none"
    remedy = "nothing to do: both hands lack frames, and which ones cannot be told"
    raise BadInput(folder, f"hand poses numbered 0 to {n_frames - 1} or 1 to {n_frames}", got, remedy)


def _hands(raw: RawTree, key: SequenceKey, tool: ObjectTrack) -> dict[Side, SourceHand]:
    folder = f"{HANDS}/{key.name}"
    poses: dict[Side, Poses] = {side: _dictionary(raw, f"{folder}/{side}_hand.pkl") for side in SIDES}
    frames = frames_by_side(folder, {side: list(poses[side]) for side in SIDES}, tool.n_frames)
    return {side: _hand(raw, key, side, poses[side], frames[side], tool.n_frames) for side in SIDES}


def _shape_path(key: SequenceKey, side: Side) -> str:
    return f"{HANDS}/{key.name}/{side}_hand_shape.pkl"


def _has_shape(raw: RawTree, key: SequenceKey, side: Side) -> bool:
    """Whether a hand's shape file exists. If the manifest lists it, it is required."""
    path = _shape_path(key, side)
    return raw.has(path) or path in (raw.manifest or ())


def _betas(raw: RawTree, key: SequenceKey, side: Side) -> np.ndarray:
    """(1, 10) betas, zero without a file, as in TACO's loader (``read_hand_shape`` of its dataset_utils)."""
    if not _has_shape(raw, key, side):
        return np.zeros((1, 10))
    path = _shape_path(key, side)
    return _single_row(f"{path}: hand_shape", checks.entry(path, _dictionary(raw, path), "hand_shape"), 10)[None]


def _hand(
    raw: RawTree, key: SequenceKey, side: Side, poses: Poses, frames: Mapping[Hashable, int], n_frames: int
) -> SourceHand:
    path = f"{HANDS}/{key.name}/{side}_hand.pkl"
    pose, translation_m = np.zeros((n_frames, 48)), np.zeros((n_frames, 3))
    valid = np.zeros(n_frames, dtype=bool)
    for frame_key, frame in frames.items():
        location, entry = f"{path}: {frame_key}", poses[frame_key]
        pose[frame] = _single_row(f"{location}.hand_pose", checks.entry(location, entry, "hand_pose"), 48)
        translation_m[frame] = _single_row(f"{location}.hand_trans", checks.entry(location, entry, "hand_trans"), 3)
        valid[frame] = True
    return SourceHand(translation_m, pose[:, :3], pose[:, 3:], _betas(raw, key, side), valid=valid)


def _dictionary(raw: RawTree, path: str) -> Mapping[Hashable, Any]:
    value = load_torch_pickle(raw.read(path), path)
    if not isinstance(value, dict):
        raise BadInput(path, "a dictionary", type(value).__name__)
    return value


def _single_row(location: str, value: Any, columns: int) -> np.ndarray:
    """(column,) float64 from a tensor of shape (columns,) or (1, columns)."""
    array = np.asarray(value)
    return checks.table(location, array[None] if array.ndim == 1 else array, columns, rows=1, row_name="row")[0]


def _object(raw: RawTree, key: SequenceKey, kind: str) -> ObjectTrack:
    folder = f"{OBJECTS}/{key.name}"
    names = [name for name in raw.names(folder, ".npy") if name.startswith(f"{kind}_")]
    if len(names) != 1:
        got = f"{len(names)}: {', '.join(names) or 'none'}"
        raise BadInput(f"{folder}/{kind}_<id>.npy", "poses of one object", got)
    path = f"{folder}/{names[0]}"
    poses = load_npy(raw.file(path))
    if poses.dtype.kind != "f" or poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise BadInput(path, "matrices of shape (frames, 4, 4)", f"{poses.dtype} of shape {poses.shape}")
    poses = poses.astype(np.float64)
    checks.finite(path, poses)
    checks.rigid_transforms(path, [f"frame {frame}" for frame in range(len(poses))], poses)
    model_path = f"{MODELS}/{names[0].removeprefix(f'{kind}_').removesuffix('.npy')}_cm.obj"
    mesh, name = load_mesh(raw.file(model_path)), Path(model_path).name.removesuffix("_cm.obj")
    return ObjectTrack(
        ObjectModel(name, mesh.vertices * CENTIMETRES, mesh.faces, np.zeros(len(mesh.vertices), dtype=np.uint8)),
        rotmat_to_rotvec(poses[:, :3, :3]).astype(np.float32),
        poses[:, :3, 3].astype(np.float32),
    )


def _contact_range(clip: Clip, hands: HandPair) -> tuple[int, int]:
    """Half-open range from the first to the last frame with a joint or tip of a hand within 2 cm of the tool."""
    rotation = rotvec_to_rotmat(clip.object.rotvec.astype(np.float64))
    near = np.zeros(clip.n_frames, dtype=bool)
    for side in SIDES:
        joints = track_joints(clip.hands[side], hands[side]).astype(np.float64)
        local = (joints - clip.object.translation_m[:, None]) @ rotation
        model = clip.object.model
        distance = closest_points(model.vertices_m, model.faces, local.reshape(-1, 3)).distance_m
        near |= clip.hands[side].valid & (distance.reshape(local.shape[:2]) < TOUCH_M).any(axis=1)
    if not near.any():
        remedy = "nothing to do if nobody touches it; check that the MANO files are the ones TACO used"
        raise BadInput(f"{HANDS}/{clip.sequence}", "a hand within 2 cm of the tool", "none in any frame", remedy)
    touched = np.flatnonzero(near)
    return int(touched[0]), int(touched[-1]) + 1
