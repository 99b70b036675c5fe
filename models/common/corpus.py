"""Clips for training: the train and validation splits, batches in a reproducible order, and facts for checkpoints."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from hoidata.annotation.vocabulary import Vocabulary
from hoidata.batches.dataset import ClipBatch, ClipSample, Crop, HoiDataset, collate
from hoidata.batches.frame_selection import FrameSelection
from hoidata.devices import send
from hoidata.files import canonical_json, sha256_bytes
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore
from models.common.augmentation import Augmentation

BUCKET_BATCHES = 4
Item = TypeVar("Item")
HAND_TYPES = ("left", "right", "both")


@dataclass(frozen=True)
class BatchSpec:
    """What batches contain."""

    frames: int = 0  # selected frames per clip, for losses of geometry (``FrameSelection``)
    entries: int = 0  # distance entries per batch, for losses of geometry
    parts: Sequence[int] = (0,)  # numbers of the micro-batches of this process
    of: int = 1  # micro-batches of a batch, of all processes
    augmented_copies: int = 0  # per clip, in addition to the clip (``Augmentation``)


@dataclass(frozen=True)
class Corpus:
    """Training and validation clips of one dataset; the test split is not even opened."""

    annotated: AnnotatedStore
    train: HoiDataset
    validation: HoiDataset

    @classmethod
    def of(cls, annotated: AnnotatedStore, seed: int, crop: Crop = "random") -> "Corpus":
        """crop: of training clips that are too long; long validation clips are cut to their first frames."""
        train = HoiDataset(annotated, "train", crop=crop, seed=seed)
        return cls(annotated, train, HoiDataset(annotated, "validation", crop="start"))

    @property
    def held_out(self) -> list[ClipSample]:
        """Validation clips; may be empty."""
        return list(self.validation)

    def digest(self) -> str:
        """SHA-256 of everything that training and validation read from clips: arrays, sentences and meshes."""
        digest, subsets = sha256(), (self.train, self.validation)
        for sample in itertools.chain.from_iterable(map(subset.whole, subset.ids) for subset in subsets):
            model, entries = sample.object_model, sample.distances
            words = (sample.clip_id, sample.hand_type, sample.verb, *sample.sentences, len(sample.object))
            digest.update(canonical_json(words).encode())
            arrays = (
                *(sample.hands, sample.object, sample.joints_m, sample.valid, sample.betas, sample.template_m),
                *(sample.text, sample.contact, *vars(sample.points).values(), *vars(entries).values()),
                *(model.vertices_m, model.faces, model.part),
            )
            for array in arrays:
                digest.update(b"" if array is None else np.ascontiguousarray(array).data)
        return digest.hexdigest()

    def facts(self, hands: HandPair) -> dict[str, Any]:
        """What a checkpoint stores about its clips."""
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
    dataset: HoiDataset, size: int, seed: int, spec: BatchSpec = BatchSpec(), start: int = 0
) -> Iterator[list[tuple[int, ClipBatch]]]:
    """Endless batches of about ``size`` clips, from step ``start``; each as micro-batches with their numbers.

    Every epoch has a new order and contains every clip once. Random numbers depend on (seed, epoch) or (seed, step,
    part), so that a resumed training gets the same batches.
    """
    lengths = [min(dataset.whole(clip_id).length, dataset.max_frames) for clip_id in dataset.ids]
    augmentation = Augmentation(dataset, spec.augmented_copies)
    for step, (epoch, indices) in enumerate(_plan(lengths, size, seed), 1):
        if step > start:
            dataset.set_epoch(epoch)
            parts = {part: indices[part :: spec.of] or indices[:1] for part in spec.parts}
            yield [
                (part, _collated([dataset[index] for index in part_indices], spec, (seed, step, part), augmentation))
                for part, part_indices in parts.items()
            ]


def _collated(
    samples: list[ClipSample], spec: BatchSpec, seed: tuple[int, int, int], augmentation: Augmentation
) -> ClipBatch:
    if augmentation.count:
        numbers = np.random.default_rng([*seed, 2]).integers(0, augmentation.count + 1, len(samples)).tolist()
        samples = [
            augmentation.copy_of(clip.clip_id, n) if n else clip for clip, n in zip(samples, numbers, strict=True)
        ]
    random = np.random.default_rng(seed)
    lengths = [sample.length for sample in samples]
    sight = FrameSelection.drawn(lengths, spec.frames, spec.entries, random) if spec.frames else None
    return collate(samples, sight)


def _plan(lengths: list[int], size: int, seed: int) -> Iterator[tuple[int, list[int]]]:
    """Epoch and clip indices of every step. Within a few batches, clips are sorted by length, which saves padding."""
    for epoch in itertools.count():
        random = np.random.default_rng([seed, epoch])
        for window in _split(random.permutation(len(lengths)).tolist(), size * BUCKET_BATCHES):
            groups = _split(sorted(window, key=lambda index: (lengths[index], index)), size)
            for number in random.permutation(len(groups)):
                yield epoch, groups[number]


def _split(items: list[Item], size: int) -> list[list[Item]]:
    """The items in order, in nearly equal parts whose size is closest to ``size``."""
    parts = max(1, round(len(items) / size))
    edges = [len(items) * part // parts for part in range(parts + 1)]
    return [items[start:stop] for start, stop in pairwise(edges)]


def any_form(batch: ClipBatch, generator: torch.Generator) -> Tensor:
    """(B, 512) features of one of the four sentences of each clip, chosen uniformly."""
    form = torch.randint(batch.text.shape[1], (len(batch),), generator=generator)
    return batch.text[torch.arange(len(batch), device=batch.text.device), send(form, batch.text.device)]
