"""Clips for a training: the two splits that may be read, batches in a repeatable order, and facts to record."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from hoidata.batches.dataset import ClipBatch, ClipSample, Crop, HoiDataset, collate
from hoidata.batches.sight import Sight
from hoidata.devices import send
from hoidata.files import canonical_json, sha256_bytes
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore
from models.common.augmentation import Augmentation
from models.common.vocabulary import Vocabulary

BUCKET_BATCHES = 4
Item = TypeVar("Item")
HAND_TYPES = ("left", "right", "both")


@dataclass(frozen=True)
class Wanted:
    """What of every batch is asked for. frames, entries: of each clip and in all, for losses of geometry (``Sight``).

    parts: those of ``of`` equal parts of a batch that this process computes. augmented_copies: of every clip, beside it
    (``Augmentation``).
    """

    frames: int = 0
    entries: int = 0
    parts: Sequence[int] = (0,)
    of: int = 1
    augmented_copies: int = 0


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
        """Validation clips, none where the split has none: nothing is chosen then."""
        return list(self.validation)

    def digest(self) -> str:
        """SHA-256 of all that training and validation see of the clips: arrays, words and meshes."""
        found, subsets = sha256(), (self.train, self.validation)
        for sample in itertools.chain.from_iterable(map(subset.whole, subset.ids) for subset in subsets):
            model, entries = sample.object_model, sample.distances
            words = (sample.clip_id, sample.hand_type, sample.verb, *sample.sentences, len(sample.object))
            found.update(canonical_json(words).encode())
            arrays = (
                *(sample.hands, sample.object, sample.joints_m, sample.valid, sample.betas, sample.template_m),
                *(sample.text, sample.contact, *vars(sample.points).values(), *vars(entries).values()),
                *(model.vertices_m, model.faces, model.part),
            )
            for array in arrays:
                found.update(b"" if array is None else np.ascontiguousarray(array).data)
        return found.hexdigest()

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


def batches(
    dataset: HoiDataset, size: int, seed: int, wanted: Wanted = Wanted(), start: int = 0
) -> Iterator[list[tuple[int, ClipBatch]]]:
    """Endless steps of about ``size`` clips, from step ``start`` on; each the parts asked for, with their numbers.

    Every epoch has a new order and meets every clip once. All that is drawn comes from (seed, epoch) or (seed, step,
    part), so that a training that goes on finds what it would have found.
    """
    lengths = [min(dataset.whole(clip_id).length, dataset.max_frames) for clip_id in dataset.ids]
    augmentation = Augmentation(dataset, wanted.augmented_copies)
    for step, (epoch, rows) in enumerate(_plan(lengths, size, seed), 1):
        if step > start:
            dataset.set_epoch(epoch)
            parts = {part: rows[part :: wanted.of] or rows[:1] for part in wanted.parts}
            yield [
                (part, _collated([dataset[row] for row in own], wanted, (seed, step, part), augmentation))
                for part, own in parts.items()
            ]


def _collated(
    samples: list[ClipSample],
    wanted: Wanted,
    drawn_from: tuple[int, int, int],
    augmentation: Augmentation,
) -> ClipBatch:
    if augmentation.count:
        numbers = np.random.default_rng([*drawn_from, 2]).integers(0, augmentation.count + 1, len(samples)).tolist()
        samples = [augmentation.copy_of(one.clip_id, n) if n else one for one, n in zip(samples, numbers, strict=True)]
    random = np.random.default_rng(drawn_from)
    lengths = [sample.length for sample in samples]
    sight = Sight.drawn(lengths, wanted.frames, wanted.entries, random) if wanted.frames else None
    return collate(samples, sight)


def _plan(lengths: list[int], size: int, seed: int) -> Iterator[tuple[int, list[int]]]:
    """Epoch and clips of every step. Clips of like length share a batch, which saves padding: within each interval of a
    few batches they are sorted."""
    for epoch in itertools.count():
        random = np.random.default_rng([seed, epoch])
        for window in _split(random.permutation(len(lengths)).tolist(), size * BUCKET_BATCHES):
            groups = _split(sorted(window, key=lambda row: (lengths[row], row)), size)
            for number in random.permutation(len(groups)):
                yield epoch, groups[number]


def _split(items: list[Item], size: int) -> list[list[Item]]:
    """The items in order, in as many nearly equal parts as come closest to ``size`` each."""
    parts = max(1, round(len(items) / size))
    edges = [len(items) * part // parts for part in range(parts + 1)]
    return [items[start:stop] for start, stop in pairwise(edges)]


def any_form(batch: ClipBatch, generator: torch.Generator) -> Tensor:
    """(B, 512) features of one of the four sentences of each clip, drawn evenly."""
    form = torch.randint(batch.text.shape[1], (len(batch),), generator=generator)
    return batch.text[torch.arange(len(batch), device=batch.text.device), send(form, batch.text.device)]
