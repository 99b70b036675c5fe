"""The unified store of one dataset: a folder of Parquet tables and stored NPZ arrays.

    meta/info.json            schema_version, dataset, synthetic, fps, hand_model, units, axes, licence, frame and
                              hand_convention (what the source's frame and hand parameters mean)
    meta/sequences.parquet    one row per clip: id, words, and where its rows lie in the arrays
    meta/objects.parquet      one row per object     meta/files.parquet       one row per raw file
    meta/quarantine.parquet   what was left out, with the reason
    arrays/frames-00000.npz   one member per array, the clips of a shard one after another; never compressed
    arrays/objects.npz        <object>/vertices_m, <object>/faces, <object>/part; arrays/templates.npz personal hands

In one line: ``clip = open_store("data/embedded/grab/clips").clip("grab/s1/mug_drink_1")``. With plain NumPy::

    rows = pandas.read_parquet("clips/meta/sequences.parquet").set_index("clip_id")
    row = rows.loc["grab/s1/mug_drink_1"]
    arrays = numpy.load(f"clips/arrays/frames-{row.shard:05d}.npz")
    wrist_m = arrays["left_wrist_m"][row.first_row : row.first_row + row.n_frames]

Betas start at ``<side>_betas_row`` and have 1 row or one per frame (``<side>_betas_count``); the k-th further object
starts at ``other_row + k * n_frames`` of the ``other_*`` arrays.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pandas as pd

from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair, load_embedded_hands, track_joints
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.schema.clip import SIDES, Clip, HandTrack, ObjectTrack, Side, SourceFile
from hoidata.schema.mapped import map_npz
from hoidata.schema.quarantine import Quarantined
from hoidata.schema.writing import SCHEMA_VERSION, write_store

__all__ = ["SCHEMA_VERSION", "Quarantined", "Store", "open_store", "write_store"]


def open_store(folder: str | Path, hands: HandPair | None = None) -> "Store":
    """Open a store for reading.

    hands: the hand model its parameters belong to; not needed when that is the embedded one, or when no joints are
    asked for. Raises MissingResource when ``folder`` is no store, BadInput for a newer schema or other hands.
    """
    folder = Path(folder)
    path = folder / "meta" / "info.json"
    if not path.is_file():
        raise MissingResource(f"{folder} is no store: {path} is missing; run the conversion of this dataset first")
    try:
        info = orjson.loads(path.read_bytes())
        major = int(info["schema_version"].split(".")[0])
    except (orjson.JSONDecodeError, KeyError, ValueError, AttributeError, TypeError) as error:
        raise BadInput(path, "JSON with a schema_version", str(error), "run the conversion again") from error
    if major != int(SCHEMA_VERSION.split(".")[0]):
        remedy = "upgrade hoidata to the version that wrote it, or convert again"
        raise BadInput(path, f"schema version {SCHEMA_VERSION}", info["schema_version"], remedy)
    written = info.get("hand_model", {}).get("digest")
    if hands is not None and written is not None and hands.digest != written:
        remedy = "open it with the hands it was converted with"
        raise BadInput(path, f"hand model {written[:12]}", f"{hands.name} {hands.digest[:12]}", remedy)
    sequences, objects, files, quarantine = (
        pd.read_parquet(folder / "meta" / f"{name}.parquet") for name in ("sequences", "objects", "files", "quarantine")
    )
    sequences = sequences.set_index("clip_id", drop=False).rename_axis(None)
    return Store(folder, info, sequences, objects, files, quarantine, hands)


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

    def __getstate__(self) -> dict[str, Any]:
        """Workers open the array files anew: a pickled memory map would carry the whole dataset."""
        return {**self.__dict__, "_arrays": {}, "_models": {}}

    def __len__(self) -> int:
        return len(self.sequences)

    @property
    def ids(self) -> list[str]:
        return self.sequences["clip_id"].tolist()

    def clip(self, clip_id: str) -> Clip:
        """The clip as it was written, float32. Raises KeyError when there is none of that id."""
        row = self._row(clip_id)
        start, stop = row["first_row"], row["first_row"] + row["n_frames"]
        others = [self._other_object(row, number) for number in range(len(row["other_objects"]))]
        return Clip(
            hands={side: self._hand(row, side) for side in SIDES},
            object=self._object(row["object"], row["shard"], "object", start, stop),
            other_objects=tuple(others),
            source_frames=self._rows(row["shard"], "source_frames", start, stop),
            gravity=None if row["gravity"] is None else np.array(row["gravity"]),
            source_from_world=np.array(row["source_from_world"]).reshape(4, 4),
            sources=tuple(self._source(number) for number in row["source_files"]),
            **{name: row[name] for name in ("clip_id", "dataset", "subject", "sequence", "verb", "object_words")},
            **{name: row[name] for name in ("labelled_hand", "source_fps", "synthetic")},
        )

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
            arrays = {key: np.array(self._file("objects")[f"{name}/{key}"]) for key in ("vertices_m", "faces", "part")}
            hinge = None
            if facts["articulated"]:
                hinge = Hinge(axis=np.array(facts["hinge_axis"]), origin_m=np.array(facts["hinge_origin_m"]))
            self._models[name] = ObjectModel(name, hinge=hinge, **arrays)
        return self._models[name]

    def _row(self, clip_id: str) -> dict[str, Any]:
        if clip_id not in self.sequences.index:
            raise KeyError(f"no clip {clip_id!r} in {self.folder}, which has {len(self)} clips")
        row: dict[str, Any] = self.sequences.loc[clip_id].to_dict()
        return {key: _plain(value) for key, value in row.items()}

    def _file(self, name: str) -> dict[str, np.ndarray]:
        if name not in self._arrays:
            self._arrays[name] = map_npz(self.folder / "arrays" / f"{name}.npz")
        return self._arrays[name]

    def _rows(self, shard: int, name: str, start: int, stop: int) -> np.ndarray:
        return np.array(self._file(f"frames-{shard:05d}")[name][start:stop])

    def _hand(self, row: dict[str, Any], side: Side) -> HandTrack:
        start, stop = row["first_row"], row["first_row"] + row["n_frames"]
        betas_start = row[f"{side}_betas_row"]
        template = row[f"{side}_template"]
        return HandTrack(
            **{
                name: self._rows(row["shard"], f"{side}_{name}", start, stop)
                for name in ("wrist_m", "global_orient", "hand_pose", "valid")
            },
            betas=self._rows(row["shard"], f"{side}_betas", betas_start, betas_start + row[f"{side}_betas_count"]),
            template_m=None if template is None else np.array(self._file("templates")[template]),
        )

    def _object(self, name: str, shard: int, prefix: str, start: int, stop: int) -> ObjectTrack:
        model = self.object_model(name)
        return ObjectTrack(
            model,
            rotvec=self._rows(shard, f"{prefix}_rotvec", start, stop),
            translation_m=self._rows(shard, f"{prefix}_translation_m", start, stop),
            hinge_rad=self._rows(shard, f"{prefix}_hinge_rad", start, stop) if model.is_articulated else None,
        )

    def _other_object(self, row: dict[str, Any], number: int) -> ObjectTrack:
        start = row["other_row"] + number * row["n_frames"]
        return self._object(row["other_objects"][number], row["shard"], "other", start, start + row["n_frames"])

    def _source(self, number: int) -> SourceFile:
        facts = self.files.iloc[number]
        return SourceFile(str(facts["path"]), int(facts["size"]), str(facts["sha256"]))


def _plain(value: Any) -> Any:
    """NumPy scalars as Python ones; a missing value (pandas has three kinds) as None."""
    if isinstance(value, np.ndarray | list):
        return list(value)
    if isinstance(value, np.generic):
        value = value.item()
    return None if value is None or value is pd.NA or value != value else value
