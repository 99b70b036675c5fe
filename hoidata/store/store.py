"""Store of one dataset: a folder of Parquet tables and uncompressed NPZ arrays.

``hoidata/store/README.md`` describes the files and fields. To read a clip:
``clip = open_store("data/embedded/grab/clips").clip("grab/s1/mug_drink_1")``. With NumPy and pandas alone::

    sequences = pandas.read_parquet("clips/meta/sequences.parquet").set_index("clip_id")
    clip = sequences.loc["grab/s1/mug_drink_1"]
    arrays = numpy.load(f"clips/arrays/frames-{clip.shard:05d}.npz")
    wrist_m = arrays["left_wrist_m"][clip.first_row : clip.first_row + clip.n_frames]

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
    """Return the row of each clip by its id, as Python values.

    A dict, because the row of a pandas table costs more than reading the clip. Added keys: ``frames``, the clip's rows
    of its shard; ``hands``, by side the rows of its betas and its template; ``columns``, the fields of ``Clip`` among
    the columns. gravity (3,) and source_from_world (4, 4) become arrays.
    """
    rows = {}
    for facts in pa.Table.from_pandas(sequences, preserve_index=False).to_pylist():
        facts["frames"] = slice(facts["first_row"], facts["first_row"] + facts["n_frames"])
        facts["hands"] = {side: _hand_rows(facts, side) for side in SIDES}
        facts["columns"] = {name: facts[name] for name in (*_FACTS, *_FURTHER_FACTS)}
        facts["gravity"] = None if facts["gravity"] is None else np.array(facts["gravity"])
        facts["source_from_world"] = np.array(facts["source_from_world"]).reshape(4, 4)
        rows[facts["clip_id"]] = facts
    return rows


def _hand_rows(facts: dict[str, Any], side: Side) -> tuple[slice, str | None]:
    first = facts[f"{side}_betas_row"]
    return slice(first, first + facts[f"{side}_betas_count"]), facts[f"{side}_template"]


@dataclass(frozen=True)
class FrameShard:
    """The memory-mapped members of one ``frames-*.npz``."""

    source_frames: np.ndarray
    hands: Mapping[Side, tuple[np.ndarray, ...]]  # wrist_m, global_orient, hand_pose, betas, valid
    object: tuple[np.ndarray, ...]  # rotvec, translation_m, hinge_rad
    other: tuple[np.ndarray, ...]  # the same of the further objects
    camera: tuple[np.ndarray, ...]  # rotvec, position_m, images

    @classmethod
    def open(cls, path: Path) -> "FrameShard":
        arrays = map_npz(path)
        names = ("wrist_m", "global_orient", "hand_pose", "betas", "valid")
        return cls(
            source_frames=arrays["source_frames"],
            hands={side: tuple(arrays[f"{side}_{name}"] for name in names) for side in SIDES},
            object=tuple(arrays[f"object_{name}"] for name in _POSE),
            other=tuple(arrays[f"other_{name}"] for name in _POSE),
            camera=tuple(arrays[f"camera_{name}"] for name in ("rotvec", "position_m", "images")),
        )


__all__ = ["SCHEMA_VERSION", "Quarantined", "Store", "open_store", "write_store"]


def stored_hinge(axis: Any, origin_m: Any) -> Hinge:
    """The joint of a row of objects.parquet; without an origin it is prismatic."""
    return Hinge(np.array(axis), np.zeros(3) if origin_m is None else np.array(origin_m), origin_m is None)


def open_store(folder: str | Path, hands: HandPair | None = None) -> "Store":
    """Open a store for reading.

    hands: hand model of its parameters. Only ``joints`` needs it, and only if it is not the embedded hand.
    Raises MissingResource if ``folder`` is not a store, BadInput for another schema version or hand model.
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
    return Store(folder, info, sequences, objects, files=files, quarantine=quarantine, hands=hands)


