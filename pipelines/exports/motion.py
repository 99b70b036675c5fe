"""The arrays and facts of one exported clip, which all formats use: joints, parameters, object poses, sentences."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import orjson
import pyarrow as pa

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.files.written import read_table
from hoidata.geometry.intervals import runs
from hoidata.hands import HandPair
from hoidata.store.annotated import SUBSETS
from hoidata.store.store import Store
from pipelines.exports.licences import PERSON, Kind
from pipelines.pages.glb import continuous_quaternions

MAX_NAME_BYTES = 150  # file systems permit 255, including suffixes
_ESCAPED = re.compile(r"^[._]|_$|(?<=_)_|[^\w .,+=@()#-]")  # "_" next to "_": two mean "/"
WORLD = "the world frame of the clip"
Y_UP = "rotated so that gravity is -y, y is up; not rotated if a clip's gravity is not known"


class Column(NamedTuple):
    """One array of a clip."""

    name: str
    dtype: str
    shape: tuple[int, ...]  # per frame, () for one value; in ``CLIP_COLUMNS`` per clip, -1 for a varying length
    meaning: str  # content, reference, frame and unit


_JOINTS = "joints: wrist, three each of index, middle, pinky, ring and thumb, then their tips; world frame, metre"
_REPEATED = "untracked frames repeat the last tracked pose, or before the first tracked frame the first"
_POSE = "axis-angles of 15 finger joints relative to their parents; zero is the hand model's flat hand"
_BETAS = "shape coefficients on the hand model's template; NaN if {}_template_m alone is the shape"
_TEMPLATE = "778 vertices of the person's {} rest mesh, which replaces the hand model's template, metre; "
_VALID = f"whether the hand is tracked; {_REPEATED}; zeros if it is never tracked in the clip"
_HINGE = "joint position from the mesh as stored: hinge angle in radian, slide in metre; 0 if rigid"


def _hand_columns(side: Side) -> tuple[Column, ...]:
    return (
        Column(f"{side}_joints_m", "float32", (21, 3), _JOINTS),
        Column(f"{side}_valid", "bool", (), _VALID),
        Column(f"{side}_global_orient", "float32", (3,), "axis-angle of the wrist joint; world frame, radian"),
        Column(f"{side}_hand_pose", "float32", (45,), f"{_POSE}, not its mean pose; radian"),
        Column(f"{side}_betas", "float32", (10,), _BETAS.format(side)),
    )


COLUMNS = (
    *_hand_columns("left"),
    *_hand_columns("right"),
    Column("object_translation_m", "float32", (3,), "origin of the object frame; world frame, metre"),
    Column("object_quaternion_xyzw", "float32", (4,), "world_from_object rotation, column vectors"),
    Column("object_hinge_rad", "float32", (), _HINGE),
    Column("source_frames", "int32", (), "index in the source file, from 0"),
)
CLIP_COLUMNS = (
    Column("gravity", "float32", (3,), "unit vector of gravity; world frame; NaN if it is not known"),
    *(
        Column(f"{side}_template_m", "float32", (-1, 3), f"{_TEMPLATE.format(side)}empty if the person has none")
        for side in SIDES
    ),
)


@dataclass(frozen=True)
class Format:
    """An export format."""

    meaning: str  # one line for people
    kinds: tuple[Kind, ...] = ()  # of the arrays it can have
    write: "Callable[[Path, Iterable[ExportedClip]], None] | None" = None  # None: the description alone
    columns: tuple[Column, ...] = ()  # arrays with a documented meaning
    world: str = WORLD  # the frame of its coordinates
    unsupported: Callable[[Clip], str] = lambda clip: ""  # the reason why it cannot represent a clip; "" if it can

    def kinds_in(self, store: Store) -> tuple[Kind, ...]:
        """The kinds of arrays in an export of this store: personal rest meshes only if the store has some."""
        templates = store.sequences[[f"{side}_template" for side in SIDES]].notna()
        return tuple(kind for kind in self.kinds if kind is not PERSON or templates.to_numpy().any())

    @property
    def untracked(self) -> str:
        """The values of a hand in frames without tracking, in words."""
        return "their values are undefined" if self.write is None else "they repeat its last tracked pose"


@dataclass(frozen=True)
class ExportedClip:
    """One clip. In untracked frames its hands repeat the last tracked pose."""

    clip: Clip
    joints: dict[Side, np.ndarray]  # (frame, 21, 3) float32 of each hand, metres, world
    hands: HandPair  # the model of the hand parameters
    sentences: tuple[str, ...]  # at least one
    subset: str = ""  # train, validation or test; empty if the clip is in none

    @property
    def file_name(self) -> str:
        """The clip id as a file name without suffix."""
        return file_name_of(self.clip.clip_id)

    @property
    def motion_facts(self) -> dict[str, Any]:
        """Facts for a scene or skeleton, as JSON values; untracked_frames are half-open ranges per hand."""
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
        """All facts of the clip, as JSON values."""
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
        arrays: dict[str, Any] = {"source_frames": clip.source_frames}
        for side in SIDES:
            hand = clip.hands[side]
            arrays |= {f"{side}_{name}": getattr(hand, name) for name in ("valid", "global_orient", "hand_pose")}
            arrays |= {f"{side}_joints_m": self.joints[side]}
            arrays |= {f"{side}_betas": np.broadcast_to(_betas(hand), (clip.n_frames, 10))}
        arrays |= {"object_translation_m": track.translation_m, "object_hinge_rad": hinge_of(track)}
        arrays["object_quaternion_xyzw"] = continuous_quaternions(track.rotvec)
        return {column.name: np.ascontiguousarray(arrays[column.name], column.dtype) for column in COLUMNS}

    def clip_arrays(self) -> dict[str, np.ndarray]:
        """The arrays of ``CLIP_COLUMNS``, in their order."""
        arrays: dict[str, Any] = {"gravity": np.full(3, np.nan) if self.clip.gravity is None else self.clip.gravity}
        for side in SIDES:
            template_m = self.clip.hands[side].template_m
            arrays[f"{side}_template_m"] = np.zeros((0, 3)) if template_m is None else template_m
        return {column.name: np.ascontiguousarray(arrays[column.name], column.dtype) for column in CLIP_COLUMNS}


def file_name_of(label: str) -> str:
    """A clip id or object name as a file name: ``a/b`` becomes ``a__b``, special characters ``%..``.

    Different labels get different names, and no name leaves the folder, since labels are text of untrusted files.
    """
    name = "__".join(_ESCAPED.sub(lambda match: f"%{ord(match.group()):02X}", part) for part in label.split("/"))
    if len(name.encode()) > MAX_NAME_BYTES:
        name = f"{name.encode()[:MAX_NAME_BYTES].decode(errors='ignore')}-{sha256(label.encode()).hexdigest()[:12]}"
    return name


def _filled_untracked(track: HandTrack, joints_m: np.ndarray) -> tuple[HandTrack, np.ndarray]:
    """A hand and its joints with the last tracked pose in untracked frames; zeros if it is never tracked."""
    if track.valid.any():
        return track.with_last_valid_pose(), joints_m[track.last_valid_frames]
    poses = (track.wrist_m, track.global_orient, track.hand_pose)
    wrist_m, global_orient, hand_pose = map(np.zeros_like, poses)
    return replace(track, wrist_m=wrist_m, global_orient=global_orient, hand_pose=hand_pose), 0 * joints_m


def _betas(hand: HandTrack) -> np.ndarray:
    """The shape coefficients; NaN with a personal rest mesh, where zeros would be read as MANO's mean hand."""
    return np.full_like(hand.betas, np.nan) if hand.template_m is not None and not hand.betas.any() else hand.betas


