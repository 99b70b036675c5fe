"""Encoded motions: the features of predicted and recorded motions that feature metrics compare.

Encoders are injected; this package imports no model. The encoding of a motion depends on that motion alone.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from typing import NamedTuple, Protocol

import numpy as np

from hoidata.clips.clip import SIDES, Side
from hoidata.metrics.pair import Motion, acting_sides
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.store import Store

MOTIONS_PER_BATCH = 128
UNKNOWN = -1


class Encoding(NamedTuple):
    """The output of an encoder for a batch of motions."""

    features: np.ndarray  # (motion, F) float64
    logits: np.ndarray  # (motion, K); K = 0 for an encoder without labels


class Encoder(Protocol):
    """A function from motions to features, learned or not."""

    @property
    def name(self) -> str:
        """The suffix of the metrics that use this encoder."""
        ...

    @property
    def digest(self) -> str:
        """SHA-256 of weights and configuration."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """The verbs of the logits, in order; empty for an encoder that does not classify."""
        ...

    def encode(self, motions: Sequence[Motion], sides: Sequence[tuple[Side, ...]]) -> Encoding:
        """Encode motions. ``sides`` are the acting hands of each; the other hands are ignored."""
        ...

    def encode_text(self, text: np.ndarray) -> np.ndarray | None:
        """(clip, F) features of sentences (clip, 512) in the feature space of motions; None for a classifier."""


@dataclass(frozen=True)
class EncodedSet:
    """Encodings of M motions of one encoder, with facts of the clips they belong to."""

    encoder: str  # name of the encoder
    digest: str  # of the encoder
    labels: tuple[str, ...]  # of the encoder
    features: np.ndarray  # (M, F)
    logits: np.ndarray  # (M, K)
    label: np.ndarray  # (M,) index into ``labels``, ``UNKNOWN`` for a verb that was not trained
    clip: np.ndarray  # (M,) index of the clip, shared by sets that are compared
    sample: np.ndarray  # (M,) number of the motion among those of its clip
    prompt: np.ndarray  # (M,) verb, object and hand in words: equal prompts count as the same sentence
    object: np.ndarray  # (M,) name of the object
    group: np.ndarray  # (M,) source sequence of the clip
    text: np.ndarray | None = None  # (M, F) the clip's sentence in the feature space of motions

    def __len__(self) -> int:
        return len(self.features)

    def take(self, rows: np.ndarray) -> "EncodedSet":
        """The motions ``rows``, in that order."""
        arrays = {item.name: getattr(self, item.name) for item in fields(self)}
        return replace(self, **{name: array[rows] for name, array in arrays.items() if isinstance(array, np.ndarray)})

    def repetitions(self) -> list["EncodedSet"]:
        """One set per sample number: the first motions of all clips, the second motions, and so on."""
        return [self.take(np.flatnonzero(self.sample == number)) for number in np.unique(self.sample)]


class EncoderInput(NamedTuple):
    """One motion to encode."""

    motion: Motion
    sides: tuple[Side, ...]  # the acting hands
    clip: int  # index of its clip
    sample: int  # number among the motions of its clip


def encode_sets(
    encoders: Sequence[Encoder], inputs: Iterable[EncoderInput], annotated: AnnotatedStore, ids: Sequence[str]
) -> list[EncodedSet]:
    """Encode motions with every encoder, in batches; one set per encoder, none without motions.

    Args:
        inputs: a stream of motions.
        ids: the clips of the dataset ``annotated`` that ``EncoderInput.clip`` indexes.
    """
    numbers: list[tuple[int, int]] = []
    batches: list[list[Encoding]] = [[] for _ in encoders]
    stream = iter(inputs)
    while chunk := list(islice(stream, MOTIONS_PER_BATCH)):
        numbers += [(item.clip, item.sample) for item in chunk]
        motions, sides = [item.motion for item in chunk], [item.sides for item in chunk]
        for encodings, encoder in zip(batches, encoders, strict=True):
            encodings.append(encoder.encode(motions, sides))
    clip, sample = np.array(numbers, dtype=np.int64).reshape(-1, 2).T
    return [
        _encoded(encoder, encodings, clip, sample, annotated, ids)
        for encoder, encodings in zip(encoders, batches, strict=True)
        if encodings
    ]


def _encoded(
    encoder: Encoder,
    encodings: list[Encoding],
    clip: np.ndarray,
    sample: np.ndarray,
    annotated: AnnotatedStore,
    ids: Sequence[str],
) -> EncodedSet:
    sequences = annotated.store.sequences.loc[list(ids)]
    verbs, hands = [annotated.verb(clip_id) for clip_id in ids], [annotated.hand_type(clip_id) for clip_id in ids]
    prompt = [" | ".join(map(str, words)) for words in zip(verbs, sequences["object_words"], hands, strict=True)]
    label = [encoder.labels.index(verb) if verb in encoder.labels else UNKNOWN for verb in verbs]
    text = encoder.encode_text(np.stack([annotated.text_embedding(clip_id)[0] for clip_id in ids]))
    return EncodedSet(
        encoder=encoder.name,
        digest=encoder.digest,
        labels=encoder.labels,
        features=np.concatenate([batch.features for batch in encodings]),
        logits=np.concatenate([batch.logits for batch in encodings]),
        label=np.array(label)[clip],
        clip=clip,
        sample=sample,
        prompt=np.array(prompt)[clip],
        object=sequences["object"].to_numpy(str)[clip],
        group=sequences["sequence"].to_numpy(str)[clip],
        text=None if text is None else text[clip],
    )


def recorded_motions(annotated: AnnotatedStore, ids: Sequence[str]) -> Iterator[EncoderInput]:
    """The recorded clips as encoder inputs, one motion each."""
    for number, clip_id in enumerate(ids):
        sides = acting_sides(annotated.hand_type(clip_id))
        yield EncoderInput(stored_motion(annotated.store, clip_id), sides, number, 0)


def stored_motion(store: Store, clip_id: str) -> Motion:
    """A clip of a store with the joints of its hands."""
    joints: dict[Side, np.ndarray] = {side: store.joints(clip_id, side) for side in SIDES}
    return Motion(store.clip(clip_id, motion_only=True), joints, store.hand_pair())