def read_info(folder: str | Path) -> dict[str, Any]:
    """Read ``meta/info.json``.

    Raises MissingResource if ``folder`` is not a store, or is empty for a stated reason; BadInput if the file is
    invalid or of another schema version.
    """
    path = Path(folder) / "meta" / "info.json"
    for parent in (Path(folder), Path(folder).parent):  # a family without motions has empty.json instead of clips/
        if not path.is_file() and (reason := empty_reason(parent)):
            raise MissingResource(f"{parent} is empty: {reason}")
    if not path.is_file():
        raise MissingResource(f"{folder} is not a store: {path} is missing; run the conversion of this dataset first")
    info = read_json(path)
    if info["schema_version"] != SCHEMA_VERSION:
        remedy = "run the conversion again, or use the hoidata that wrote it"
        raise BadInput(path, f"schema version {SCHEMA_VERSION}", str(info["schema_version"])[:80], remedy)
    return info


@dataclass
class Store:
    """The clips of one dataset."""

    folder: Path
    info: dict[str, Any]  # meta/info.json
    sequences: pd.DataFrame  # under clip ids
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
        """Leave out memory maps, which would pickle the whole dataset: each worker opens the files again."""
        return {**self.__dict__, "_arrays": {}, "_models": {}, "_shards": {}, "_rows": {}, "_sources": []}

    def __len__(self) -> int:
        return len(self.sequences)

    @property
    def ids(self) -> list[str]:
        return self.sequences["clip_id"].tolist()

    def clip(self, clip_id: str, *, motion_only: bool = False) -> Clip:
        """Read a clip, float32. Raises KeyError for an unknown id.

        motion_only: skip camera, body and contact labels of the source, which can be larger than all the rest.
        """
        facts = self._facts(clip_id)
        frames, shard, gravity = facts["frames"], self._frames(facts["shard"]), facts["gravity"]
        return Clip(
            hands={side: self._hand(facts, side) for side in SIDES},
            object=self._object(facts["object"], shard.object, frames),
            other_objects=self._other_objects(facts, shard) if facts["other_objects"] else (),
            source_frames=shard.source_frames[frames].copy(),
            gravity=None if gravity is None else gravity.copy(),
            source_from_world=facts["source_from_world"].copy(),
            sources=self._sources_of(facts),
            camera=None if motion_only else self._camera(facts, shard),
            body=None if motion_only else self._body(facts),
            source_contact=None if motion_only else self._source_contact(facts),
            **facts["columns"],
        )

    @property
    def recordings(self) -> list[str]:
        """The sequences whose whole recording is stored, with the hand skeleton of the source."""
        return sorted(self.info.get("recordings", {}))

    def recording(self, sequence: str) -> HandRecording:
        """Read one of ``recordings``. Raises KeyError for an unknown sequence."""
        if sequence not in self.recordings:
            raise KeyError(f"no recording {sequence!r} in {self.folder}; there are: {', '.join(self.recordings)}")
        facts = self.info["recordings"][sequence]
        hand = read_hand(facts["hand"], self.info["source_hands"][facts["hand"]], self._file("source_hands"))
        model, sources = self.object_model(facts["object"]), self._sources_of(facts)
        return read_recording(sequence, self.info["dataset"], facts, self._file("recordings"), hand, model, sources)

    def joints(self, clip_id: str, side: Side) -> np.ndarray:
        """Return (frame, 21, 3) float32 world joints of one hand, metres, in valid and invalid frames."""
        return track_joints(self._hand(self._facts(clip_id), side), self.hand_pair()[side])

    def hand_pair(self) -> HandPair:
        """Return the hand model of this store. Raises MissingResource if it is MANO and was not passed."""
        if self.hands is None:
            embedded = load_embedded_hands()
            if self.info.get("hand_model", {}).get("digest") != embedded.digest:
                was = f"was converted with {self.info.get('hand_model', {}).get('name', 'another hand model')}"
                raise MissingResource(f"{self.folder} {was}: open_store(folder, hands=...) needs it")
            self.hands = embedded
        return self.hands

    def object_model(self, name: str) -> ObjectModel:
        """Return the canonical mesh of an object by its key in ``objects``."""
        if name not in self._models:
            match = self.objects.loc[self.objects["object"] == name]
            if match.empty:
                raise KeyError(f"no object {name!r} in {self.folder}; there are: {', '.join(self.objects['object'])}")
            facts = match.iloc[0]
            arrays = {key: self._file("objects")[f"{name}/{key}"].copy() for key in ("vertices_m", "faces", "part")}
            hinge = stored_hinge(facts["hinge_axis"], facts["hinge_origin_m"]) if facts["articulated"] else None
            self._models[name] = ObjectModel(name, hinge=hinge, **arrays)
        return self._models[name]

    def _facts(self, clip_id: str) -> dict[str, Any]:
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

    def _hand(self, facts: dict[str, Any], side: Side) -> HandTrack:
        wrist_m, global_orient, hand_pose, betas, valid = self._frames(facts["shard"]).hands[side]
        frames, (betas_rows, template) = facts["frames"], facts["hands"][side]
        return HandTrack(
            wrist_m=wrist_m[frames].copy(),
            global_orient=global_orient[frames].copy(),
            hand_pose=hand_pose[frames].copy(),
            betas=betas[betas_rows].copy(),
            valid=valid[frames].copy(),
            template_m=None if template is None else self._file("templates")[template].copy(),
        )

    def _object(self, name: str, pose: tuple[np.ndarray, ...], rows: slice) -> ObjectTrack:
        model = self.object_model(name)
        rotvec, translation_m, hinge_rad = pose
        hinge = hinge_rad[rows].copy() if model.is_articulated else None
        return ObjectTrack(model, rotvec[rows].copy(), translation_m[rows].copy(), hinge)

    def _other_objects(self, facts: dict[str, Any], shard: FrameShard) -> tuple[ObjectTrack, ...]:
        first, length = facts["other_row"], facts["n_frames"]
        starts = range(first, first + length * len(facts["other_objects"]), length)
        pairs = zip(facts["other_objects"], starts, strict=True)
        return tuple(self._object(name, shard.other, slice(start, start + length)) for name, start in pairs)

    def _camera(self, facts: dict[str, Any], shard: FrameShard) -> CameraTrack | None:
        first, intrinsics = facts["camera_row"], facts["camera_intrinsics"]
        if first < 0:
            return None
        rotvec, position_m, images = (array[first : first + facts["n_frames"]].copy() for array in shard.camera)
        intrinsics = None if intrinsics is None else np.array(intrinsics)
        return CameraTrack(facts["camera_name"], rotvec, position_m, images, intrinsics=intrinsics)

    def _body(self, facts: dict[str, Any]) -> BodyTrack | None:
        if facts["body_row"] < 0:
            return None
        shard = self._file(f"body-{facts['shard']:05d}")
        rows = slice(facts["body_row"], facts["body_row"] + facts["n_frames"])
        expressions = slice(facts["expression_row"], facts["expression_row"] + facts["n_frames"])
        return BodyTrack(
            **{name: shard[name][rows].copy() for name in ("transl_m", "global_orient", "body_pose", "face_pose")},
            expression=None if facts["expression_row"] < 0 else shard["expression"][expressions].copy(),
        )

    def _source_contact(self, facts: dict[str, Any]) -> SourceContact | None:
        first, count = facts["source_contact_row"], facts["source_contact_count"]
        if first < 0:
            return None
        if count == 0:
            return SourceContact(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0, np.uint8))
        shard = self._file(f"source_contact-{facts['shard']:05d}")
        return SourceContact(**{name: shard[name][first : first + count].copy() for name in shard})

    def _sources_of(self, facts: dict[str, Any]) -> tuple[SourceFile, ...]:
        if not self._sources and len(self.files):
            columns = (self.files[name].tolist() for name in ("path", "size", "sha256"))
            self._sources = [SourceFile(*values) for values in zip(*columns, strict=True)]
        return tuple(self._sources[number] for number in facts["source_files"])
