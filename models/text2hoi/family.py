"""Text2HOI as a family, also without its refiner, and conditioned on another clip's sentence.

``diagnose`` measures contact maps and lengths of the networks on the test clips, with baselines. ``hoidata.metrics``
compares motions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from torch import Tensor

from hoidata.annotation.encoders import TextEncoder, load_encoder, refuse_other_encoder
from hoidata.annotation.wording import parsed_verb
from hoidata.batches.dataset import ClipSample, collate
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip
from hoidata.settings import build_config
from models.common.checkpoints import load_checkpoint
from models.common.contact_maps import best_threshold, mean_f1, mean_maps, true_maps
from models.common.family import Family, Figures, ReportsContact, Skipped, Sources
from models.common.predicting import first_sentence
from models.text2hoi.contact_training import (
    CONTACT,
    DEFAULT_THRESHOLD,
    ContactNetwork,
    contact_probabilities,
    contact_threshold,
)
from models.text2hoi.length import LENGTH, LengthModel
from models.text2hoi.sampler import NETWORKS, SamplingConfig, Text2Hoi

CONTACT_SAMPLES = 32


def diagnose(sources: Sources) -> Figures:
    """Contact F1 and length error on the test clips, by network, rounded to six digits."""
    train, validation, test = map(sources.clips, ("train", "validation", "test"))
    metrics = {
        "contact": contact_metrics(sources, train, validation, test),
        "length": length_metrics(sources, train, test),
    }
    return {name: {key: round(float(value), 6) for key, value in values.items()} for name, values in metrics.items()}


def contact_metrics(
    sources: Sources, train: list[ClipSample], held_out: list[ClipSample], test: list[ClipSample]
) -> dict[str, float]:
    """F1 of the mean of sampled contact maps, and of mean training maps as baselines.

    held_out: validation clips, on which the thresholds of baselines are chosen; ``DEFAULT_THRESHOLD`` without any.
    """
    checkpoint = load_checkpoint(sources.checkpoints / CONTACT.name, CONTACT, sources.device)
    assert isinstance(checkpoint.network, ContactNetwork)
    threshold = contact_threshold(checkpoint)
    f1 = mean_f1(contact_probabilities(checkpoint.network, test, CONTACT_SAMPLES, 0), true_maps(test), threshold)
    baselines = {}
    for kind in ("index", "position", "object"):
        chosen = DEFAULT_THRESHOLD
        if held_out:
            chosen = best_threshold(mean_maps(train, held_out, kind), true_maps(held_out))
        baselines[kind] = mean_f1(mean_maps(train, test, kind), true_maps(test), chosen)
    mean_map = max(baselines["index"], baselines["position"])
    return {
        "clips": len(test),
        "f1": f1,
        "f1_mean_map": mean_map,
        "f1_margin": f1 - mean_map,
        "f1_mean_map_by_index": baselines["index"],
        "f1_mean_map_by_position": baselines["position"],
        "f1_mean_map_of_same_object": baselines["object"],
        "threshold": threshold,
    }


def length_metrics(sources: Sources, train: list[ClipSample], test: list[ClipSample]) -> dict[str, float]:
    """Mean absolute error of the expected length, in frames; the baseline is the mean length of training clips."""
    network = load_checkpoint(sources.checkpoints / LENGTH.name, LENGTH).network
    assert isinstance(network, LengthModel)
    batch = collate(test)
    true = batch.lengths.numpy()
    verbs = [parsed_verb(sample.sentences[0], network.config.verbs) for sample in test]
    error = float(np.abs(network.expected_frames(batch.text[:, 0], verbs).numpy() - true).mean())
    baseline = float(np.abs(np.mean([sample.length for sample in train]) - true).mean())
    return {
        "clips": len(true),
        "mae_frames": error,
        "mae_mean_length_frames": baseline,
        "mae_ratio": error / max(baseline, 1e-9),
    }


ALL_NAMES = tuple(network.name for network in NETWORKS)
NAMES = ("contact", "diffusion", "refiner")  # networks that generate refined motions of a given length


def load_text2hoi(sources: Sources, **changes: Any) -> Text2Hoi:
    """The networks with the settings of ``sample.text2hoi``, except for ``changes``."""
    config = build_config(SamplingConfig, sources.settings.get("text2hoi"), "params.yaml: sample.text2hoi")
    config = replace(config, **changes)
    return Text2Hoi.load(sources.checkpoints, sources.hands, config, sources.device)


@dataclass(frozen=True)
class OtherPrompt(ReportsContact):
    """Text2HOI conditioned on another clip's sentence: a control for metrics that should depend on the sentence."""

    model: Text2Hoi
    other: dict[str, ClipSample]  # by clip id, the clip whose sentence to use; a clip that is absent is skipped

    def sample_with_targets(
        self, requests: Sequence[Request], contact_maps: Sequence[Tensor] | None = None
    ) -> tuple[list[Clip | Skipped], list[np.ndarray | None]]:
        """contact_maps: as in ``Text2Hoi.candidates``."""
        answers: list[Clip | Skipped] = [
            Skipped(request.motion_id, "all test clips have its sentence") for request in requests
        ]
        maps: list[np.ndarray | None] = [None] * len(requests)
        indices = [index for index, request in enumerate(requests) if request.clip_id in self.other]
        given_maps = None if contact_maps is None else [contact_maps[index] for index in indices]
        if indices:
            swapped = self.with_other_sentences([requests[index] for index in indices])
            motions = self.model.sample_with_targets(swapped, contact_maps=given_maps)
            for index, clip, contact_map in zip(indices, *motions, strict=True):
                answers[index], maps[index] = clip, contact_map
        return answers, maps

    def with_other_sentences(self, requests: Sequence[Request]) -> list[Request]:
        """The requests with the other clips' sentences."""
        others = [self.other[request.clip_id] for request in requests]
        return [
            replace(request, sentence=first_sentence(other), text=other.text[0])
            for request, other in zip(requests, others, strict=True)
        ]


