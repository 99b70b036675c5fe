"""What is exported of one clip: joints, parameters, object pose and words, under the names all formats use."""

import re
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.files.written import read_table
from hoidata.geometry.intervals import runs
from hoidata.hands import JOINT_NAMES, HandPair
from hoidata.store.annotated import SUBSETS
from hoidata.store.store import Store
from pipelines.pages.glb import continuous_quaternions

LONGEST_NAME = 150  # bytes; file systems take 255, and suffixes follow
_ODD = re.compile(r"^\.|(?<=_)_|[^\w .,+=@()#-]")  # "_" after "_": two mean "/"
WORLD = "the clip's own"
Y_UP = "turned so that gravity is -y: y is up; not turned where a clip's gravity is not known"


class Column(NamedTuple):
    """One array of a clip.

    shape: of one frame, () for one value; for ``CLIP_COLUMNS`` of the whole clip, -1 for a length that varies.
    meaning: what it holds, relative to what, its frame and unit.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    meaning: str


_JOINTS = "joints: wrist, three each of index, middle, pinky, ring and thumb, then their tips; world frame, metre"
_REPEATED = "where not, its last tracked pose is repeated, before the first one the first"
_POSE = "axis-angles of 15 finger joints relative to their parents; zero is the hand model's flat hand"
_BETAS = "shape coefficients on the hand model's template; NaN where {}_template_m alone is the shape"
_TEMPLATE = "778 vertices of the person's own {} rest mesh, in the place of the hand model's template, metre; "


def _hand_columns(side: Side) -> tuple[Column, ...]:
    """What is told of one hand in each frame."""
    valid = f"whether the hand is tracked; {_REPEATED}; zeros if it is never tracked in the clip"
    return (
        Column(f"{side}_joints_m", "float32", (21, 3), _JOINTS),
        Column(f"{side}_valid", "bool", (), valid),
        Column(f"{side}_global_orient", "float32", (3,), "axis-angle of the wrist joint; world frame, radian"),
        Column(f"{side}_hand_pose", "float32", (45,), f"{_POSE}, not its mean pose; radian"),
        Column(f"{side}_betas", "float32", (10,), _BETAS.format(side)),
    )


COLUMNS = (
    *_hand_columns("left"),
    *_hand_columns("right"),
    Column("object_translation_m", "float32", (3,), "origin of the object frame; world frame, metre"),
    Column("object_quaternion_xyzw", "float32", (4,), "world_from_object rotation, column vectors"),
    Column("object_hinge_rad", "float32", (), "hinge angle from the mesh as stored, radian; 0 for a rigid object"),
    Column("source_frames", "int32", (), "index in the source file, from 0"),
)
CLIP_COLUMNS = (
    Column("gravity", "float32", (3,), "unit vector in which things fall; world frame; NaN where it is not known"),
    *(
        Column(f"{side}_template_m", "float32", (-1, 3), f"{_TEMPLATE.format(side)}empty where the person has none")
        for side in SIDES
    ),
)


@dataclass(frozen=True)
class ExportedClip:
    """One clip. joints: (frame, 21, 3) float32 of each hand, metres, world. hands: the model of its parameters.

    Both hands are as ``_held`` gives them. sentences: what it shows, in words; at least one. subset: train, validation
    or test; empty for a clip in none.
    """

    clip: Clip
    joints: dict[Side, np.ndarray]
    hands: HandPair
    sentences: tuple[str, ...]
    subset: str = ""

    @property
    def file_name(self) -> str:
        """The id as the name of a file, without suffix."""
        return file_name_of(self.clip.clip_id)

    @property
    def motion_facts(self) -> dict[str, Any]:
        """What a scene or skeleton needs beside its numbers, as JSON values.

        untracked_frames: half-open ranges per hand in which its pose is repeated, not tracked.
        """
        clip = self.clip
        return {
            "clip_id": clip.clip_id,
            "fps": FPS,
            "n_frames": clip.n_frames,
            "gravity": None if clip.gravity is None else clip.gravity.tolist(),
            "gravity_note": clip.gravity_note,
            "untracked_frames": {side: [list(run) for run in runs(~clip.hands[side].valid)] for side in SIDES},
            "hands_from": clip.hands_from,
            "synthetic": clip.synthetic,
        }

    @property
    def facts(self) -> dict[str, Any]:
        """What is known of the whole clip, as JSON values."""
        clip = self.clip
        return self.motion_facts | {
            "dataset": clip.dataset,
            "subject": clip.subject,
            "sequence": clip.sequence,
            "subset": self.subset,
            "verb": clip.verb,
            "object": clip.object.model.name,
            "object_words": clip.object_words,
            "sentences": list(self.sentences),
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of ``COLUMNS``, frame axis first, in their order."""
        clip, track = self.clip, self.clip.object
        found: dict[str, Any] = {"source_frames": clip.source_frames}
        for side in SIDES:
            hand = clip.hands[side]
            found |= {
                f"{side}_joints_m": self.joints[side],
                f"{side}_valid": hand.valid,
                f"{side}_global_orient": hand.global_orient,
                f"{side}_hand_pose": hand.hand_pose,
                f"{side}_betas": np.broadcast_to(_betas(hand), (clip.n_frames, 10)),
            }
        found |= {"object_translation_m": track.translation_m, "object_hinge_rad": hinge_of(track)}
        found["object_quaternion_xyzw"] = continuous_quaternions(track.rotvec)
        return {column.name: np.ascontiguousarray(found[column.name], column.dtype) for column in COLUMNS}

    def clip_arrays(self) -> dict[str, np.ndarray]:
        """The arrays of ``CLIP_COLUMNS``, in their order."""
        found: dict[str, Any] = {"gravity": np.full(3, np.nan) if self.clip.gravity is None else self.clip.gravity}
        for side in SIDES:
            template_m = self.clip.hands[side].template_m
            found[f"{side}_template_m"] = np.zeros((0, 3)) if template_m is None else template_m
        return {column.name: np.ascontiguousarray(found[column.name], column.dtype) for column in CLIP_COLUMNS}


