"""The verb classifier: the verb of a sentence, also for a new pair of verb and noun."""

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
from models.text2hoi.verb_classifier import (
    DEFAULT_SHRINKAGE,
    RIDGES,
    SHARPNESSES,
    Sentences,
    VerbClassifier,
    choose_shrinkage,
    fit_verb_classifiers,
)

SIZE, VERBS, NOUNS, FORMS = 96, 6, 8, 3


def written(pairs: list[tuple[int, int]], noun_scale: float = 3.0, noise: float = 0.3) -> Sentences:
    """Features of sentences for pairs of verb and noun: ``noun_scale`` times the noun plus the verb, with ``noise``."""
    random = np.random.default_rng(0)
    verbs, nouns = random.normal(size=(VERBS, SIZE)), noun_scale * random.normal(size=(NOUNS, SIZE))
    repeated_pairs = [(verb, noun) for verb, noun in pairs for _ in range(FORMS)]
    text = np.array([verbs[verb] + nouns[noun] for verb, noun in repeated_pairs]) + noise * random.normal(
        size=(len(repeated_pairs), SIZE)
    )
    text = scaled_text(torch.from_numpy(text)).numpy()
    return Sentences(text, *np.array(repeated_pairs).T, np.full(len(repeated_pairs), 1 / FORMS))


def fitted(training: Sentences) -> VerbClassifier:
    """A classifier in double precision, fitted."""
    classifier = VerbClassifier(training.text.shape[1], training.n_verbs).double()
    classifier.fit(training)
    return classifier


def classified(training: Sentences, test: Sentences) -> np.ndarray:
    """(S, V) probabilities of verbs."""
    return fitted(training).probabilities(torch.from_numpy(test.text)).numpy()


def nearest_verb(training: Sentences, test: Sentences) -> np.ndarray:
    return training.verb[((test.text[:, None] - training.text) ** 2).sum(-1).argmin(1)]


ALL_PAIRS = list(product(range(VERBS), range(NOUNS)))
NEW_PAIRS = [(verb, noun) for verb, noun in ALL_PAIRS if (verb + noun) % 3 == 0]
TRAINING_PAIRS = [pair for pair in ALL_PAIRS if pair not in NEW_PAIRS]


def test_new_pairs_are_classified_though_their_nearest_sentences_have_other_verbs() -> None:
    sentences = written([*TRAINING_PAIRS, *NEW_PAIRS])
    is_new = np.arange(len(sentences.verb)) >= FORMS * len(TRAINING_PAIRS)
    training, test = sentences.take(~is_new), sentences.take(is_new)
    probability = classified(training, test)
    assert (probability.argmax(1) == test.verb).mean() > 0.95
    assert (nearest_verb(training, test) == test.verb).mean() < 0.2
    np.testing.assert_allclose(probability.sum(1), 1, rtol=1e-5)


def test_verbs_of_real_sentences_are_classified_with_the_default_encoder() -> None:
    verbs, nouns = ("push", "lift", "pour from", "shake", "inspect"), ("mug", "flashlight", "teapot", "cube", "pan")
    pairs = list(product(range(len(verbs)), range(len(nouns))))
    texts = [f"{verbs[verb].capitalize()} a {nouns[noun]} with the right hand." for verb, noun in pairs]
    text = scaled_text(torch.from_numpy(load_encoder("use").encode(texts)).double()).numpy()
    sentences = Sentences(text, *np.array(pairs).T, np.ones(len(pairs)))
    is_new = np.array([verb == noun for verb, noun in pairs])
    probability = classified(sentences.take(~is_new), sentences.take(is_new))
    assert probability.argmax(1).tolist() == list(range(len(verbs)))