def other_prompts(sources: Sources) -> dict[str, ClipSample]:
    """For every test clip, a random other one with another sentence; with another verb and object if possible.

    A clip is absent if all test clips have its sentence.
    """
    test = sources.clips("test")
    random, chosen = np.random.default_rng(0), {}
    for sample in test:
        other = [s for s in test if s.verb != sample.verb and s.object_key != sample.object_key]
        other = other or [s for s in test if s.sentences[0] != sample.sentences[0]]
        if not other:
            continue
        same_hand = [s for s in other if s.hand_type == sample.hand_type] or other
        chosen[sample.clip_id] = same_hand[int(random.integers(len(same_hand)))]
    return chosen


@dataclass(frozen=True)
class Estimated(ReportsContact):
    """Text2HOI with length and hand type estimated from the sentence, as in ``hoidata generate``.

    The sampler of ``Text2Hoi`` is given the recorded clip's; ``encoder`` is needed for the hand type.
    """

    model: Text2Hoi
    encoder: TextEncoder

    @classmethod
    def load(cls, sources: Sources) -> "Estimated":
        expected = sources.annotated.encoder_identity
        encoder = load_encoder(sources.encoder or str(expected["name"]))
        refuse_other_encoder(sources.annotated.root, expected, encoder.identity)
        return cls(load_text2hoi(sources), encoder)

    def sample_with_targets(self, requests: Sequence[Request]) -> tuple[list[Clip], list[np.ndarray]]:
        return self.model.sample_with_targets([self.estimated(request) for request in requests])

    def estimated(self, request: Request) -> Request:
        """The request with estimated hands and a sampled length."""
        assert request.sentence is not None
        hand = self.model.choose_hand(request.sentence.words, self.encoder).hand
        active_hands = np.array([hand in (side, "both") for side in SIDES])
        return replace(request, active_hands=active_hands, n_frames=self.model.sample_length(request))


def hand_type_accuracy(sources: Sources) -> Figures:
    """Fraction of test clips whose hand type is estimated correctly from their first sentence."""
    test, model = sources.clips("test"), Estimated.load(sources)
    correct = [model.model.choose_hand(clip.sentences[0], model.encoder).hand == clip.hand_type for clip in test]
    return {"hand_type": {"clips": len(test), "accuracy": round(float(np.mean(correct)), 6)}}


TEXT2HOI = Family("text2hoi", "Text2HOI", load_text2hoi, networks=NETWORKS, uses=ALL_NAMES, diagnose=diagnose)
COARSE, CONTACT_REFINED = (
    Family(name, title, partial(load_text2hoi, refine=refine), uses=("contact", "diffusion"))
    for name, title, refine in (
        ("text2hoi-coarse", "Text2HOI before its refiner", "none"),
        ("text2hoi-contact", "Text2HOI, contact refinement", "contact"),
    )
)
ESTIMATED = Family(
    "text2hoi-estimated",
    "Text2HOI, estimated length and hand type",
    Estimated.load,
    uses=ALL_NAMES,
    estimates_length=True,
    diagnose=hand_type_accuracy,
)
OTHER_PROMPT = Family(
    "other-prompt",
    "Text2HOI, another clip's prompt",
    lambda sources: OtherPrompt(load_text2hoi(sources), other_prompts(sources)),
    uses=NAMES,
)
