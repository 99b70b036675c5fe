"""What the report shows of one dataset: which held-out clips, and what the models make of their sentences."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from hoidata.annotation.encoders import Identity
from hoidata.clips.clip import SIDES, Clip
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import FILE_NAME, Checkpoint, load_checkpoint
from models.text2hoi.contact import ContactModel
from models.text2hoi.generation import MODELS, GeneratedMotion, generate
from pipelines.pages.surface import ContactPaint

CONTACT_DRAWS = 32


@dataclass(frozen=True)
class ContactExample:
    """One test clip's contact map beside the mean of 32 predicted ones."""

    clip: Clip
    sentence: str
    truth: ContactPaint
    predicted: ContactPaint


def shown_ids(annotated: AnnotatedStore, count: int) -> list[str]:
    """Up to ``count`` test clips (validation, then training, where there are none), of different objects first."""
    ids = next((ids for split in ("test", "validation", "train") if (ids := annotated.split_ids(split))), [])
    first_of_object = list({annotated.object_key(clip_id): clip_id for clip_id in reversed(ids)}.values())[::-1]
    rest = [clip_id for clip_id in ids if clip_id not in first_of_object]
    return (first_of_object + rest)[:count]


def true_contact(annotated: AnnotatedStore, clip_id: str) -> ContactPaint:
    """Points any hand touches in any frame of the clip."""
    points = annotated.points(annotated.object_key(clip_id))
    return ContactPaint(points.points_m, points.part, annotated.contact(clip_id).astype(np.float64))


def contact_examples(annotated: AnnotatedStore, folder: Path, ids: list[str], seed: int) -> list[ContactExample]:
    """Truth and prediction for each clip id, from the contact checkpoint in ``folder``."""
    checkpoint = load_checkpoint(folder, "contact")
    return [_contact_example(annotated, checkpoint, clip_id, seed) for clip_id in ids]


@dataclass
class StoredEncoder:
    """Features (sentence, 512) an annotated dataset already holds, as an encoder: it knows no other sentence."""

    identity: Identity
    sentences: tuple[str, ...]
    features: np.ndarray

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        """(sentence, 512) float32. Raises ValueError for a sentence it does not hold."""
        return self.features[[self.sentences.index(sentence) for sentence in sentences]]


def generated_example(
    annotated: AnnotatedStore, checkpoints: Path, hands: HandPair, clip_id: str, seed: int
) -> GeneratedMotion:
    """A motion for the first sentence and the object of a clip, by the four models in ``checkpoints``."""
    sentences, words = annotated.sentences(clip_id), annotated.clip(clip_id).object_words
    encoder = StoredEncoder(annotated.encoder_identity, sentences, annotated.text_features(clip_id))
    model = annotated.object_model(annotated.object_key(clip_id))
    return generate(sentences[0], model, checkpoints, hands, encoder, seed, object_words=words)


def is_trained(checkpoints: Path) -> bool:
    """Whether all four models are there."""
    return all((checkpoints / model / FILE_NAME).is_file() for model in MODELS)


def _contact_example(annotated: AnnotatedStore, checkpoint: Checkpoint, clip_id: str, seed: int) -> ContactExample:
    network = checkpoint.network
    assert isinstance(network, ContactModel)
    points = annotated.points(annotated.object_key(clip_id))
    active_hands = [annotated.hand_type(clip_id) in (side, "both") for side in SIDES]
    probabilities = network.sample(
        torch.from_numpy(points.points_m)[None],
        torch.from_numpy(annotated.text_features(clip_id)[:1]),
        torch.tensor([active_hands]),
        CONTACT_DRAWS,
        torch.Generator().manual_seed(seed),
    )
    predicted = ContactPaint(points.points_m, points.part, probabilities[0].mean(0).double().numpy())
    sentence = annotated.sentences(clip_id)[0]
    return ContactExample(annotated.clip(clip_id), sentence, true_contact(annotated, clip_id), predicted)
