"""Reads the annotated dataset of a profile: clips, sentences, contacts and splits from the folders of four stages.

    clips/        the store (see ``hoidata.store.store``)
    annotation/   text.parquet        clip_id, form, sentence, text_row (row of embeddings.npz); per clip one row
                                      for each sentence form
                  hand_type.parquet   clip_id, hand_type, source (proximity or annotated), min_left_m, min_right_m,
                                      labelled_hand, agreement (whether labelled_hand is the hand close to the
                                      object), reason (why a clip is excluded), verb, verb_source (source: a label
                                      of the source; derived: from the motion), verb_evidence (reason for the verb)
                  hand_distance.npz   distance of each hand in each frame (``hoidata.store.hand_evidence``)
                  embeddings.npz      features (sentence, 512) float32, sentences (sentence,) text, identity JSON bytes
                  info.json           encoder, threshold_m, points, forms, counts
    contact/      objects.parquet     object, row, method        points.npz    (object, 1024, ...) sampled points
                  clips.parquet       clip_id, row, shard, and per side <side>_start, <side>_stop: rows of the shard
                  contact.npz         <side>_frames (clip, 1024) uint16: number of frames in which each point is touched
                  distances-*.npz     frame int16, point int16, joint int8, distance_m float32: one row per entry
                  info.json           threshold_m, points, counts
    splits/       splits.parquet      clip_id, split (the chosen one), one column per named split
                  info.json           definitions, clips per subset (train, validation, test), leak checks
                  statistics.json     of every stored quantity over the training subset

A clip without an active hand, or without a verb or noun, has no sentence; ``reason`` in hand_type.parquet says why.
Splits exclude such clips, and clips that match no rule of the split.
Fixed windows of whole recordings can take the place of the clips of one subset (``WindowedStore``).
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pandas as pd

from hoidata.clips.clip import SIDES, Clip, HandType, Side
from hoidata.errors import BadInput
from hoidata.files.arrays import read_npz
from hoidata.files.written import NUMBER, Shape, read_json, read_table, require_output
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import SampledPoints
from hoidata.settings import require_at_least
from hoidata.store.distances import DistanceEntries
from hoidata.store.hand_evidence import HandDistances, HandEvidence
from hoidata.store.mapped import map_npz
from hoidata.store.store import Store, open_store

SUBSETS = ("train", "validation", "test")
STAGES = {"clips": "convert", "annotation": "annotate", "contact": "contact", "splits": "split"}
MEASURED: dict[str, Shape] = {"threshold_m": NUMBER, "points": int}
SUBSET_COUNTS = {"name": str, "clips": dict.fromkeys((*SUBSETS, "left_out"), int), "keeps_its_promises": bool}


def load_annotated(root: str | Path, hands: HandPair | None = None) -> "AnnotatedStore":
    """Open ``root/clips``, ``root/annotation``, ``root/contact`` and ``root/splits`` for reading.

    hands: as in ``open_store``. Raises MissingResource if a stage has not run, or the dataset is empty.
    """
    root = Path(root)
    for folder, stage in STAGES.items():
        require_output(root / folder, stage, ".")
    return AnnotatedStore(root, open_store(root / "clips", hands))


class AnnotatedStore:
    """Clips with their sentences and contacts, by clip id. ``ids()`` are the clips with sentences."""

    def __init__(self, root: Path, store: Store) -> None:
        self.root = root
        self.store = store
        annotation, contact = root / "annotation", root / "contact"
        self.text = read_table(annotation / "text.parquet")
        self.hand_types = read_table(annotation / "hand_type.parquet").set_index("clip_id", drop=False)
        chosen = read_table(root / "splits" / "splits.parquet", ["clip_id", "split"])
        subsets = [None if pd.isna(subset) else str(subset) for subset in chosen["split"]]
        self.splits: dict[str, str | None] = dict(zip(chosen["clip_id"], subsets, strict=True))
        self.split_info = read_json(root / "splits" / "info.json", {"chosen": SUBSET_COUNTS, "splits": {}})
        self.split_info["splits"].check(dict.fromkeys(self.split_info["splits"], SUBSET_COUNTS))
        self.annotation_info = read_json(annotation / "info.json", MEASURED)
        self.contact_info = read_json(contact / "info.json", MEASURED)
        embeddings = read_npz(annotation / "embeddings.npz")
        self.encoder_identity: dict[str, Any] = orjson.loads(embeddings["identity"].tobytes())
        self._features = embeddings["features"]
        self._sentences = {str(key): rows for key, rows in self.text.groupby("clip_id", sort=False)}
        self._objects = read_table(contact / "objects.parquet").set_index("object")
        self._clips = read_table(contact / "clips.parquet").set_index("clip_id")
        self._points = read_npz(contact / "points.npz")
        self._contact = read_npz(contact / "contact.npz")
        self._distances: dict[int, dict[str, np.ndarray]] = {}
        self._hand_distances: HandDistances | None = None
        self._refuse_other_clips()

    def __len__(self) -> int:
        return len(self.ids())

    def ids(self, split: str | None = None) -> list[str]:
        """Return the clips with sentences in the store's order, of one subset of the chosen split or all.

        Raises BadInput for an unknown subset.
        """
        if split not in (None, *SUBSETS):
            raise BadInput("split", f"one of {', '.join(SUBSETS)}, or None for all clips", repr(split), "correct it")
        return [key for key in self._sentences if split is None or self.splits[key] == split]

    @property
    def missing_subsets(self) -> dict[str, str]:
        """Empty subsets of the chosen split, with the consequence as text."""
        return self.split_info.get("missing", {})

    @property
    def info(self) -> dict[str, Any]:
        """The store's ``meta/info.json``: dataset, synthetic, hand model, licence."""
        return self.store.info

    @property
    def contact_threshold_m(self) -> float:
        """The contact stage's threshold: contact maps and distances contain pairs that are closer, metres."""
        return float(self.contact_info["threshold_m"])

    def clip(self, clip_id: str) -> Clip:
        return self.store.clip(clip_id)

    def joints(self, clip_id: str, side: Side) -> np.ndarray:
        """(frame, 21, 3) float32 world joints of one hand, metres."""
        return self.store.joints(clip_id, side)

    def hand_type(self, clip_id: str) -> HandType:
        """Return the active hands by the rule ``annotate.hand``. Raises KeyError with the reason if there are none."""
        hand_type = self.hand_types.at[clip_id, "hand_type"]
        if hand_type not in ("left", "right", "both"):
            raise KeyError(f"no active hand in {clip_id}: {self.hand_types.at[clip_id, 'reason']}")
        return hand_type

    def verb(self, clip_id: str) -> str | None:
        """The annotated verb of a clip: the label of the source, else derived from the motion; None without either."""
        verb = self.hand_types.at[clip_id, "verb"]
        return verb if isinstance(verb, str) and verb else None

    def hand_evidence(self, clip_id: str, threshold_m: float | None = None) -> HandEvidence:
        """Read the distance of each hand in each frame, and the hand type at ``threshold_m``, by default annotate's.

        Per-frame distances are rounded to float32 (1 nm at 2 cm). The hand type uses the exact smallest distances.
        """
        if self._hand_distances is None:
            self._hand_distances = HandDistances(self.root / "annotation" / "hand_distance.npz", len(self.store.ids))
        index = self.hand_types.index.get_loc(clip_id)
        assert isinstance(index, int)
        smallest: dict[Side, float] = {}
        for side in SIDES:
            value = self.hand_types.at[clip_id, f"min_{side}_m"]
            smallest[side] = np.inf if pd.isna(value) else float(value)
        limit_m: float = self.annotation_info["threshold_m"] if threshold_m is None else threshold_m
        return HandEvidence(self._hand_distances.of(index), limit_m, smallest)

    def sentences(self, clip_id: str) -> tuple[str, ...]:
        """Return the sentences of a clip, one of each form (``hoidata.annotation.sentences``)."""
        return tuple(self._sentences[clip_id]["sentence"])

    def text_embedding(self, clip_id: str) -> np.ndarray:
        """Return (form, 512) float32 features of the clip's sentences, from the encoder ``encoder_identity``."""
        return self._features[self._sentences[clip_id]["text_row"].to_numpy()]

    def object_key(self, clip_id: str) -> str:
        """Return the key of the manipulated object in this store."""
        return str(self.store.sequences.at[clip_id, "object"])

    def object_model(self, object_key: str) -> ObjectModel:
        return self.store.object_model(object_key)

    def points(self, object_key: str) -> SampledPoints:
        """Return the sampled points of an object, in the object frame with the hinge at zero."""
        index = int(self._objects.at[object_key, "row"])
        arrays = {name: array[index] for name, array in self._points.items()}
        return SampledPoints(**arrays, method=self._objects.at[object_key, "method"])

    def contact_of(self, clip_id: str, side: Side) -> np.ndarray:
        """Return (1024,) uint8: 1 for points that one hand touches in any frame of the clip."""
        return (self.touched_frames(clip_id, side) > 0).astype(np.uint8)

    def contact(self, clip_id: str) -> np.ndarray:
        """Return (1024,) uint8: 1 for points that a hand touches in any frame; the contact map of Text2HOI."""
        return np.maximum(self.contact_of(clip_id, "left"), self.contact_of(clip_id, "right"))

    def touched_frames(self, clip_id: str, side: Side) -> np.ndarray:
        """Return (1024,) uint16: the number of frames in which one hand touches each point."""
        return self._contact[f"{side}_frames"][int(self._clips.at[clip_id, "row"])]

    def distances(self, clip_id: str, side: Side | None = None) -> DistanceEntries:
        """Return all joint-point distances below the threshold, of one hand or of both (left first)."""
        sides = SIDES if side is None else (side,)
        columns_of_sides = [self._entries(clip_id, name) for name in sides]
        columns = [np.concatenate(column) for column in zip(*columns_of_sides, strict=True)]
        return DistanceEntries(*columns)

    def _entries(self, clip_id: str, side: Side) -> tuple[np.ndarray, ...]:
        clip = self._clips.loc[clip_id]
        rows = slice(int(clip[f"{side}_start"]), int(clip[f"{side}_stop"]))
        shard = self._shard(int(clip["shard"]))
        frame, joint, point = (shard[name][rows].astype(np.int64) for name in ("frame", "joint", "point"))
        number = np.full(len(frame), SIDES.index(side), np.int64)
        return number, frame, joint, point, np.array(shard["distance_m"][rows])

    def _shard(self, number: int) -> dict[str, np.ndarray]:
        if number not in self._distances:
            self._distances[number] = map_npz(self.root / "contact" / f"distances-{number:05d}.npz")
        return self._distances[number]

    def __getstate__(self) -> dict[str, Any]:
        """Leave out memory maps, which would pickle whole files: each worker maps the files again."""
        return {**self.__dict__, "_distances": {}, "_hand_distances": None}

    def _refuse_other_clips(self) -> None:
        """Raise BadInput if the output of a stage belongs to another conversion than the clips."""
        tables = {"annotation": self.hand_types.index, "contact": self._clips.index, "splits": self.splits}
        for folder, clip_ids in tables.items():
            if list(clip_ids) != self.store.ids:
                got = f"{len(clip_ids)} clips, {len(set(clip_ids) & set(self.store.ids))} in common"
                expected = f"the {len(self.store)} clips of {self.store.folder}"
                raise BadInput(self.root / folder, expected, got, "run its stage again")


