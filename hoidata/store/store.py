"""The unified store of one dataset: a folder of Parquet tables and stored NPZ arrays.

``hoidata/store/README.md`` describes every file and field. In one line:
``clip = open_store("data/embedded/grab/clips").clip("grab/s1/mug_drink_1")``. With plain NumPy::

    rows = pandas.read_parquet("clips/meta/sequences.parquet").set_index("clip_id")
    row = rows.loc["grab/s1/mug_drink_1"]
    arrays = numpy.load(f"clips/arrays/frames-{row.shard:05d}.npz")
    wrist_m = arrays["left_wrist_m"][row.first_row : row.first_row + row.n_frames]

"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from hoidata.clips.clip import (
    SIDES,
    BodyTrack,
    CameraTrack,
    Clip,
    HandTrack,
    ObjectTrack,
    Side,
    SourceContact,
    SourceFile,
)
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.recording import HandRecording
from hoidata.errors import BadInput, MissingResource
from hoidata.files.written import REMEDY, empty_reason, read_json, read_table
from hoidata.hands import HandPair, load_embedded_hands, track_joints
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.store.fields import SCHEMA_VERSION, TABLES
from hoidata.store.info import info_problems
from hoidata.store.mapped import map_npz
from hoidata.store.recordings import read_hand, read_recording
from hoidata.store.writing import write_store

_POSE = ("rotvec", "translation_m", "hinge_rad")
_FACTS = ("clip_id", "dataset", "subject", "sequence", "verb", "object_words", "labelled_hand", "source_fps")
_FURTHER_FACTS = ("synthetic", "gravity_note", "hands_from", "fit_error_m")


def clip_rows(sequences: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """The row of every clip by its id, as Python values; a row of a pandas table costs more than reading the clip.

    Added: ``frames``, the rows of its shard; ``hands``, per side the rows of its betas and its template; ``facts``, the
    fields of ``Clip`` that stand in the row as they are. gravity (3,) and source_from_world (4, 4) become arrays.
    """
    rows = {}
    for row in pa.Table.from_pandas(sequences, preserve_index=False).to_pylist():
        row["frames"] = slice(row["first_row"], row["first_row"] + row["n_frames"])
        row["hands"] = {side: _hand_rows(row, side) for side in SIDES}
        row["facts"] = {name: row[name] for name in (*_FACTS, *_FURTHER_FACTS)}
        row["gravity"] = None if row["gravity"] is None else np.array(row["gravity"])
        row["source_from_world"] = np.array(row["source_from_world"]).reshape(4, 4)
        rows[row["clip_id"]] = row
    return rows


def _hand_rows(row: dict[str, Any], side: Side) -> tuple[slice, str | None]:
    first = row[f"{side}_betas_row"]
    return slice(first, first + row[f"{side}_betas_count"]), row[f"{side}_template"]


@dataclass(frozen=True)
class FrameShard:
    """The mapped members of one ``frames-*.npz``.

    hands: per side wrist_m, global_orient, hand_pose, betas, valid. object, other: rotvec, translation_m, hinge_rad.
    camera: rotvec, position_m, images.
    """

    source_frames: np.ndarray
    hands: Mapping[Side, tuple[np.ndarray, ...]]
    object: tuple[np.ndarray, ...]
    other: tuple[np.ndarray, ...]
    camera: tuple[np.ndarray, ...]

    @classmethod
    def open(cls, path: Path) -> "FrameShard":
        arrays = map_npz(path)
        names = ("wrist_m", "global_orient", "hand_pose", "betas", "valid")
        return cls(
            arrays["source_frames"],
            {side: tuple(arrays[f"{side}_{name}"] for name in names) for side in SIDES},
            tuple(arrays[f"object_{name}"] for name in _POSE),
            tuple(arrays[f"other_{name}"] for name in _POSE),
            tuple(arrays[f"camera_{name}"] for name in ("rotvec", "position_m", "images")),
        )


__all__ = ["SCHEMA_VERSION", "Quarantined", "Store", "open_store", "write_store"]


def open_store(folder: str | Path, hands: HandPair | None = None) -> "Store":
    """Open a store for reading.

    hands: the hand model its parameters belong to; not needed when that is the embedded one, or when no joints are
    asked for. Raises MissingResource when ``folder`` is no store, BadInput for another schema version or other hands.
    """
    folder = Path(folder)
    info = read_info(folder)
    path = folder / "meta" / "info.json"
    model = info.get("hand_model", {})
    if not isinstance(model, dict):
        raise BadInput(path, "a hand_model with name and digest", repr(model)[:80], "run the conversion again")
    written = model.get("digest")
    if hands is not None and written and hands.digest != written:
        remedy = "open it with the hands it was converted with"
        raise BadInput(path, f"hand model {written[:12]}", f"{hands.name} {hands.digest[:12]}", remedy)
    sequences, objects, files, quarantine = (read_table(folder / file.path) for file in TABLES.values())
    sequences = sequences.set_index("clip_id", drop=False).rename_axis(None)
    if problems := info_problems(info):
        raise BadInput(folder / problems[0].where, problems[0].expected, problems[0].got, REMEDY)
    return Store(folder, info, sequences, objects, files, quarantine, hands)


def read_info(folder: str | Path) -> dict[str, Any]:
    """``meta/info.json`` as it is on disk.

    Raises MissingResource when ``folder`` is no store, BadInput when the file is no JSON object or of another version.
    """
    path = Path(folder) / "meta" / "info.json"
    for noted in (Path(folder), Path(folder).parent):  # a family without motions has the note in the place of clips/
        if not path.is_file() and (reason := empty_reason(noted)):
            raise MissingResource(f"{noted} is empty: {reason}")
    if not path.is_file():
        raise MissingResource(f"{folder} is no store: {path} is missing; run the conversion of this dataset first")
    info = read_json(path)
    if info["schema_version"] != SCHEMA_VERSION:
        remedy = "run the conversion again, or use the hoidata that wrote it"
        raise BadInput(path, f"schema version {SCHEMA_VERSION}", str(info["schema_version"])[:80], remedy)
    return info


@dataclass
class Store:
    """One dataset's clips. sequences (indexed by clip id), objects, files, quarantine: pandas tables; info: a dict."""

    folder: Path
    info: dict[str, Any]
    sequences: pd.DataFrame
    objects: pd.DataFrame
    files: pd.DataFrame
    quarantine: pd.DataFrame
    hands: HandPair | None = None
    _arrays: dict[str, dict[str, np.ndarray]] = field(default_factory=dict, repr=False)
    _models: dict[str, ObjectModel] = field(default_factory=dict, repr=False)
    _shards: dict[int, FrameShard] = field(default_factory=dict, repr=False)
    _rows: dict[str, dict[str, Any]] = field(default_factory=dict, repr=False)
    _sources: list[SourceFile] = field(default_factory=list, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Workers open the array files anew: a pickled memory map would carry the whole dataset."""
        return {**self.__dict__, "_arrays": {}, "_models": {}, "_shards": {}, "_rows": {}, "_sources": []}

    def __len__(self) -> int:
        return len(self.sequences)

    @property
    def ids(self) -> list[str]:
        return self.sequences["clip_id"].tolist()

    def clip(self, clip_id: str, *, motion_only: bool = False) -> Clip:
        """The clip as it was written, float32. Raises KeyError when there is none of that id.

        motion_only: without camera, body and the source's contact labels, which can be larger than all the rest.
        """
        row = self._row(clip_id)
        frames, shard, gravity = row["frames"], self._frames(row["shard"]), row["gravity"]
        return Clip(
            hands={side: self._hand(row, side) for side in SIDES},
            object=self._object(row["object"], shard.object, frames),
            other_objects=self._other_objects(row, shard) if row["other_objects"] else (),
            source_frames=shard.source_frames[frames].copy(),
            gravity=None if gravity is None else gravity.copy(),
            source_from_world=row["source_from_world"].copy(),
            sources=self._sources_of(row),
            camera=None if motion_only else self._camera(row, shard),
            body=None if motion_only else self._body(row),
            source_contact=None if motion_only else self._source_contact(row),
            **row["facts"],
        )

    @property
    def recordings(self) -> list[str]:
        """The sequences whose whole recording is kept, with the hands as the source has them."""
        return sorted(self.info.get("recordings", {}))

    def recording(self, sequence: str) -> HandRecording:
        """One of ``recordings``. Raises KeyError when there is none of that name."""
        if sequence not in self.recordings:
            raise KeyError(f"no recording {sequence!r} in {self.folder}; there are: {', '.join(self.recordings)}")
        facts = self.info["recordings"][sequence]
        hand = read_hand(facts["hand"], self.info["source_hands"][facts["hand"]], self._file("source_hands"))
        model, sources = self.object_model(facts["object"]), self._sources_of(facts)
        return read_recording(sequence, self.info["dataset"], facts, self._file("recordings"), hand, model, sources)

    def joints(self, clip_id: str, side: Side) -> np.ndarray:
        """(frame, 21, 3) float32 world joints of one hand, metres, valid frames or not (see ``HandTrack.valid``)."""
        return track_joints(self._hand(self._row(clip_id), side), self.hand_pair()[side])

    def hand_pair(self) -> HandPair:
        """The hand model of this store. Raises MissingResource when it needs the user's MANO files."""
        if self.hands is None:
            embedded = load_embedded_hands()
            if self.info.get("hand_model", {}).get("digest") != embedded.digest:
                name = self.info.get("hand_model", {}).get("name", "another hand model")
                raise MissingResource(
                    f"{self.folder} was converted with {name}: open_store(folder, hands=...) needs it"
                )
            self.hands = embedded
        return self.hands

    def object_model(self, name: str) -> ObjectModel:
        """The canonical mesh of an object of this store, by its key in ``objects``."""
        if name not in self._models:
            match = self.objects.loc[self.objects["object"] == name]
            if match.empty:
                raise KeyError(f"no object {name!r} in {self.folder}; there are: {', '.join(self.objects['object'])}")
            facts = match.iloc[0]
            arrays = {key: self._file("objects")[f"{name}/{key}"].copy() for key in ("vertices_m", "faces", "part")}
            hinge = None
            if facts["articulated"]:
                hinge = Hinge(axis=np.array(facts["hinge_axis"]), origin_m=np.array(facts["hinge_origin_m"]))
            self._models[name] = ObjectModel(name, hinge=hinge, **arrays)
        return self._models[name]

    def _row(self, clip_id: str) -> dict[str, Any]:
        if not self._rows:
            self._rows = clip_rows(self.sequences)
        if clip_id not in self._rows:
            raise KeyError(f"no clip {clip_id!r} in {self.folder}, which has {len(self)} clips")
        return self._rows[clip_id]

    def _frames(self, number: int) -> FrameShard:
        if number not in self._shards:
            self._shards[number] = FrameShard.open(self.folder / "arrays" / f"frames-{number:05d}.npz")
        return self._shards[number]

    def _file(self, name: str) -> dict[str, np.ndarray]:
        if name not in self._arrays:
            self._arrays[name] = map_npz(self.folder / "arrays" / f"{name}.npz")
        return self._arrays[name]

    def _hand(self, row: dict[str, Any], side: Side) -> HandTrack:
        wrist_m, global_orient, hand_pose, betas, valid = self._frames(row["shard"]).hands[side]
        frames, (betas_rows, template) = row["frames"], row["hands"][side]
        return HandTrack(
            wrist_m[frames].copy(),
            global_orient[frames].copy(),
            hand_pose[frames].copy(),
            betas[betas_rows].copy(),
            valid[frames].copy(),
            None if template is None else self._file("templates")[template].copy(),
        )

    def _object(self, name: str, pose: tuple[np.ndarray, ...], rows: slice) -> ObjectTrack:
        model = self.object_model(name)
        rotvec, translation_m, hinge_rad = pose
        hinge = hinge_rad[rows].copy() if model.is_articulated else None
        return ObjectTrack(model, rotvec[rows].copy(), translation_m[rows].copy(), hinge)

    def _other_objects(self, row: dict[str, Any], shard: FrameShard) -> tuple[ObjectTrack, ...]:
        first, length = row["other_row"], row["n_frames"]
        starts = range(first, first + length * len(row["other_objects"]), length)
        pairs = zip(row["other_objects"], starts, strict=True)
        return tuple(self._object(name, shard.other, slice(start, start + length)) for name, start in pairs)

    def _camera(self, row: dict[str, Any], shard: FrameShard) -> CameraTrack | None:
        first, intrinsics = row["camera_row"], row["camera_intrinsics"]
        if first < 0:
            return None
        rotvec, position_m, images = (array[first : first + row["n_frames"]].copy() for array in shard.camera)
        intrinsics = None if intrinsics is None else np.array(intrinsics)
        return CameraTrack(row["camera_name"], rotvec, position_m, images, intrinsics)

    def _body(self, row: dict[str, Any]) -> BodyTrack | None:
        if row["body_row"] < 0:
            return None
        shard = self._file(f"body-{row['shard']:05d}")
        rows = slice(row["body_row"], row["body_row"] + row["n_frames"])
        expressions = slice(row["expression_row"], row["expression_row"] + row["n_frames"])
        return BodyTrack(
            **{name: shard[name][rows].copy() for name in ("transl_m", "global_orient", "body_pose", "face_pose")},
            expression=None if row["expression_row"] < 0 else shard["expression"][expressions].copy(),
        )

    def _source_contact(self, row: dict[str, Any]) -> SourceContact | None:
        first, count = row["source_contact_row"], row["source_contact_count"]
        if first < 0:
            return None
        if count == 0:
            return SourceContact(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0, np.uint8))
        shard = self._file(f"source_contact-{row['shard']:05d}")
        return SourceContact(**{name: shard[name][first : first + count].copy() for name in shard})

    def _sources_of(self, row: dict[str, Any]) -> tuple[SourceFile, ...]:
        if not self._sources and len(self.files):
            columns = (self.files[name].tolist() for name in ("path", "size", "sha256"))
            self._sources = [SourceFile(*values) for values in zip(*columns, strict=True)]
        return tuple(self._sources[number] for number in row["source_files"])
