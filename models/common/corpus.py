"""Clips for a training: the two splits that may be read, batches in a repeatable order, and facts to record."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor

from hoidata.batches.dataset import ClipBatch, ClipSample, Crop, HoiDataset, collate
from hoidata.files import canonical_json, sha256_bytes
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore
from models.common.vocabulary import Vocabulary

BUCKET_BATCHES = 4
Item = TypeVar("Item")
HAND_TYPES = ("left", "right", "both")


@dataclass(frozen=True)
class Corpus:
    """Training and validation clips of one dataset; the test split is not even opened."""

    annotated: AnnotatedStore
    train: HoiDataset
    validation: HoiDataset

    @classmethod
    def of(cls, annotated: AnnotatedStore, seed: int, crop: Crop = "random") -> "Corpus":
        """``crop`` is for long training clips; of long validation clips the first frames are taken."""
        train = HoiDataset(annotated, "train", crop=crop, seed=seed)
        return cls(annotated, train, HoiDataset(annotated, "validation", crop="start"))

    @property
    def held_out(self) -> list[ClipSample]:
        """Validation clips; training clips (cropped to the start) where the dataset is too small to have any."""
        if len(self.validation):
            return list(self.validation)
        return list(HoiDataset(self.annotated, "train", crop="start"))

    def facts(self, hands: HandPair) -> dict[str, Any]:
        """What a checkpoint records about its clips."""
        clips = {"train": list(self.train.ids), "validation": list(self.validation.ids)}
        samples = [*self.train, *self.validation]
        names = sorted({sample.dataset for sample in samples})
        return {
            "clips": clips,
            "clips_digest": sha256_bytes(canonical_json(clips).encode()),
            "datasets": {name: sum(sample.dataset == name for sample in self.train) for name in names},
            "hand_types": {hand: sum(sample.hand_type == hand for sample in self.train) for hand in HAND_TYPES},
            "contact_threshold_m": self.annotated.contact_threshold_m,
            "vocabulary": Vocabulary.of(self.train).rows,
            "synthetic": any(sample.synthetic for sample in samples),
            "encoder": self.annotated.encoder_identity,
            "hand": hands.name,
            "hand_digest": hands.digest,
        }


def batches(dataset: HoiDataset, size: int, generator: torch.Generator, with_entries: bool) -> Iterator[ClipBatch]:
    """Endless batches of about ``size`` clips; every epoch has a new order and meets every clip once.

    Clips of like length share a batch, which saves padding: within each stretch of a few batches they are sorted.
    """
    epoch = 0
    while True:
        dataset.set_epoch(epoch)
        order = torch.randperm(len(dataset), generator=generator).tolist()
        for window in _split(order, size * BUCKET_BATCHES):
            clips = sorted((dataset[index] for index in window), key=lambda sample: (sample.length, sample.clip_id))
            groups = _split(clips, size)
            for index in torch.randperm(len(groups), generator=generator).tolist():
                yield collate(groups[index], with_entries)
        epoch += 1


def _split(items: list[Item], size: int) -> list[list[Item]]:
    """The items in order, in as many nearly equal parts as come closest to ``size`` each."""
    parts = max(1, round(len(items) / size))
    edges = [len(items) * part // parts for part in range(parts + 1)]
    return [items[start:stop] for start, stop in pairwise(edges)]


def any_form(batch: ClipBatch, generator: torch.Generator) -> Tensor:
    """(B, 512) features of one of the four sentences of each clip, drawn evenly."""
    form = torch.randint(batch.text.shape[1], (len(batch),), generator=generator)
    return batch.text[torch.arange(len(batch)), form.to(batch.text.device)]