@dataclass(frozen=True)
class WindowProtocol:
    """Which windows of a clip are evaluated; the defaults are those of BimArt's released code."""

    start: int = 100  # first frame of the first window
    stride: int = 64  # frames from one window to the next
    frames: int = 64  # of a window
    trimmed_end: int = 164  # last frames of the clip that no window reaches

    def __post_init__(self) -> None:
        for name, least in (("start", 0), ("stride", 1), ("frames", 3), ("trimmed_end", 0)):
            require_at_least("windows", self, name, least)

    def starts(self, n_frames: int) -> range:
        """First frames of the windows of a clip."""
        return range(self.start, n_frames - self.trimmed_end - self.frames, self.stride)


class WindowedStore(AnnotatedStore):
    """An annotated dataset with windows instead of the clips of one subset, named ``<clip id>@<first frame>``.

    A window has the sentences, the active hands and the sequence of its clip, but no camera, body, further objects or
    contact labels of the source. A clip that is too short has no window.
    """

    def __init__(self, whole: AnnotatedStore, protocol: WindowProtocol, split: str = "test") -> None:
        self.__dict__ |= whole.__dict__  # tables and caches are shared
        n_frames = whole.store.sequences["n_frames"]
        cut = {clip_id: protocol.starts(int(n_frames.at[clip_id])) for clip_id in whole.ids(split)}
        names_of = {clip_id: [f"{clip_id}@{start}" for start in starts] for clip_id, starts in cut.items()}
        self._first = {f"{clip_id}@{start}": start for clip_id, starts in cut.items() for start in starts}
        self._n_frames = protocol.frames
        clip_of = {name: clip_id for clip_id in whole.store.ids for name in names_of.get(clip_id, [clip_id])}
        names, clip_ids = list(clip_of), list(clip_of.values())
        rows = whole.store.sequences.loc[clip_ids].assign(clip_id=names).set_index("clip_id", drop=False)
        first = np.array([self._first.get(name, 0) for name in names])
        is_window = np.array([name in self._first for name in names])
        rows["first_row"] += first
        for side in SIDES:
            rows[f"{side}_betas_row"] += first * (rows[f"{side}_betas_count"] > 1)
            rows.loc[is_window & (rows[f"{side}_betas_count"] > 1), f"{side}_betas_count"] = protocol.frames
        rows.loc[is_window, "n_frames"] = protocol.frames
        rows.loc[is_window, ["camera_row", "body_row", "source_contact_row"]] = -1
        others = zip(is_window, rows["other_objects"], strict=True)
        rows["other_objects"] = [[] if window else objects for window, objects in others]
        self.store = replace(whole.store, sequences=rows.rename_axis(None), _rows={})
        self.splits = {name: whole.splits[clip_id] for name, clip_id in clip_of.items()}
        with_text = {name: clip_id for name, clip_id in clip_of.items() if clip_id in whole._sentences}
        self._sentences = {name: whole._sentences[clip_id] for name, clip_id in with_text.items()}
        hand_types = whole.hand_types.loc[clip_ids].assign(clip_id=names)
        self.hand_types = hand_types.set_index("clip_id", drop=False)
        self._clips = whole._clips.loc[clip_ids].set_axis(names)

    def distances(self, clip_id: str, side: Side | None = None) -> DistanceEntries:
        entries, first = super().distances(clip_id, side), self._first.get(clip_id)
        return entries if first is None else entries.window(first, first + self._n_frames)

    def touched_frames(self, clip_id: str, side: Side) -> np.ndarray:
        if clip_id not in self._first:
            return super().touched_frames(clip_id, side)
        entries = self.distances(clip_id, side)
        pairs = np.unique(np.stack((entries.frame, entries.point)), axis=1)
        return np.bincount(pairs[1], minlength=self.contact_info["points"]).astype(np.uint16)
