"""Whether the object of a motion moves as in training clips of the verb its sentence was read as.

A sampler draws from what it learnt, now and then a motion of another verb. What the object does is a few numbers
(``hoidata.actions``), and which verb's training clips do most alike, and within which bounds they do it, needs no test
clip and no judge: a motion that fails is drawn again.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.actions.action import Actions, action_numbers, training_actions
from hoidata.batches.requests import ObjectPoints, Request
from hoidata.clips.clip import SIDES, Clip
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import HandPair, track_joints
from models.common.checkpoints import Checkpoint
from models.common.corpus import Corpus
from models.common.vocabulary import Vocabulary
from models.text2hoi.verb_reading import readings_of

RECORD = "actions"  # its name among the results of a diffusion checkpoint


@dataclass(frozen=True)
class VerbCheck:
    """actions: of the training clips. threshold_m: how near a joint must come to touch. hands: of the clips."""

    trained: Checkpoint
    actions: Actions
    threshold_m: float
    hands: HandPair

    @classmethod
    def of(cls, trained: Checkpoint, hands: HandPair) -> "VerbCheck | None":
        """Of a diffusion checkpoint; None where it is told no verbs, or was written before they were kept."""
        record = trained.info.get("results", {}).get(RECORD)
        if record is None or not readings_of(trained.network):
            return None
        return cls(trained, Actions.read(record), trained.facts["contact_threshold_m"], hands)

    def numbers(self, clip: Clip, points: ObjectPoints) -> dict[str, float]:
        """What the object does in a clip (``hoidata.actions``)."""
        index, touching = ProximityIndex(points), np.zeros((len(SIDES), clip.n_frames), bool)
        for row, side in enumerate(SIDES):
            track = clip.hands[side]
            if track.valid.any():
                near = index.entries(track_joints(track, self.hands[side]), track.valid, clip.object, self.threshold_m)
                touching[row, near["frame"]] = True
        return action_numbers(clip.object, clip.gravity, touching)

    def moved_as(self, numbers: Mapping[str, float]) -> str | None:
        """The verb whose training clips move the object most alike; None where gravity is not known."""
        return self.actions.named(numbers)

    def asked(self, request: Request) -> str | None:
        """The verb that a sentence was read as; None where that is not known."""
        read = read_verb(self.trained, torch.from_numpy(request.text))
        return None if read is None else read[0]

    def unusual(self, asked: str | None, numbers: Mapping[str, float]) -> tuple[str, ...]:
        """Which numbers, in words, lie outside the bounds of the training clips of the verb asked for."""
        return () if asked is None else self.actions.unusual(asked, numbers)

    def fails(self, asked: str | None, moved_as: str | None) -> bool:
        """Whether a motion is of another verb than the one asked for; False where either is not known."""
        return not (asked is None or moved_as is None or asked not in self.actions.centroids or moved_as == asked)


def read_verb(trained: Checkpoint, text: Tensor) -> tuple[str, float] | None:
    """The likeliest verb of a sentence with features (512,), and how likely; None where a network is told no verbs."""
    readings = readings_of(trained.network)
    verbs = sorted(filter(None, Vocabulary.read(trained.facts).verbs))
    if not readings or not verbs:
        return None
    probability = readings[0].read(text[None].to(readings[0].mean.device))[0]
    return verbs[int(probability.argmax())], round(float(probability.max()), 3)


def action_results(network: nn.Module, corpus: Corpus) -> Mapping[str, Any]:
    """What a diffusion checkpoint keeps of its training clips' objects, where it is told verbs."""
    return {RECORD: training_actions(corpus.annotated).record} if readings_of(network) else {}
