"""Motions as an encoder sees them, and what is known of each: the ground of every figure that needs features.

An encoder is handed in; nothing here knows a network. What it says of a motion depends on that motion alone.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from typing import NamedTuple, Protocol

import numpy as np

from hoidata.actions.action import verb_of
from hoidata.clips.clip import SIDES, Side
from hoidata.metrics.pair import Motion, acting_sides
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.store import Store

MOTIONS_AT_ONCE = 128
UNKNOWN = -1


class Encoding(NamedTuple):
    """features: (motion, F) float64; logits: (motion, K), with K = 0 of an encoder that knows no labels."""

    features: np.ndarray
    logits: np.ndarray


class Encoder(Protocol):
    """Something learnt that turns motions into features.

    name: as it stands in the names of figures. digest: SHA-256 of its weights and configuration. labels: the
    verbs that its logits stand for, in their order; none of an encoder that tells no labels apart.
    """

    @property
    def name(self) -> str: ...
    @property
    def digest(self) -> str: ...
    @property
    def labels(self) -> tuple[str, ...]: ...

    def encode(self, motions: Sequence[Motion], sides: Sequence[tuple[Side, ...]]) -> Encoding:
        """Features and logits of motions of which only the hands ``sides`` act; others' numbers count nothing."""
        ...

    def encode_text(self, text: np.ndarray) -> np.ndarray | None:
        """(clip, F) features of sentences (clip, 512) in the space of the motions; None of a classifier."""
        ...


@dataclass(frozen=True)
class EncodedSet:
    """Features of motions, one row each, with what is known of the clip each was made for.

    features (M, F), logits (M, K). label (M,): index into the encoder's labels, ``UNKNOWN`` for a verb it never met.
    clip (M,): which clip, an index that is the same in sets that belong together. sample (M,): which of its motions.
    prompt (M,): verb, object and hand in words, what tells sentences apart; object (M,): name of the object. group
    (M,): source sequence of the clip. text (M, F): the clip's own sentence in the space of the motions, or None.
    """

    encoder: str
    digest: str
    labels: tuple[str, ...]
    features: np.ndarray
    logits: np.ndarray
    label: np.ndarray
    clip: np.ndarray
    sample: np.ndarray
    prompt: np.ndarray
    object: np.ndarray
    group: np.ndarray
    text: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.features)

    def take(self, rows: np.ndarray) -> "EncodedSet":
        """Some rows of it, in the order given."""
        arrays = {item.name: getattr(self, item.name) for item in fields(self)}
        return replace(self, **{name: array[rows] for name, array in arrays.items() if isinstance(array, np.ndarray)})

    def repetitions(self) -> list["EncodedSet"]:
        """The first motion of every clip, the second of every clip, and so on: each is one run of the experiment."""
        return [self.take(np.flatnonzero(self.sample == number)) for number in np.unique(self.sample)]


class Asked(NamedTuple):
    """One motion to encode. sides: the hands that act. clip: index of its clip; sample: which of its motions."""

    motion: Motion
    sides: tuple[Side, ...]
    clip: int
    sample: int


def encode_sets(
    encoders: Sequence[Encoder], asked: Iterable[Asked], annotated: AnnotatedStore, ids: Sequence[str]
) -> list[EncodedSet]:
    """One :class:`EncodedSet` per encoder of the motions asked, a few of which are in memory at a time.

    ids: the clips that ``Asked.clip`` counts, of the dataset ``annotated``.
    """
    rows, found = list[tuple[int, int]](), [list[Encoding]() for _ in encoders]
    stream = iter(asked)
    while chunk := list(islice(stream, MOTIONS_AT_ONCE)):
        rows += [(item.clip, item.sample) for item in chunk]
        motions, sides = [item.motion for item in chunk], [item.sides for item in chunk]
        for own, encoder in zip(found, encoders, strict=True):
            own.append(encoder.encode(motions, sides))
    clip, sample = np.array(rows, dtype=np.int64).reshape(-1, 2).T
    return [
        _encoded(encoder, own, clip, sample, annotated, ids)
        for encoder, own in zip(encoders, found, strict=True)
        if own
    ]


def _encoded(
    encoder: Encoder,
    parts: list[Encoding],
    clip: np.ndarray,
    sample: np.ndarray,
    annotated: AnnotatedStore,
    ids: Sequence[str],
) -> EncodedSet:
    known = annotated.store.sequences.loc[list(ids)]
    verbs, hands = [verb_of(annotated, clip_id) for clip_id in ids], [annotated.hand_type(clip_id) for clip_id in ids]
    prompt = [" | ".join(map(str, row)) for row in zip(verbs, known["object_words"], hands, strict=True)]
    label = [encoder.labels.index(verb) if verb in encoder.labels else UNKNOWN for verb in verbs]
    text = encoder.encode_text(np.stack([annotated.text_embedding(clip_id)[0] for clip_id in ids]))
    return EncodedSet(
        encoder.name,
        encoder.digest,
        encoder.labels,
        np.concatenate([part.features for part in parts]),
        np.concatenate([part.logits for part in parts]),
        np.array(label)[clip],
        clip,
        sample,
        np.array(prompt)[clip],
        known["object"].to_numpy(str)[clip],
        known["sequence"].to_numpy(str)[clip],
        None if text is None else text[clip],
    )


def recorded(annotated: AnnotatedStore, ids: Sequence[str]) -> Iterator[Asked]:
    """The recorded clips themselves, one motion each."""
    for number, clip_id in enumerate(ids):
        yield Asked(stored_motion(annotated.store, clip_id), acting_sides(annotated.hand_type(clip_id)), number, 0)


def stored_motion(store: Store, clip_id: str) -> Motion:
    """A clip of a store with the joints of its hands."""
    joints: dict[Side, np.ndarray] = {side: store.joints(clip_id, side) for side in SIDES}
    return Motion(store.clip(clip_id, motion_only=True), joints, store.hand_pair())
