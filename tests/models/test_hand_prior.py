"""The prior of the hand choice is counted on the training part alone."""

import pytest

from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import AnnotatedStore
from models.common.corpus import Corpus


@pytest.fixture
def counts(annotated: AnnotatedStore) -> dict:
    return Corpus.of(annotated, seed=0).facts(load_embedded_hands())["hand_types"]


def test_hands_are_counted_on_training_clips_only(annotated: AnnotatedStore, counts: dict) -> None:
    of_part = {
        part: [annotated.hand_type(clip_id) for clip_id in annotated.ids(part)]
        for part in ("train", "validation", "test")
    }
    assert counts == {hand: of_part["train"].count(hand) for hand in ("left", "right", "both")}
    everywhere = [hand for hands in of_part.values() for hand in hands]
    with_validation = of_part["train"] + of_part["validation"]
    for others in (everywhere, with_validation):
        assert counts != {hand: others.count(hand) for hand in ("left", "right", "both")}
