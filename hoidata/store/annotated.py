"""The annotated dataset of one profile and source: clips, words, contacts, read from the four folders stages write.

    clips/        the store (see ``hoidata.store.store``)
    annotation/   text.parquet        clip_id, form, sentence, text_row (row of embeddings.npz); per clip the four
                                      forms
                  hand_type.parquet   clip_id, hand_type, source (proximity or annotated), min_left_m, min_right_m,
                                      labelled_hand, agreement (of it with the hand that comes near), reason (why a
                                      clip is left out), verb, verb_source (source: the clip came with it; derived:
                                      its motion shows it), verb_evidence (what that rests on)
                  hand_distance.npz   how near each hand is in every frame (``hoidata.store.hand_evidence``)
                  embeddings.npz      features (sentence, 512) float32, sentences (sentence,) text, identity JSON bytes
                  info.json           encoder, threshold_m, points, hand (where it is not proximity), forms,
                                      counts
    contact/      objects.parquet     object, row, method        points.npz    (object, 1024, ...) sampled points
                  clips.parquet       clip_id, row, shard, and per side <side>_start, <side>_stop: rows of the shard
                  contact.npz         <side>_frames (clip, 1024) uint16: in how many frames each point is touched
                  distances-*.npz     frame int16, point int16, joint int8, distance_m float32: one row per entry
                  info.json           threshold_m, points, counts
    splits/       splits.parquet      clip_id, split (the chosen one), one column per named split
                  info.json           definitions, clips per subset (train, validation, test), leak checks
                  statistics.json     of every stored quantity over the training subset

A clip without an acting hand, or without words, has a row with the reason in hand_type.parquet and no sentence; it
belongs to no subset of a split. Clips that match no rule of a split are excluded too.
"""

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

    hands: as in ``open_store``. Raises MissingResource naming the stage that has not run, or why a dataset is empty.
    """
    root = Path(root)
    for folder, stage in STAGES.items():
        require_output(root / folder, stage, ".")
    return AnnotatedStore(root, open_store(root / "clips", hands))


class AnnotatedStore:
    """Clips with their words and contacts, by clip id. ``ids()`` are the clips that have sentences."""

    def __init__(self, root: Path, store: Store) -> None:
        self.root = root
        self.store = store
        annotation, contact = root / "annotation", root / "contact"
        self.text = read_table(annotation / "text.parquet")
        self.hand_types = read_table(annotation / "hand_type.parquet").set_index("clip_id", drop=False)
        chosen = read_table(root / "splits" / "splits.parquet", ["clip_id", "split"])
        self.splits: dict[str, str | None] = {
            clip_id: None if pd.isna(subset) else str(subset) for clip_id, subset in chosen.itertuples(index=False)
        }
        self.split_info = read_json(root / "splits" / "info.json", {"chosen": SUBSET_COUNTS, "splits": {}})
        self.split_info["splits"].check(dict.fromkeys(self.split_info["splits"], SUBSET_COUNTS))
        self.annotation_info = read_json(annotation / "info.json", MEASURED)
        self.contact_info = read_json(contact / "info.json", MEASURED)
        embeddings = read_npz(annotation / "embeddings.npz")
        self.encoder_identity: dict[str, Any] = orjson.loads(embeddings["identity"].tobytes())
        self._features = embeddings["features"]
        self._sentences = _by_clip(self.text)
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
        """Clips with sentences, of one subset of the chosen split or all, in the store's order.

        Raises BadInput for what is the name of no subset.
        """
        if split not in (None, *SUBSETS):
            raise BadInput("split", f"one of {', '.join(SUBSETS)}, or None for all clips", repr(split), "correct it")
        return [key for key in self._sentences if split is None or self.splits[key] == split]

    @property
    def missing_subsets(self) -> dict[str, str]:
        """Subsets of the chosen split without clips, with what that means in words."""
        return self.split_info.get("missing", {})

    @property
    def info(self) -> dict[str, Any]:
        """The store's ``meta/info.json``: dataset, synthetic, hand model, licence."""
        return self.store.info

    @property
    def contact_threshold_m(self) -> float:
        """The contact stage's: contact maps and distances hold what is closer, metres."""
        return float(self.contact_info["threshold_m"])

    def clip(self, clip_id: str) -> Clip:
        return self.store.clip(clip_id)

    def joints(self, clip_id: str, side: Side) -> np.ndarray:
        """(frame, 21, 3) float32 world joints of one hand, metres."""
        return self.store.joints(clip_id, side)

    def hand_type(self, clip_id: str) -> HandType:
        """The active hands, by the rule ``annotate.hand``. Raises KeyError with the reason for a clip without any."""
        found = self.hand_types.at[clip_id, "hand_type"]
        if found not in ("left", "right", "both"):
            raise KeyError(f"no hand acts in {clip_id}: {self.hand_types.at[clip_id, 'reason']}")
        return found

    def hand_evidence(self, clip_id: str, threshold_m: float | None = None) -> HandEvidence:
        """How near each hand comes in every frame, and the hand type at ``threshold_m``, by default the stage's own.

        Kept by the stage annotate: nothing is computed. Per-frame distances are rounded to float32 (1 nm at 2 cm); the
        clip's hand type rests on the exact smallest ones.
        """
        if self._hand_distances is None:
            self._hand_distances = HandDistances(self.root / "annotation" / "hand_distance.npz", len(self.store.ids))
        row = self.hand_types.index.get_loc(clip_id)
        assert isinstance(row, int)
        smallest: dict[Side, float] = {}
        for side in SIDES:
            value = self.hand_types.at[clip_id, f"min_{side}_m"]
            smallest[side] = np.inf if pd.isna(value) else float(value)
        judged_m: float = self.annotation_info["threshold_m"] if threshold_m is None else threshold_m
        return HandEvidence(None, self._hand_distances.of(row), judged_m, smallest).at_threshold(judged_m)

    def sentences(self, clip_id: str) -> tuple[str, ...]:
        """Imperative, passive, subject and gerund form."""
        return tuple(self._sentences[clip_id]["sentence"])

    def text_embedding(self, clip_id: str) -> np.ndarray:
        """(4, 512) float32 features of the four sentences, of the encoder ``encoder_identity``."""
        return self._features[self._sentences[clip_id]["text_row"].to_numpy()]

    def object_key(self, clip_id: str) -> str:
        """Name of the manipulated object within this dataset."""
        return str(self.store.sequences.at[clip_id, "object"])

    def object_model(self, object_key: str) -> ObjectModel:
        return self.store.object_model(object_key)

    def points(self, object_key: str) -> SampledPoints:
        """The sampled points of an object, in its own frame with the hinge at zero."""
        row = int(self._objects.at[object_key, "row"])
        arrays = {name: array[row] for name, array in self._points.items()}
        return SampledPoints(**arrays, method=self._objects.at[object_key, "method"])

    def contact_of(self, clip_id: str, side: Side) -> np.ndarray:
        """(1024,) uint8: points one hand touches in any frame of the clip."""
        return (self.touched_frames(clip_id, side) > 0).astype(np.uint8)

    def contact(self, clip_id: str) -> np.ndarray:
        """(1024,) uint8: points any hand touches in any frame of the clip, Text2HOI's contact map."""
        return np.maximum(self.contact_of(clip_id, "left"), self.contact_of(clip_id, "right"))

    def touched_frames(self, clip_id: str, side: Side) -> np.ndarray:
        """(1024,) uint16: in how many frames one hand touches each point."""
        return self._contact[f"{side}_frames"][int(self._clips.at[clip_id, "row"])]

    def distances(self, clip_id: str, side: Side | None = None) -> DistanceEntries:
        """All joint-point distances under the threshold, of one hand or of both (left first)."""
        sides = SIDES if side is None else (side,)
        columns_of_sides = [self._entries(clip_id, name) for name in sides]
        columns = [np.concatenate(column) for column in zip(*columns_of_sides, strict=True)]
        return DistanceEntries(*columns)

    def _entries(self, clip_id: str, side: Side) -> tuple[np.ndarray, ...]:
        row = self._clips.loc[clip_id]
        rows = slice(int(row[f"{side}_start"]), int(row[f"{side}_stop"]))
        shard = self._shard(int(row["shard"]))
        frame, joint, point = (shard[name][rows].astype(np.int64) for name in ("frame", "joint", "point"))
        number = np.full(len(frame), SIDES.index(side), np.int64)
        return number, frame, joint, point, np.array(shard["distance_m"][rows])

    def _shard(self, number: int) -> dict[str, np.ndarray]:
        if number not in self._distances:
            self._distances[number] = map_npz(self.root / "contact" / f"distances-{number:05d}.npz")
        return self._distances[number]

    def __getstate__(self) -> dict[str, Any]:
        """Workers map the distances anew: a pickled memory map would carry all of them."""
        return {**self.__dict__, "_distances": {}, "_hand_distances": None}

    def _refuse_other_clips(self) -> None:
        """Raise BadInput when a stage's output belongs to another conversion than the clips beside it."""
        tables = {"annotation": self.hand_types.index, "contact": self._clips.index, "splits": self.splits}
        for folder, found in tables.items():
            if list(found) != self.store.ids:
                got = f"{len(found)}, {len(set(found) & set(self.store.ids))} of them among these"
                expected = f"the {len(self.store)} clips of the store beside it"
                raise BadInput(self.root / folder, expected, got, "run its stage again")


def _by_clip(text: pd.DataFrame) -> dict[str, pd.DataFrame]:
    return {str(key): rows for key, rows in text.groupby("clip_id", sort=False)}
