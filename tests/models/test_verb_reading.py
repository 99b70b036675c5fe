"""What a network is told of a sentence: its verb, also where verb and noun were never in one sentence before."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from hoidata.annotation.encoders import load_encoder
from hoidata.batches.dataset import HoiDataset
from hoidata.store.annotated import load_annotated
from models.common.checkpoints import load_checkpoint
from models.common.features import scaled_text
from models.registry import load_network
from models.text2hoi.diffusion import DiffusionModel
from models.text2hoi.length import LengthConfig, LengthModel
from models.text2hoi.verb_reading import (
    RIDGES,
    SHARPNESSES,
    USUAL,
    Sentences,
    VerbReading,
    choose_shrinkage,
    learn_verbs,
)

SIZE, VERBS, NOUNS, FORMS = 96, 6, 8, 3


def written(pairs: list[tuple[int, int]], noun_m: float = 3.0, odd: float = 0.3) -> Sentences:
    """Features of a few sentences for each pair of verb and noun: the noun is louder than the verb, all are ``odd``."""
    draws = np.random.default_rng(0)
    verbs, nouns = draws.normal(size=(VERBS, SIZE)), noun_m * draws.normal(size=(NOUNS, SIZE))
    rows = [(verb, noun) for verb, noun in pairs for _ in range(FORMS)]
    text = np.array([verbs[verb] + nouns[noun] for verb, noun in rows]) + odd * draws.normal(size=(len(rows), SIZE))
    text = scaled_text(torch.from_numpy(text)).numpy()
    return Sentences(text, *np.array(rows).T, np.full(len(rows), 1 / FORMS))


def learnt(known: Sentences) -> VerbReading:
    """A reading of double precision, fitted."""
    reading = VerbReading(known.text.shape[1], known.n_verbs).double()
    reading.learn(known)
    return reading


def read(known: Sentences, asked: Sentences) -> np.ndarray:
    """(S, V) probabilities of verbs."""
    return learnt(known).read(torch.from_numpy(asked.text)).numpy()


def nearest_verb(known: Sentences, asked: Sentences) -> np.ndarray:
    return known.verb[((asked.text[:, None] - known.text) ** 2).sum(-1).argmin(1)]


EVERY = list(product(range(VERBS), range(NOUNS)))
HELD_OUT = [(verb, noun) for verb, noun in EVERY if (verb + noun) % 3 == 0]
TOGETHER = [pair for pair in EVERY if pair not in HELD_OUT]


def test_verbs_are_read_where_the_nearest_sentence_has_another_one() -> None:
    both = written([*TOGETHER, *HELD_OUT])
    new = np.arange(len(both.verb)) >= FORMS * len(TOGETHER)
    known, asked = both.take(~new), both.take(new)
    found = read(known, asked)
    assert (found.argmax(1) == asked.verb).mean() > 0.95
    assert (nearest_verb(known, asked) == asked.verb).mean() < 0.2
    np.testing.assert_allclose(found.sum(1), 1, rtol=1e-5)


def test_verbs_of_sentences_are_read_by_the_encoder_that_comes_with_us() -> None:
    verbs, nouns = ("push", "lift", "pour from", "shake", "inspect"), ("mug", "flashlight", "teapot", "cube", "pan")
    pairs = list(product(range(len(verbs)), range(len(nouns))))
    wording = [f"{verbs[verb].capitalize()} a {nouns[noun]} with the right hand." for verb, noun in pairs]
    text = scaled_text(torch.from_numpy(load_encoder("use").encode(wording)).double()).numpy()
    whole = Sentences(text, *np.array(pairs).T, np.ones(len(pairs)))
    new = np.array([verb == noun for verb, noun in pairs])
    found = read(whole.take(~new), whole.take(new))
    assert found.argmax(1).tolist() == list(range(len(verbs)))


def test_the_layer_is_a_ridge_regression_over_pairs_that_weigh_alike() -> None:
    known = written(TOGETHER[:12])
    weight = known.weight * np.random.default_rng(1).uniform(0.5, 2, len(known.weight))
    reading = learnt(replace(known, weight=weight))
    ridge, _ = choose_shrinkage(replace(known, weight=weight))
    share, wanted = weight / weight.sum(), np.eye(known.n_verbs)[known.verb]
    away, left = known.text - share @ known.text, wanted - share @ wanted
    mean_variance = (share[:, None] * away**2).sum() / SIZE
    # The same problem with the penalty as further rows, by another solver.
    rows = np.concatenate((np.sqrt(share)[:, None] * away, np.sqrt(ridge * mean_variance) * np.eye(SIZE)))
    targets = np.concatenate((np.sqrt(share)[:, None] * left, np.zeros((SIZE, known.n_verbs))))
    np.testing.assert_allclose(reading.weights.numpy(), np.linalg.lstsq(rows, targets)[0], atol=1e-6)


def left_out_loss(known: Sentences, ridge: float, sharpness: float) -> float:
    """Cross-entropy of sentences of each noun by the plain normal equations of those of the others."""
    total = 0.0
    for noun in range(NOUNS):
        some, rest = known.take(known.noun == noun), known.take(known.noun != noun)
        share, wanted = np.diag(rest.weight / rest.weight.sum()), np.eye(VERBS)[rest.verb]
        middle, prior = (share @ rest.text).sum(0), (share @ wanted).sum(0)
        spread = (rest.text - middle).T @ share @ (rest.text - middle)
        penalty = ridge * np.trace(spread) / SIZE * np.eye(SIZE)
        layer = np.linalg.solve(spread + penalty, (rest.text - middle).T @ share @ (wanted - prior))
        for text, verb, weight in zip(some.text, some.verb, some.weight, strict=True):
            odds = np.exp(sharpness * ((text - middle) @ layer + prior))
            total -= weight * np.log(odds[verb] / odds.sum())
    return total


@pytest.mark.parametrize("noun_m", [0.0, 3.0, 10.0])
def test_shrinkage_is_the_best_on_sentences_whose_noun_was_left_out(noun_m: float) -> None:
    known = written(TOGETHER, noun_m)
    every = {both: left_out_loss(known, *both) for both in product(RIDGES, SHARPNESSES)}
    assert choose_shrinkage(known) == min(every, key=lambda both: every[both])


def test_nouns_that_say_nothing_ask_for_another_shrinkage_than_loud_ones() -> None:
    assert choose_shrinkage(written(TOGETHER, 0.0)) != choose_shrinkage(written(TOGETHER, 10.0))


def test_probabilities_are_as_sharp_as_was_chosen_whatever_the_length_of_features() -> None:
    known = written(TOGETHER)
    reading = learnt(known)
    odds = np.exp(
        choose_shrinkage(known)[1]
        * ((known.text - reading.mean.numpy()) @ reading.weights.numpy() + reading.offset.numpy())
    )
    for length in (0.1, 1.0, 30.0):
        found = reading.read(torch.from_numpy(length * known.text)).numpy()
        np.testing.assert_allclose(found, odds / odds.sum(1, keepdims=True), rtol=1e-6)


def doubted() -> tuple[Sentences, Sentences]:
    """Sentences to learn from, and some with new pairs of verb and noun: of a few the verb is hardly read."""
    both = written([*TOGETHER, *HELD_OUT], odd=1.5)
    new = np.arange(len(both.verb)) >= FORMS * len(TOGETHER)
    return both.take(~new), both.take(new)


def test_a_likely_verb_is_told_as_surely_as_most_training_sentences_had_theirs() -> None:
    known, asked = doubted()
    own = read(known, known)[np.arange(len(known.verb)), known.verb]
    plain, told = read(known, asked), learnt(known).eval()(torch.from_numpy(asked.text)).numpy()
    likely = plain.max(1) > 0.5
    least = told[likely].max(1).min()
    assert (own < least).mean() == pytest.approx(0.05, abs=1 / len(own))
    np.testing.assert_array_equal(told.argmax(1), plain.argmax(1))
    np.testing.assert_allclose(told[likely].max(1), np.maximum(plain.max(1), least)[likely])
    as_read = (plain.max(1) > least) | ~likely
    assert {(plain[own].max() > 0.5, bool(as_read[own])) for own in range(len(plain))} == {
        (True, True),
        (True, False),
        (False, True),
    }
    np.testing.assert_array_equal(told[as_read], plain[as_read])
    # The verbs that a sentence is not told as keep their order and shares among each other.
    rest = np.arange(VERBS) != plain.argmax(1)[:, None]
    of_rest = [(kind / np.where(rest, kind, 0).sum(1, keepdims=True))[rest] for kind in (told, plain)]
    np.testing.assert_allclose(*of_rest)
    np.testing.assert_allclose(told.sum(1), 1)


def test_sentences_are_told_as_they_are_read_in_training() -> None:
    known, asked = doubted()
    reading, text = learnt(known), torch.from_numpy(asked.text)
    plain = reading.read(text)
    assert torch.equal(reading.train()(text), plain)
    assert not torch.allclose(reading.eval()(text), plain)


def test_verbs_that_have_a_noun_of_their_own_cannot_be_asked_for() -> None:
    assert choose_shrinkage(written([(0, 0), (1, 1), (2, 2)])) == USUAL
    assert choose_shrinkage(written([(0, 0), (1, 0)])) == USUAL


def test_how_long_features_are_and_how_often_a_clip_was_recorded_change_nothing(annotated_root: Path) -> None:
    clips = list(HoiDataset(load_annotated(annotated_root), "train", crop="start"))
    once, again = Sentences.of(clips), Sentences.of([*clips, clips[0], clips[0]])
    np.testing.assert_array_equal(once.text, again.text)
    np.testing.assert_array_equal(once.weight, again.weight)
    np.testing.assert_allclose(np.linalg.norm(once.text, axis=1), 512**0.5)
    longer = Sentences.of([replace(clip, text=clip.text * 7) for clip in clips])
    np.testing.assert_allclose(once.text, longer.text, rtol=1e-6)
    assert once.n_verbs == len({clip.verb for clip in clips})
    pairs = {(clip.verb, clip.object_words) for clip in clips}
    assert once.weight.sum() == pytest.approx(len(pairs))
    for verb, noun in zip(once.verb, once.noun, strict=True):
        assert once.weight[(once.verb == verb) & (once.noun == noun)].sum() == pytest.approx(1)


def test_clips_without_verbs_tell_nothing(annotated_root: Path) -> None:
    clips = [replace(clip, verb=None) for clip in HoiDataset(load_annotated(annotated_root), "train", crop="start")]
    nothing = Sentences.of(clips)
    assert nothing.n_verbs == 1
    network = LengthModel(LengthConfig(text_input="verbs", verbs=nothing.n_verbs, width=8))
    learn_verbs(network, nothing)
    noise = torch.zeros(2, 64)
    found = network.moments(torch.randn(2, 512), torch.ones(2, 2), noise)[0]
    assert found[0] == found[1]


def test_training_keeps_the_reading_it_began_with_and_stores_it(annotated_root: Path, trained: Path) -> None:
    sentences = Sentences.of(HoiDataset(load_annotated(annotated_root), "train", crop="start"))
    for name in ("diffusion", "length"):
        network = load_checkpoint(trained / name, load_network(name)).network
        assert isinstance(network, DiffusionModel | LengthModel)
        readings = [part for part in network.modules() if isinstance(part, VerbReading)]
        assert len(readings) == 1
        fresh = VerbReading(512, sentences.n_verbs)
        fresh.learn(sentences)
        assert {key: value.tolist() for key, value in readings[0].state_dict().items()} == {
            key: value.tolist() for key, value in fresh.state_dict().items()
        }