def file_name_of(label: str) -> str:
    """A clip's id or an object's name as the name of one file: ``a/b`` becomes ``a__b``, odd characters ``%..``.

    Different labels have different names, and none leaves the folder: labels are text of foreign files.
    """
    parts = [_ODD.sub(lambda found: f"%{ord(found.group()):02X}", part) for part in label.split("/")]
    name = "__".join(parts)
    if len(name.encode()) > LONGEST_NAME:
        name = f"{name.encode()[:LONGEST_NAME].decode(errors='ignore')}-{sha256(label.encode()).hexdigest()[:12]}"
    return name


def _held(track: HandTrack, joints_m: np.ndarray) -> tuple[HandTrack, np.ndarray]:
    """A hand and its joints that keep the last tracked pose; zeros if it is never tracked, as no pose is known."""
    if track.valid.any():
        return track.held(), joints_m[track.shown_frames]
    poses = (track.wrist_m, track.global_orient, track.hand_pose)
    wrist_m, global_orient, hand_pose = map(np.zeros_like, poses)
    return replace(track, wrist_m=wrist_m, global_orient=global_orient, hand_pose=hand_pose), 0 * joints_m


def _betas(hand: HandTrack) -> np.ndarray:
    """The shape coefficients. Zeros beside a personal rest mesh would be read as MANO's mean hand: they become NaN."""
    return np.full_like(hand.betas, np.nan) if hand.template_m is not None and not hand.betas.any() else hand.betas


def hinge_of(track: ObjectTrack) -> np.ndarray:
    """(frame,) hinge angles, radians; zeros for a rigid object."""
    return np.zeros(track.n_frames) if track.hinge_rad is None else np.asarray(track.hinge_rad)


class Source:
    """A store to be exported: its clips, with the sentences and subsets of the stages' folders beside it, if any.

    clip_ids: those to export, by default all.
    """

    def __init__(self, store: Store, clip_ids: tuple[str, ...] = ()) -> None:
        self.store = store
        root = store.folder.parent
        self._sentences = _grouped(root / "annotation" / "text.parquet", "sentence")
        self._subsets = _grouped(root / "splits" / "splits.parquet", "split")
        self.ids = sorted(clip_ids or store.ids, key=self._subset_order)

    def clip(self, clip_id: str) -> ExportedClip:
        """One clip with its joints and words."""
        clip = self.store.clip(clip_id, motion_only=True)
        hands, joints = dict(clip.hands), {}
        for side in SIDES:
            hands[side], joints[side] = _held(hands[side], self.store.joints(clip_id, side))
        words = self._sentences.get(clip_id) or [f"{clip.verb} the {clip.object_words}" if clip.verb else ""]
        return ExportedClip(
            replace(clip, hands=hands), joints, self.store.hand_pair(), tuple(map(str, words)), self.subset(clip_id)
        )

    def subset(self, clip_id: str) -> str:
        """train, validation or test; empty for a clip in none."""
        found = self._subsets.get(clip_id, [None])[0]
        return found if found in SUBSETS else ""

    def _subset_order(self, clip_id: str) -> int:
        """Clips of a subset follow each other; otherwise the order is the store's."""
        return [*SUBSETS, ""].index(self.subset(clip_id))


def _grouped(path: Path, column: str) -> dict[str, list[Any]]:
    """The values of a column by clip id, in the table's order; none without the file."""
    if not path.is_file():
        return {}
    rows = read_table(path, ["clip_id", column])
    return {str(key): group[column].tolist() for key, group in rows.groupby("clip_id", sort=False)}


def state_names(side: Side) -> list[str]:
    """Names of the 63 numbers of one hand's joints."""
    return [f"{side}.{joint}.{axis}" for joint in JOINT_NAMES for axis in "xyz"]


_ARROW = {"float32": pa.float32(), "int32": pa.int32(), "int64": pa.int64(), "bool": pa.bool_()}


def row_type(column: Column) -> pa.DataType:
    """The Arrow type of one frame: a value, or lists; of a fixed length but for -1, which pyarrow too takes for any."""
    kind: pa.DataType = _ARROW[column.dtype]
    for length in reversed(column.shape):
        kind = pa.list_(kind, length)
    return kind


def frames_array(values: np.ndarray, column: Column) -> pa.Array:
    """(frame, ...) values as an Arrow array with one row per frame."""
    array: Any = pa.array(np.ascontiguousarray(values, column.dtype).ravel())
    for length in reversed(column.shape):
        array = pa.FixedSizeListArray.from_arrays(array, length)
    return array