def test_the_classifier_is_a_weighted_ridge_regression() -> None:
    training = written(TRAINING_PAIRS[:12])
    weight = training.weight * np.random.default_rng(1).uniform(0.5, 2, len(training.weight))
    classifier = fitted(replace(training, weight=weight))
    ridge, _ = choose_shrinkage(replace(training, weight=weight))
    weights, one_hot = weight / weight.sum(), np.eye(training.n_verbs)[training.verb]
    centred, residual = training.text - weights @ training.text, one_hot - weights @ one_hot
    mean_variance = (weights[:, None] * centred**2).sum() / SIZE
    # The same problem with the penalty as additional equations, by another solver.
    inputs = np.concatenate((np.sqrt(weights)[:, None] * centred, np.sqrt(ridge * mean_variance) * np.eye(SIZE)))
    targets = np.concatenate((np.sqrt(weights)[:, None] * residual, np.zeros((SIZE, training.n_verbs))))
    np.testing.assert_allclose(classifier.weights.numpy(), np.linalg.lstsq(inputs, targets)[0], atol=1e-6)


def held_out_loss(training: Sentences, ridge: float, sharpness: float) -> float:
    """Leave-one-noun-out cross-entropy, from the normal equations."""
    total = 0.0
    for noun in range(NOUNS):
        held_out, fitted = training.take(training.noun == noun), training.take(training.noun != noun)
        weights, one_hot = np.diag(fitted.weight / fitted.weight.sum()), np.eye(VERBS)[fitted.verb]
        mean, prior = (weights @ fitted.text).sum(0), (weights @ one_hot).sum(0)
        covariance = (fitted.text - mean).T @ weights @ (fitted.text - mean)
        penalty = ridge * np.trace(covariance) / SIZE * np.eye(SIZE)
        layer = np.linalg.solve(covariance + penalty, (fitted.text - mean).T @ weights @ (one_hot - prior))
        for text, verb, weight in zip(held_out.text, held_out.verb, held_out.weight, strict=True):
            odds = np.exp(sharpness * ((text - mean) @ layer + prior))
            total -= weight * np.log(odds[verb] / odds.sum())
    return total


@pytest.mark.parametrize("noun_scale", [0.0, 3.0, 10.0])
def test_shrinkage_is_chosen_by_leave_one_noun_out_cross_validation(noun_scale: float) -> None:
    training = written(TRAINING_PAIRS, noun_scale)
    losses = {pair: held_out_loss(training, *pair) for pair in product(RIDGES, SHARPNESSES)}
    assert choose_shrinkage(training) == min(losses, key=lambda pair: losses[pair])


def test_shrinkage_depends_on_the_scale_of_nouns() -> None:
    assert choose_shrinkage(written(TRAINING_PAIRS, 0.0)) != choose_shrinkage(written(TRAINING_PAIRS, 10.0))


def test_probabilities_have_the_chosen_sharpness_and_ignore_the_length_of_features() -> None:
    training = written(TRAINING_PAIRS)
    classifier = fitted(training)
    odds = np.exp(
        choose_shrinkage(training)[1]
        * ((training.text - classifier.mean.numpy()) @ classifier.weights.numpy() + classifier.offset.numpy())
    )
    for length in (0.1, 1.0, 30.0):
        probability = classifier.probabilities(torch.from_numpy(length * training.text)).numpy()
        np.testing.assert_allclose(probability, odds / odds.sum(1, keepdims=True), rtol=1e-6)


def uncertain_sentences() -> tuple[Sentences, Sentences]:
    """Training sentences, and noisy ones with new pairs of verb and noun; a few are classified with low confidence."""
    sentences = written([*TRAINING_PAIRS, *NEW_PAIRS], noise=1.5)
    is_new = np.arange(len(sentences.verb)) >= FORMS * len(TRAINING_PAIRS)
    return sentences.take(~is_new), sentences.take(is_new)