def hinge_of(track: ObjectTrack) -> np.ndarray:
    """(frame,) hinge angles, radians; zeros for a rigid object."""
    return np.zeros(track.n_frames) if track.hinge_rad is None else np.asarray(track.hinge_rad)


class Source:
    """The clips ``clip_ids`` of a store, or all, with sentences and subsets of the stages next to it, if present."""

    def __init__(self, store: Store, clip_ids: tuple[str, ...] = ()) -> None:
        self.store = store
        root = store.folder.parent
        self._sentences = _grouped(root / "annotation" / "text.parquet", "sentence")
        self._subsets = _grouped(root / "splits" / "splits.parquet", "split")
        self._verbs = verbs_of(store)
        # Clips of a subset follow each other, in the order of the store.
        self.ids = sorted(
            dict.fromkeys(clip_ids) or store.ids, key=lambda clip_id: [*SUBSETS, ""].index(self._subset(clip_id))
        )

    def clip(self, clip_id: str) -> ExportedClip:
        """One clip with its joints and sentences."""
        clip = replace(self.store.clip(clip_id, motion_only=True), verb=self._verbs.get(clip_id))
        hands, joints = dict(clip.hands), {}
        for side in SIDES:
            hands[side], joints[side] = _filled_untracked(hands[side], self.store.joints(clip_id, side))
        sentences = self._sentences.get(clip_id) or [f"{clip.verb} the {clip.object_words}" if clip.verb else ""]
        filled, words = replace(clip, hands=hands), tuple(map(str, sentences))
        return ExportedClip(filled, joints, self.store.hand_pair(), words, self._subset(clip_id))

    def _subset(self, clip_id: str) -> str:
        subset = self._subsets.get(clip_id, [None])[0]
        return subset if subset in SUBSETS else ""


def verbs_of(store: Store) -> dict[str, str]:
    """The verbs of the clips that have one: annotated ones, which may be derived from motion, else the source's."""
    annotated = _grouped(store.folder.parent / "annotation" / "hand_type.parquet", "verb")
    labels = store.sequences["verb"].to_dict() | {clip_id: verbs[0] for clip_id, verbs in annotated.items()}
    return {clip_id: verb for clip_id, verb in labels.items() if isinstance(verb, str) and verb}


def _grouped(path: Path, column: str) -> dict[str, list[Any]]:
    """The values of a column by clip id, in the table's order; empty if the file does not exist."""
    if not path.is_file():
        return {}
    rows = read_table(path, ["clip_id", column])
    return {str(key): group[column].tolist() for key, group in rows.groupby("clip_id", sort=False)}


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write indented JSON in the order of the values."""
    path.write_bytes(orjson.dumps(values, option=orjson.OPT_INDENT_2) + b"\n")


def row_type(column: Column) -> pa.DataType:
    """The Arrow type of one frame: a value or nested lists of fixed length; -1 means any length."""
    kind = pa.type_for_alias(column.dtype)
    for length in reversed(column.shape):
        kind = pa.list_(kind, length)
    return kind


def frames_array(values: np.ndarray, column: Column) -> pa.Array:
    """(frame, ...) values as an Arrow array with one row per frame."""
    array: Any = pa.array(np.ascontiguousarray(values, column.dtype).ravel())
    for length in reversed(column.shape):
        array = pa.FixedSizeListArray.from_arrays(array, length)
    return array
