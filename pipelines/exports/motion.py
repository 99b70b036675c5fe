"""What is exported of one clip: joints, parameters, object pose and words, under the names all formats use."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, ObjectTrack, Side
from hoidata.files.written import read_table
from hoidata.hands import JOINT_NAMES, HandPair
from hoidata.store.annotated import SUBSETS
from hoidata.store.store import Store
from pipelines.pages.glb import continuous_quaternions


class Column(NamedTuple):
    """One array of a clip. shape: of one frame, () for one value."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    meaning: str


def _hand_columns(side: Side) -> tuple[Column, ...]:
    return (
        Column(f"{side}_joints_m", "float32", (21, 3), f"world joints of the {side} hand, metres"),
        Column(f"{side}_valid", "bool", (), f"False: numbers of the {side} hand that mean nothing"),
        Column(f"{side}_global_orient", "float32", (3,), "axis-angle of the wrist, radians, world"),
        Column(f"{side}_hand_pose", "float32", (45,), "axis-angles of 15 finger joints, absolute, radians"),
        Column(f"{side}_betas", "float32", (10,), "MANO shape"),
    )


COLUMNS = (
    *_hand_columns("left"),
    *_hand_columns("right"),
    Column("object_translation_m", "float32", (3,), "world position of the object frame's origin, metres"),
    Column("object_quaternion_xyzw", "float32", (4,), "world_from_object, column vectors"),
    Column("object_hinge_rad", "float32", (), "hinge angle; 0 for rigid objects"),
    Column("source_frames", "int32", (), "index in the source file, from 0"),
)


@dataclass(frozen=True)
class ExportedClip:
    """One clip. joints: (frame, 21, 3) float32 of each hand, metres, world. hands: the model of its parameters.

    sentences: what it shows, in words; at least one. subset: train, validation or test; empty for a clip in none.
    """

    clip: Clip
    joints: dict[Side, np.ndarray]
    hands: HandPair
    sentences: tuple[str, ...]
    subset: str = ""

    @property
    def file_name(self) -> str:
        """The id as the name of a file, without suffix."""
        return self.clip.clip_id.replace("/", "__")

    @property
    def facts(self) -> dict[str, Any]:
        """What is known of the whole clip, as JSON values."""
        clip = self.clip
        return {
            "clip_id": clip.clip_id,
            "dataset": clip.dataset,
            "subject": clip.subject,
            "sequence": clip.sequence,
            "subset": self.subset,
            "fps": FPS,
            "n_frames": clip.n_frames,
            "verb": clip.verb,
            "object": clip.object.model.name,
            "object_words": clip.object_words,
            "sentences": list(self.sentences),
            "gravity": None if clip.gravity is None else clip.gravity.tolist(),
            "hands_from": clip.hands_from,
            "synthetic": clip.synthetic,
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
                f"{side}_betas": np.broadcast_to(hand.betas, (clip.n_frames, 10)),
            }
        found |= {"object_translation_m": track.translation_m, "object_hinge_rad": hinge_of(track)}
        found["object_quaternion_xyzw"] = continuous_quaternions(track.rotvec)
        return {column.name: np.ascontiguousarray(found[column.name], column.dtype) for column in COLUMNS}


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
        joints: dict[Side, np.ndarray] = {side: self.store.joints(clip_id, side) for side in SIDES}
        words = self._sentences.get(clip_id) or [f"{clip.verb} the {clip.object_words}" if clip.verb else ""]
        return ExportedClip(clip, joints, self.store.hand_pair(), tuple(map(str, words)), self.subset(clip_id))

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