def test_a_probable_verb_is_raised_to_the_confidence_of_training_sentences() -> None:
    training, test = uncertain_sentences()
    confidence = classified(training, training)[np.arange(len(training.verb)), training.verb]
    plain, sharpened = classified(training, test), fitted(training).eval()(torch.from_numpy(test.text)).numpy()
    likely = plain.max(1) > 0.5
    lowest = sharpened[likely].max(1).min()
    assert (confidence < lowest).mean() == pytest.approx(0.05, abs=1 / len(confidence))
    np.testing.assert_array_equal(sharpened.argmax(1), plain.argmax(1))
    np.testing.assert_allclose(sharpened[likely].max(1), np.maximum(plain.max(1), lowest)[likely])
    unchanged = (plain.max(1) > lowest) | ~likely
    assert {(plain[confidence].max() > 0.5, bool(unchanged[confidence])) for confidence in range(len(plain))} == {
        (True, True),
        (True, False),
        (False, True),
    }
    np.testing.assert_array_equal(sharpened[unchanged], plain[unchanged])
    # The other verbs keep their relative probabilities.
    others = np.arange(VERBS) != plain.argmax(1)[:, None]
    relative = [
        (probability / np.where(others, probability, 0).sum(1, keepdims=True))[others]
        for probability in (sharpened, plain)
    ]
    np.testing.assert_allclose(*relative)
    np.testing.assert_allclose(sharpened.sum(1), 1)


def test_probabilities_are_not_sharpened_in_training() -> None:
    training, test = uncertain_sentences()
    classifier, text = fitted(training), torch.from_numpy(test.text)
    plain = classifier.probabilities(text)
    assert torch.equal(classifier.train()(text), plain)
    assert not torch.allclose(classifier.eval()(text), plain)


def test_shrinkage_is_the_default_if_no_verb_occurs_with_two_nouns() -> None:
    assert choose_shrinkage(written([(0, 0), (1, 1), (2, 2)])) == DEFAULT_SHRINKAGE
    assert choose_shrinkage(written([(0, 0), (1, 0)])) == DEFAULT_SHRINKAGE


def test_feature_length_and_repeated_clips_change_nothing(annotated_root: Path) -> None:
    clips = list(HoiDataset(load_annotated(annotated_root), "train", crop="start"))
    once, repeated = Sentences.of(clips), Sentences.of([*clips, clips[0], clips[0]])
    np.testing.assert_array_equal(once.text, repeated.text)
    np.testing.assert_array_equal(once.weight, repeated.weight)
    np.testing.assert_allclose(np.linalg.norm(once.text, axis=1), 512**0.5)
    longer = Sentences.of([replace(clip, text=clip.text * 7) for clip in clips])
    np.testing.assert_allclose(once.text, longer.text, rtol=1e-6)
    assert once.n_verbs == len({clip.verb for clip in clips})
    pairs = {(clip.verb, clip.object_words) for clip in clips}
    assert once.weight.sum() == pytest.approx(len(pairs))
    for verb, noun in zip(once.verb, once.noun, strict=True):
        assert once.weight[(once.verb == verb) & (once.noun == noun)].sum() == pytest.approx(1)


def test_clips_without_verbs_give_a_constant_input(annotated_root: Path) -> None:
    clips = [replace(clip, verb=None) for clip in HoiDataset(load_annotated(annotated_root), "train", crop="start")]
    sentences = Sentences.of(clips)
    assert sentences.n_verbs == 1
    network = LengthModel(LengthConfig(text_input="verb_probabilities", verb_count=sentences.n_verbs, width=8))
    fit_verb_classifiers(network, sentences)
    noise = torch.zeros(2, 64)
    lengths = network.moments(torch.randn(2, 512), torch.ones(2, 2), noise)[0]
    assert lengths[0] == lengths[1]


def test_training_does_not_change_the_classifier_and_stores_it(annotated_root: Path, trained: Path) -> None:
    sentences = Sentences.of(HoiDataset(load_annotated(annotated_root), "train", crop="start"))
    for name in ("diffusion", "length"):
        network = load_checkpoint(trained / name, load_network(name)).network
        assert isinstance(network, DiffusionModel | LengthModel)
        classifiers = [part for part in network.modules() if isinstance(part, VerbClassifier)]
        assert len(classifiers) == 1
        fresh = VerbClassifier(512, sentences.n_verbs)
        fresh.fit(sentences)
        assert {key: value.tolist() for key, value in classifiers[0].state_dict().items()} == {
            key: value.tolist() for key, value in fresh.state_dict().items()
        }
